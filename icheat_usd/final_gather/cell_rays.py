"""Rays that end in gather cells, in one compiled pass; surfaces are looked at where someone asks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icheat_usd.kernels.packets import DETOUR
from icheat_usd.materials import empty_points, shade_hits, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, Hits, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces
from icheat_usd.transport.cell_paths import first_cells
from icheat_usd.transport.rays import routed_triangles


class CellRays(NamedTuple):
    """`hits.GatherRays` whose ends are known by cell and triangle alone."""

    cell: I32  #: (n,) gather cell that a ray ends in, behind mirrors and glass too; -1 for none
    throughput: F32  #: (n, 3) of the lobe, and of delta vertices on the way; 0 where there is no end
    origins: F32  #: (n, 3)
    directions: F32  #: (n, 3)
    seed: int  #: of the choices at delta vertices, for `first_surfaces`
    reflectance: F32  #: (n, 3) the lobe's share of `throughput`
    hits: Hits  #: (n,) first surfaces
    detour: I64  #: (n_detours,) ascending numbers of rays that went over mirrors, glass, holes
    detour_ends: SurfacePoints  #: (n_detours,) where they end

    def ends_of(self, snapshot: SceneSnapshot, some: I64) -> SurfacePoints:
        """Surfaces that some of the rays, ascending numbers, end on."""
        hits = Hits._make(np.take(column, some) for column in self.hits)
        points = shade_hits(snapshot, hits, self.directions[some])
        _, here, there = np.intersect1d(some, self.detour, assume_unique=True, return_indices=True)
        column: Any
        for column, other in zip(points, take_points(self.detour_ends, there), strict=True):
            column[here] = other
        return points

    def cells(self, gather: GatherSamples) -> I32:
        """Gather cells that the rays end in; -1 for none."""
        return self.cell

    def distances(self) -> F32:
        """Metres from start to end, in a straight line; anything where there is no end."""
        distance = self.hits.distance
        if len(self.detour):
            distance = distance.copy()
            way = self.detour_ends.position - np.take(self.origins, self.detour, axis=0)
            distance[self.detour] = np.linalg.norm(way, axis=1)
        return distance


def trace_to_cells(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    origins: F32,
    directions: F32,
    reflectance: F32,
    seed: int,
) -> CellRays | None:
    """Rays with a lobe's reflectance, all (n, 3); None with a tracer that compiled loops cannot call."""
    trace = tracer.compiled()
    if trace is None:
        return None
    cell, hits = first_cells(snapshot, trace, gather, routed_triangles(snapshot), origins, directions, reflectance)
    detour, detour_ends, way = np.flatnonzero(cell == DETOUR), empty_points(0), np.empty((0, 3), np.float32)
    if len(detour):
        rays = origins[detour], directions[detour]
        ends = first_surfaces(snapshot, tracer, *rays, seed, counters=detour.astype(np.int32))
        detour_ends, way = ends.points, ends.throughput
        cell[detour] = gather.locate(detour_ends)
    throughput = reflectance * (cell >= 0)[:, None]
    throughput[detour] *= way
    return CellRays(cell, throughput, origins, directions, seed, reflectance, hits, detour, detour_ends)
