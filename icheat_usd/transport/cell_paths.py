"""Rays to gather cells, also over mirrors, glass and holes; no surfaces are looked at but those that carry rays on."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels import cell_rays, tracing
from icheat_usd.kernels.embree import TraceTable
from icheat_usd.kernels.packets import DETOUR, NOTHING
from icheat_usd.materials import nonzero_rows, shade_hits, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, U8, Hits, SceneSnapshot
from icheat_usd.tracing import spawn_points, unit_directions


def first_cells(
    snapshot: SceneSnapshot,
    trace: TraceTable,
    gather: GatherSamples,
    route: U8,
    origins: F32,
    directions: F32,
    weight: F32,
) -> tuple[I32, Hits]:
    """Gather cells of the first surfaces, and these.

    Parameters
    ----------
    route : (n_triangles,) uint8
        Of `routed_triangles`.
    origins, directions, weight : (n, 3) float32
        Rays without weight are not traced.

    Returns
    -------
    cell : (n,) int32
        `packets.NOTHING` for none; `packets.DETOUR` on surfaces that may not simply reflect.
    hits : Hits of n rays
    """
    geometry, locator = snapshot.geometry, gather.locator
    n = len(origins)
    cell = np.empty(n, np.int32)
    distance, u, v = np.empty((3, n), np.float32)
    instance, triangle = np.empty((2, n), np.int32)
    hits = Hits(distance, instance, triangle, u, v)
    cell_rays.trace_to_cells(
        trace,
        gather.hit_cells.table(geometry, n),
        locator.table,
        locator.depth,
        geometry.points,
        geometry.instance_to_world,
        geometry.instance_to_object,
        route,
        origins,
        directions,
        weight,
        cell,
        hits,
    )
    return cell, hits


def cells_behind(
    snapshot: SceneSnapshot,
    trace: TraceTable,
    gather: GatherSamples,
    route: U8,
    origins: F32,
    directions: F32,
    counters: I32,
    seed: int,
    max_depth: int,
    first: Hits | None = None,
) -> tuple[I32, F32]:
    """What `first_surfaces` and `GatherSamples.locate` find.

    Parameters
    ----------
    route : (n_triangles,) uint8
        Of `routed_triangles`.
    origins, directions, counters, seed, max_depth
        As of `first_surfaces`.
    first : Hits of n rays, optional
        Where they are known, and all may not simply reflect.

    Returns
    -------
    cell : (n,) int32
        -1 for none.
    throughput : (n, 3) float32
        Of the paths that end in a cell.
    """
    towards = unit_directions(directions)
    n = len(origins)
    cell, throughput = np.full(n, NOTHING, np.int32), np.ones((n, 3), np.float32)
    path = np.arange(n)
    for depth in range(max_depth + 1):
        if depth == 0 and first is not None:
            hits = first
        else:
            moving = np.repeat(nonzero_rows(towards)[:, None], 3, axis=1).astype(np.float32)
            ends, hits = first_cells(snapshot, trace, gather, route, origins, towards, moving)
            met = np.flatnonzero(ends == DETOUR)
            ends[met] = NOTHING
            cell[path] = ends
            path, towards = path[met], towards[met]
            hits = Hits._make(np.take(column, met) for column in hits)
        points = shade_hits(snapshot, hits, towards)
        through, state = throughput[path], np.empty(len(path), np.uint8)
        tracing.step_paths(points, towards, counters[path], seed & 0xFFFFFFFF, depth, through, state)
        throughput[path] = through
        stopped = np.flatnonzero(state == tracing.STOPPED)
        cell[path[stopped]] = gather.locate(take_points(points, stopped))
        followed = np.flatnonzero(state == tracing.FOLLOWED)
        if not len(followed):
            break
        path, towards = path[followed], np.ascontiguousarray(towards[followed])
        origins = spawn_points(snapshot, take_points(points, followed), towards)
    return cell, throughput
