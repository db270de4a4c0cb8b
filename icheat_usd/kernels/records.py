"""An adaptive quadtree over the image, and interpolation between the records at its corners.

`level` holds, for each pixel, log2 of the side of the block that it lies in;
blocks stand on multiples of their side. Their corners are pixels, at the
right and lower border of the image the last ones.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

MAX_ENTRIES = 8  # of one sample: six in a block (four corners, two nodes on its edges), or with strangers nearby
_NODES = 6
_NEAREST = 4  # records that are mixed by distance
_RINGS = 3  # of buckets around a sample's own, where they are looked for

# Two places share a sheet fully down to the first cosine between their normals, and not at all below the second.
_SAME_TURN = np.float32(0.85)
_OTHER_TURN = np.float32(0.6)
# The same for the distance to each other's tangent plane, as a share of their distance on the surface and in the image.
_SAME_PLANE = np.float32(0.15)
_OTHER_PLANE = np.float32(0.3)
_FAR_CORNER = np.float32(4.0)  # pixels from which a surface at an angle does not matter
_OTHER_CORNER = np.float32(0.05)  # least share of a record on the sheet that is nearer to or further from a corner
_OTHER_INSTANCE = np.float32(1.5)  # factor of the distance to records on other objects: those of one's own come first


@kernel
def balance(level):  # type: ignore[no-untyped-def]
    """Divide blocks until none is more than twice as wide as one beside it."""
    height, width = level.shape
    finest = 0
    changed = True
    while changed:
        changed = False
        for y in range(height):
            for x in range(width):
                own = level[y, x]
                if own < finest + 2:
                    continue
                side = 1 << own
                x0, y0 = x & ~(side - 1), y & ~(side - 1)
                if x != x0 or y != y0:
                    continue
                least = own
                for k in range(side):
                    if x0 + k < width:
                        if y0 > 0:
                            least = min(least, level[y0 - 1, x0 + k])
                        if y0 + side < height:
                            least = min(least, level[y0 + side, x0 + k])
                    if y0 + k < height:
                        if x0 > 0:
                            least = min(least, level[y0 + k, x0 - 1])
                        if x0 + side < width:
                            least = min(least, level[y0 + k, x0 + side])
                if least < own - 1:
                    changed = True
                    for v in range(y0, min(height, y0 + side)):
                        for u in range(x0, min(width, x0 + side)):
                            level[v, u] = own - 1


@kernel
def mark_corners(level, corner):  # type: ignore[no-untyped-def]
    """Set `corner` (height, width) to 1 at the corners of all blocks; a block of one pixel has only that one."""
    height, width = level.shape
    corner[:] = 0
    for y in range(height):
        for x in range(width):
            side = 1 << level[y, x]
            if x & (side - 1) or y & (side - 1):
                continue
            corner[y, x] = 1
            if side > 1:
                x1, y1 = min(x + side, width - 1), min(y + side, height - 1)
                corner[y, x1] = 1
                corner[y1, x] = 1
                corner[y1, x1] = 1


@kernel
def _line_nodes(corner, fixed, vertical, place, begin, end, middle, node, weight):  # type: ignore[no-untyped-def]
    """Nodes (y, x) and weights of a place on an edge of blocks that may have a node in its middle."""
    if begin < middle < end:
        there = corner[middle, fixed] if vertical else corner[fixed, middle]
        if there:
            if place < middle:
                end = middle
            else:
                begin = middle
    share = np.float32(0.0) if end == begin else np.float32(place - begin) / np.float32(end - begin)
    for k in range(2):
        along = begin if k == 0 else end
        node[k, 0] = along if vertical else fixed
        node[k, 1] = fixed if vertical else along
    weight[0] = np.float32(1.0) - share
    weight[1] = share
    return 2


@kernel
def block_nodes(corner, level, x, y, node, weight):  # type: ignore[no-untyped-def]
    """Nodes (y, x) around a pixel in its block and weights that reproduce what is linear in the image; their number.

    Bilinear between four corners; where a neighbour has a node on the edge
    between, the block is a fan of triangles about its middle, which is the
    mean of the corners, so that both sides of the edge agree.
    """
    height, width = level.shape
    side = 1 << level[y, x]
    x0, y0 = x & ~(side - 1), y & ~(side - 1)
    if side == 1:
        node[0, 0], node[0, 1], weight[0] = y, x, np.float32(1.0)
        return 1
    x1, y1 = min(x0 + side, width - 1), min(y0 + side, height - 1)
    xm, ym = x0 + side // 2, y0 + side // 2
    if x0 == x1 or y == y0:
        if x0 == x1:
            return _line_nodes(corner, x0, True, y, y0, y1, ym, node, weight)
        return _line_nodes(corner, y0, False, x, x0, x1, xm, node, weight)
    if y0 == y1 or x == x0:
        if y0 == y1:
            return _line_nodes(corner, y0, False, x, x0, x1, xm, node, weight)
        return _line_nodes(corner, x0, True, y, y0, y1, ym, node, weight)
    # Corners clockwise from the upper left, and the middles of the edges after each.
    node[0, 0], node[0, 1] = y0, x0
    node[1, 0], node[1, 1] = y0, x1
    node[2, 0], node[2, 1] = y1, x1
    node[3, 0], node[3, 1] = y1, x0
    fx, fy = np.float32(x - x0) / np.float32(x1 - x0), np.float32(y - y0) / np.float32(y1 - y0)
    one = np.float32(1.0)
    weight[0], weight[1] = (one - fx) * (one - fy), fx * (one - fy)
    weight[2], weight[3] = fx * fy, (one - fx) * fy
    has_top = xm < x1 and corner[y0, xm]
    has_bottom = xm < x1 and corner[y1, xm]
    has_left = ym < y1 and corner[ym, x0]
    has_right = ym < y1 and corner[ym, x1]
    if not (has_top or has_right or has_bottom or has_left):
        return 4
    # Which edge the ray from the middle through the pixel meets: the coordinates about the middle, in half sides.
    cx, cy = np.float32(2.0) * fx - one, np.float32(2.0) * fy - one
    if abs(cx) >= abs(cy):
        edge = 1 if cx > 0 else 3
        out, along = abs(cx), cy if cx > 0 else -cy
    else:
        edge = 2 if cy > 0 else 0
        out, along = abs(cy), -cx if cy > 0 else cx
    share_middle = (one - out) * np.float32(0.25)
    for k in range(4):
        weight[k] = share_middle
    if out <= np.float32(0.0):
        return 4
    place = np.float32(0.5) + np.float32(0.5) * along / out  # on the edge, clockwise from 0 to 1
    first, last = edge, (edge + 1) % 4
    if edge == 0:
        hanging, hy, hx, middle = has_top, y0, xm, np.float32(xm - x0) / np.float32(x1 - x0)
    elif edge == 1:
        hanging, hy, hx, middle = has_right, ym, x1, np.float32(ym - y0) / np.float32(y1 - y0)
    elif edge == 2:
        hanging, hy, hx, middle = has_bottom, y1, xm, np.float32(x1 - xm) / np.float32(x1 - x0)
    else:
        hanging, hy, hx, middle = has_left, ym, x0, np.float32(y1 - ym) / np.float32(y1 - y0)
    if not hanging:
        weight[first] += out * (one - place)
        weight[last] += out * place
        return 4
    node[4, 0], node[4, 1] = hy, hx
    if place < middle:
        share = place / middle
        weight[first] += out * (one - share)
        weight[4] = out * share
    else:
        share = (place - middle) / (one - middle)
        weight[4] = out * (one - share)
        weight[last] += out * share
    return 5


@kernel
def _falling(value, full, none):  # type: ignore[no-untyped-def]
    """1 up to `full`, 0 from `none` on, smooth between."""
    t = min(max((none - value) / (none - full), np.float32(0.0)), np.float32(1.0))
    return t * t * (np.float32(3.0) - np.float32(2.0) * t)


@parallel_kernel
def corner_distance(first, position, normal, extent, pixel, out):  # type: ignore[no-untyped-def]
    """Distance of view samples to the surfaces that rise from theirs nearby, in pixels at their depth; at most 4.

    What a place sees of a surface that it touches depends on the logarithm of this.
    """
    height, width = first.shape
    for v in prange(len(out)):
        x, y = np.int64(pixel[v] % width), np.int64(pixel[v] // width)
        least = _FAR_CORNER
        for wy in range(max(0, y - 2), min(height, y + 3)):
            for wx in range(max(0, x - 2), min(width, x + 3)):
                w = first[wy, wx]
                if w < 0 or w == v:
                    continue
                dx = position[w, 0] - position[v, 0]
                dy = position[w, 1] - position[v, 1]
                dz = position[w, 2] - position[v, 2]
                apart = np.float32(np.sqrt(dx * dx + dy * dy + dz * dz))
                rise = dx * normal[v, 0] + dy * normal[v, 1] + dz * normal[v, 2]
                facing = -(dx * normal[w, 0] + dy * normal[w, 1] + dz * normal[w, 2])
                cosine = normal[v, 0] * normal[w, 0] + normal[v, 1] * normal[w, 1] + normal[v, 2] * normal[w, 2]
                if cosine < _SAME_TURN and rise > np.float32(0.1) * apart and facing > np.float32(0.0):
                    least = min(least, facing / extent[v])
        out[v] = max(least, np.float32(0.05))


@kernel
def _same_corner(corners, v, w):  # type: ignore[no-untyped-def]
    """1 for places as far from the nearest corner, 0 where one is much nearer."""
    ratio = abs(np.float32(np.log2(corners[v] / corners[w])))
    return _falling(ratio, np.float32(0.5), np.float32(2.0))


@kernel
def same_sheet(position, normal, extent, v, w, pixels):  # type: ignore[no-untyped-def]
    """How far two places, `pixels` apart in the image, lie on one sheet of surface: 1 for a plane, 0 across an edge.

    The plane test looks at the smaller of two lengths: distance in space, and
    in the image at the depth of `v`, which is the shorter one where the
    surface is seen at a grazing angle and another may lie behind it.
    """
    if v == w:
        return np.float32(1.0)
    cosine = normal[v, 0] * normal[w, 0] + normal[v, 1] * normal[w, 1] + normal[v, 2] * normal[w, 2]
    if cosine <= _OTHER_TURN:
        return np.float32(0.0)
    dx = position[w, 0] - position[v, 0]
    dy = position[w, 1] - position[v, 1]
    dz = position[w, 2] - position[v, 2]
    off = max(
        abs(dx * normal[v, 0] + dy * normal[v, 1] + dz * normal[v, 2]),
        abs(dx * normal[w, 0] + dy * normal[w, 1] + dz * normal[w, 2]),
    )
    apart = np.float32(np.sqrt(dx * dx + dy * dy + dz * dz))
    length = min(apart, max(pixels, np.float32(2.0)) * extent[v])
    if off >= _OTHER_PLANE * length:
        return np.float32(1.0) if apart == np.float32(0.0) else np.float32(0.0)
    turn = _falling(-cosine, -_SAME_TURN, -_OTHER_TURN)
    return turn * _falling(off / length, _SAME_PLANE, _OTHER_PLANE)


@kernel
def _insert(record, weight, out_record, out_weight, n):  # type: ignore[no-untyped-def]
    """Add an entry to one sample's, which stay in ascending order; a record that is there already gets the sum."""
    place = n
    while place > 0 and out_record[place - 1] > record:
        place -= 1
    if place > 0 and out_record[place - 1] == record:
        out_weight[place - 1] += weight
        return n
    for k in range(n, place, -1):
        out_record[k] = out_record[k - 1]
        out_weight[k] = out_weight[k - 1]
    out_record[place] = record
    out_weight[place] = weight
    return n + 1


