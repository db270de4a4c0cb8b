"""Training lights are many, different, and repeatable."""

from __future__ import annotations

import numpy as np

from icheat_usd.samples import gather_samples, view_samples
from icheat_usd.scene import F32, SceneSnapshot
from icheat_usd.tracing import build_tracer
from icheat_usd.transport import build_bounces
from icheat_usd.transport.training import training_radiance
from tests.scenes import closed_box, cornell


def lights_of(scene: SceneSnapshot, n: int, seed: int = 0) -> tuple[F32, F32]:
    tracer = build_tracer(scene)
    gather = gather_samples(scene, tracer, view_samples(scene, tracer), n=400)
    bounces = build_bounces(scene, tracer, gather, rays_per_row=32)
    return training_radiance(scene, tracer, gather, bounces, n, seed), gather.area


def test_training_lights_are_of_every_size_and_all_different() -> None:
    lights, area = lights_of(cornell(), 16)
    assert lights.shape == (16, 400) and lights.dtype == np.float32
    assert np.all(np.isfinite(lights)) and lights.min() >= 0
    np.testing.assert_allclose(np.average(lights, axis=1, weights=area), 1, rtol=1e-4)
    # Area over which a light's energy is spread, as a share of all: (sum b)^2 / sum b^2.
    spread = (lights @ area) ** 2 / (lights**2 @ area) / area.sum()
    assert spread.min() < 0.1 and spread.max() > 0.3
    unit = lights / np.linalg.norm(lights, axis=1, keepdims=True)
    assert np.median(unit @ unit.T) < 0.8
    assert (unit @ unit.T - np.eye(16)).max() < 0.999


def test_a_closed_room_gets_as_many_lights_without_a_sky() -> None:
    lights, _ = lights_of(closed_box(), 9)
    assert len(lights) == 9 and np.all(lights.any(axis=1))


def test_the_seed_alone_decides_the_lights() -> None:
    first, _ = lights_of(cornell(), 8)
    again, _ = lights_of(cornell(), 8)
    other, _ = lights_of(cornell(), 8, seed=1)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
