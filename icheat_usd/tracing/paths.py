"""Rays that mirrors, glass, holes and see-through surfaces carry on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icheat_usd.materials import shade_hits, take_points
from icheat_usd.scene import F32, I32, Bool, DeltaKind, Hits, Materials, SceneSnapshot, SurfacePoints, Texture
from icheat_usd.tracing._rays import checked_rays, unit_directions
from icheat_usd.tracing.protocol import Tracer, spawn_points

#: A shadow ray through more layers than this counts as blocked.
MAX_LAYERS = 256


class PathEnds(NamedTuple):
    """Where n rays end: at the first surface that scatters them."""

    points: SurfacePoints  #: instance -1 = escaped, absorbed or too deep; delta NONE
    throughput: F32  #: (n, 3) 0 where absorbed or too deep
    direction: F32  #: (n, 3) unit, of the last segment
    distance: F32  #: (n,) metres along all segments; inf where nothing was reached


def passing_materials(materials: Materials) -> Bool:
    """(n,) which materials can let light straight through somewhere."""
    textured = materials.texture[:, Texture.OPACITY] >= 0
    return (
        textured
        | (materials.opacity < np.maximum(materials.opacity_threshold, 1e-30))
        | ((materials.opacity < 1) & (materials.opacity_threshold <= 0))
    )


def is_see_through(snapshot: SceneSnapshot) -> bool:
    """Whether any surface may let light straight through."""
    passing = passing_materials(snapshot.materials)
    return bool(passing.any() and passing[snapshot.geometry.material].any())


def first_surfaces(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    origins: F32,
    directions: F32,
    seed: int,
    max_depth: int = 16,
    counters: I32 | None = None,
    flux: bool = False,
) -> PathEnds:
    """Follow rays over everything that does not scatter them.

    Mirrors reflect; smooth glass reflects or refracts by a random choice with
    the Fresnel reflectance as probability; holes and the see-through share of
    translucent surfaces let a path straight on. Emission met on the way is not collected.

    Parameters
    ----------
    origins, directions : (n, 3) float32
        World space, metres; directions of any length.
    seed : int
        Random numbers depend on (seed, counter, depth) alone.
    max_depth : int
        Deltas along one path before it is given up.
    counters : (n,) int32
        One per ray, by default its row: callers that work in blocks number their rays across blocks.
    flux : bool
        Whether the paths carry flux from a light instead of asking for radiance. Radiance here is the same on both
        sides of glass; so flux that is bent into a denser medium, and squeezed there, counts less by the square of
        the index of refraction, and as much more on its way out (Veach 1997, section 5.2).

    Returns
    -------
    PathEnds
    """
    from icheat_usd.kernels import tracing

    origins, directions, _ = checked_rays(origins, directions, None)
    ray_direction = unit_directions(directions)
    n = len(origins)
    path = np.arange(n, dtype=np.int32)
    counter = path if counters is None else np.require(counters, np.int32, ["C", "W"])
    throughput = np.ones((n, 3), np.float32)
    travelled = np.zeros(n, np.float32)
    ends: PathEnds | None = None
    for depth in range(max_depth + 1):
        hits = tracer.intersect(origins, ray_direction)
        points = shade_hits(snapshot, hits, ray_direction)
        last = ray_direction.copy()
        state = np.empty(len(path), np.uint8)
        tracing.step_paths(points, ray_direction, counter, int(seed) & 0xFFFFFFFF, depth, throughput, state)
        if flux:
            _squeeze(points, ray_direction, throughput)
        travelled += hits.distance
        followed = state == tracing.FOLLOWED
        absorbed = state == tracing.ABSORBED
        if depth == max_depth:
            absorbed |= followed
        if ends is None:
            ends = PathEnds(points, throughput.copy(), last, travelled.copy())
            if not followed.any():
                return ends
        else:
            kept: Any
            for kept, now in zip(ends.points, points, strict=True):
                kept[path] = now
            ends.throughput[path] = throughput
            ends.direction[path] = last
            ends.distance[path] = travelled
        gone = path[absorbed]
        for column in ends.points:
            column[gone] = 0
        ends.points.instance[gone] = ends.points.triangle[gone] = -1
        ends.throughput[gone] = 0
        ends.distance[gone] = np.inf
        if depth == max_depth or not followed.any():
            break
        alive = np.flatnonzero(followed)
        ray_direction = np.ascontiguousarray(ray_direction[alive])
        origins = spawn_points(snapshot, take_points(points, alive), ray_direction)
        path, counter = path[alive], counter[alive]
        throughput, travelled = throughput[alive], travelled[alive]
    assert ends is not None
    return ends


def _squeeze(points: SurfacePoints, onwards: F32, throughput: F32) -> None:
    """Weigh flux that goes on through glass, in place."""
    bent = np.flatnonzero((points.delta == DeltaKind.GLASS) & (points.instance >= 0))
    bent = bent[np.einsum("ij,ij->i", onwards[bent], points.normal[bent]) < 0]
    ior2 = points.ior[bent] ** 2
    throughput[bent] *= np.where(points.side[bent] == 0, 1 / ior2, ior2)[:, None]


def transmittance(
    snapshot: SceneSnapshot, tracer: Tracer, origins: F32, directions: F32, t_max: F32 | float | None = None
) -> F32:
    """Share of light that crosses each segment in a straight line.

    Parameters
    ----------
    origins, directions : (n, 3) float32
        World space; directions of any length.
    t_max : (n,) float32, one number, or None
        End of the segments in units of the direction.

    Returns
    -------
    (n, 3) float32
        0 where something opaque is in the way. Every interface of smooth glass lets ``1 - F`` through
        without bending the ray (right for panes; solid glass casts no caustics), holes 1, translucent surfaces
        ``1 - opacity``. Mirrors block.
    """
    from icheat_usd.kernels import tracing

    origins, directions, limits = checked_rays(origins, directions, t_max)
    n = len(origins)
    if not is_see_through(snapshot):
        clear = ~tracer.occluded(origins, directions, limits)
        return np.repeat(clear.astype(np.float32)[:, None], 3, 1)

    passing = passing_materials(snapshot.materials)
    left = np.ones(n, np.float32)
    ray = np.arange(n)
    limits = np.broadcast_to(limits, n).astype(np.float32)
    for _ in range(MAX_LAYERS):
        hits = tracer.intersect(origins, directions, limits)
        met = hits.instance >= 0
        through = met & passing[snapshot.geometry.material[hits.triangle]]
        left[ray[met & ~through]] = 0
        alive = np.flatnonzero(through)
        if not len(alive):
            return np.repeat(left[:, None], 3, 1)
        ray, origins, directions, limits = ray[alive], origins[alive], directions[alive], limits[alive]
        columns: list[Any] = [column[alive] for column in hits]
        hits = Hits(*columns)
        points = shade_hits(snapshot, hits, directions)
        share = np.empty(len(ray), np.float32)
        tracing.straight_transmittance(points, directions, share)
        left[ray] *= share
        # Going on from beside the ray must still end at the same place, which may be as close to a surface.
        finite = np.isfinite(limits)
        ends = origins + directions * np.where(finite, limits, 0)[:, None]
        origins = spawn_points(snapshot, points, directions)
        onwards = np.where(finite[:, None], ends - origins, directions)
        ahead = (onwards * directions).sum(1) > 0
        directions, limits = onwards, np.where(finite, 1, np.inf).astype(np.float32)
        alive = np.flatnonzero((share > 0) & ahead)
        ray, origins, directions, limits = ray[alive], origins[alive], directions[alive], limits[alive]
        if not len(ray):
            return np.repeat(left[:, None], 3, 1)
    left[ray] = 0
    return np.repeat(left[:, None], 3, 1)
