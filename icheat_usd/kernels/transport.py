"""From gather rays to rows of transport."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel
from icheat_usd.kernels.cell_map import (
    WALK,
    entry_at,
    nearest_listed,
    place_on,
    plane_of,
    side_seen,
    unit_normal,
)
from icheat_usd.kernels.locate import nearest_sample
from icheat_usd.kernels.random import hash_combine, sobol_pair

_BLOCK = 2048


@parallel_kernel
def cells_of_hits(  # type: ignore[no-untyped-def]
    cells,
    locator,
    depth,
    points,
    to_world,
    to_object,
    triangle_route,
    directions,
    instance,
    triangle,
    u,
    v,
    cell,
    detour,
):
    """Gather cell of every hit, -1 for none; `detour` marks hits on triangles that do not simply reflect."""
    n = len(instance)
    place, face, square, candidates = cells.place, cells.face, cells.square, cells.candidates
    sample, slot, slot_detour = locator.sample, locator.slot, locator.slot_detour
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        stack = np.empty((depth + 1, 2), np.int64)
        bound = np.empty(depth + 1, np.float32)
        for q in range(block * _BLOCK, min(n, (block + 1) * _BLOCK)):
            i, t = np.int64(instance[q]), np.int64(triangle[q])
            cell[q] = -1
            detour[q] = 0
            if i < 0:
                continue
            if triangle_route[t] != 0:
                detour[q] = 1
                continue
            plane = plane_of(points, to_object, i, t)
            if not plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2] > 0.0:
                continue
            side = side_seen(plane, directions[q, 0], directions[q, 1], directions[q, 2])
            entry = entry_at(place, face, square, i, t, side, u[q], v[q])
            if entry < 0:
                px, py, pz = place_on(points, to_world, i, t, u[q], v[q])
                nx, ny, nz = unit_normal(plane, side)
                if entry == WALK:
                    entry = nearest_sample(locator, i, side, px, py, pz, nx, ny, nz, stack, bound)
                else:
                    detour_2 = slot_detour[slot[2 * i + side]]
                    entry = nearest_listed(candidates, sample, entry, detour_2, px, py, pz, nx, ny, nz)
            cell[q] = entry


@parallel_kernel
def pack_units(counts, begin, key, hits, units, out_key, out_units):  # type: ignore[no-untyped-def]
    """Copy the first ``counts[r]`` entries of each padded row to ``begin[r]``, hits as units of light."""
    for r in prange(len(counts)):
        for e in range(counts[r]):
            out_key[begin[r] + e] = key[r, e]
            out_units[begin[r] + e] = np.float32(hits[r, e]) * np.float32(units)


@parallel_kernel
def divide(values, divisor):  # type: ignore[no-untyped-def]
    """Divide values (n,) in place, in double precision."""
    n = len(values)
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        for e in range(block * _BLOCK, min(n, (block + 1) * _BLOCK)):
            values[e] = values[e] / divisor


@parallel_kernel
def ray_counters(seed, stream, n_rays, out):  # type: ignore[no-untyped-def]
    """A number of its own for ``r * n_rays + k``, ray k of the sequence ``(seed, stream[r])``."""
    for r in prange(len(stream)):
        row_seed = hash_combine(seed, stream[r])
        for k in range(n_rays):
            out[r * n_rays + k] = np.int32(hash_combine(row_seed, k))


@parallel_kernel
def merge_weights(n_rays, cell, weight, counts, out_cell, out_weight):  # type: ignore[no-untyped-def]
    """Row r of the outputs: distinct cells of its `n_rays` entries, ascending, and their added weights (n, k).

    Entries without a cell, and cells without any weight, are dropped.
    """
    n_columns = weight.shape[1]
    for r in prange(len(counts)):
        first = r * n_rays
        keys = cell[first : first + n_rays]
        order = np.argsort(keys, kind="mergesort")
        total = np.empty(n_columns, np.float64)
        count = 0
        e = 0
        while e < n_rays:
            key = keys[order[e]]
            for c in range(n_columns):
                total[c] = 0.0
            while e < n_rays and keys[order[e]] == key:
                for c in range(n_columns):
                    total[c] += weight[first + order[e], c]
                e += 1
            if key >= 0 and total.max() > 0.0:
                out_cell[first + count] = key
                for c in range(n_columns):
                    out_weight[first + count, c] = total[c]
                count += 1
        counts[r] = count


@parallel_kernel
def pack_weights(n_rays, counts, packed_begin, cell, weight, out_cell, out_weight):  # type: ignore[no-untyped-def]
    """Copy the first ``counts[r]`` entries of each row to ``packed_begin[r]``; weights column by column."""
    for r in prange(len(counts)):
        for e in range(counts[r]):
            out_cell[packed_begin[r] + e] = cell[r * n_rays + e]
            for c in range(weight.shape[1]):
                out_weight[c, packed_begin[r] + e] = weight[r * n_rays + e, c]


@parallel_kernel
def point_sets(seed, stream, n_rays, out):  # type: ignore[no-untyped-def]
    """Stratified points of the unit square: ``r * n_rays + k`` is point k of the sequence ``(seed, stream[r])``."""
    for r in prange(len(stream)):
        row_seed = hash_combine(seed, stream[r])
        for k in range(n_rays):
            u, v = sobol_pair(k, row_seed)
            out[r * n_rays + k, 0] = u
            out[r * n_rays + k, 1] = v


_NEIGHBOURS = 4
_SAME_SHEET = np.float32(0.7)  # least cosine between the normals of two points that may share a row
_OTHER_INSTANCE = np.float32(1.0)  # added to the squared distance: rows of the same surface come first
_REACH = np.float32(2.0)  # spacings: weights end here
_ACCEPT = np.float32(1.25)  # spacings: the nearest row must be no further


@parallel_kernel
def interpolation_weights(  # type: ignore[no-untyped-def]
    position,
    normal,
    instance,
    spacing,
    block,
    n_blocks_x,
    n_blocks_y,
    row_view,
    row_of_view,
    bucket_begin,
    bucket_row,
    wanted,
    count,
    out_row,
    out_weight,
):
    """Up to four rows and their weights for the view samples that are wanted; count 0 where no row is near enough.

    Squared distance between points: (distance / spacing)^2 + 2 (1 - cos of the
    normals), candidates from the blocks around the sample's own. Weights after
    Franke & Little vanish at the distance of the fifth row, so no row comes or
    goes at once.
    """
    for v in prange(len(count)):
        count[v] = 0
        if not wanted[v]:
            continue
        if row_of_view[v] >= 0:
            count[v] = 1
            out_row[v, 0] = row_of_view[v]
            out_weight[v, 0] = np.float32(1.0)
            continue
        near = np.full(_NEIGHBOURS + 1, np.float32(np.inf))
        best = np.full(_NEIGHBOURS + 1, np.int64(-1))
        bx, by = block[v] % n_blocks_x, block[v] // n_blocks_x
        for y in range(max(0, by - 2), min(n_blocks_y, by + 3)):
            for x in range(max(0, bx - 2), min(n_blocks_x, bx + 3)):
                place = y * n_blocks_x + x
                for e in range(bucket_begin[place], bucket_begin[place + 1]):
                    row = bucket_row[e]
                    w = row_view[row]
                    cosine = normal[v, 0] * normal[w, 0] + normal[v, 1] * normal[w, 1] + normal[v, 2] * normal[w, 2]
                    if cosine < _SAME_SHEET:
                        continue
                    dx = (position[w, 0] - position[v, 0]) / spacing[v]
                    dy = (position[w, 1] - position[v, 1]) / spacing[v]
                    dz = (position[w, 2] - position[v, 2]) / spacing[v]
                    # Off the tangent planes is another sheet: a step, the inside of a corner.
                    off = max(
                        abs(dx * normal[v, 0] + dy * normal[v, 1] + dz * normal[v, 2]),
                        abs(dx * normal[w, 0] + dy * normal[w, 1] + dz * normal[w, 2]),
                    )
                    if off > np.float32(0.5):
                        continue
                    d2 = dx * dx + dy * dy + dz * dz + np.float32(2.0) * max(np.float32(0.0), np.float32(1.0) - cosine)
                    if instance[w] != instance[v]:
                        d2 += _OTHER_INSTANCE
                    d = np.float32(np.sqrt(d2))
                    k = _NEIGHBOURS
                    if d < near[k]:
                        while k > 0 and near[k - 1] > d:
                            near[k] = near[k - 1]
                            best[k] = best[k - 1]
                            k -= 1
                        near[k] = d
                        best[k] = row
        if near[0] > _ACCEPT:
            continue
        limit = min(near[_NEIGHBOURS], _REACH)
        total = np.float32(0.0)
        n = 0
        for k in range(_NEIGHBOURS):
            if near[k] < limit:
                w32 = (limit - near[k]) / (limit * max(near[k], np.float32(1e-6)))
                out_row[v, n] = best[k]
                out_weight[v, n] = w32 * w32
                total += w32 * w32
                n += 1
        if total > np.float32(0.0):
            for k in range(n):
                out_weight[v, k] /= total
        else:  # five rows equally far
            n = 1
            out_row[v, 0] = best[0]
            out_weight[v, 0] = np.float32(1.0)
        for k in range(1, n):  # columns ascend
            row, weight, place = out_row[v, k], out_weight[v, k], k
            while place > 0 and out_row[v, place - 1] > row:
                out_row[v, place] = out_row[v, place - 1]
                out_weight[v, place] = out_weight[v, place - 1]
                place -= 1
            out_row[v, place] = row
            out_weight[v, place] = weight
        count[v] = n
