"""Rows of transport in one pass: gather rays are made, traced, looked up and counted without arrays in between."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import get_num_threads, prange, types
from numba.extending import intrinsic

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packets import (
    CELL,
    DETOUR,
    INSTANCE,
    NOTHING,
    TRIANGLE,
    clear_packet,
    look_up_cells,
    make_look_up,
    make_packet,
    trace_16,
)
from icheat_usd.kernels.random import hash_combine, sobol_pair
from icheat_usd.kernels.samples import basis, cosine_direction, cosine_lobe

BATCH = 4096  # rays that are put in order of direction; their buffers fit the second-level cache
_BINS = 16  # along each axis, of directions in the order of tracing


def thread_count() -> int:
    """Threads that parallel kernels run on."""
    return int(get_num_threads())


@kernel
def block_rows(n_rays):  # type: ignore[no-untyped-def]
    """Rows whose rays are ordered together, where each has so many."""
    return max(1, BATCH // n_rays)


@cast(Any, intrinsic)  # as a caller sees it: without the typing context
def _trailing_zeros(typingctx: Any, word: Any) -> Any:
    """Place of the lowest bit of a word that is not zero."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), codegen


@kernel
def fill_directions(shading_normal, normal, i, first, last, row_seed, at, x, y, z):  # type: ignore[no-untyped-def]
    """Cosine directions ``first:last`` of a sequence about point i, to ``x[at:]``; zero where below the surface."""
    sx, sy, sz = shading_normal[i, 0], shading_normal[i, 1], shading_normal[i, 2]
    gx, gy, gz = normal[i, 0], normal[i, 1], normal[i, 2]
    tx, ty, tz, bx, by, bz = basis(sx, sy, sz)
    out_x, out_y, out_z = x[at : at + last - first], y[at : at + last - first], z[at : at + last - first]
    zero = np.float32(0.0)
    for k in range(last - first):
        u, v = sobol_pair(first + k, row_seed)
        a, b, c = cosine_lobe(u, v)
        dx, dy, dz = a * tx + b * bx + c * sx, a * ty + b * by + c * sy, a * tz + b * bz + c * sz
        above = dx * gx + dy * gy + dz * gz > zero
        out_x[k] = dx if above else zero
        out_y[k] = dy if above else zero
        out_z[k] = dz if above else zero


