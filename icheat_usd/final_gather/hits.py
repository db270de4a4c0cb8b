"""Light that leaves the surfaces which gather rays hit."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.gather import uniforms
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.samples import cosine_rays
from icheat_usd.lighting import LightSampler, irradiance
from icheat_usd.materials import effective_albedo, nonzero_rows, take_points
from icheat_usd.scene import F32, I64, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points

INVERSE_PI = np.float32(1.0 / np.pi)


def trace_hemisphere(
    snapshot: SceneSnapshot, tracer: Tracer, points: SurfacePoints, stream: I64, n_rays: int, seed: int
) -> tuple[SurfacePoints, F32]:
    """Cosine-weighted rays from each point to the first surfaces that scatter.

    Returns
    -------
    points : SurfacePoints
        (n * n_rays,) in the order of the rays.
    throughput : (n * n_rays, 3) float32
        Of the delta vertices in between; 0 where a ray left the scene or
        pointed below the geometric surface.
    """
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
    ends = first_surfaces(snapshot, tracer, origins, directions, int(hash_combine(seed, 1)))
    return ends.points, ends.throughput * (ends.points.instance >= 0)[:, None]


def reflected_radiance(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    points: SurfacePoints,
    throughput: F32,
    *,
    n_bounces: int,
    seed: int,
) -> F32:
    """Diffuse radiance that each point reflects, by one path per point.

    Emission is not in it: emissive meshes and domes count as direct light.
    Paths end after `n_bounces` reflections, or earlier by Russian roulette.

    Parameters
    ----------
    points : SurfacePoints
        (n,) hits of gather rays; those with `throughput` 0 are skipped.
    throughput : (n, 3) float32
        Carried into the result.

    Returns
    -------
    (n, 3) float32, radiance, scene-linear
    """
    result = np.zeros_like(throughput)
    alive = np.flatnonzero(nonzero_rows(throughput))
    carried = np.take(throughput, alive, axis=0)
    points = take_points(points, alive)
    for bounce in range(n_bounces):
        if len(alive) == 0:
            break
        step_seed = int(hash_combine(seed, bounce))
        albedo = effective_albedo(points)
        received = irradiance(snapshot, tracer, sampler, points, step_seed, 1).sum(axis=0)
        result[alive] += carried * albedo * received * INVERSE_PI
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
        points, through = trace_hemisphere(snapshot, tracer, points, alive, 1, int(hash_combine(step_seed, 2)))
        carried = carried * through
        lives = np.flatnonzero(nonzero_rows(carried))
        alive, carried, points = alive[lives], np.take(carried, lives, axis=0), take_points(points, lives)
    return result
