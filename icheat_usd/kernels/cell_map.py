"""Gather cell of a hit by a table over the triangles: what a walk down the cluster tree finds, in a step or two.

Every side of every placed triangle is divided by a grid in its barycentric
coordinates. A square of the grid names the one sample that is nearest all
over it, or the few that are nearest somewhere in it; only among these are
distances compared, exactly as `nearest_sample` compares them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.locate import AGREE, nearest_sample

WALK = -(1 << 31)  # an entry without candidates: walk down the tree
NO_FACES = -(1 << 40)  # a placement without entries
BLOCK = 4  # squares along a side of a block, which shares one search for candidates
MOST = 12  # candidates of a square; more are looked up in the tree
_SEARCHED = 512  # candidates of a block
_TOGETHER = 32  # blocks that share buffers
_FINEST = 4096  # squares along an edge


class CellTable(NamedTuple):
    """Entries are a sample, or ``-1 - first`` of a list in `candidates`, or `WALK`."""

    place: NDArray[np.int64]  #: (n_instances,) added to a triangle's row gives its placed triangle; or `NO_FACES`
    #: (2 * n_placed, 4) of each side: entry, 0, 0, 0; or first square, squares along two edges, the corner of these
    face: NDArray[np.int32]
    square: NDArray[np.int32]  #: entries of the squares of divided sides, block by block of 4 by 4
    candidates: NDArray[np.int32]  #: lists: how many, then samples, ascending


# Below, no array is taken from a tuple and no row from an array in a loop over hits: each would count a reference,
# which made a look-up ten times as slow.


@kernel
def placed_triangle(points, to_world, i, t, k):  # type: ignore[no-untyped-def]
    """Corner k and the edges to the next two in world space, double precision."""
    m, n = (k + 1) % 3, (k + 2) % 3
    ax, ay, az = np.float64(points[t, k, 0]), np.float64(points[t, k, 1]), np.float64(points[t, k, 2])
    ex, ey, ez = points[t, m, 0] - ax, points[t, m, 1] - ay, points[t, m, 2] - az
    fx, fy, fz = points[t, n, 0] - ax, points[t, n, 1] - ay, points[t, n, 2] - az
    return (
        (
            to_world[i, 0, 0] * ax + to_world[i, 0, 1] * ay + to_world[i, 0, 2] * az + to_world[i, 0, 3],
            to_world[i, 1, 0] * ax + to_world[i, 1, 1] * ay + to_world[i, 1, 2] * az + to_world[i, 1, 3],
            to_world[i, 2, 0] * ax + to_world[i, 2, 1] * ay + to_world[i, 2, 2] * az + to_world[i, 2, 3],
        ),
        (
            to_world[i, 0, 0] * ex + to_world[i, 0, 1] * ey + to_world[i, 0, 2] * ez,
            to_world[i, 1, 0] * ex + to_world[i, 1, 1] * ey + to_world[i, 1, 2] * ez,
            to_world[i, 2, 0] * ex + to_world[i, 2, 1] * ey + to_world[i, 2, 2] * ez,
        ),
        (
            to_world[i, 0, 0] * fx + to_world[i, 0, 1] * fy + to_world[i, 0, 2] * fz,
            to_world[i, 1, 0] * fx + to_world[i, 1, 1] * fy + to_world[i, 1, 2] * fz,
            to_world[i, 2, 0] * fx + to_world[i, 2, 1] * fy + to_world[i, 2, 2] * fz,
        ),
    )


@kernel
def plane_of(points, to_object, i, t):  # type: ignore[no-untyped-def]
    """Normal of the front in world space, double precision, not normalised; zero of a degenerate triangle."""
    ax, ay, az = np.float64(points[t, 0, 0]), np.float64(points[t, 0, 1]), np.float64(points[t, 0, 2])
    ex, ey, ez = points[t, 1, 0] - ax, points[t, 1, 1] - ay, points[t, 1, 2] - az
    fx, fy, fz = points[t, 2, 0] - ax, points[t, 2, 1] - ay, points[t, 2, 2] - az
    gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    return (
        to_object[i, 0, 0] * gx + to_object[i, 1, 0] * gy + to_object[i, 2, 0] * gz,
        to_object[i, 0, 1] * gx + to_object[i, 1, 1] * gy + to_object[i, 2, 1] * gz,
        to_object[i, 0, 2] * gx + to_object[i, 1, 2] * gy + to_object[i, 2, 2] * gz,
    )


@kernel
def place_on(points, to_world, i, t, u, v):  # type: ignore[no-untyped-def]
    """Place on a triangle in world space, rounded once: a hit far from its ray's origin lies on its triangle."""
    b1, b2 = np.float64(u), np.float64(v)
    ax, ay, az = np.float64(points[t, 0, 0]), np.float64(points[t, 0, 1]), np.float64(points[t, 0, 2])
    ex, ey, ez = points[t, 1, 0] - ax, points[t, 1, 1] - ay, points[t, 1, 2] - az
    fx, fy, fz = points[t, 2, 0] - ax, points[t, 2, 1] - ay, points[t, 2, 2] - az
    x, y, z = ax + b1 * ex + b2 * fx, ay + b1 * ey + b2 * fy, az + b1 * ez + b2 * fz
    return (
        np.float32(to_world[i, 0, 0] * x + to_world[i, 0, 1] * y + to_world[i, 0, 2] * z + to_world[i, 0, 3]),
        np.float32(to_world[i, 1, 0] * x + to_world[i, 1, 1] * y + to_world[i, 1, 2] * z + to_world[i, 1, 3]),
        np.float32(to_world[i, 2, 0] * x + to_world[i, 2, 1] * y + to_world[i, 2, 2] * z + to_world[i, 2, 3]),
    )


