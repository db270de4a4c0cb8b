"""Camera samples as places where irradiance is wanted: how wide a pixel is there, and how near the next surface."""

from __future__ import annotations

import numpy as np

from icheat_usd.final_gather.irradiance_cache import Places
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.samples import cosine_rays
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, Camera, SceneSnapshot
from icheat_usd.tracing import Tracer, spawn_points

_RAYS = 4  # of each place: in a narrow gap any of them meets its other side


def places_of(snapshot: SceneSnapshot, tracer: Tracer, view: ViewSamples, seed: int) -> Places:
    """The places of view samples; what is found at one depends on its own random numbers alone."""
    n = view.n
    origins, directions = np.empty((n * _RAYS, 3), np.float32), np.empty((n * _RAYS, 3), np.float32)
    cosine_rays(
        spawn_points(snapshot, view.points, view.points.normal),
        view.points.shading_normal,
        view.points.normal,
        np.arange(n + 1, dtype=np.int64),
        _RAYS,
        int(hash_combine(seed, 0x9EA6)),
        view.stream.astype(np.int64) & 0x7FFFFFFF,
        np.empty(n * _RAYS, np.int64),
        origins,
        directions,
    )
    near = tracer.intersect(origins, directions).distance.reshape(n, _RAYS).min(axis=1, initial=np.inf)
    return Places(view.points, pixel_extent(snapshot.camera, view), near.astype(np.float32))


def pixel_extent(camera: Camera, view: ViewSamples) -> F32:
    """(n,) metres that a pixel spans at each view sample, across the line of sight."""
    width = np.float32((camera.window[1] - camera.window[0]) / camera.width)
    return np.full(view.n, width, np.float32) if camera.orthographic else view.depth * width