@kernel
def fill_row(  # type: ignore[no-untyped-def]
    shading_normal, normal, begin, end, first, n, of_rays, row_seed, at, origin, x, y, z
):
    """Rays ``first:first + n`` of a row, of `of_rays` in all. The row has points ``begin:end``.

    `shading_normal` and `normal` are (n_points, 3) float32. Out, from entry `at`
    on: number of the point `origin` (room,) int64, and direction `x`, `y`, `z`
    (room,) float32 each.
    """
    points = end - begin
    k = first
    while k < first + n:
        i = k * points // of_rays
        last = min(first + n, ((i + 1) * of_rays + points - 1) // points)
        fill_directions(shading_normal, normal, begin + i, k, last, row_seed, at + k - first, x, y, z)
        for e in range(at + k - first, at + last - first):
            origin[e] = begin + i
        k = last


@kernel
def _octahedral_bin(x, y, z, n):  # type: ignore[no-untyped-def]
    """Bin of a direction of any length in an n by n grid, row by row; y is up, in the middle of the square.

    Cigolle et al. 2014, A Survey of Efficient Representations for Independent Unit Vectors, JCGT 3(2).
    """
    total = abs(x) + abs(y) + abs(z)
    scale = np.float32(0.5) / max(total, np.float32(1e-30))
    a, b = x * scale, z * scale
    half = np.float32(0.5)
    folded_a = half - abs(b)
    folded_b = half - abs(a)
    if y < np.float32(0.0):
        a, b = (folded_a if a >= np.float32(0.0) else -folded_a), (folded_b if b >= np.float32(0.0) else -folded_b)
    column = min(max(np.int32((a + half) * np.float32(n)), np.int32(0)), np.int32(n - 1))
    row = min(max(np.int32((b + half) * np.float32(n)), np.int32(0)), np.int32(n - 1))
    return row * np.int32(n) + column


@kernel
def _order_by_direction(n, x, y, z, bin_of, bin_begin, order):  # type: ignore[no-untyped-def]
    """Rays in order of direction, bin by bin; those without a direction are left out. Returns how many there are."""
    bin_begin[:] = 0
    for e in range(n):
        bin_of[e] = _octahedral_bin(x[e], y[e], z[e], _BINS)
    for e in range(n):
        if not abs(x[e]) + abs(y[e]) + abs(z[e]) > np.float32(0.0):
            bin_of[e] = _BINS * _BINS
        elif (bin_of[e] // _BINS) % 2 == 1:  # there and back, so that successive bins are neighbours
            bin_of[e] ^= _BINS - 1
        bin_begin[bin_of[e] + 1] += 1
    for b in range(_BINS * _BINS):
        bin_begin[b + 1] += bin_begin[b]
    for e in range(n):
        order[bin_begin[bin_of[e]]] = e
        bin_begin[bin_of[e]] += 1
    return bin_begin[_BINS * _BINS - 1]


@parallel_kernel
def count_hits(  # type: ignore[no-untyped-def]
    trace,
    cells,
    locator,
    depth,
    points,
    to_world,
    to_object,
    triangle_route,
    position,
    shading_normal,
    normal,
    point_begin,
    stream,
    seed,
    first_ray,
    n_rays,
    of_rays,
    counter,
    mark,
    count,
    out_key,
    out_hits,
    n_detours,
    detour,
    met,
):
    """How many rays of each row end in each cell; keys are cells, and ascend.

    A lane's rows are worked on by one thread, so that sums do not depend on the threads.

    Parameters
    ----------
    trace, cells, locator : TraceTable, CellTable and table of the locator
    depth : int
        Of the locator's tree.
    points : (n_triangles, 3, 3) float32
        Corners, object space.
    to_world, to_object : (n_instances, 3, 4) float32
    triangle_route : (n_triangles,) uint8
        1: a hit must be looked at more closely.
    position, shading_normal, normal : (n_points, 3) float32
        Starts in world space, metres, off the surface; unit normals.
    point_begin : (n_rows + 1,) int64
    stream : (n_rows,) int64
    seed, first_ray, n_rays, of_rays : int
        Rays ``first_ray:first_ray + n_rays`` of sequences of `of_rays`.
    counter : (n_lanes, n_cells) int32, mark : (n_lanes, n_cells / 64) uint64
        Zero before and after.
    count : (n_rows,) int64, out_key, out_hits : (n_rows, room) int32
        Out: number of cells met; the cells; the rays that end in each.
    n_detours : (n_blocks,) int64, detour : (n_blocks, room) int32, met : Hits of (n_blocks, room)
        Out: the rays of each block of `block_rows` that end on triangles which do not simply reflect, counted row by
        row, and what they met; in the order of tracing, in which those after one another go about the same way.
    """
    n_rows = len(stream)
    together = block_rows(n_rays)
    met_distance, met_instance, met_triangle, met_u, met_v = met.distance, met.instance, met.triangle, met.u, met.v
    n_lanes = counter.shape[0]
    mesh_begin, instance_mesh = trace.mesh_begin, trace.instance_mesh
    place, face, square, candidates = cells.place, cells.face, cells.square, cells.candidates
    sample, slot, slot_detour = locator.sample, locator.slot, locator.slot_detour
    for lane in prange(n_lanes):
        x, y, z = np.empty(BATCH, np.float32), np.empty(BATCH, np.float32), np.empty(BATCH, np.float32)
        origin, order = np.empty(BATCH, np.int64), np.empty(BATCH, np.int64)
        bin_of, bin_begin = np.empty(BATCH, np.int32), np.empty(_BINS * _BINS + 2, np.int64)
        key = np.empty(BATCH, np.int32)
        stack, bound = np.empty((depth + 1, 2), np.int64), np.empty(depth + 1, np.float32)
        valid, rays, words, single, single_words = make_packet()
        ends, at = make_look_up()
        rays_at, valid_at, single_at = rays.ctypes.data, valid.ctypes.data, single.ctypes.data

        for block in range(lane, (n_rows + together - 1) // together, n_lanes):
            row_0, row_1 = block * together, min(n_rows, (block + 1) * together)
            n_met = 0
            done = 0
            while done < n_rays:
                m = min(n_rays - done, BATCH)
                for r in range(row_0, row_1):
                    fill_row(
                        shading_normal,
                        normal,
                        point_begin[r],
                        point_begin[r + 1],
                        first_ray + done,
                        m,
                        of_rays,
                        hash_combine(seed, stream[r]),
                        (r - row_0) * m,
                        origin,
                        x,
                        y,
                        z,
                    )
                n = (row_1 - row_0) * m
                key[:n] = NOTHING
                n_valid = _order_by_direction(n, x, y, z, bin_of, bin_begin, order)
                for first in range(0, n_valid, 16):
                    width = min(16, n_valid - first)
                    for k in range(16):
                        e = order[first + min(k, width - 1)]
                        valid[k] = -1 if k < width else 0
                        o = origin[e]
                        for c in range(3):
                            rays[c, k] = position[o, c]
                        rays[4, k] = x[e]
                        rays[5, k] = y[e]
                        rays[6, k] = z[e]
                    clear_packet(rays, words)
                    trace_16(trace, rays, words, valid, rays_at, valid_at, single, single_words, single_at)
                    look_up_cells(
                        valid, rays, words, mesh_begin, instance_mesh, place, face, square, candidates, sample, slot,
                        slot_detour, locator, points, to_world, to_object, triangle_route, stack, bound, ends, at,
                    )  # fmt: skip
                    for k in range(width):
                        e = order[first + k]
                        key[e] = ends[CELL, k]
                        if ends[CELL, k] == DETOUR:
                            detour[block, n_met] = e // m * n_rays + done + e % m
                            met_instance[block, n_met] = ends[INSTANCE, k]
                            met_triangle[block, n_met] = ends[TRIANGLE, k]
                            met_distance[block, n_met] = rays[8, k]
                            met_u[block, n_met], met_v[block, n_met] = rays[15, k], rays[16, k]
                            n_met += 1
                done += m
                n_detours[block] = n_met
                for r in range(row_0, row_1):
                    for k in range(m):
                        found = key[(r - row_0) * m + k]
                        if found >= 0:
                            counter[lane, found] += 1
                            mark[lane, found >> 6] |= np.uint64(1) << np.uint64(found & 63)
                    if done < n_rays:
                        continue
                    total = 0
                    for w in range(mark.shape[1]):
                        bits = mark[lane, w]
                        mark[lane, w] = 0
                        while bits != np.uint64(0):
                            found = 64 * w + np.int64(_trailing_zeros(bits))
                            bits &= bits - np.uint64(1)
                            out_key[r, total] = found
                            out_hits[r, total] = counter[lane, found]
                            counter[lane, found] = 0
                            total += 1
                    count[r] = total


@parallel_kernel
def rays_of_rows(  # type: ignore[no-untyped-def]
    position, shading_normal, normal, point_begin, stream, seed, of_rays, row, ray, origins, directions, counter
):
    """Ray ``ray[q]`` of row ``row[q]``, and a number of its own for random choices on its way.

    Inputs as for `count_hits`; `row` and `ray` are (n,) integers. Out: `origins`
    and `directions` (n, 3) float32, 0 where a direction is below the surface,
    and `counter` (n,) int32.
    """
    for q in prange(len(row)):
        r, k = np.int64(row[q]), np.int64(ray[q])
        row_seed = hash_combine(seed, stream[r])
        i = point_begin[r] + k * (point_begin[r + 1] - point_begin[r]) // of_rays
        u, v = sobol_pair(k, row_seed)
        x, y, z = cosine_direction(shading_normal[i, 0], shading_normal[i, 1], shading_normal[i, 2], u, v)
        if not x * normal[i, 0] + y * normal[i, 1] + z * normal[i, 2] > np.float32(0.0):
            x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        directions[q, 0], directions[q, 1], directions[q, 2] = x, y, z
        for c in range(3):
            origins[q, c] = position[i, c]
        counter[q] = np.int32(hash_combine(row_seed, k))