@kernel
def side_seen(plane, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Side that a ray of direction ``(dx, dy, dz)`` meets; 1 is the back."""
    return np.int64(1) if plane[0] * dx + plane[1] * dy + plane[2] * dz > 0.0 else np.int64(0)


@kernel
def unit_normal(plane, side):  # type: ignore[no-untyped-def]
    """Normal of a side from that of the plane."""
    scale = 1.0 / np.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2])
    if side == 1:
        scale = -scale
    return np.float32(plane[0] * scale), np.float32(plane[1] * scale), np.float32(plane[2] * scale)


@kernel
def square_at(face, f, u, v):  # type: ignore[no-untyped-def]
    """Number of the square of a place on side `f` of the placed triangles; -1 for a side that is not divided."""
    along_u, along_v = np.int64(face[f, 1]), np.int64(face[f, 2])
    if along_u == 0:
        return np.int64(-1)
    if face[f, 3] != 0:
        w = np.float32(1.0) - u - v
        u, v = (v, w) if face[f, 3] == 1 else (w, u)
    a = min(max(np.int64(u * np.float32(along_u)), 0), along_u - 1)
    b = min(max(np.int64(v * np.float32(along_v)), 0), along_v - 1)
    block = (b >> 2) * ((along_u + 3) >> 2) + (a >> 2)  # a block of 4 by 4 entries is a line of the cache
    return np.int64(face[f, 0]) + (block << 4) + ((b & 3) << 2) + (a & 3)


@kernel
def entry_at(place, face, square, i, t, side, u, v):  # type: ignore[no-untyped-def]
    """Entry of a place on a triangle."""
    if place[i] == NO_FACES:
        return np.int64(WALK)
    f = 2 * (place[i] + t) + side
    at = square_at(face, f, u, v)
    return np.int64(face[f, 0]) if at < 0 else np.int64(square[at])


@kernel
def nearest_listed(candidates, sample, entry, detour, x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """The nearest of the samples that an entry lists, as `nearest_sample` measures it."""
    begin = -entry
    best = np.int64(candidates[begin])
    best_distance = np.float32(np.inf)
    for e in range(begin, begin + candidates[begin - 1]):
        j = np.int64(candidates[e])
        ex, ey, ez = sample[j, 0] - x, sample[j, 1] - y, sample[j, 2] - z
        d = ex * ex + ey * ey + ez * ez
        if d < best_distance:
            if sample[j, 3] * nx + sample[j, 4] * ny + sample[j, 5] * nz <= AGREE:
                d += detour
            if d < best_distance:
                best_distance = d
                best = j
    return best


@parallel_kernel
def divide_faces(points, to_world, locator, spacing, fineness, placed_instance, place, out):  # type: ignore[no-untyped-def]
    """Squares along two edges of every side of the placed triangles, and the corner where these meet.

    That is the one with the shortest edges: squares at the tip of a sliver are slivers, too. There are 0 where a side
    has one sample.

    Parameters
    ----------
    points : (n_triangles, 3, 3) float32, object space
    to_world : (n_instances, 3, 4) float32
    spacing : (n_slots,)
        Mean distance of samples, metres.
    fineness : float
        Size of a square in these.
    placed_instance : (n_placed,)
        Instance of each placed triangle.
    place : (n_instances,) int64, see `CellTable`
    out : (2 n_placed, 3) int32
        Row 2 p + side.
    """
    for p in prange(len(placed_instance)):
        i = placed_instance[p]
        _, e, f = placed_triangle(points, to_world, i, p - place[i], 0)
        e2 = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
        f2 = f[0] * f[0] + f[1] * f[1] + f[2] * f[2]
        ef = e[0] * f[0] + e[1] * f[1] + e[2] * f[2]
        area = np.sqrt(max(0.0, e2 * f2 - ef * ef))
        g2 = max(0.0, e2 + f2 - 2.0 * ef)  # between the other two corners
        corner = 0  # across from the longest edge
        if f2 > g2 and f2 >= e2:
            corner, e2, f2 = 1, g2, e2
        elif e2 > g2:
            corner, e2, f2 = 2, f2, g2
        for side in range(2):
            slot = locator.slot[2 * i + side]
            out[2 * p + side, 0] = 0
            out[2 * p + side, 1] = 0
            out[2 * p + side, 2] = corner
            if locator.slot_begin[slot + 1] - locator.slot_begin[slot] == 1:
                continue
            size = fineness * spacing[slot]
            along_u, along_v = max(1.0, np.sqrt(e2) / size), max(1.0, np.sqrt(f2) / size)
            # Slivers: long edges, but few samples.
            limit = 4.0 + 4.0 * area / (size * size)
            if not along_u * along_v <= limit:
                shrink = np.sqrt(limit / (along_u * along_v))
                shorter = max(1.0, shrink * min(along_u, along_v))
                longer = limit / shorter
                along_u, along_v = (shorter, longer) if along_u < along_v else (longer, shorter)
            out[2 * p + side, 0] = np.int32(min(max(np.ceil(along_u), 1.0), _FINEST))
            out[2 * p + side, 1] = np.int32(min(max(np.ceil(along_v), 1.0), _FINEST))


@kernel
def _within(record, sample, begin, end, root, c, n, detour, radius, reach2, stack, found):  # type: ignore[no-untyped-def]
    """Samples that may be nearest to a place no further than `radius` from `c`; their number, or -1 for too many."""
    count = 0
    reach = np.sqrt(reach2) + radius  # of the distance from `c`
    stack[0, 0], stack[0, 1] = (root, 0) if root >= 0 else (-1 - begin, end - begin)
    depth = 1
    while depth > 0:
        depth -= 1
        what, number = stack[depth, 0], stack[depth, 1]
        if what >= 0:
            for first in (8, 0):
                d2 = 0.0
                for a in range(3):
                    low, high = record[what, first + a] - c[a], c[a] - record[what, first + 3 + a]
                    d2 += max(low, high, 0.0) ** 2
                if d2 <= reach * reach:
                    stack[depth, 0], stack[depth, 1] = record[what, first + 6], record[what, first + 7]
                    depth += 1
            continue
        for j in range(-1 - what, -1 - what + number):
            d2 = 0.0
            for a in range(3):
                d2 += (sample[j, a] - c[a]) ** 2
            if d2 > reach * reach:
                continue
            if sample[j, 3] * n[0] + sample[j, 4] * n[1] + sample[j, 5] * n[2] <= AGREE:
                if max(0.0, np.sqrt(d2) - radius) ** 2 + detour > reach2:
                    continue
            if count == len(found):
                return -1
            found[count] = j
            count += 1
    return count


@kernel
def _nearest_somewhere(g, n, slack, kept):  # type: ignore[no-untyped-def]
    """Which of n samples no other one beats at all four corners of a convex region; `kept` has room for two sets.

    `g` (4, n) are squared distances, less a function of the place that all
    samples share. Differences of them are linear in the place, so the corners decide.
    """
    best, least = 0, np.inf
    for j in range(n):
        largest = max(max(g[0, j], g[1, j]), max(g[2, j], g[3, j]))
        if largest < least:
            best, least = j, largest
    limit_0, limit_1, limit_2, limit_3 = g[0, best] + slack, g[1, best] + slack, g[2, best] + slack, g[3, best] + slack
    count = 0
    for j in range(n):
        if (g[0, j] <= limit_0) | (g[1, j] <= limit_1) | (g[2, j] <= limit_2) | (g[3, j] <= limit_3):
            kept[count] = j
            count += 1
    if count == 1:
        return count
    left = 0
    for a in range(count):
        j = kept[a]
        beaten = False
        for b in range(count):
            k = kept[b]
            beaten |= (
                (g[0, j] > g[0, k] + slack)
                & (g[1, j] > g[1, k] + slack)
                & (g[2, j] > g[2, k] + slack)
                & (g[3, j] > g[3, k] + slack)
            )
        if not beaten:
            # Entries before `a` are still compared against, so what is left goes behind them.
            kept[count + left] = j
            left += 1
    for a in range(left):
        kept[a] = kept[count + a]
    return left


@kernel
def _at_corners(term, n, u0, u1, v0, v1, whole, g):  # type: ignore[no-untyped-def]
    """``term[0] + u term[1] + v term[2]`` of n samples at the corners of a rectangle in (u, v), or of a triangle."""
    for j in range(n):
        at = term[0, j] + u0 * term[1, j] + v0 * term[2, j]
        along_u, along_v = (u1 - u0) * term[1, j], (v1 - v0) * term[2, j]
        g[0, j] = at
        g[1, j] = at + along_u
        g[2, j] = at + along_v
        g[3, j] = at if whole else at + along_u + along_v


@parallel_kernel
def find_candidates(  # type: ignore[no-untyped-def]
    points, to_world, to_object, locator, depth, placed_instance, place, divided, block_face, block_number, count, found
):
    """Candidates of the squares of some blocks: `count` (n, 16), -1 for too many, and `found` (n, 16, MOST).

    Block ``block_number[b]``, row by row, of side ``block_face[b]``, both (n,) integers. `points` to `place` as for
    `divide_faces`, with `to_object` (n_instances, 3, 4) float32, the locator's `depth`, and `divided` its result;
    `count` and `found` are int32.
    """
    record, sample = locator.record, locator.sample
    slots, slot_begin, slot_record, slot_detour = (
        locator.slot,
        locator.slot_begin,
        locator.slot_record,
        locator.slot_detour,
    )
    n_blocks = len(block_face)
    for chunk in prange((n_blocks + _TOGETHER - 1) // _TOGETHER):
        stack = np.empty((2 * depth + 2, 2), np.int64)
        bound = np.empty(depth + 1, np.float32)
        near = np.empty(_SEARCHED, np.int64)
        kept = np.empty(2 * _SEARCHED, np.int64)
        term = np.empty((3, _SEARCHED), np.float64)
        g = np.empty((4, _SEARCHED), np.float64)
        for b in range(chunk * _TOGETHER, min(n_blocks, (chunk + 1) * _TOGETHER)):
            side = block_face[b] % 2
            p = block_face[b] // 2
            i = placed_instance[p]
            t = p - place[i]
            for q in range(BLOCK * BLOCK):
                count[b, q] = -1
            slot = slots[2 * i + side]
            begin, end = slot_begin[slot], slot_begin[slot + 1]
            if end - begin == 1:
                count[b, 0] = 1
                found[b, 0, 0] = begin
                continue
            plane = plane_of(points, to_object, i, t)
            if not plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2] > 0.0:
                continue
            along_u, along_v = np.int64(divided[block_face[b], 0]), np.int64(divided[block_face[b], 1])
            blocks_u = (along_u + BLOCK - 1) // BLOCK
            first_u, first_v = BLOCK * (block_number[b] % blocks_u), BLOCK * (block_number[b] // blocks_u)
            last_u, last_v = min(first_u + BLOCK, along_u), min(first_v + BLOCK, along_v)
            if first_u / along_u + first_v / along_v > 1.0 + 1e-3:
                continue
            n = unit_normal(plane, side)
            corner, e, f = placed_triangle(points, to_world, i, t, divided[block_face[b], 2])
            whole = along_u == 1 and along_v == 1
            # A little larger than the block: rounding may put a place on its border into its neighbour.
            grow = 1e-3
            u0, u1 = (first_u - grow) / along_u, (last_u + grow) / along_u
            v0, v1 = (first_v - grow) / along_v, (last_v + grow) / along_v
            if whole:  # the corner between the other two, further out
                u1, v1 = 1.0 + 2 * grow, 1.0 + 2 * grow

            # The ball around the block, and the samples that can be nearest in it.
            um, vm = 0.5 * (u0 + u1), 0.5 * (v0 + v1)
            if whole:
                um, vm = 1.0 / 3.0, 1.0 / 3.0
            c = (
                corner[0] + um * e[0] + vm * f[0],
                corner[1] + um * e[1] + vm * f[1],
                corner[2] + um * e[2] + vm * f[2],
            )
            radius2 = 0.0
            for k in range(3 if whole else 4):
                du = (u1 if k % 2 == 1 else u0) - um
                dv = (v1 if k // 2 == 1 else v0) - vm
                x, y, z = du * e[0] + dv * f[0], du * e[1] + dv * f[1], du * e[2] + dv * f[2]
                radius2 = max(radius2, x * x + y * y + z * z)
            radius = 1.01 * np.sqrt(radius2)
            detour = np.float64(slot_detour[slot])
            j = nearest_sample(
                locator, i, side, np.float32(c[0]), np.float32(c[1]), np.float32(c[2]), n[0], n[1], n[2], stack, bound
            )
            d2 = 0.0
            largest = 0.0  # coordinate, which the rounding of a place is relative to
            for a in range(3):
                d2 += (sample[j, a] - c[a]) ** 2
                largest = max(largest, abs(sample[j, a]) + radius)
            rounding = largest * 2.0**-22
            reach2 = (np.sqrt(d2) + radius + rounding) ** 2
            if sample[j, 3] * n[0] + sample[j, 4] * n[1] + sample[j, 5] * n[2] <= AGREE:
                reach2 += detour
            root = np.int64(slot_record[slot])
            number = _within(
                record, sample, begin, end, root, c, n, detour, radius + rounding, 1.0001 * reach2, stack, near
            )
            if number < 0:
                continue
            for a in range(1, number):  # ascending, as lists are
                j = near[a]
                k = a
                while k > 0 and near[k - 1] > j:
                    near[k] = near[k - 1]
                    k -= 1
                near[k] = j

            # Squared distances along the triangle, about the middle of the ball: a term that all samples share,
            # and one that is linear in the place. The whole block first: who loses all over it needs no square.
            for step in range(2):
                far = 0.0
                for a in range(number):
                    j = near[a]
                    x, y, z = sample[j, 0] - c[0], sample[j, 1] - c[1], sample[j, 2] - c[2]
                    along_e, along_f = x * e[0] + y * e[1] + z * e[2], x * f[0] + y * f[1] + z * f[2]
                    d2 = x * x + y * y + z * z
                    if sample[j, 3] * n[0] + sample[j, 4] * n[1] + sample[j, 5] * n[2] <= AGREE:
                        d2 += detour
                    far = max(far, np.sqrt(d2))
                    term[0, a] = d2 + 2.0 * (um * along_e + vm * along_f)
                    term[1, a] = -2.0 * along_e
                    term[2, a] = -2.0 * along_f
                far += radius
                slack = 1e-5 * far * far + 4.0 * rounding * far
                if step == 0:
                    _at_corners(term, number, u0, u1, v0, v1, whole, g)
                    number = _nearest_somewhere(g, number, slack, kept)
                    for a in range(number):
                        near[a] = near[kept[a]]
            for b_v in range(first_v, last_v):
                for b_u in range(first_u, last_u):
                    if b_u / along_u + b_v / along_v > 1.0 + 3 * grow:
                        continue
                    left = number
                    if number > 1 and not whole:
                        lowest_u, highest_u = (b_u - grow) / along_u, (b_u + 1 + grow) / along_u
                        lowest_v, highest_v = (b_v - grow) / along_v, (b_v + 1 + grow) / along_v
                        _at_corners(term, number, lowest_u, highest_u, lowest_v, highest_v, False, g)
                        left = _nearest_somewhere(g, number, slack, kept)
                    q = (b_v - first_v) * BLOCK + b_u - first_u
                    if left > MOST:
                        continue
                    count[b, q] = left
                    for a in range(left):
                        found[b, q, a] = near[a] if left == number else near[kept[a]]


@parallel_kernel
def store_entries(  # type: ignore[no-untyped-def]
    divided, square_begin, block_face, block_number, count, found, list_begin, stored, face, square, candidates
):
    """Entries of the squares of some blocks; `candidates` are theirs, behind `stored` ones of other blocks."""
    for b in prange(len(block_face)):
        side = block_face[b]
        along_u, along_v = divided[side, 0], divided[side, 1]
        blocks_u = max(1, (along_u + BLOCK - 1) // BLOCK)
        first_u, first_v = BLOCK * (block_number[b] % blocks_u), BLOCK * (block_number[b] // blocks_u)
        for q in range(BLOCK * BLOCK):
            u, v = first_u + q % BLOCK, first_v + q // BLOCK
            if q > 0 and (u >= along_u or v >= along_v):
                continue
            entry = np.int64(WALK)
            if count[b, q] == 1:
                entry = np.int64(found[b, q, 0])
            elif count[b, q] > 1:
                entry = -1 - (stored + list_begin[b, q])
                candidates[list_begin[b, q]] = count[b, q]
                for a in range(count[b, q]):
                    candidates[list_begin[b, q] + 1 + a] = found[b, q, a]
            if along_u * along_v > 1:
                square[square_begin[side] + BLOCK * BLOCK * block_number[b] + q] = entry
            else:
                face[side, 0] = entry
