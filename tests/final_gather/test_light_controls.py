"""Preview and final gather agree on lights that are linked, multiplied and shaped."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from icheat_usd.final_gather import FinalGather
from icheat_usd.scene import LightControls, LightKind, SceneSnapshot
from tests.agreement import compare
from tests.lighting.test_controls import EVEN, flags, profile
from tests.pipeline import Pipeline
from tests.scenes import Light, cornell_meshes, look_at, make_snapshot, rotation, translation

DOWN = rotation((1, 0, 0), -90)
SPOT = Light(LightKind.SPHERE, (90, 80, 60), (translation(0.3, 0.9, 0.2) @ DOWN)[:3], (0.05, 0), path="/spot")
PANEL = Light(LightKind.RECT, (2, 3, 5), (translation(-0.4, 0.9, 0.3) @ DOWN)[:3], (0.4, 0.4), path="/panel")


@functools.cache
def scene(is_controlled: bool = True) -> SceneSnapshot:
    """A Cornell box under a soft spot that the blocks do not stop, and a panel that the floor does not see."""
    camera = look_at((0, 0, 3.9), fov=39.3, width=16, height=16)
    plain = make_snapshot(cornell_meshes(), lights=[SPOT, PANEL], camera=camera)
    spot = LightControls(
        None, flags(plain, "/tall", "/low"), shaping=EVEN._replace(cone=np.array([0.4, 0.8]), focus=1.0)
    )
    panel = LightControls(flags(plain, "/floor"), None, 0.6, 0.0, profile())
    return replace(plain, light_controls=(spot, panel)) if is_controlled else plain


@functools.cache
def preview(seed: int) -> Pipeline:
    return Pipeline(scene(), n_gather=4096, rays=64, light_samples=8, samples_per_pixel=16, n_bounces=4, seed=seed)


@functools.cache
def final(seed: int, is_controlled: bool = True, method: str = "brute") -> FinalGather:
    pipeline = Pipeline(scene(is_controlled), n_gather=4096, light_samples=8, n_bounces=4, seed=seed)
    return pipeline.final(method=method, samples=16, rays=16, light_samples=4, seed=seed)


def test_indirect_light_of_both_agrees() -> None:
    """Cells are 5 cm across in a box of 2 m: 3 % of tolerance for the light of a place, 2 % in the mean."""
    relit = [preview(seed).image(preview(seed).relight().indirect) for seed in range(3)]
    found = compare(relit, [final(seed).indirect for seed in range(4)], tolerance=0.03)
    assert (np.abs(found.ratio - 1) < 4 * found.error + 0.02).all(), found
    assert found.pixels < 1.4 and found.blocks < 2.4, found


def test_indirect_light_at_cache_records_agrees() -> None:
    cached = [final(seed, method="cached").indirect for seed in range(3)]
    found = compare(cached, [final(seed).indirect for seed in range(4)], tolerance=0.05)
    assert (np.abs(found.ratio - 1) < 4 * found.error + 0.02).all(), found
    assert found.pixels < 1.4 and found.blocks < 2.4, found


def test_direct_light_of_both_agrees() -> None:
    relit = [preview(seed).image(preview(seed).relight().direct) for seed in range(3)]
    found = compare(relit, [final(seed).direct for seed in range(4)])
    assert (np.abs(found.ratio - 1) < 4 * found.error + 0.005).all(), found


def test_controls_change_both_parts_by_far_more_than_these_tolerances() -> None:
    for name in ("direct", "indirect"):
        with_controls, without = (getattr(final(0, is_controlled), name) for is_controlled in (True, False))
        assert np.sqrt(((with_controls - without) ** 2).mean()) > 0.3 * without.mean()
