"""Photons: light traced from every kind of light over diffuse reflections, mirrors and glass.

They follow the same rules as gather rays and shadow rays, so that both ways of
solving the earlier bounces agree: every reflection at a scattering surface is
diffuse; between two of them mirrors reflect, glass bends and holes let through;
straight from a light, glass lets ``1 - F`` through without bending it and mirrors
block, as for shadow rays (no caustics). Light and shadow linking, shaping and diffuse
multipliers of lights count. Edits are never seen here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.kernels import photons as kernels
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.tracing import straight_transmittance
from icheat_usd.lighting import LightSampler
from icheat_usd.lighting.controls import hidden_instances, receives, shape
from icheat_usd.materials import (
    concatenate_points,
    effective_albedo,
    nonzero_rows,
    points_on_surface,
    shade_hits,
    take_points,
)
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import F32, F64, I32, I64, U8, DeltaKind, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points
from icheat_usd.tracing.paths import MAX_LAYERS, passing_materials

_AT_ONCE = 1 << 18  # photons in flight, to bound memory
_PILOT = 1 << 15  # photons that find out what of a light gets where it matters
_GRID = 32  # cells on a side of what is learnt of a light
_BLIND_SHARE = 0.25  # of the photons that do not go where the pilot found light
_EQUAL_SHARE = 0.25  # of the photons, the same number for every light: each may be looked at alone

# Photons start this share of the scene's radius from an analytic light: such lights are often authored in the plane
# of a ceiling, and direct light ignores what is as near to them.
_CLEARANCE = 1e-4


@dataclass(frozen=True)
class PhotonSettings:
    """Effort of a photon map."""

    n_emitted: int = 1 << 20  #: photons that leave lights
    n_nearest: int = 200  #: photons of one density estimate
    max_radius: float = 0.1  #: of one density estimate, as a share of the scene's radius
    n_bounces: int = 16  #: diffuse reflections before the last one
    seed: int = 0


class Photons(NamedTuple):
    """Light that arrives at scattering surfaces."""

    position: F32  #: (m, 3)
    normal: F32  #: (m, 3) of the surface's plane, on the side that the photon came from
    power: F32  #: (m, 3) flux that arrives, as shading with the interpolated normal sees it
    light: I32  #: (m,) where it comes from
    bounce: U8  #: (m,) diffuse reflections on the way; 0 is direct light

    def take(self, rows: Any) -> Photons:
        """Photons of these rows (indices or mask), contiguous."""
        columns: list[Any] = [np.ascontiguousarray(column[rows]) for column in self]
        return Photons(*columns)


def trace_photons(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    settings: PhotonSettings,
    *,
    progress: Progress = silent,
) -> Photons:
    """Photons of all lights, direct ones included.

    Lights share the photons by the light that arrives after a reflection, a quarter equally. Each photon is a
    path that ends by Russian roulette or after `n_bounces` arrivals; random numbers depend on (seed, light, photon,
    bounce) alone.

    Notes
    -----
    Light from infinitely far, of distant lights and domes, starts on a disk as wide as the scene. A pilot finds
    out where on it sunlight gets into a room, and from which directions that of domes does (lamps: into which); three
    quarters of the photons go there. Of a dome over a wide landscape most of the rest is spent outside.
    """
    found: list[Photons] = []
    aims = [_learn(snapshot, tracer, sampler, settings, light) for light in range(len(snapshot.lights.kind))]
    shares = _shares(aims, settings)
    done, total = 0, max(int(shares.sum()), 1)
    for light, n in enumerate(shares.tolist()):
        for first in range(0, n, _AT_ONCE):
            progress("trace photons", done / total)
            count = min(_AT_ONCE, n - first)
            own = _Bundle(snapshot, tracer, sampler, settings, light, first, n, count, aims[light])
            found += own.trace()
            done += count
    progress("trace photons", 1.0)
    if not found:
        none = np.zeros((0, 3), np.float32)
        return Photons(none, none, none, np.zeros(0, np.int32), np.zeros(0, np.uint8))
    columns: list[Any] = [np.concatenate(column) for column in zip(*found, strict=True)]
    return Photons(*columns)


class _Aim(NamedTuple):
    """Where photons of a light are sent: cumulative distributions on a grid of the unit square."""

    rows: F64  #: (n,)
    cells: F64  #: (n, n) in each row
    useful: float  #: power that arrives after a reflection


def _aim(weight: F64) -> _Aim:
    """Aim by weights (n, n), of which the neighbours of a cell have a share: a pilot does not find everything."""
    near = sum(np.roll(weight, (x, y), (0, 1)) for x in (-1, 0, 1) for y in (-1, 0, 1)) / 9
    mean = float(weight.mean())
    density = _BLIND_SHARE + (1 - _BLIND_SHARE) * (near / mean if mean > 0 else np.ones_like(weight))
    cells = np.cumsum(density, axis=1)
    rows = np.cumsum(cells[:, -1])
    cells, rows = cells / cells[:, -1:], rows / rows[-1]
    return _Aim(rows, np.ascontiguousarray(cells), float(weight.sum()))


def _learn(
    snapshot: SceneSnapshot, tracer: Tracer, sampler: LightSampler, settings: PhotonSettings, light: int
) -> _Aim:
    """Find out with some photons of a light which of them are worth tracing."""
    anywhere = _aim(np.zeros((_GRID, _GRID)))
    pilot = replace(settings, seed=int(hash_combine(settings.seed, 0x9F)))
    bundle = _Bundle(snapshot, tracer, sampler, pilot, light, 0, _PILOT, _PILOT, anywhere)
    arrived = bundle.trace()
    # Direct light is found by shadow rays; it counts where nothing else arrives.
    later = arrived[1:] or arrived
    if not later:
        return anywhere
    power = np.concatenate([one.power.mean(axis=1, dtype=np.float64) for one in later])
    photon = np.concatenate(bundle.arrivals[-len(later) :])
    found = np.bincount(bundle.cell[photon], power, _GRID * _GRID).astype(np.float64)
    return _aim(found.reshape(_GRID, _GRID))


def _shares(aims: list[_Aim], settings: PhotonSettings) -> I64:
    """Photons of each light."""
    useful = np.array([aim.useful for aim in aims])
    shining = useful > 0
    if not shining.any():
        return np.zeros(len(aims), np.int64)
    share = (1 - _EQUAL_SHARE) * useful / useful.sum() + _EQUAL_SHARE * shining / shining.sum()
    return np.ceil(settings.n_emitted * share).astype(np.int64)


def _emit(
    snapshot: SceneSnapshot,
    sampler: LightSampler,
    light: int,
    first: int,
    count: int,
    total: int,
    seed: int,
    aim: _Aim,
) -> tuple[F32, F32, F32, I32]:
    """Where photons of a light start, their directions and power, and the cells that they were aimed at."""
    lights = snapshot.lights
    origin, direction = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    power = np.zeros((count, 3), np.float32)
    cell = np.zeros(count, np.int32)
    diffuse = np.float32(snapshot.controls(light).diffuse)
    if not nonzero_rows(lights.radiance[light : light + 1])[0]:
        return origin, direction, power, cell
    if lights.kind[light] != LightKind.MESH:
        radius = float(snapshot.radius)
        kernels.emit_from_shape(
            lights, snapshot.textures, sampler.tables, light, radius, _CLEARANCE * radius, aim.rows, aim.cells, first,
            total, seed, origin, direction, power, cell,
        )  # fmt: skip
        shape(snapshot, light, -direction, power)
        return origin, direction, power * diffuse, cell
    row, barycentric, side = np.zeros(count, np.int64), np.zeros((count, 2), np.float32), np.zeros(count, np.uint8)
    kernels.emit_from_mesh(lights, sampler.tables, light, first, total, seed, row, barycentric, side, power)
    instance, triangle = lights.triangle_instance[row], lights.triangle[row]
    start = points_on_surface(snapshot, instance, triangle, barycentric, side)
    kernels.directions_from_mesh(start.normal, light, first, seed, direction)
    return spawn_points(snapshot, start, direction), direction, power * diffuse * start.emission, cell


class _Bundle:
    """Some photons of one light, from there until all of them are absorbed."""

    def __init__(
        self,
        snapshot: SceneSnapshot,
        tracer: Tracer,
        sampler: LightSampler,
        settings: PhotonSettings,
        light: int,
        first: int,
        total: int,
        count: int,
        aim: _Aim,
    ) -> None:
        self.snapshot, self.tracer, self.light, self.n_bounces = snapshot, tracer, light, settings.n_bounces
        self.seed = int(hash_combine(hash_combine(settings.seed, 0xA0), light))
        self.origin, self.direction, self.power, self.cell = _emit(
            snapshot, sampler, light, first, count, total, settings.seed & 0xFFFFFFFF, aim
        )
        self.photon = np.arange(first, first + count, dtype=np.int32)
        self.arrivals: list[I32] = []  #: numbers of the photons that arrived, bounce by bounce

    def trace(self) -> list[Photons]:
        """What arrives, bounce by bounce."""
        arrived = []
        points = self._cross()
        for bounce in range(self.n_bounces):
            if bounce:
                ends = first_surfaces(
                    self.snapshot,
                    self.tracer,
                    self.origin,
                    self.direction,
                    int(hash_combine(self.seed, bounce)),
                    counters=self.photon,
                    flux=True,
                )
                self.power = self.power * ends.throughput
                self.direction, points = ends.direction, ends.points
            points = self._keep(points, (points.instance >= 0) & nonzero_rows(self.power))
            if not len(self.photon):
                break
            power = np.empty_like(self.power)
            kernels.arriving_power(points, self.direction, self.power, power)
            self.power = power
            # A see-through surface stops a photon by chance, but reflects what arrives for those who hit it by chance.
            whole = (self.power / np.maximum(points.opacity, np.float32(1e-3))[:, None]).astype(np.float32)
            self.arrivals.append(self.photon)
            arrived.append(
                Photons(
                    points.position,
                    points.normal,
                    whole,
                    np.full(len(whole), self.light, np.int32),
                    np.full(len(whole), bounce, np.uint8),
                )
            )
            self._reflect(points, bounce)
        return arrived

    def _keep(self, points: SurfacePoints, mask: Any) -> SurfacePoints:
        rows = np.flatnonzero(mask)
        self.photon, self.power, self.direction = self.photon[rows], self.power[rows], self.direction[rows]
        return take_points(points, rows)

    def _reflect(self, points: SurfacePoints, bounce: int) -> None:
        lives = np.zeros(len(self.photon), np.bool_)
        self.direction = np.empty_like(self.direction)
        kernels.reflect_photons(
            points.normal, effective_albedo(points), self.photon, bounce, self.seed, self.power, self.direction, lives
        )
        points = self._keep(points, lives)
        self.origin = spawn_points(self.snapshot, points, self.direction)

    def _cross(self) -> SurfacePoints:
        """Take the photons straight to where they arrive first, and drop those that arrive nowhere.

        What does not block the light (`shadowLink`) and yet receives it stops a copy of a photon.
        """
        passing = passing_materials(self.snapshot.materials)
        see_through = bool(passing[np.unique(self.snapshot.geometry.material)].any())
        hidden = hidden_instances(self.snapshot, self.light)
        rows = np.flatnonzero(nonzero_rows(self.power))
        origin = self.origin[rows]
        arrived: list[tuple[I64, SurfacePoints]] = []
        for layer in range(MAX_LAYERS):
            direction = np.ascontiguousarray(self.direction[rows])
            points = shade_hits(self.snapshot, self.tracer.intersect(origin, direction), direction)
            goes = np.zeros(len(rows), np.bool_)
            if see_through:
                share = np.empty(len(rows), np.float32)
                straight_transmittance(points, direction, share)
                kernels.crossings(share, self.photon[rows], layer, self.seed, goes)
            stays = ~goes & (points.delta == DeltaKind.NONE)
            lit = receives(self.snapshot, self.light, points.instance)
            stays &= (points.instance >= 0) if lit is None else lit
            arrived.append((rows[stays], take_points(points, stays)))
            if hidden is not None:
                goes |= hidden[points.instance]
            goes &= points.instance >= 0
            rows = rows[goes]
            if not len(rows):
                break
            origin = spawn_points(self.snapshot, take_points(points, goes), direction[goes])
        stopped = np.concatenate([one for one, _ in arrived])
        self.photon, self.power, self.direction = self.photon[stopped], self.power[stopped], self.direction[stopped]
        return concatenate_points(*(points for _, points in arrived))
