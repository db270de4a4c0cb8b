"""Where sampled rows stand on a scene: places on faces, and the nearest of them."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

NEIGHBOURS = 4  # rows that a mixture has
_SAME = 0.8  # cosine of normals that belong together,
_OTHER = 0.5  # and of normals that do not
_BLOCK = 1024


@parallel_kernel
def triangles_of_places(corner_uv, first, begin, order, face, uv, out_triangle, out_weight):  # type: ignore[no-untyped-def]
    """Triangle and barycentric weights (corners 1, 2) of places on control faces; triangle -1 where a face has none.

    ``order[begin[f]:begin[f + 1]]`` are the triangles of face f, counted from `first`. A place that lies in
    none of them goes to the one that it misses least.
    """
    for q in prange(len(face)):
        out_triangle[q] = -1
        out_weight[q, 0] = 0.0
        out_weight[q, 1] = 0.0
        best = -np.inf
        f = face[q]
        if f < 0 or f >= len(begin) - 1:
            continue
        for e in range(begin[f], begin[f + 1]):
            t = first + order[e]
            ax, ay = np.float64(corner_uv[t, 0, 0]), np.float64(corner_uv[t, 0, 1])
            bx, by = corner_uv[t, 1, 0] - ax, corner_uv[t, 1, 1] - ay
            cx, cy = corner_uv[t, 2, 0] - ax, corner_uv[t, 2, 1] - ay
            area = bx * cy - by * cx
            if area == 0.0:
                u, v, inside = 1.0 / 3.0, 1.0 / 3.0, -1e9
            else:
                px, py = uv[q, 0] - ax, uv[q, 1] - ay
                u = (px * cy - py * cx) / area
                v = (bx * py - by * px) / area
                inside = min(min(u, v), 1.0 - u - v)
            if inside > best:
                best = inside
                u, v = max(u, 0.0), max(v, 0.0)
                total = max(u + v, 1.0)
                out_triangle[q] = t
                out_weight[q, 0] = u / total
                out_weight[q, 1] = v / total


@kernel
def _closest(a, b, c, p, out):  # type: ignore[no-untyped-def]
    """Weights of corners b and c of the point closest to p (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = np.dot(ab, ap), np.dot(ac, ap)
    out[0], out[1] = 0.0, 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        return
    bp = p - b
    d3, d4 = np.dot(ab, bp), np.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        out[0] = 1.0
        return
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and d1 != d3:
        out[0] = d1 / (d1 - d3)
        return
    cp = p - c
    d5, d6 = np.dot(ab, cp), np.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        out[1] = 1.0
        return
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0 and d2 != d6:
        out[1] = d2 / (d2 - d6)
        return
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0 and (d4 - d3) + (d5 - d6) != 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        out[0], out[1] = 1.0 - w, w
        return
    total = va + vb + vc
    if total != 0.0:
        out[0], out[1] = vb / total, vc / total


@parallel_kernel
def nearest_on_triangles(points, position, out_triangle, out_weight):  # type: ignore[no-untyped-def]
    """Nearest place on triangles (n, 3, 3) of each position, by trying all of them."""
    for q in prange(len(position)):
        weight = np.empty(2, np.float64)
        best = np.inf
        p = position[q].astype(np.float64)
        for t in range(len(points)):
            a = points[t, 0].astype(np.float64)
            b = points[t, 1].astype(np.float64)
            c = points[t, 2].astype(np.float64)
            _closest(a, b, c, p, weight)
            gap = a + weight[0] * (b - a) + weight[1] * (c - a) - p
            d = np.dot(gap, gap)
            if d < best:
                best = d
                out_triangle[q] = t
                out_weight[q, 0] = weight[0]
                out_weight[q, 1] = weight[1]


@kernel
def build_search(key, begin, order, axis):  # type: ignore[no-untyped-def]
    """Sort the points of every group ``begin[g]:begin[g + 1]`` into a balanced k-d tree.

    The middle point of a range is its node and divides the others along
    ``axis`` of that place. `key` (n, d) comes back in tree order, `order` as
    the points' numbers before.
    """
    stack = np.empty((128, 2), np.int64)
    for g in range(len(begin) - 1):
        stack[0, 0], stack[0, 1] = begin[g], begin[g + 1]
        top = 1
        while top > 0:
            top -= 1
            lo, hi = stack[top, 0], stack[top, 1]
            if hi - lo < 2:
                continue
            widest, extent = 0, -1.0
            for c in range(key.shape[1]):
                spread = key[lo:hi, c].max() - key[lo:hi, c].min()
                if spread > extent:
                    widest, extent = c, spread
            place = np.argsort(key[lo:hi, widest], kind="mergesort")
            key[lo:hi] = key[lo:hi][place]
            order[lo:hi] = order[lo:hi][place]
            middle = (lo + hi) // 2
            axis[middle] = widest
            stack[top, 0], stack[top, 1] = lo, middle
            stack[top + 1, 0], stack[top + 1, 1] = middle + 1, hi
            top += 2


@kernel
def _neighbours(key, axis, lo, hi, place, within, stack, bound, near, distance):  # type: ignore[no-untyped-def]
    """The nearest points of a range, at most ``len(near)``, nearest first; returns how many.

    That many are known to lie no further than the square root of `within`, which saves looking elsewhere.
    """
    found, top = 0, 1
    stack[0, 0], stack[0, 1], bound[0] = lo, hi, 0.0
    limit = len(near)
    while top > 0:
        top -= 1
        lo, hi = stack[top, 0], stack[top, 1]
        if hi <= lo or bound[top] > within or (found == limit and bound[top] > distance[limit - 1]):
            continue
        middle = (lo + hi) // 2
        d = 0.0
        for c in range(key.shape[1]):
            d += (key[middle, c] - place[c]) ** 2
        if found < limit or d < distance[limit - 1] or (d == distance[limit - 1] and middle < near[limit - 1]):
            slot = found if found < limit else limit - 1
            while slot > 0 and (d < distance[slot - 1] or (d == distance[slot - 1] and middle < near[slot - 1])):
                distance[slot] = distance[slot - 1]
                near[slot] = near[slot - 1]
                slot -= 1
            distance[slot] = d
            near[slot] = middle
            found = min(found + 1, limit)
        if hi - lo == 1:
            continue
        gap = place[axis[middle]] - key[middle, axis[middle]]
        far_lo, far_hi, near_lo, near_hi = middle + 1, hi, lo, middle
        if gap > 0:
            far_lo, far_hi, near_lo, near_hi = lo, middle, middle + 1, hi
        stack[top, 0], stack[top, 1], bound[top] = far_lo, far_hi, gap * gap
        stack[top + 1, 0], stack[top + 1, 1], bound[top + 1] = near_lo, near_hi, 0.0
        top += 2
    return found


@kernel
def _furthest(key, near, place):  # type: ignore[no-untyped-def]
    """Square of the largest distance of some points."""
    largest = 0.0
    for slot in range(len(near)):
        d = 0.0
        for c in range(key.shape[1]):
            d += (key[near[slot], c] - place[c]) ** 2
        largest = max(largest, d)
    return largest


@parallel_kernel
def mixtures(  # type: ignore[no-untyped-def]
    key,
    axis,
    begin,
    normal,
    reach,
    row,
    turn,
    group,
    position,
    place_normal,
    out_row,
    out_weight,
    out_confidence,
    out_nearest,
):
    """Rows and weights for n places; group -1, or one without points, gives none.

    Keys are of the position and of the normal times the `turn` (n_groups,) of the group.
    Weights are those of Franke and Little: they fall to 0 at the distance of
    the fifth neighbour, so that nothing jumps where neighbours change. They
    sum to the confidence: 1 within the neighbours' `reach`, 0 from twice that
    on, and 0 where no neighbour's normal agrees. `out_nearest` is the nearest
    point and its distance.
    """
    n = len(group)
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        stack = np.empty((128, 2), np.int64)
        bound = np.empty(128, np.float64)
        near = np.empty(NEIGHBOURS + 1, np.int64)
        distance = np.empty(NEIGHBOURS + 1, np.float64)
        share = np.empty(NEIGHBOURS, np.float64)
        mixed = np.empty(NEIGHBOURS, np.float64)
        place = np.empty(6, np.float64)
        last, found = np.int64(-1), np.int64(0)
        for q in range(block * _BLOCK, min(n, (block + 1) * _BLOCK)):
            out_confidence[q] = 0.0
            out_nearest[q, 0] = -1.0
            out_nearest[q, 1] = np.inf
            for s in range(NEIGHBOURS):
                out_row[q, s] = -1
                out_weight[q, s] = 0.0
            g = group[q]
            if g < 0 or begin[g] == begin[g + 1]:
                continue
            for c in range(3):
                place[c], place[3 + c] = position[q, c], turn[g] * place_normal[q, c]
            # Places come in the order of pixels: the neighbours of the last one are near this one, too.
            within = np.inf
            if g == last and found > NEIGHBOURS:
                within = _furthest(key, near, place)
            found = _neighbours(key, axis, begin[g], begin[g + 1], place, within, stack, bound, near, distance)
            last = g
            used = min(found, NEIGHBOURS)
            for s in range(found):
                distance[s] = np.sqrt(distance[s])
            border = distance[NEIGHBOURS] if found > NEIGHBOURS else 2.0 * max(distance[used - 1], reach[near[0]])
            total, agreeing, mean_reach = 0.0, 0.0, 0.0
            smallest = 1e-7 * border
            for s in range(used):
                w = 1.0
                if border > 0.0:
                    d = max(distance[s], smallest)
                    w = (max(border - d, 0.0) / d) ** 2
                share[s] = w
                total += w
            if total == 0.0:
                # Five neighbours at the same distance.
                for s in range(used):
                    share[s] = 1.0
                total = used * 1.0
            for s in range(used):
                cosine = 0.0
                for c in range(3):
                    cosine += place_normal[q, c] * normal[near[s], c]
                t = min(max((cosine - _OTHER) / (_SAME - _OTHER), 0.0), 1.0)
                mean_reach += share[s] / total * reach[near[s]]
                share[s] *= t * t * (3.0 - 2.0 * t)
                agreeing += share[s]
            out_nearest[q, 0] = near[0]
            out_nearest[q, 1] = distance[0]
            if agreeing == 0.0 or mean_reach == 0.0:
                continue
            fade = min(max(2.0 - distance[0] / mean_reach, 0.0), 1.0)
            fade = fade * fade * (3.0 - 2.0 * fade) * min(2.0 * agreeing / total, 1.0)
            out_confidence[q] = fade
            # Neighbours of one row count as one, the identity as none: then places with the same mixture look the same.
            n_rows = 0
            for s in range(used):
                here = row[near[s]]
                if here < 0 or share[s] == 0.0:
                    continue
                slot = 0
                while slot < n_rows and out_row[q, slot] != here:
                    slot += 1
                if slot == n_rows:
                    out_row[q, slot] = here
                    mixed[slot] = 0.0
                    n_rows += 1
                mixed[slot] += share[s]
            for slot in range(n_rows):
                # Rounding of sums must not tell places apart.
                part = mixed[slot] / agreeing
                out_weight[q, slot] = fade * (1.0 if part > 1.0 - 1e-6 else part)
