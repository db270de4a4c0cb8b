"""Any rays, each traced to the gather cell that it ends in."""

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

_RAYS_AT_ONCE = 1024  # that a thread takes: a multiple of a packet's 16


@kernel
def _trace_some(  # type: ignore[no-untyped-def]
    first,
    last,
    trace,
    cells,
    locator,
    depth,
    points,
    to_world,
    to_object,
    triangle_route,
    origins,
    directions,
    weight,
    out_cell,
    out_hits,
):
    """Rays `first` to `last` of `trace_to_cells`."""
    mesh_begin, instance_mesh = trace.mesh_begin, trace.instance_mesh
    place, face, square, candidates = cells.place, cells.face, cells.square, cells.candidates
    sample, slot, slot_detour = locator.sample, locator.slot, locator.slot_detour
    distance, instance, triangle, hit_u, hit_v = (
        out_hits.distance, out_hits.instance, out_hits.triangle, out_hits.u, out_hits.v,
    )  # fmt: skip
    stack, bound = np.empty((depth + 1, 2), np.int64), np.empty(depth + 1, np.float32)
    valid, rays, words, single, single_words = make_packet()
    ends, at = make_look_up()
    rays_at, valid_at, single_at = rays.ctypes.data, valid.ctypes.data, single.ctypes.data
    for begin in range(first, last, 16):
        n = min(16, last - begin)
        for e in range(16):
            r = begin + min(e, n - 1)
            is_lit = weight[r, 0] > 0.0 or weight[r, 1] > 0.0 or weight[r, 2] > 0.0
            valid[e] = -1 if e < n and is_lit else 0
            for c in range(3):
                rays[c, e] = origins[r, c]
                rays[4 + c, e] = directions[r, c]
        clear_packet(rays, words)
        trace_16(trace, rays, words, valid, rays_at, valid_at, single, single_words, single_at)
        look_up_cells(
            valid, rays, words, mesh_begin, instance_mesh, place, face, square, candidates, sample, slot, slot_detour,
            locator, points, to_world, to_object, triangle_route, stack, bound, ends, at,
        )  # fmt: skip
        for e in range(n):
            r, is_met = begin + e, ends[INSTANCE, e] >= 0
            out_cell[r] = ends[CELL, e]
            instance[r] = ends[INSTANCE, e]
            triangle[r] = ends[TRIANGLE, e]
            distance[r] = rays[8, e] if is_met else np.float32(np.inf)
            hit_u[r] = rays[15, e] if is_met else np.float32(0.0)
            hit_v[r] = rays[16, e] if is_met else np.float32(0.0)


@parallel_kernel
def trace_to_cells(  # type: ignore[no-untyped-def]
    trace,
    cells,
    locator,
    depth,
    points,
    to_world,
    to_object,
    triangle_route,
    origins,
    directions,
    weight,
    out_cell,
    out_hits,
):
    """Gather cell and first surface of n rays; those without weight are not traced.

    Parameters
    ----------
    trace, cells, locator, depth, points, to_world, to_object, triangle_route
        As of `record_rays.trace_hemispheres`.
    origins, directions, weight : (n, 3) float32
    out_cell : (n,) int32
        A cell, `NOTHING` or `DETOUR`.
    out_hits : Hits of n rays
        The first surface; instance -1 where there is none.
    """
    n = len(origins)
    for chunk in prange((n + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE):
        _trace_some(
            chunk * _RAYS_AT_ONCE,
            min(n, (chunk + 1) * _RAYS_AT_ONCE),
            trace,
            cells,
            locator,
            depth,
            points,
            to_world,
            to_object,
            triangle_route,
            origins,
            directions,
            weight,
            out_cell,
            out_hits,
        )