@parallel_kernel
def record_weights(  # type: ignore[no-untyped-def]
    samples,
    pixel,
    position,
    normal,
    instance,
    extent,
    corners,
    nearness,
    level,
    corner,
    record_at,
    record_of,
    record_view,
    bucket_side,
    bucket_begin,
    bucket_record,
    strict,
    count,
    out_record,
    out_weight,
    fit,
    reach,
):
    """Records and weights of some view samples; count 0 where no record is on the sample's sheet.

    In its block a sample takes part in the corners that share its sheet, in
    perspective: ``weight * nearness`` (1 / depth) reproduces what is linear on
    a plane in space. The share that they leave goes to the nearest records on
    the sheet, weighted after Franke & Little. A sample with a record of its own takes that.

    Parameters
    ----------
    samples : (n_samples,)
        Rows of the arrays of n_view samples.
    pixel, instance : (n_view,) integers
    position, normal : (n_view, 3) float32
        World space, metres; unit shading normals.
    extent : (n_view,) float32
        Width of a pixel at the sample, metres.
    corners : (n_view,) float32, of `corner_distance`
    nearness : (n_view,) float32
        1 / depth, 1 / metres; 1 for parallel rays.
    level : (height, width) int32, corner : (height, width) uint8
        Level of each pixel's block; not 0 at the blocks' corners.
    record_at : (height, width)
        Record of the first view sample of each pixel, or -1.
    record_of : (n_view,)
        Record of each view sample, or -1.
    record_view : (n_records,)
        View sample of each record.
    bucket_side : int, pixels
    bucket_begin : (n_buckets + 1,), bucket_record : (n_records,)
        Records by bucket, row by row.
    strict
        0 accepts records of any sheet.
    count : (n_samples,) int64, out_record : (n_samples, MAX_ENTRIES) int32, out_weight : the same, float32
        Out.
    fit : (n_samples,)
        Share that the block's corners took.
    reach : (n_samples,)
        Pixels to the nearest record on the sheet, where `fit` is less than 1; else 0.
    """
    height, width = level.shape
    n_buckets_x = (width + bucket_side - 1) // bucket_side
    n_buckets_y = (height + bucket_side - 1) // bucket_side
    for q in prange(len(samples)):
        v = samples[q]
        if record_of[v] >= 0:
            count[q] = 1
            out_record[q, 0] = record_of[v]
            out_weight[q, 0] = np.float32(1.0)
            fit[q] = np.float32(1.0)
            reach[q] = np.float32(0.0)
            continue
        x, y = np.int64(pixel[v] % width), np.int64(pixel[v] // width)
        record = np.empty(16, np.int32)
        weight = np.empty(16, np.float32)
        node = np.empty((_NODES, 2), np.int64)
        share = np.empty(_NODES, np.float32)
        n = 0
        n_nodes = block_nodes(corner, level, x, y, node, share)
        inside = np.float32(0.0)
        total = np.float32(0.0)
        for k in range(n_nodes):
            r = record_at[node[k, 0], node[k, 1]]
            if r < 0 or share[k] <= np.float32(0.0):
                continue
            w = record_view[r]
            pixels = np.float32(max(abs(node[k, 0] - y), abs(node[k, 1] - x)))
            alike = same_sheet(position, normal, extent, v, w, pixels) * _same_corner(corners, v, w)
            if alike > np.float32(0.0):
                inside += share[k] * alike
                value = share[k] * alike * nearness[w]
                total += value
                n = _insert(r, value, record, weight, n)
        fit[q] = inside
        # Corners that share half a sheet are no better than others near.
        inside = max(np.float32(2.0) * inside - np.float32(1.0), np.float32(0.0))
        if inside > np.float32(0.0):
            for k in range(n):
                weight[k] *= inside / total
        else:
            n = 0
        reach[q] = np.float32(0.0)
        rest = np.float32(1.0) - inside
        if rest > np.float32(1e-4):
            near = np.full(_NEAREST + 1, np.float32(np.inf))
            alikes = np.zeros(_NEAREST + 1, np.float32)
            best = np.full(_NEAREST + 1, np.int64(-1))
            closest = np.float32(np.inf)
            bx, by = x // bucket_side, y // bucket_side
            for ring in range(_RINGS + 1):
                for cy in range(max(0, by - ring), min(n_buckets_y, by + ring + 1)):
                    for cx in range(max(0, bx - ring), min(n_buckets_x, bx + ring + 1)):
                        if max(abs(cx - bx), abs(cy - by)) != ring:
                            continue
                        place = cy * n_buckets_x + cx
                        for e in range(bucket_begin[place], bucket_begin[place + 1]):
                            r = bucket_record[e]
                            w = record_view[r]
                            wx, wy = np.int64(pixel[w] % width), np.int64(pixel[w] // width)
                            pixels = np.float32(max(abs(wx - x), abs(wy - y)))
                            alike = same_sheet(position, normal, extent, v, w, pixels)
                            if strict == 0:
                                alike = max(alike, np.float32(1e-3))
                            if alike <= np.float32(0.0):
                                continue
                            same = _same_corner(corners, v, w)
                            if same > np.float32(0.5):
                                closest = min(closest, pixels)
                            alike *= max(same * same, _OTHER_CORNER)
                            dx = position[w, 0] - position[v, 0]
                            dy = position[w, 1] - position[v, 1]
                            dz = position[w, 2] - position[v, 2]
                            d = np.float32(np.sqrt(dx * dx + dy * dy + dz * dz)) / np.float32(np.sqrt(alike))
                            if instance[w] != instance[v]:
                                d *= _OTHER_INSTANCE
                            k = _NEAREST
                            if d < near[k]:
                                while k > 0 and near[k - 1] > d:
                                    near[k], best[k], alikes[k] = near[k - 1], best[k - 1], alikes[k - 1]
                                    k -= 1
                                near[k], best[k], alikes[k] = d, r, alike
                if ring > 0 and near[_NEAREST] < np.float32(np.inf):
                    break
            reach[q] = closest
            if best[0] >= 0:
                limit = near[_NEAREST] if near[_NEAREST] < np.float32(np.inf) else np.float32(2.0) * near[_NEAREST - 1]
                if not limit < np.float32(np.inf):
                    for k in range(_NEAREST):
                        if best[k] >= 0:
                            limit = np.float32(2.0) * near[k]
                total = np.float32(0.0)
                franke = np.zeros(_NEAREST, np.float32)
                for k in range(_NEAREST):
                    if best[k] >= 0 and near[k] < limit:
                        f = (limit - near[k]) / (limit * max(near[k], np.float32(1e-6) * limit))
                        franke[k] = f * f * alikes[k]
                        total += franke[k]
                if not total > np.float32(0.0):  # all equally far, or none apart
                    franke[0] = np.float32(1.0)
                    total = np.float32(1.0)
                for k in range(_NEAREST):
                    if franke[k] > np.float32(0.0):
                        n = _insert(np.int32(best[k]), rest * franke[k] / total, record, weight, n)
            elif n > 0:  # the corners alone
                for k in range(n):
                    weight[k] /= inside
        while n > MAX_ENTRIES:  # the least one goes
            least = 0
            for k in range(n):
                if weight[k] < weight[least]:
                    least = k
            for k in range(least, n - 1):
                record[k], weight[k] = record[k + 1], weight[k + 1]
            n -= 1
        total = np.float32(0.0)
        for k in range(n):
            total += weight[k]
        for k in range(n):
            out_record[q, k] = record[k]
            out_weight[q, k] = weight[k] / total
        count[q] = n
