"""Rays of specular lobes to the gather cells that they end in."""

from __future__ import annotations

import numpy as np

from icheat_usd.final_gather.cell_rays import CellRays, trace_to_cells
from icheat_usd.kernels.lobe_rays import fill_lobe_rays
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.tracing import point_magnitudes
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I64, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer


def trace_lobe(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    points: SurfacePoints,
    to_eye: F32,
    draws: I64,
    n_rays: int,
    seed: int,
) -> CellRays | None:
    """The rays of `hits.trace_specular`; None with a tracer that compiled loops cannot call."""
    n = len(draws) * n_rays
    magnitude = np.empty(len(draws), np.float32)
    point_magnitudes(snapshot.geometry, points.instance, points.triangle, magnitude)
    origins, directions, reflectance = (np.empty((n, 3), np.float32) for _ in range(3))
    fill_lobe_rays(
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
    own = int(hash_combine(seed, 1))
    return trace_to_cells(snapshot, tracer, gather, origins, directions, reflectance, own)
