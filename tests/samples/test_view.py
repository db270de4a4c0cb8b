"""Camera rays reach what the camera sees: through lenses, mirrors, glass and holes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest

from icheat_usd.samples import ViewSamples, view_samples
from icheat_usd.scene import LightKind, SceneSnapshot
from icheat_usd.tracing import build_tracer
from tests.scenes import Light, Material, Mesh, box, look_at, make_snapshot, quad, rotation, translation


def view_of(scene: SceneSnapshot, **options: int) -> ViewSamples:
    return view_samples(scene, build_tracer(scene), **options)


def wall(z: float, material: Material | None = None, size: float = 20.0) -> Mesh:
    """Square facing +Z at depth `z`."""
    return Mesh(quad(size), material, transforms=[translation(0, 0, z) @ rotation((1, 0, 0), 90)], path=f"/wall{-z}")


def looking_back(width: int = 8, height: int = 6, **changes: Any) -> Any:
    """Camera at the origin that looks along -Z, 90 degrees high."""
    return replace(look_at((0, 0, 0), (0, 0, -1), fov=90, width=width, height=height), **changes)


def test_one_sample_looks_through_the_centre_of_its_pixel() -> None:
    view = view_of(make_snapshot([wall(-2)], camera=looking_back()))
    assert np.array_equal(view.pixel, np.arange(48))
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    expected = np.stack([((x + 0.5) / 8 * 2 - 1) * 8 / 6 * 2, (1 - (y + 0.5) / 6 * 2) * 2, np.full(x.shape, -2.0)], -1)
    np.testing.assert_allclose(view.points.position, expected.reshape(-1, 3), atol=1e-5)
    np.testing.assert_allclose(view.depth, np.linalg.norm(view.points.position, axis=1), rtol=1e-6)
    np.testing.assert_allclose(view.to_eye * view.depth[:, None], -view.points.position, atol=1e-5)
    assert np.all(view.throughput == 1)


def test_more_samples_are_stratified_over_the_pixel_and_share_its_weight() -> None:
    view = view_of(make_snapshot([wall(-1)], camera=looking_back(4, 4)), samples_per_pixel=16)
    assert np.array_equal(view.pixel, np.repeat(np.arange(16), 16))
    np.testing.assert_allclose(view.throughput, 1 / 16)
    place = (view.points.position[:16, :2] * [1, -1] + 1) * 2  # pixel 0 is the unit square at the top left
    strata = np.floor(place * 4).astype(int)
    assert len({tuple(s) for s in strata}) == 16 and strata.min() == 0 and strata.max() == 3


def test_an_orthographic_camera_looks_straight_ahead() -> None:
    camera = looking_back(orthographic=True, window=(-3.0, 1.0, -1.0, 2.0))
    view = view_of(make_snapshot([wall(-5)], camera=camera))
    np.testing.assert_allclose(view.depth, 5, rtol=1e-6)
    np.testing.assert_allclose(view.points.position[0], [-3 + 0.25, 2 - 0.25, -5], atol=1e-5)


def test_clipping_hides_what_is_too_near_or_too_far() -> None:
    scene = make_snapshot([wall(-1), wall(-3), wall(-9)], camera=looking_back(near=2.0, far=5.0))
    view = view_of(scene)
    np.testing.assert_allclose(view.points.position[:, 2], -3, atol=1e-5)
    np.testing.assert_allclose(view.depth, np.linalg.norm(view.points.position, axis=1), rtol=1e-5)
    assert view_of(replace(scene, camera=replace(scene.camera, far=2.5))).n == 0


def test_a_lens_is_sharp_at_its_focus_and_blurs_elsewhere() -> None:
    camera = looking_back(2, 2, lens_radius=0.5, focus_distance=2.0)
    for z, spread in ((-2.0, 0.0), (-4.0, 0.5)):
        view = view_of(make_snapshot([wall(z)], camera=camera), samples_per_pixel=64)
        pinhole = view_of(make_snapshot([wall(z)], camera=replace(camera, lens_radius=0.0)), samples_per_pixel=64)
        off = np.linalg.norm(view.points.position - pinhole.points.position, axis=1)
        assert off.max() == pytest.approx(spread, abs=0.02)


def test_a_mirror_shows_what_is_behind_the_camera() -> None:
    mirror = Material(diffuse=0.8, metallic=1.0, roughness=0.0)
    back = Mesh(quad(40), transforms=[translation(0, 0, 4) @ rotation((1, 0, 0), -90)], path="/back")
    view = view_of(make_snapshot([wall(-1, mirror), back], camera=looking_back()))
    assert np.array_equal(view.pixel, np.arange(48))
    assert np.all(view.points.instance == 1)
    np.testing.assert_allclose(view.points.position[:, 2], 4, atol=1e-4)
    assert np.all((view.throughput >= 0.8 - 1e-5) & (view.throughput <= 1))
    np.testing.assert_allclose(view.depth, 6 * np.linalg.norm(view.to_eye / view.to_eye[:, 2:], axis=1), rtol=1e-4)
    assert np.all(view.to_eye[:, 2] < 0)


def test_glass_divides_a_path_into_what_it_reflects_and_what_shines_through() -> None:
    glass = Material(opacity=0.0, ior=1.5, roughness=0.0)
    room = Mesh(box(20, inward=True), Material(0.5), path="/room")
    scene = make_snapshot([wall(-1, glass, 40), room], camera=looking_back(6, 6))
    for splits in (0, 1, 2):
        view = view_of(scene, max_splits=splits)
        assert np.all(view.points.instance == 1)
        counts = np.bincount(view.pixel, minlength=36)
        assert np.all(counts == (1 if splits == 0 else 2))
        total = np.bincount(view.pixel, view.throughput[:, 0], 36)
        np.testing.assert_allclose(total, 1, rtol=1e-5)
    first = view.throughput[view.pixel == 14][:, 0]
    assert first.min() == pytest.approx(0.04, abs=0.005)  # ((1.5 - 1) / (1.5 + 1))^2 near the axis


def test_a_translucent_surface_is_seen_with_its_opacity_and_seen_through_with_the_rest() -> None:
    scene = make_snapshot([wall(-1, Material(opacity=0.25)), wall(-2)], camera=looking_back(4, 4))
    view = view_of(scene)
    assert np.array_equal(view.pixel, np.repeat(np.arange(16), 2))
    by_wall = {i: view.throughput[view.points.instance == i][:, 0] for i in (0, 1)}
    np.testing.assert_allclose(by_wall[0], 0.25, rtol=1e-6)
    np.testing.assert_allclose(by_wall[1], 0.75, rtol=1e-6)


def test_rays_that_leave_the_scene_bring_the_sky_and_no_samples() -> None:
    scene = make_snapshot([wall(-1, size=1.0)], lights=[Light(LightKind.DOME, (1, 2, 3))], camera=looking_back(16, 16))
    for spp in (1, 16):
        view = view_of(scene, samples_per_pixel=spp)
        covered = np.bincount(view.pixel, view.throughput[:, 0], 256)
        np.testing.assert_allclose(view.background, (1 - covered)[:, None] * [[1, 2, 3]], atol=1e-4)
        assert covered.mean() == pytest.approx(0.25, abs=0.01)


def test_the_same_seed_gives_the_same_bits_for_any_number_of_threads() -> None:
    glass = Material(opacity=0.0, ior=1.5, roughness=0.0)
    scene = make_snapshot([Mesh(box(1, (0, 0, -2)), glass), wall(-5)], camera=looking_back(16, 16))
    views = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        views.append(view_of(scene, samples_per_pixel=4, max_splits=1, seed=3))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    one, two = views
    assert np.array_equal(one.pixel, two.pixel) and np.all(np.diff(one.pixel) >= 0)
    assert np.array_equal(one.throughput, two.throughput)
    assert np.array_equal(one.points.position, two.points.position)


def test_a_pixel_without_samples_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one sample"):
        view_of(make_snapshot([wall(-1)]), samples_per_pixel=0)
