"""Gather rays of cache records: where each ends, kept so that light and edits can be looked up again."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icheat_usd.final_gather.near_hits import NearLight
from icheat_usd.kernels import record_rays as kernels
from icheat_usd.kernels.packets import DETOUR
from icheat_usd.materials import concatenate_points, empty_points, shade_hits, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, Hits, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points
from icheat_usd.transport.rays import routed_triangles

_DETOUR_DEPTH = 8  # mirrors and faces of glass on a gather ray


class RecordRays(NamedTuple):
    """Stratified hemispheres of n records; see `kernels.record_rays`."""

    n_theta: int
    n_phi: int
    seed: int
    stream: I64  #: (n,)
    position: F32  #: (n, 3) where rays start
    shading_normal: F32  #: (n, 3)
    cell: I32  #: (n, n_rays) gather cell that the ray ends in, behind mirrors and glass too; -1 for none
    distance: F32  #: (n, n_rays) metres to the first surface
    instance: I32  #: (n, n_rays) first surface, -1 for none
    triangle: I32  #: (n, n_rays)
    uv: F32  #: (n, n_rays, 2)
    adjusted: I64  #: (k,) ascending numbers, ``row * n_rays + ray``, of rays that bring other light than cells
    throughput: F32  #: (k, 3) what they bring over that: detours, and near hits
    detour: I64  #: (n_detours,) ascending numbers of rays that went over mirrors, glass, holes
    detour_ends: SurfacePoints  #: (n_detours,) where they end

    @property
    def n_rays(self) -> int:
        return self.n_theta * self.n_phi

    @property
    def sender(self) -> I32:
        """(n, n_rays) instance that sends each ray its light, behind mirrors and glass too; -1 for none."""
        found = np.where(self.cell >= 0, self.instance, np.int32(-1))
        lit = self.cell.reshape(-1)[self.detour] >= 0
        found.reshape(-1)[self.detour] = np.where(lit, self.detour_ends.instance, np.int32(-1))
        return found

    def radiance(self, of_cells: F32) -> F32:
        """What each ray brings, (n, n_rays, C), when cells send `of_cells` (n_cells + 1, C), the last row zero."""
        nothing = len(of_cells) - 1
        found = np.take(of_cells, np.where(self.cell < 0, nothing, self.cell), axis=0)
        if len(self.adjusted):
            flat = found.reshape(-1, found.shape[-1])
            flat[self.adjusted] *= np.tile(self.throughput, found.shape[-1] // 3)
        return found

    def mean_radiance(self, of_cells: F32) -> F32:
        """Its mean over the rays of each, (n, C)."""
        out = np.empty((len(self.cell), of_cells.shape[1]), np.float32)
        kernels.mean_radiance(self.cell, self.adjusted, self.throughput, of_cells, out)
        return out

    def way(self) -> F32:
        """What the way of rays `adjusted` leaves of light that does not come from cells, (k, 3): 1 of near hits."""
        went = np.isin(self.adjusted, self.detour, assume_unique=True)
        return np.where(went[:, None], self.throughput, np.float32(1)).astype(np.float32)

    def ends(self, snapshot: SceneSnapshot, flat: I64) -> SurfacePoints:
        """Surfaces that send light along rays `flat`, ascending numbers ``row * n_rays + ray``."""
        row, ray = flat // self.n_rays, flat % self.n_rays
        directions, _ = self._directions(row, ray)
        hits = Hits(
            np.take(self.distance.reshape(-1), flat),
            np.take(self.instance.reshape(-1), flat),
            np.take(self.triangle.reshape(-1), flat),
            np.ascontiguousarray(np.take(self.uv.reshape(-1, 2), flat, axis=0)[:, 0]),
            np.ascontiguousarray(np.take(self.uv.reshape(-1, 2), flat, axis=0)[:, 1]),
        )
        points = shade_hits(snapshot, hits, directions)
        _, here, there = np.intersect1d(flat, self.detour, assume_unique=True, return_indices=True)
        column: Any
        for column, other in zip(points, take_points(self.detour_ends, there), strict=True):
            column[here] = other
        return points

    def end_positions(self, flat: I64) -> F32:
        """Where these surfaces are, (k, 3)."""
        row, ray = flat // self.n_rays, flat % self.n_rays
        directions, _ = self._directions(row, ray)
        found = np.take(self.distance.reshape(-1), flat)[:, None] * directions + np.take(self.position, row, axis=0)
        _, here, there = np.intersect1d(flat, self.detour, assume_unique=True, return_indices=True)
        found[here] = self.detour_ends.position[there]
        return found

    def _directions(self, row: I64, ray: I64) -> tuple[F32, I32]:
        directions, counter = np.empty((len(row), 3), np.float32), np.empty(len(row), np.int32)
        kernels.hemisphere_directions(
            self.shading_normal, row, ray, self.stream, self.seed, self.n_theta, self.n_phi, directions, counter
        )
        return directions, counter


class HemisphereTracer:
    """Traces the rays of records on one scene."""

    def __init__(
        self,
        snapshot: SceneSnapshot,
        tracer: Tracer,
        gather: GatherSamples,
        n_theta: int,
        n_phi: int,
        seed: int,
        near: NearLight | None = None,
    ) -> None:
        self._snapshot, self._tracer, self._gather, self._near = snapshot, tracer, gather, near
        self._n_theta, self._n_phi, self._seed = n_theta, n_phi, seed
        self._route = routed_triangles(snapshot)

    def trace(self, points: SurfacePoints, stream: I64, strata: tuple[int, int] | None = None) -> RecordRays:
        """Rays from some points; `stream` (n,) numbers their random sequences.

        Parameters
        ----------
        strata : (int, int), optional
            Rings and sectors, 2 or multiples of 4, where these are not the usual ones.
        """
        n_theta, n_phi = strata or (self._n_theta, self._n_phi)
        return self._measure_near(self._trace(points, stream, n_theta, n_phi))

    def _measure_near(self, rays: RecordRays) -> RecordRays:
        """Light of near hits, as what it is over the light of their cells: lights have the same shares in both."""
        if self._near is None:
            return rays
        near = self._near.is_near(rays.distance, rays.cell)
        near.reshape(-1)[rays.detour] = False
        flat = np.flatnonzero(near)
        if len(flat) == 0:
            return rays
        key = np.empty(len(flat), np.uint64)
        kernels.patch_keys(
            rays.position,
            rays.shading_normal,
            rays.stream,
            rays.seed,
            rays.n_theta,
            rays.n_phi,
            rays.distance,
            rays.cell,
            flat,
            key,
        )
        new = np.flatnonzero(self._near.wanted(key))
        if len(new):
            row, ray = flat[new] // rays.n_rays, flat[new] % rays.n_rays
            self._near.learn(key[new], rays.ends(self._snapshot, flat[new]), rays.stream[row] * rays.n_rays + ray)
        sent = np.take(self._near.cells, np.take(rays.cell.reshape(-1), flat), axis=0)
        throughput = np.divide(self._near.radiance(key), sent, out=np.zeros_like(sent), where=sent > 0)
        adjusted = np.concatenate([rays.adjusted, flat])
        order = np.argsort(adjusted, kind="stable")
        return rays._replace(adjusted=adjusted[order], throughput=np.concatenate([rays.throughput, throughput])[order])

    def _trace(self, points: SurfacePoints, stream: I64, n_theta: int, n_phi: int) -> RecordRays:
        n, n_rays = len(stream), n_theta * n_phi
        rays = RecordRays(
            n_theta,
            n_phi,
            self._seed,
            stream,
            spawn_points(self._snapshot, points, points.normal),
            np.require(points.shading_normal, np.float32, ["C", "W"]),
            np.empty((n, n_rays), np.int32),
            np.empty((n, n_rays), np.float32),
            np.empty((n, n_rays), np.int32),
            np.empty((n, n_rays), np.int32),
            np.empty((n, n_rays, 2), np.float32),
            np.empty(0, np.int64),
            np.empty((0, 3), np.float32),
            np.empty(0, np.int64),
            empty_points(0),
        )
        trace = self._tracer.compiled()
        if trace is None:
            return self._one_by_one(rays, points)
        geometry, locator = self._snapshot.geometry, self._gather.locator
        kernels.trace_hemispheres(
            trace,
            self._gather.hit_cells.table(geometry, n * n_rays),
            locator.table,
            locator.depth,
            geometry.points,
            geometry.instance_to_world,
            geometry.instance_to_object,
            self._route,
            rays.position,
            rays.shading_normal,
            np.require(points.normal, np.float32, ["C", "W"]),
            stream,
            self._seed,
            n_theta,
            n_phi,
            rays.cell,
            rays.distance,
            rays.instance,
            rays.triangle,
            rays.uv,
        )
        return self._behind(rays, np.flatnonzero(rays.cell.reshape(-1) == DETOUR))

    def _behind(self, rays: RecordRays, detour: I64) -> RecordRays:
        """Follow rays over surfaces that do not simply reflect."""
        if len(detour) == 0:
            return rays
        row, ray = detour // rays.n_rays, detour % rays.n_rays
        directions, counter = rays._directions(row, ray)
        origins = np.take(rays.position, row, axis=0)
        seed = self._seed
        ends = first_surfaces(self._snapshot, self._tracer, origins, directions, seed, _DETOUR_DEPTH, counter)
        cell = self._gather.locate(ends.points)
        np.put(rays.cell, detour, cell)
        throughput = ends.throughput * (cell >= 0)[:, None]
        return rays._replace(adjusted=detour, throughput=throughput, detour=detour, detour_ends=ends.points)

    def _one_by_one(self, rays: RecordRays, points: SurfacePoints) -> RecordRays:
        """The same with a tracer that compiled loops cannot call."""
        n, n_rays = rays.cell.shape
        row, ray = np.repeat(np.arange(n), n_rays), np.tile(np.arange(n_rays), n)
        directions, _ = rays._directions(row, ray)
        below = (directions * np.take(points.normal, row, axis=0)).sum(axis=1) <= 0
        directions[below] = 0
        hits = self._tracer.intersect(np.take(rays.position, row, axis=0), directions)
        shape = (n, n_rays)
        rays = rays._replace(
            distance=hits.distance.reshape(shape),
            instance=hits.instance.reshape(shape),
            triangle=hits.triangle.reshape(shape),
            uv=np.stack([hits.u, hits.v], axis=1).reshape(n, n_rays, 2),
            cell=self._gather.locate(shade_hits(self._snapshot, hits, directions)).reshape(shape),
        )
        routed = np.take(self._route, np.maximum(hits.triangle, 0)) != 0
        return self._behind(rays, np.flatnonzero((hits.instance >= 0) & routed))


def without_hits(rays: RecordRays) -> RecordRays:
    """The same without the places on their surfaces, half of what they hold: new memory costs as much as the rays."""
    n_rays = rays.n_rays
    return rays._replace(triangle=np.empty((0, n_rays), np.int32), uv=np.empty((0, n_rays, 2), np.float32))


def concatenate_rays(parts: list[RecordRays]) -> RecordRays:
    """Rays of all parts, one after another; all of one tracer."""
    first = parts[0]
    before = np.cumsum([0, *(part.cell.size for part in parts[:-1])])
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in (
            "stream", "position", "shading_normal", "cell", "distance", "instance", "triangle", "uv", "throughput",
        )
    }  # fmt: skip
    return first._replace(
        adjusted=np.concatenate([part.adjusted + begin for part, begin in zip(parts, before, strict=True)]),
        detour=np.concatenate([part.detour + begin for part, begin in zip(parts, before, strict=True)]),
        detour_ends=concatenate_points(*(part.detour_ends for part in parts)),
        **arrays,
    )


def take_rays(rays: RecordRays, rows: I64) -> RecordRays:
    """Rays of some records, ascending."""
    inside = np.full(len(rays.stream), -1, np.int64)
    inside[rows] = np.arange(len(rows))
    arrays: dict[str, Any] = {
        name: np.take(getattr(rays, name), rows, axis=0)
        for name in ("stream", "position", "shading_normal", "cell", "distance", "instance", "triangle", "uv")
    }

    def among(numbers: I64) -> tuple[I64, I64]:
        row = inside[numbers // rays.n_rays]
        kept = np.flatnonzero(row >= 0)
        return kept, row[kept] * rays.n_rays + numbers[kept] % rays.n_rays

    adjusted, detour = among(rays.adjusted), among(rays.detour)
    return rays._replace(
        adjusted=adjusted[1],
        throughput=rays.throughput[adjusted[0]],
        detour=detour[1],
        detour_ends=take_points(rays.detour_ends, detour[0]),
        **arrays,
    )
