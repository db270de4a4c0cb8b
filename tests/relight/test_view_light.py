"""Direct light of a still view: what plain rounds of shadow rays say, and more of these where they would show."""

from __future__ import annotations

import zlib

import numba
import numpy as np
import pytest

from icheat_usd.kernels.place_columns import RUN
from icheat_usd.lighting import build_light_sampler, reflected_direct
from icheat_usd.lighting.sampler import LightSampler
from icheat_usd.relight import view_light
from icheat_usd.relight.grain import order_of_tiles
from icheat_usd.relight.lights import LiveLights
from icheat_usd.relight.view_light import ROUNDS, light_view
from icheat_usd.scene import F32, LightKind
from tests.pipeline import Pipeline
from tests.scenes import Light, Material, Mesh, box, cornell_meshes, look_at, make_snapshot, rotation, translation

SAMPLES = 16


@pytest.fixture(scope="module")
def room() -> Pipeline:
    """A glossy block that casts two soft shadows, one of them of a dim light."""
    down = rotation((1, 0, 0), -90)
    lights = [
        Light(LightKind.SPHERE, (0.4, 0.2, 0.1), translation(0.6, 0.5, 0.2)[:3].astype(np.float32), (0.1, 0.0)),
        Light(LightKind.RECT, (9, 9, 9), (translation(-0.4, 0.95, 0) @ down)[:3].astype(np.float32), (0.3, 0.3)),
    ]
    block = Mesh(box(0.35, (0.2, -0.3, 0.1)), Material(0.7, specular=0.1, roughness=0.3), path="/block")
    camera = look_at((0, 0, 3.9), fov=39.3, width=96, height=72)
    return Pipeline(make_snapshot([*cornell_meshes(), block], lights=lights, camera=camera), n_gather=100)


def sampler(room: Pipeline) -> LightSampler:
    return build_light_sampler(room.snapshot, room.tracer, room.view.points, 3)


def plain(room: Pipeline, n: int, seed: int = 3) -> F32:
    view = room.view
    return reflected_direct(room.snapshot, room.tracer, sampler(room), view.points, view.to_eye, seed, n)


def lit(room: Pipeline, n: int = SAMPLES) -> F32:
    return light_view(room.snapshot, room.tracer, room.view, light_samples=n, seed=3)


def test_where_nothing_is_grainy_rounds_are_the_rays_of_one_look(room: Pipeline, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(view_light, "MOST_GRAINY", 0.0)
    expected = plain(room, SAMPLES)
    np.testing.assert_allclose(lit(room), expected, rtol=1e-5, atol=1e-6 * expected.max())


def test_fewer_rays_than_rounds_are_one_look(room: Pipeline):
    np.testing.assert_array_equal(lit(room, ROUNDS - 1), plain(room, ROUNDS - 1))


def test_borders_of_shadows_get_the_rays_of_four_looks_and_other_places_those_of_one(room: Pipeline):
    found, one, two, four = (lit(room), *(plain(room, share * SAMPLES) for share in (1, 2, 4)))
    near = [np.isclose(found, of, rtol=1e-5, atol=1e-6 * four.max()).all(axis=(0, 2)) for of in (one, two, four)]
    assert np.logical_or.reduce(near).all()
    assert all((near[i] & ~near[0] & ~near[3 - i]).any() for i in (1, 2))
    changed = ~near[0]
    assert 0.05 < changed.mean() <= 1 / 3 + RUN / room.view.n
    # Whole runs, of all lights at once.
    order = order_of_tiles(room.view)
    for begin in range(0, len(order), RUN):
        some = order[begin : begin + RUN]
        assert near[0][some].all() or near[1][some].all() or near[2][some].all()
    true = plain(room, 4096, seed=9)
    off = [np.square(of.sum(axis=0) - true.sum(axis=0)).sum(axis=1) for of in (found, one)]
    assert off[0][changed].sum() < off[1][changed].sum() / 3
    # Most of the noise that there was is where more rays were sent.
    assert off[1][changed].sum() > 0.8 * off[1].sum()


def test_each_light_keeps_its_own_share(room: Pipeline):
    true, found = plain(room, 1024, seed=9), lit(room)
    for of_light, expected in zip(found, true, strict=True):
        assert np.sqrt(np.square(of_light - expected).mean()) < 0.1 * np.sqrt(np.square(expected).mean())


def test_same_bits_for_any_number_of_threads(room: Pipeline):
    both = lit(room)
    numba.set_num_threads(1)
    try:
        np.testing.assert_array_equal(lit(room), both)
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)


def test_a_scene_without_lights_is_dark(room: Pipeline):
    snapshot = make_snapshot(cornell_meshes(), lights=[], camera=room.snapshot.camera)
    assert light_view(snapshot, room.tracer, room.view).shape == (0, room.view.n, 3)


@pytest.fixture(scope="module")
def under_sky() -> Pipeline:
    """A room without a ceiling, in which walls have soft borders of shadow."""
    camera = look_at((0, 0, 3.9), fov=39.3, width=96, height=72)
    open_room = [mesh for mesh in cornell_meshes() if mesh.path != "/ceiling"]
    block = Mesh(box(0.35, (0.2, -0.3, 0.1)), Material(0.7), path="/block")
    sky = Light(LightKind.DOME, (0.5, 0.6, 0.9), path="/sky")
    return Pipeline(make_snapshot([*open_room, block], lights=[sky], camera=camera), n_gather=100, bounce_rays=16)


def live(of: Pipeline) -> LiveLights:
    return LiveLights(of.snapshot, of.tracer, of.view, of.gather, of.bounces, n_bounces=1, light_samples=4, seed=3)


def test_a_live_dome_comes_to_rest_as_a_still_view_is_lit_and_shows_what_all_samples_had_before(under_sky: Pipeline):
    seed = (3 + zlib.crc32(b"/sky")) & 0x7FFFFFFF
    parts = under_sky.snapshot, under_sky.tracer, under_sky.view
    expected = light_view(*parts, light_samples=4, seed=seed)
    points, eye = under_sky.view.points, under_sky.view.to_eye
    one_look = reflected_direct(*parts[:2], build_light_sampler(*parts[:2], points, seed), points, eye, seed, [4 * 4])
    assert 0.02 < (~np.isclose(expected, one_look, rtol=1e-4, atol=1e-6)).any(axis=(0, 2)).mean() < 0.4
    lights = live(under_sky)
    shown = []
    while lights.refine():
        shown.append(np.allclose(lights.view_direct, one_look, rtol=1e-4, atol=1e-6))
    assert any(shown)
    np.testing.assert_array_equal(lights.view_direct, expected)


def test_a_light_that_comes_while_a_dome_is_looked_at_changes_nothing_of_it(under_sky: Pipeline):
    alone = live(under_sky)
    while alone.refine():
        pass
    lights, n_steps = live(under_sky), 0
    while lights.refine():
        n_steps += 1
        if n_steps % 3 == 0 and n_steps < 40:
            here = translation(0, 0.1 * n_steps / 40, 0)[:3]
            lights.add(f"/more_{n_steps}", LightKind.SPHERE, to_world=here, radiance=(1, 1, 1), size=(0.1, 0))
    assert len(lights.paths) > 3
    np.testing.assert_array_equal(lights.view_direct[0], alone.view_direct[0])
