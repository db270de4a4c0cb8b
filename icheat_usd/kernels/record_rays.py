"""Stratified hemispheres of gather rays, each traced to the gather cell that it ends in."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packets import (
    CELL,
    INSTANCE,
    TRIANGLE,
    clear_packet,
    look_up_cells,
    make_look_up,
    make_packet,
    trace_16,
)
from icheat_usd.kernels.random import hash_combine, sobol_pair, to_unit
from icheat_usd.kernels.samples import basis, unit_circle

_TOUCHING = np.float32(1e-6)  # metres: a ray may end where it starts, in a crease
_HEMISPHERES = 27  # the bit of a stream from which it counts the hemispheres of one record
_BLOCK = 4  # strata along each side of a packet at most: rays of one cone
_PACKET = 16
_CHUNK = 64  # hemispheres that a thread sums


@kernel
def shared_seed(seed, stream):  # type: ignore[no-untyped-def]
    """What the hemispheres of one record draw their random numbers from."""
    return hash_combine(seed, stream & ((1 << _HEMISPHERES) - 1))


@kernel
def turn_of(seed, stream):  # type: ignore[no-untyped-def]
    """Where the first azimuth of a hemisphere lies, in turns; the same for all of one record."""
    return to_unit(hash_combine(shared_seed(seed, stream), 0x7F4A7C15))


@kernel
def stratum_direction(sx, sy, sz, seed, stream, j, k, n_theta, n_phi):  # type: ignore[no-untyped-def]
    """A direction of stratum (j, k) about a unit normal, jittered; all strata hold the same share of the cosine.

    Rings j go outwards from the normal, ``sin(theta)^2`` from ``j / n_theta`` to ``(j + 1) / n_theta``. What the
    hemispheres of one record have in a stratum are points of one sequence, and spread over it.
    """
    word = hash_combine(shared_seed(seed, stream), j * n_phi + k)
    within, along = sobol_pair(stream >> _HEMISPHERES, word)
    u = (np.float32(j) + within) / np.float32(n_theta)
    v = (np.float32(k) + along) / np.float32(n_phi) + turn_of(seed, stream)
    if v >= np.float32(1.0):
        v -= np.float32(1.0)
    radius = np.float32(np.sqrt(u))
    cosine, sine = unit_circle(v)
    a, b = radius * cosine, radius * sine
    c = np.float32(np.sqrt(max(np.float32(0.0), np.float32(1.0) - u)))
    tx, ty, tz, bx, by, bz = basis(sx, sy, sz)
    return a * tx + b * bx + c * sx, a * ty + b * by + c * sy, a * tz + b * bz + c * sz


@kernel
def _trace_some(  # type: ignore[no-untyped-def]
    first,
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
    stream,
    seed,
    n_theta,
    n_phi,
    out_cell,
    out_distance,
    out_instance,
    out_triangle,
    out_uv,
):
    """Rows of `trace_hemispheres` from `first` on that share packets: one, or as many as fill one."""
    mesh_begin, instance_mesh = trace.mesh_begin, trace.instance_mesh
    place, face, square, candidates = cells.place, cells.face, cells.square, cells.candidates
    sample, slot, slot_detour = locator.sample, locator.slot, locator.slot_detour
    stack, bound = np.empty((depth + 1, 2), np.int64), np.empty(depth + 1, np.float32)
    valid, rays, words, single, single_words = make_packet()
    ends, at = make_look_up()
    rays_at, valid_at, single_at = rays.ctypes.data, valid.ctypes.data, single.ctypes.data
    high, wide = min(_BLOCK, n_theta), min(_BLOCK, n_phi)
    for j0 in range(0, n_theta, _BLOCK):
        for k0 in range(0, n_phi, _BLOCK):
            for e in range(_PACKET):
                r = first + e // (high * wide)
                valid[e] = 0
                if r >= len(stream):
                    continue
                j, k = j0 + e // wide % high, k0 + e % wide
                sx, sy, sz = shading_normal[r, 0], shading_normal[r, 1], shading_normal[r, 2]
                x, y, z = stratum_direction(sx, sy, sz, seed, stream[r], j, k, n_theta, n_phi)
                if x * normal[r, 0] + y * normal[r, 1] + z * normal[r, 2] > np.float32(0.0):
                    valid[e] = -1
                rays[0, e] = position[r, 0]
                rays[1, e] = position[r, 1]
                rays[2, e] = position[r, 2]
                rays[4, e] = x
                rays[5, e] = y
                rays[6, e] = z
            clear_packet(rays, words)
            trace_16(trace, rays, words, valid, rays_at, valid_at, single, single_words, single_at)
            look_up_cells(
                valid, rays, words, mesh_begin, instance_mesh, place, face, square, candidates, sample, slot,
                slot_detour, locator, points, to_world, to_object, triangle_route, stack, bound, ends, at,
            )  # fmt: skip
            for e in range(_PACKET):
                r = first + e // (high * wide)
                if r >= len(stream):
                    break
                column = (j0 + e // wide % high) * n_phi + k0 + e % wide
                out_cell[r, column] = ends[CELL, e]
                out_instance[r, column] = ends[INSTANCE, e]
                out_triangle[r, column] = ends[TRIANGLE, e]
                out_distance[r, column] = np.inf
                if ends[INSTANCE, e] >= 0:
                    out_uv[r, column, 0] = rays[15, e]
                    out_uv[r, column, 1] = rays[16, e]
                    out_distance[r, column] = rays[8, e]


@parallel_kernel
def trace_hemispheres(  # type: ignore[no-untyped-def]
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
    stream,
    seed,
    n_theta,
    n_phi,
    out_cell,
    out_distance,
    out_instance,
    out_triangle,
    out_uv,
):
    """Gather cell and distance of every ray of n hemispheres.

    Parameters
    ----------
    trace, cells, locator : TraceTable, CellTable and table of the locator
    depth : int
        Of the locator's tree.
    points, to_world, to_object : as in `Geometry`
    triangle_route : (n_triangles,) uint8
        1: a hit must be looked at more closely.
    position, shading_normal, normal : (n, 3) float32
        Starts in world space, off the surface; unit normals.
    stream : (n,) int64
        Number of each hemisphere's random sequence.
    n_theta, n_phi : int
        Strata, 2 or multiples of 4.
    out_cell : (n, n_theta * n_phi) int32
        Ray (j, k) in column ``j n_phi + k``: a cell, `NOTHING` or `DETOUR`.
    out_distance : (n, n_rays) float32
        Metres to the first surface, inf where there is none.
    out_instance, out_triangle : (n, n_rays) int32, out_uv : (n, n_rays, 2) float32
        The first surface; -1 where there is none.
    """
    at_once = max(1, _PACKET // (n_theta * n_phi))
    for part in prange((len(stream) + at_once - 1) // at_once):
        _trace_some(
            np.int64(part) * at_once,
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
            stream,
            seed,
            n_theta,
            n_phi,
            out_cell,
            out_distance,
            out_instance,
            out_triangle,
            out_uv,
        )


@parallel_kernel
def mean_radiance(cell, adjusted, throughput, of_cells, out):  # type: ignore[no-untyped-def]
    """Mean of what the rays of n hemispheres bring, to `out` (n, C), C a multiple of 3.

    Parameters
    ----------
    cell, adjusted, throughput
        Of `RecordRays`.
    of_cells : (n_cells, C) float32
        Radiance that cells send.
    """
    n, n_rays = cell.shape
    share = np.float32(1.0 / n_rays)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        begin, end = chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)
        a = np.searchsorted(adjusted, begin * n_rays)
        for r in range(begin, end):
            out[r, :] = np.float32(0.0)
            for ray in range(n_rays):
                is_adjusted = a < len(adjusted) and adjusted[a] == r * n_rays + ray
                if cell[r, ray] >= 0:
                    for c in range(out.shape[1]):
                        light = of_cells[cell[r, ray], c]
                        out[r, c] += light * throughput[a, c % 3] if is_adjusted else light
                a += is_adjusted
            for c in range(out.shape[1]):
                out[r, c] *= share


@parallel_kernel
def hemisphere_directions(shading_normal, row, column, stream, seed, n_theta, n_phi, out, counter):  # type: ignore[no-untyped-def]
    """Directions (n, 3) of rays `column` of hemispheres `row`, and a number of its own for choices on its way."""
    for q in prange(len(row)):
        r, ray = row[q], column[q]
        x, y, z = stratum_direction(
            shading_normal[r, 0],
            shading_normal[r, 1],
            shading_normal[r, 2],
            seed,
            stream[r],
            ray // n_phi,
            ray % n_phi,
            n_theta,
            n_phi,
        )
        out[q, 0], out[q, 1], out[q, 2] = x, y, z
        counter[q] = np.int32(hash_combine(hash_combine(seed, stream[r]), ray))


@parallel_kernel
def patch_keys(position, shading_normal, stream, seed, n_theta, n_phi, distance, cell, flat, out):  # type: ignore[no-untyped-def]
    """Keys of the patches that rays `flat`, ``row * n_rays + ray``, end in: parts of a cell as wide as a ray is long.

    Widths are powers of two, half a ray's length or more. Different patches share a key with a chance of 2^-64.
    """
    for q in prange(len(flat)):
        r, ray = flat[q] // (n_theta * n_phi), flat[q] % (n_theta * n_phi)
        nx, ny, nz = shading_normal[r, 0], shading_normal[r, 1], shading_normal[r, 2]
        x, y, z = stratum_direction(nx, ny, nz, seed, stream[r], ray // n_phi, ray % n_phi, n_theta, n_phi)
        d = distance[r, ray]
        level = np.floor(np.log2(max(d, _TOUCHING)))
        size = np.float32(2.0**level)
        key = _mixed(np.uint64(0), np.int64(cell[r, ray]))
        key = _mixed(key, np.int64(level))
        key = _mixed(key, np.int64(np.floor((position[r, 0] + d * x) / size)))
        key = _mixed(key, np.int64(np.floor((position[r, 1] + d * y) / size)))
        out[q] = _mixed(key, np.int64(np.floor((position[r, 2] + d * z) / size)))


@kernel
def _mixed(key, word):  # type: ignore[no-untyped-def]
    key = (key ^ np.uint64(word)) * np.uint64(0x9E3779B97F4A7C15)
    return key ^ (key >> np.uint64(29))
