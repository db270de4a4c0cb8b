"""Direct light in one pass brings what separate arrays of rays bring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.kernels.embree import TraceTable
from icheat_usd.lighting import build_light_sampler, direct
from icheat_usd.samples import view_samples
from icheat_usd.scene import F32, SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.tracing.embree import EmbreeTracer
from tests.lighting.test_controls import LIGHTS, room
from tests.scenes import look_at

N_RAYS = 5


class SingleRays(EmbreeTracer):
    """As in scenes of many instances, where packets are slower."""

    def compiled_shadows(self) -> TraceTable:
        function = self.address_of("rtcOccluded1")[0]
        return super().compiled_shadows()._replace(function=function, packets=False)


def light_of(snapshot: SceneSnapshot, tracer: Tracer, *, is_glossy: bool, guided: bool = False) -> tuple[F32, F32]:
    """What the only light brings to what the camera sees, and the least and the most that a ray brings."""
    view = view_samples(snapshot, tracer, samples_per_pixel=1)
    sampler = build_light_sampler(snapshot, tracer, view.points if guided else None)
    out, extremes = np.zeros((view.n, 3), np.float32), np.empty((view.n, 2), np.float32)
    extremes[...] = np.inf, -np.inf
    eye, draws = view.to_eye if is_glossy else None, direct.own_draws(0, view.n)
    direct.add_shadow_rays(snapshot, tracer, sampler, view.points, eye, 0, draws, 3, N_RAYS, (N_RAYS, 2), out, extremes)
    return out, extremes


def seen(kind: str) -> SceneSnapshot:
    snapshot = room(kind)
    return replace(snapshot, camera=look_at((0.4, 1.1, 2.5), (0, 0.1, 0), width=24, height=16))


@pytest.mark.parametrize("is_glossy", [True, False])
@pytest.mark.parametrize("kind", LIGHTS)
def test_it_brings_what_arrays_of_rays_bring(kind: str, is_glossy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = seen(kind)
    tracer = build_tracer(snapshot)
    guided = kind in ("dome", "sky")
    found, range_found = light_of(snapshot, tracer, is_glossy=is_glossy, guided=guided)
    single, _ = light_of(snapshot, SingleRays(snapshot), is_glossy=is_glossy, guided=guided)
    monkeypatch.setattr(direct, "_add_in_one_pass", lambda *args: False)
    expected, range_expected = light_of(snapshot, tracer, is_glossy=is_glossy, guided=guided)
    lit = expected.any(axis=1)
    assert 0.2 < lit.mean() and len(np.unique(expected)) > 3
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
    if is_glossy:
        np.testing.assert_allclose(range_found, range_expected, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(single, expected, rtol=1e-4, atol=1e-6)
