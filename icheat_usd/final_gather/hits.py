"""Gather rays, and the light that leaves the surfaces which they hit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.final_gather.cell_rays import CellRays, trace_to_cells
from icheat_usd.kernels.direct import fill_specular_numbers
from icheat_usd.kernels.gather import uniforms
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.samples import cosine_rays
from icheat_usd.lighting import LightSampler, irradiance
from icheat_usd.materials import effective_albedo, nonzero_rows, sample_specular, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, Bool, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points
from icheat_usd.transport import sum_groups

INVERSE_PI = np.float32(1.0 / np.pi)


class GatherRays(NamedTuple):
    """Rays from points, each followed to the first surface that scatters."""

    ends: SurfacePoints  #: (n,) instance -1 where a ray left the scene
    throughput: F32  #: (n, 3) of the delta vertices in between and of the lobe; 0 where there is no end
    origins: F32  #: (n, 3)
    directions: F32  #: (n, 3)
    seed: int  #: of the choices at delta vertices, for `first_surfaces`
    reflectance: F32 | None = None  #: (n, 3) the lobe's share of `throughput`; None is 1

    def ends_of(self, snapshot: SceneSnapshot, some: I64) -> SurfacePoints:
        """Surfaces that some of the rays end on."""
        return take_points(self.ends, some)

    def cells(self, gather: GatherSamples) -> I32:
        """Gather cells that the rays end in; -1 for none."""
        return gather.locate(self.ends)

    def distances(self) -> F32:
        """Metres from start to end, in a straight line; anything where there is no end."""
        return np.asarray(np.linalg.norm(self.ends.position - self.origins, axis=1), np.float32)


def trace_hemisphere(
    snapshot: SceneSnapshot, tracer: Tracer, points: SurfacePoints, stream: I64, n_rays: int, seed: int
) -> GatherRays:
    """`n_rays` cosine-weighted rays from each point, in the order of the points.

    Rays that would point below the geometric surface have throughput 0.
    """
    origins, directions = _hemisphere(snapshot, points, stream, n_rays, seed)
    seed = int(hash_combine(seed, 1))
    ends = first_surfaces(snapshot, tracer, origins, directions, seed)
    return GatherRays(ends.points, ends.throughput * (ends.points.instance >= 0)[:, None], origins, directions, seed)


def trace_hemisphere_to_cells(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    points: SurfacePoints,
    stream: I64,
    n_rays: int,
    seed: int,
) -> GatherRays | CellRays:
    """`trace_hemisphere`, for callers that want cells first."""
    origins, directions = _hemisphere(snapshot, points, stream, n_rays, seed)
    reflectance = np.repeat(nonzero_rows(directions)[:, None], 3, axis=1).astype(np.float32)
    rays = trace_to_cells(snapshot, tracer, gather, origins, directions, reflectance, int(hash_combine(seed, 1)))
    return trace_hemisphere(snapshot, tracer, points, stream, n_rays, seed) if rays is None else rays


def _hemisphere(snapshot: SceneSnapshot, points: SurfacePoints, stream: I64, n_rays: int, seed: int) -> tuple[F32, F32]:
    """Starts and directions of `n_rays` cosine-weighted rays from each point."""
    n = len(stream)
    origins, directions = np.empty((n * n_rays, 3), np.float32), np.empty((n * n_rays, 3), np.float32)
    cosine_rays(
        spawn_points(snapshot, points, points.normal),
        points.shading_normal,
        points.normal,
        np.arange(n + 1, dtype=np.int64),
        n_rays,
        seed,
        stream,
        np.empty(n * n_rays, np.int64),
        origins,
        directions,
    )
    return origins, directions


def trace_specular(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    points: SurfacePoints,
    to_eye: F32,
    draws: I64,
    n_rays: int,
    seed: int,
) -> GatherRays:
    """`n_rays` rays from each point that follow its specular lobe; the lobe's weight is in their throughput.

    `draws` (n, 2) are the sequence of each point and its number among those that share it: their rays are stratified
    together.
    """
    repeated = take_points(points, np.repeat(np.arange(len(draws)), n_rays))
    u = np.empty((len(draws) * n_rays, 2), np.float32)
    fill_specular_numbers(draws * (1, n_rays), n_rays, seed & 0xFFFFFFFF, u)
    directions, base_weight, edge_weight = sample_specular(repeated, np.repeat(to_eye, n_rays, axis=0), u)
    origins = spawn_points(snapshot, repeated, directions)
    seed = int(hash_combine(seed, 1))
    ends = first_surfaces(snapshot, tracer, origins, directions, seed)
    reflectance = base_weight[:, None] * repeated.specular + edge_weight[:, None] * repeated.specular_edge
    lit = (ends.points.instance >= 0)[:, None]
    throughput = np.where(lit, reflectance * ends.throughput, np.float32(0)).astype(np.float32)
    return GatherRays(ends.points, throughput, origins, directions, seed, reflectance)


class Reflected(NamedTuple):
    """Diffuse radiance that n points reflect."""

    total: F32  #: (n, 3)
    by_group: F32  #: (G, n, 3) of each group of lights; the same array where there is only one


def reflected_radiance(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    throughput: F32,
    *,
    n_bounces: int,
    seed: int,
    light_group: I64 | None = None,
    n_groups: int = 1,
    only: Bool | None = None,
) -> Reflected:
    """Diffuse radiance that each point reflects, by one path per point.

    Emission is not in it: emissive meshes and domes count as direct light.
    Paths end after `n_bounces` reflections, or earlier by Russian roulette.

    Parameters
    ----------
    points : SurfacePoints
        (n,) hits of gather rays; those with `throughput` 0 are skipped.
    throughput : (n, 3) float32
        Carried into the result.
    light_group : (n_lights,), optional
        Group of each light, where there are several; paths and `total` do not depend on it.
    only : (n_lights,) bool, optional
        Lights whose light counts; all by default. Paths do not depend on it.

    Returns
    -------
    Reflected
        Radiance, scene-linear.
    """
    result = np.zeros_like(throughput)
    by_group = result[None] if n_groups == 1 else np.zeros((n_groups, *throughput.shape), np.float32)
    alive = np.flatnonzero(nonzero_rows(throughput))
    carried = np.take(throughput, alive, axis=0)
    points = take_points(points, alive)
    for bounce in range(n_bounces):
        if len(alive) == 0:
            break
        step_seed = int(hash_combine(seed, bounce))
        albedo = effective_albedo(points)
        per_light = irradiance(snapshot, tracer, sampler, points, step_seed, 1)
        if only is not None:
            per_light[~only] = 0
        received = per_light.sum(axis=0)
        result[alive] += carried * albedo * received * INVERSE_PI
        if n_groups > 1:
            assert light_group is not None
            of_groups = sum_groups(per_light, light_group, n_groups)
            by_group[:, alive] += carried * albedo * of_groups * INVERSE_PI
        if bounce + 1 == n_bounces:
            break
        carried = carried * albedo
        # Survival by the reflectance of this vertex alone: the paths that carry most light live longest.
        largest = np.maximum(np.maximum(albedo[:, 0], albedo[:, 1]), albedo[:, 2])
        survival = np.clip(largest, np.float32(0.05), np.float32(0.95))
        chance = np.empty(len(alive), np.float32)
        uniforms(step_seed, alive, chance)
        lives = np.flatnonzero(chance < survival)
        alive, points = alive[lives], take_points(points, lives)
        carried = np.take(carried, lives, axis=0) / survival[lives, None]
        rays = trace_hemisphere(snapshot, tracer, points, alive, 1, int(hash_combine(step_seed, 2)))
        carried, points = carried * rays.throughput, rays.ends
        lives = np.flatnonzero(nonzero_rows(carried))
        alive, carried, points = alive[lives], np.take(carried, lives, axis=0), take_points(points, lives)
    return Reflected(result, by_group)
