"""Live lights that are linked, multiplied and shaped: at once, while they move, and at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits.model import Edit, EditStack
from icheat_usd.lighting import build_light_sampler, reflected_direct
from icheat_usd.relight.lights import LiveLights
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.scene import PLAIN, LightControls, LightKind, SceneSnapshot
from icheat_usd.transport import light_cells
from tests.lighting.test_controls import EVEN, flags, profile
from tests.pipeline import Pipeline, select
from tests.relight.test_live_lights import DOME, RECT, SPHERE, build, down, moved, room, settle
from tests.scenes import Light

RECT_, SPHERE_, DOME_, LAMP = range(4)


def linked(*lights: Light) -> SceneSnapshot:
    """`room`: every light is linked, multiplied or shaped in some way."""
    bare = room(*lights)
    by_path = {
        "/rect": LightControls(shaping=EVEN._replace(cone=np.array([0.3, 0.9]), focus=2.0)),
        "/sphere": LightControls(flags(bare, "/red"), flags(bare, "/tall"), shaping=profile()),
        "/dome": LightControls(flags(bare, "/floor", "/shiny"), flags(bare, "/ceiling", "/pane"), 0.5, 2.0),
        "/lamp": LightControls(flags(bare, "/back"), flags(bare, "/pane"), specular=0.0),
    }
    return replace(bare, light_controls=tuple(by_path[path] for path in bare.light_paths))


@pytest.fixture(scope="module")
def scene() -> Pipeline:
    return Pipeline(linked(RECT, SPHERE, DOME), n_gather=100, bounce_rays=32)


@pytest.fixture(scope="module")
def first(scene: Pipeline) -> LiveLights:
    """At first look."""
    return build(scene)


@pytest.fixture(scope="module")
def rested(scene: Pipeline) -> LiveLights:
    return settle(build(scene, light_samples=64))


@pytest.mark.parametrize("when", ["first", "rested"])
def test_what_is_left_out_gets_nothing(scene: Pipeline, when: str, request: pytest.FixtureRequest) -> None:
    lights: LiveLights = request.getfixturevalue(when)
    where = np.array([scene.snapshot.surfaces[i].path for i in scene.view.points.instance])
    for light, out in ((SPHERE_, ["/red"]), (DOME_, ["/floor", "/shiny"]), (LAMP, ["/back"])):
        dark = np.isin(where, out)
        assert dark.any()
        np.testing.assert_array_equal(lights.view_direct[light, dark], 0.0)
        assert lights.view_direct[light, ~dark].any()


def test_at_rest_the_light_is_that_of_the_slow_way(scene: Pipeline, rested: LiveLights) -> None:
    snapshot = scene.snapshot
    cells = light_cells(snapshot, scene.tracer, scene.gather, scene.bounces, n_bounces=6, light_samples=64)
    sampler = build_light_sampler(snapshot, scene.tracer, scene.view.points)
    direct = reflected_direct(snapshot, scene.tracer, sampler, scene.view.points, scene.view.to_eye, 5, 256)
    area = scene.gather.area[:, None]
    for light in range(4):
        found, expected = rested.radiance[light] * area, cells.radiance[light] * area
        np.testing.assert_allclose(found.sum(0), expected.sum(0), rtol=0.04)
        found, expected = rested.view_direct[light], direct[light]
        np.testing.assert_allclose(found.mean(0), expected.mean(0), rtol=0.06)
        assert np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()) < 0.15


@pytest.mark.parametrize("light", [RECT_, SPHERE_, DOME_])
def test_the_first_look_comes_near(first: LiveLights, rested: LiveLights, light: int) -> None:
    """A ray each, and few directions of the sky: right in the mean over the view."""
    np.testing.assert_allclose(first.view_direct[light].mean(0), rested.view_direct[light].mean(0), rtol=0.2)


def test_a_light_that_was_moved_about_ends_like_one_that_always_stood_there(scene: Pipeline) -> None:
    lights = settle(build(scene, linked(RECT, SPHERE)))
    lights.change(0, to_world=down(0.0, 0.2, 0.9))
    lights.refine()
    lights.change(0, to_world=down(-0.4, 0.7, 0.2), size=(0.5, 0.4))
    settle(lights)
    there = settle(build(scene, linked(moved(RECT), SPHERE)))
    np.testing.assert_array_equal(lights.radiance, there.radiance)
    np.testing.assert_array_equal(lights.view_direct, there.view_direct)


def test_lights_keep_their_controls_when_they_change_and_others_come_and_go(scene: Pipeline) -> None:
    lights = build(scene, linked(RECT, SPHERE))
    of_rect, of_sphere, of_lamp = linked(RECT, SPHERE).light_controls
    lights.change(1, radiance=(1, 1, 1), size=(0.2, 0))
    lights.set_gain(0, 0.5)
    lights.add("/new", LightKind.DISTANT, to_world=np.eye(3, 4), radiance=(3, 3, 3))
    lights.remove(0)
    now = lights.snapshot()
    assert now.light_paths == ("/sphere", "/lamp", "/new")
    assert now.controls(2) == PLAIN and now.controls(0).shaping is not None
    np.testing.assert_array_equal(now.controls(0).receivers, of_sphere.receivers)
    np.testing.assert_array_equal(now.controls(1).receivers, of_lamp.receivers)
    assert of_rect.shaping is not None
    lights.remove(1)
    lights.remove(0)
    assert lights.snapshot().light_controls == ()


def test_a_view_is_edited_while_lights_come_and_go_among_linked_ones(scene: Pipeline) -> None:
    lights = build(scene, linked(RECT, SPHERE))
    of = Pipeline(linked(RECT, SPHERE), n_gather=100, rays=32, bounce_rays=32)
    live = LiveRelighter(of.snapshot, scene.view, scene.gather, of.transport, lights)
    everything = select(*(surface.path for surface in of.snapshot.surfaces))
    edit = Edit("/all", "scale", {"gain": 2.0}, everything, select("/red"))
    live.set_stack(EditStack("/stack", (edit,)))
    before = live.frame()
    lights.add("/new", LightKind.DISTANT, to_world=np.eye(3, 4), radiance=(3, 3, 3))
    live.set_stack(EditStack("/stack", (replace(edit, lights=("/new",)),)))
    assert (live.frame() != before).any()
    lights.remove(0)
    live.set_stack(EditStack("/stack", (edit,)))
    assert np.isfinite(live.frame()).all()


def test_plain_lights_have_the_bits_that_they_have_among_plain_ones(scene: Pipeline) -> None:
    """Controls of one light are nothing to the others, on the quick way and on the slow one."""
    bare = room(RECT, SPHERE)
    only_rect = replace(bare, light_controls=(linked(RECT, SPHERE).light_controls[0], PLAIN, PLAIN))
    plain, some = (settle(build(scene, one)) for one in (bare, only_rect))
    for light in (1, 2):
        np.testing.assert_array_equal(some.radiance[light], plain.radiance[light])
        np.testing.assert_array_equal(some.view_direct[light], plain.view_direct[light])
    assert not np.array_equal(some.view_direct[0], plain.view_direct[0])
