"""Lights that are moved from rest: what looks with few rays got wrong there is not wrong again."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from icheat_usd.relight import closer_look
from icheat_usd.relight.closer_look import WORST_CELLS
from icheat_usd.relight.lights import LiveLights
from icheat_usd.scene import F32, LightKind, SceneSnapshot
from icheat_usd.session.frames import array_bytes
from tests.pipeline import Pipeline
from tests.relight.test_live_lights import gradient_image, settle
from tests.scenes import Light, Material, Mesh, box, cornell_meshes, look_at, make_snapshot, rotation, translation

Kind = Callable[[float], Light]
DOWN = rotation((1, 0, 0), -90)
SAMPLES = 32


def rect(x: float) -> Light:
    to_world = (translation(x, 0.6, 0.1) @ DOWN)[:3].astype(np.float32)
    return Light(LightKind.RECT, (9, 9, 9), to_world, (0.5, 0.5), path="/rect")


def dome(angle: float) -> Light:
    to_world = rotation((0, 1, 0), angle)[:3].astype(np.float32)
    return Light(LightKind.DOME, (1, 1, 1), to_world, image=gradient_image(), path="/dome")


def sun(degrees: float) -> Light:
    """Half a degree wide to either side."""
    to_world = rotation((0, 1, 0), 35.0 + degrees)[:3].astype(np.float32)
    return Light(LightKind.DISTANT, (3, 3, 3), to_world, (float(np.radians(0.5)), 0.0), path="/sun")


def room(light: Light) -> SceneSnapshot:
    """A block that casts a soft shadow."""
    block = Mesh(box(0.35, (0.2, -0.3, 0.1)), Material(0.7), path="/block")
    camera = look_at((0, 0, 3.9), fov=39.3, width=96, height=72)
    return make_snapshot([*cornell_meshes(), block], lights=[light], camera=camera)


@pytest.fixture(autouse=True)
def _cells_are_not_looked_at_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """What leaves less noise of a first look leaves less to be known of it."""
    monkeypatch.setattr(closer_look, "WORST_CELLS", 0)


@pytest.fixture(scope="module")
def scene() -> Pipeline:
    return Pipeline(room(rect(0.0)), n_gather=1500, bounce_rays=32)


def build(scene: Pipeline, light: Light, light_samples: int = SAMPLES) -> LiveLights:
    parts = scene.snapshot, scene.tracer, scene.view, scene.gather, scene.bounces
    return LiveLights(room(light), *parts[1:], n_bounces=4, light_samples=light_samples, seed=3)


def off(scene: Pipeline, lights: LiveLights, true: LiveLights) -> F32:
    """Relative errors of direct light at the view and at the cells, and of all light of the cells."""
    area = scene.gather.area[:, None]
    found = []
    for values in (
        lambda one: one.view_direct[0],
        lambda one: np.sqrt(area) * one._lights[0].direct,
        lambda one: np.sqrt(area) * one.radiance[0],
    ):
        expected = values(true).astype(np.float64)
        found.append(np.sqrt(np.square(values(lights) - expected).sum() / np.square(expected).sum()))
    return np.array(found)


KINDS = pytest.mark.parametrize(("light", "step"), [(rect, 0.01), (dome, 1.0)])


def dragged(scene: Pipeline, light: Kind, steps: list[float], rests: bool = True) -> LiveLights:
    """A light that was moved from 0 over some places, after it had come to rest, or never was there."""
    lights = build(scene, light(0.0))
    if rests:
        settle(lights)
    for step in steps:
        lights.change(0, to_world=light(step).to_world)
    return lights


@KINDS
def test_near_where_it_was_at_rest_a_light_has_less_noise(scene: Pipeline, light: Kind, step: float):
    true = settle(build(scene, light(step)))
    known, unknown = (off(scene, dragged(scene, light, [step], rests), true) for rests in (True, False))
    assert (known < unknown * (0.3, 0.6, 0.75)).all()


@KINDS
def test_where_it_was_it_looks_as_it_did(scene: Pipeline, light: Kind, step: float):
    """The same bits are not asked for; the noise of few places stays."""
    true = settle(build(scene, light(0.0)))
    for steps in ([0.0], [step, 3 * step, 0.0]):
        known, unknown = (off(scene, dragged(scene, light, steps, rests), true) for rests in (True, False))
        assert (known < unknown * (0.3, 0.5, 0.7)).all()


@KINDS
def test_far_from_there_it_is_no_worse_than_if_it_had_never_been_there(scene: Pipeline, light: Kind, step: float):
    true = settle(build(scene, light(60 * step)))
    steps = [k * step for k in range(10, 61, 10)]
    known, unknown = (off(scene, dragged(scene, light, steps, rests), true) for rests in (True, False))
    assert (known < 1.05 * unknown).all()


def test_a_sun_that_is_far_from_its_place_looks_no_worse_at_the_view_than_if_it_had_never_been_there(scene: Pipeline):
    """No ghosts of its shadows."""
    steps = [3.0 * k for k in range(1, 7)]
    known, unknown = (dragged(scene, sun, steps, rests) for rests in (True, False))
    true = settle(build(scene, sun(18.0)))
    assert off(scene, known, true)[0] < 1.02 * off(scene, unknown, true)[0]


def test_a_sun_that_hardly_turned_is_known_where_it_rested(scene: Pipeline):
    true = settle(build(scene, sun(0.1)))
    known, unknown = (off(scene, dragged(scene, sun, [0.1], rests), true) for rests in (True, False))
    assert known[0] < 0.8 * unknown[0]


def test_some_rounds_are_enough_to_know_noise_and_fewer_are_not(scene: Pipeline):
    true = settle(build(scene, rect(0.01)))
    fresh = off(scene, build(scene, rect(0.01)), true)
    for n_steps, is_known in ((7, False), (12, True)):
        lights = build(scene, rect(0.0))
        for _ in range(n_steps):
            assert lights.refine()
        lights.change(0, to_world=rect(0.01).to_world)
        assert (off(scene, lights, true)[:2] < 0.6 * fresh[:2]).all() == is_known


def test_what_was_known_stays_known_while_a_light_goes_on(scene: Pipeline):
    """A pause of a few steps, too short to know better, forgets nothing."""
    true = settle(build(scene, rect(0.02)))
    fresh = off(scene, build(scene, rect(0.02)), true)
    lights = settle(build(scene, rect(0.0)))
    lights.change(0, to_world=rect(0.01).to_world)
    for _ in range(2):
        assert lights.refine()
    lights.change(0, to_world=rect(0.02).to_world)
    assert (off(scene, lights, true)[:2] < 0.6 * fresh[:2]).all()


def test_a_new_image_is_looked_at_afresh(scene: Pipeline):
    image = np.random.default_rng(1).random((8, 16, 3)).astype(np.float32)
    looks = []
    for rests in (False, True):
        lights = build(scene, dome(0.0))
        if rests:
            settle(lights)
        lights.change(0, texture=image)
        looks.append(lights.view_direct.copy())
    np.testing.assert_array_equal(*looks)


def test_it_ends_as_a_light_that_always_stood_there(scene: Pipeline):
    true = settle(build(scene, rect(0.05)))
    lights = settle(build(scene, rect(0.0)))
    lights.change(0, to_world=rect(0.03).to_world)
    lights.change(0, to_world=rect(0.05).to_world)
    settle(lights)
    np.testing.assert_array_equal(lights.view_direct, true.view_direct)
    np.testing.assert_array_equal(lights.radiance, true.radiance)


@KINDS
def test_a_light_that_is_not_followed_takes_less_memory_and_goes_on(scene: Pipeline, light: Kind, step: float):
    places = [step * k for k in (1, 2, 3)]
    followed, left = (dragged(scene, light, places[:2]) for _ in range(2))
    image = left.view_direct.copy()
    left.stop_following()
    np.testing.assert_array_equal(left.view_direct, image)
    assert array_bytes([left]) < array_bytes([followed]) - image.nbytes
    true = build(scene, light(places[2]))
    looks = []
    for lights in (followed, left, true):
        if lights is not true:
            lights.change(0, to_world=light(places[2]).to_world)
        looks.append(lights.view_direct.copy())
        settle(lights)
        np.testing.assert_array_equal(lights.view_direct, followed.view_direct)
        np.testing.assert_array_equal(lights.radiance, followed.radiance)
    # Nothing is known of its noise now.
    np.testing.assert_array_equal(looks[1], looks[2])
    assert not np.array_equal(looks[0], looks[2])


def test_what_is_known_takes_noise_that_second_looks_leave(scene: Pipeline, monkeypatch: pytest.MonkeyPatch):
    """Neither does without the other: of the light at the cells, both together leave the least."""
    true = settle(build(scene, rect(0.0)))
    errors = {}
    for n_cells in (0, WORST_CELLS):
        monkeypatch.setattr(closer_look, "WORST_CELLS", n_cells)
        for rests in (True, False):
            errors[n_cells, rests] = off(scene, dragged(scene, rect, [0.01, 0.03, 0.0], rests), true)[1]
    assert errors[WORST_CELLS, True] < 0.8 * min(errors[0, True], errors[WORST_CELLS, False])
