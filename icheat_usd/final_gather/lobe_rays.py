"""Rays of specular lobes that end in gather cells, in one compiled pass; surfaces are looked at where edits ask."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icheat_usd.kernels import lobe_rays as kernels
from icheat_usd.kernels.packets import DETOUR
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.tracing import point_magnitudes
from icheat_usd.materials import empty_points, shade_hits, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, Hits, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces
from icheat_usd.transport.rays import routed_triangles


class LobeRays(NamedTuple):
    """`hits.GatherRays` of a specular lobe, whose ends are known by cell and triangle alone."""

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


def trace_lobe(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    points: SurfacePoints,
    to_eye: F32,
    draws: I64,
    n_rays: int,
    seed: int,
) -> LobeRays | None:
    """The rays of `hits.trace_specular`; None with a tracer that compiled loops cannot call."""
    trace = tracer.compiled()
    if trace is None:
        return None
    geometry, locator = snapshot.geometry, gather.locator
    n = len(draws) * n_rays
    magnitude = np.empty(len(draws), np.float32)
    point_magnitudes(geometry, points.instance, points.triangle, magnitude)
    origins, directions, reflectance = (np.empty((n, 3), np.float32) for _ in range(3))
    kernels.fill_lobe_rays(
        points,
        magnitude,
        np.require(to_eye, np.float32, ["C", "W"]),
        np.ascontiguousarray(draws, np.int64),
        n_rays,
        seed & 0xFFFFFFFF,
        origins,
        directions,
        reflectance,
    )
    cell = np.empty(n, np.int32)
    hits = Hits(
        distance=np.empty(n, np.float32),
        instance=np.empty(n, np.int32),
        triangle=np.empty(n, np.int32),
        u=np.empty(n, np.float32),
        v=np.empty(n, np.float32),
    )
    kernels.trace_to_cells(
        trace,
        gather.hit_cells.table(geometry, n),
        locator.table,
        locator.depth,
        geometry.points,
        geometry.instance_to_world,
        geometry.instance_to_object,
        routed_triangles(snapshot),
        origins,
        directions,
        reflectance,
        cell,
        hits,
    )
    own = int(hash_combine(seed, 1))
    detour, detour_ends, way = np.flatnonzero(cell == DETOUR), empty_points(0), np.empty((0, 3), np.float32)
    if len(detour):
        rays = origins[detour], directions[detour]
        ends = first_surfaces(snapshot, tracer, *rays, own, counters=detour.astype(np.int32))
        detour_ends, way = ends.points, ends.throughput
        cell[detour] = gather.locate(detour_ends)
    throughput = reflectance * (cell >= 0)[:, None]
    throughput[detour] *= way
    return LobeRays(cell, throughput, origins, directions, own, reflectance, hits, detour, detour_ends)
