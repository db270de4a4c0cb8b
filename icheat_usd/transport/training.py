"""Lights that nobody placed: what plausible ones make leave the gather cells.

Where to keep rows, and which of their coefficients, is decided by what lights
do to them. An artist's lights are not known yet, so these stand for them: the
choice must be good for any light of their kinds, in any place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels.rows import mean_over_segments
from icheat_usd.kernels.samples import cosine_rays
from icheat_usd.materials import effective_albedo, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, F64, I64, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points, transmittance
from icheat_usd.transport.bounces import Bounces

_PLACES = 4096  # rays whose ends say where in the scene there is room for lights
_PATCHES = 2  # patch points of a cell that are lit: the rest would make edges sharper, and nothing else
_SKY_RAYS = 16  # per cell, shared by all domes
_BOUNCES = 5  # indirect light is soft: later bounces look like these
_TRIES = 16  # places for a light before one that lights nothing is given up
_SHORT = 0.999  # of a shadow ray, so that a light close to a wall is not behind it

_INDOORS = ("panel", "spot", "bulb", "window", "beam", "grazing")
_OUTDOORS = ("panel", "spot", "sun", "bulb", "window", "dome", "beam", "grazing")


@dataclass(frozen=True)
class _Places:
    """Rays between surfaces of the scene: lights stand on them and near their ends."""

    origin: F32  #: (n, 3)
    direction: F32  #: (n, 3) unit
    distance: F32  #: (n,) to the surface that ends the ray; the longer, the more room for a light
    normal: F32  #: (n, 3) there, towards the ray


@dataclass(frozen=True)
class _Sky:
    """Rays from all cells, and what of the sky they see."""

    cell: I64  #: (m,) of the rays that leave the scene, ascending
    direction: F32  #: (m, 3) unit
    share: F32  #: (m,) of the light that comes through; 1 / number of the cell's rays is in it


@dataclass(frozen=True)
class _Shape:
    """A parallelogram of light; without extent it is a point."""

    centre: F64  #: (3,)
    u: F64  #: (3,) half an edge
    v: F64  #: (3,)
    axis: F64  #: (3,) unit, where it shines to
    cone: tuple[float, float] | None = None  #: cosines where a spot's light ends and where it is full
    isotropic: bool = False  #: shines alike to all sides


def training_radiance(
    snapshot: SceneSnapshot, tracer: Tracer, gather: GatherSamples, bounces: Bounces, n: int = 96, seed: int = 0
) -> F32:
    """What `n` plausible lights make leave the gather cells, after some bounces.

    Panels in free space, spots, narrow beams that light a few cells, bulbs
    and windows close to walls, rectangles at grazing angles; where the scene
    is open also suns through its openings, and domes. The scene's own lights
    are not among them.

    Returns
    -------
    (n, n_gather) float32
        Scalar radiance; each light's mean over the cells by area is 1.

    Notes
    -----
    Lights are points of view for choices, not pictures: one shadow ray per
    patch point, mean albedo. Depends on the seed alone.
    """
    rng = np.random.default_rng(seed)
    places = _find_places(snapshot, tracer, gather, rng, seed)
    sky = _find_sky(snapshot, tracer, gather, seed)
    kinds = _OUTDOORS if len(sky.cell) else _INDOORS
    lamp = _Lamp(snapshot, tracer, gather)
    out = np.empty((n, gather.n), np.float32)
    for light in range(n):
        kind = kinds[light % len(kinds)]
        for _ in range(_TRIES):
            if kind == "dome":
                out[light] = _under_dome(sky, gather.n, rng) * lamp.cell_albedo
            elif kind == "sun":
                out[light] = lamp.parallel(*_sun(sky, rng), rng)
            else:
                out[light] = lamp.shine(_place(kind, places, rng), rng)
            if out[light].any():
                break
        else:
            out[light] = lamp.cell_albedo
    total = out.T.copy()
    last = total
    albedo = bounces.albedo.mean(axis=1)[:, None]
    for _ in range(_BOUNCES):
        last = albedo * bounces.rows.matmul(last)
        total += last
    mean = np.average(total.astype(np.float64), axis=0, weights=gather.area)
    return np.ascontiguousarray(total.T / np.where(mean > 0, mean, 1)[:, None], np.float32)


class _Lamp:
    """Lights the patch points of the cells."""

    def __init__(self, snapshot: SceneSnapshot, tracer: Tracer, gather: GatherSamples) -> None:
        count = np.minimum(np.diff(gather.cell_begin), _PATCHES)
        self._begin = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        cell = np.repeat(np.arange(gather.n), count)
        points = take_points(gather.patch_points, gather.cell_begin[cell] + np.arange(len(cell)) - self._begin[cell])
        self._snapshot, self._tracer, self._points = snapshot, tracer, points
        self._origin = spawn_points(snapshot, points, points.normal)
        self._nearest = (0.25 * gather.area[cell])[:, None]
        self._albedo = effective_albedo(points).mean(axis=1)
        self.cell_albedo = self._mean(self._albedo)

    def shine(self, shape: _Shape, rng: np.random.Generator) -> F32:
        """Radiance that leaves the cells under one light: (n_gather,)."""
        place = rng.random((len(self._origin), 2), np.float32) * 2 - 1
        end = shape.centre + place[:, :1] * shape.u + place[:, 1:] * shape.v
        to_light = (end - self._origin).astype(np.float32)
        # A light is no nearer to a cell than the cell is wide: the mean over the cell is never brighter.
        squared = np.maximum(_dot(to_light, to_light)[:, None], self._nearest)
        unit = to_light / np.sqrt(squared)
        emitted = -unit @ shape.axis.astype(np.float32)
        if shape.cone is not None:
            edge = np.clip((emitted - shape.cone[0]) / (shape.cone[1] - shape.cone[0]), 0, 1)
            emitted = edge * edge * (3 - 2 * edge)
        elif shape.isotropic:
            emitted = np.ones_like(emitted)
        return self._lit(to_light, _cosine(self._points, unit) * np.maximum(emitted, 0) / squared[:, 0], _SHORT)

    def parallel(self, towards: F64, angle: float, rng: np.random.Generator) -> F32:
        """The same under a sun of half-angle `angle`, radians."""
        tangent, other = _frame(towards)
        radius, turn = angle * np.sqrt(rng.random(len(self._origin))), 2 * np.pi * rng.random(len(self._origin))
        direction = towards + (radius * np.cos(turn))[:, None] * tangent + (radius * np.sin(turn))[:, None] * other
        rays: F32 = direction.astype(np.float32)
        return self._lit(rays, _cosine(self._points, rays), np.inf)

    def _lit(self, direction: F32, value: F32, t_max: float) -> F32:
        lit = np.flatnonzero(value > 0)
        seen = transmittance(self._snapshot, self._tracer, self._origin[lit], direction[lit], t_max).mean(axis=1)
        out = np.zeros(len(value), np.float32)
        out[lit] = value[lit] * seen * self._albedo[lit]
        return self._mean(out)

    def _mean(self, values: F32) -> F32:
        out = np.empty((len(self._begin) - 1, 1), np.float32)
        mean_over_segments(self._begin, np.ascontiguousarray(values, np.float32)[:, None], out)
        return out[:, 0]


def _cosine(points: SurfacePoints, direction: F32) -> F32:
    above = _dot(points.normal, direction) > 0
    return np.where(above, np.maximum(_dot(points.shading_normal, direction), 0), 0).astype(np.float32)


def _dot(a: F32, b: F32) -> F32:
    """Scalar products of (n, 3) rows; a tenth of the time of a sum along the short axis."""
    out: F32 = a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]
    return out


def _find_places(
    snapshot: SceneSnapshot, tracer: Tracer, gather: GatherSamples, rng: np.random.Generator, seed: int
) -> _Places:
    """Cells are denser where they matter to the view, so their rays cross the rooms that it shows."""
    start = rng.integers(0, gather.n, _PLACES)
    origin, direction = _rays(snapshot, gather, start, 1, seed)
    ends = first_surfaces(snapshot, tracer, origin, direction, seed)
    met = (ends.points.instance >= 0)[:, None]
    ahead = np.where(met, ends.points.position - origin, direction * np.float32(snapshot.radius))
    distance = np.linalg.norm(ahead, axis=1)
    whole = np.flatnonzero(distance > 0)
    normal = np.where(met, ends.points.normal, -direction)
    distance = distance[whole]
    return _Places(origin[whole], ahead[whole] / distance[:, None], distance, normal[whole])


def _find_sky(snapshot: SceneSnapshot, tracer: Tracer, gather: GatherSamples, seed: int) -> _Sky:
    start = np.repeat(np.arange(gather.n), _SKY_RAYS)
    origin, direction = _rays(snapshot, gather, np.arange(gather.n), _SKY_RAYS, seed + 1)
    share = transmittance(snapshot, tracer, origin, direction, np.inf).mean(axis=1) / np.float32(_SKY_RAYS)
    seen = np.flatnonzero((share > 0) & direction.any(axis=1))
    return _Sky(start[seen], direction[seen], share[seen])


def _rays(snapshot: SceneSnapshot, gather: GatherSamples, start: I64, n_rays: int, seed: int) -> tuple[F32, F32]:
    points = take_points(gather.points, start)
    n = len(start) * n_rays
    origins, directions = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
    cosine_rays(
        spawn_points(snapshot, points, points.normal),
        points.shading_normal,
        points.normal,
        np.arange(len(start) + 1),
        n_rays,
        seed & 0xFFFFFFFF,
        np.arange(len(start)),
        np.empty(n, np.int64),
        origins,
        directions,
    )
    return origins, directions


def _place(kind: str, places: _Places, rng: np.random.Generator) -> _Shape:
    room = np.cumsum(places.distance, dtype=np.float64)
    ray = int(np.searchsorted(room, rng.random() * room[-1]))
    direction, normal = places.direction[ray].astype(np.float64), places.normal[ray].astype(np.float64)
    length = float(places.distance[ray])
    origin = places.origin[ray].astype(np.float64)
    end = origin + direction * length
    if kind in ("spot", "beam"):  # somewhere along the ray, at its end
        low, high = (2.0, 5.0) if kind == "beam" else (8.0, 30.0)
        angle = np.radians(rng.uniform(low, high))
        u, v = (0.01 * length * axis for axis in _frame(direction))
        cone = (float(np.cos(angle)), float(np.cos(0.7 * angle)))
        return _Shape(origin + direction * length * rng.uniform(0.05, 0.6), u, v, direction, cone)
    if kind == "panel":  # in free space, large
        u, v = (axis * length * rng.uniform(0.1, 0.4) for axis in _frame(direction))
        return _Shape(origin + direction * length * rng.uniform(0.3, 0.7), u, v, -direction)
    tangent, other = _frame(normal)
    if kind == "bulb":  # close to a wall
        extent = 0.02 * length
        return _Shape(
            end + normal * length * rng.uniform(0.04, 0.3), extent * tangent, extent * other, normal, None, True
        )
    wide, high = length * rng.uniform(0.05, 0.3, 2)
    if kind == "window":  # in a wall
        return _Shape(end + normal * 0.02 * length, wide * tangent, high * other, normal)
    # Grazing: on edge at a wall, and shining along it.
    turn = rng.uniform(0, 2 * np.pi)
    along, across = np.cos(turn) * tangent + np.sin(turn) * other, np.cos(turn) * other - np.sin(turn) * tangent
    high = 0.1 * length
    return _Shape(end + normal * 1.2 * high, wide * across, high * normal, along)


def _sun(sky: _Sky, rng: np.random.Generator) -> tuple[F64, float]:
    """Direction to a sun that some cell sees, and its half-angle."""
    return sky.direction[rng.integers(len(sky.cell))].astype(np.float64), float(rng.choice([0.0047, 0.02, 0.08]))


def _under_dome(sky: _Sky, n: int, rng: np.random.Generator) -> F32:
    """Mean radiance of a sky with a bright side, as the cells see it: (n,)."""
    bright = sky.direction[rng.integers(len(sky.cell))]
    sharpness, floor = rng.choice([1.0, 8.0, 60.0]), rng.choice([0.0, 0.02, 0.3])
    radiance = floor + (0.5 + 0.5 * np.clip(sky.direction @ bright, -1, 1)) ** sharpness
    return np.bincount(sky.cell, radiance * sky.share, n).astype(np.float32)


def _frame(normal: F64) -> tuple[F64, F64]:
    """Two unit vectors at right angles to a unit vector."""
    helper = np.eye(3)[int(np.argmin(np.abs(normal)))]
    tangent = np.cross(normal, helper)
    tangent /= np.linalg.norm(tangent)
    return tangent, np.cross(normal, tangent)
