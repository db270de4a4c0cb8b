"""Camera samples as places where irradiance is wanted: how wide a pixel is there, and how near the next surface."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels import near_surfaces as kernels
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.samples import cosine_rays
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, I64, Camera, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, spawn_points

_RAYS = 4  # of each pixel: in a narrow gap any of them meets its other side


def near_of(snapshot: SceneSnapshot, tracer: Tracer, view: ViewSamples, seed: int, most_reach: float = np.inf) -> F32:
    """Distance of the nearest surface that a few rays from each view sample meet, (n,) metres, inf for none.

    Samples of a pixel that lie on the same instance share their rays; what is found depends on no other pixel.

    Parameters
    ----------
    most_reach : float
        Pixels, as wide as they are there, that rays are followed.
    """
    n_rays = max(1, _RAYS // view.samples_per_pixel)
    limit = pixel_extent(snapshot.camera, view) * np.float32(most_reach)
    stream, own = view.stream.astype(np.int64) & 0x7FFFFFFF, int(hash_combine(seed, 0x9EA6))
    found = np.empty(view.n, np.float32)
    trace = tracer.compiled()
    if trace is None:
        found = _one_by_one(snapshot, tracer, view.points, stream, own, n_rays, limit)
    else:
        start = spawn_points(snapshot, view.points, view.points.normal)
        shading_normal = np.require(view.points.shading_normal, np.float32, ["C", "W"])
        normal = np.require(view.points.normal, np.float32, ["C", "W"])
        kernels.near_surfaces(trace, start, shading_normal, normal, stream, own, n_rays, limit, found)
    if view.samples_per_pixel == 1:
        return found
    begin = np.flatnonzero(np.diff(view.pixel, prepend=-1, append=-1))
    near = np.empty_like(found)
    kernels.least_of_pixels(begin, view.points.instance, found, near)
    return near


def _one_by_one(
    snapshot: SceneSnapshot, tracer: Tracer, points: SurfacePoints, stream: I64, seed: int, n_rays: int, limit: F32
) -> F32:
    """The same with a tracer that compiled loops cannot call."""
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
    distance = tracer.intersect(origins, directions, np.repeat(limit, n_rays)).distance
    return distance.reshape(n, n_rays).min(axis=1, initial=np.inf).astype(np.float32)


def pixel_extent(camera: Camera, view: ViewSamples) -> F32:
    """(n,) metres that a pixel spans at each view sample, across the line of sight."""
    width = np.float32((camera.window[1] - camera.window[0]) / camera.width)
    return np.full(view.n, width, np.float32) if camera.orthographic else view.depth * width
