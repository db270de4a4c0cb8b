"""Lights that change: one at a time, and the same in the end as if they had always been so."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.lighting import build_light_sampler, reflected_direct
from icheat_usd.lighting.change import LightError, texture_image
from icheat_usd.relight.lights import LiveLights
from icheat_usd.scene import LightKind, SceneSnapshot
from icheat_usd.session.seen_light import SeenLight
from icheat_usd.transport import light_cells, more_bounces, solve_bounces
from icheat_usd.transport.quick_bounces import lasting_albedo
from tests.pipeline import Pipeline
from tests.scenes import (
    Image,
    Light,
    Material,
    Mesh,
    cornell_meshes,
    look_at,
    make_snapshot,
    quad,
    rotation,
    translation,
)


def down(x: float, y: float, z: float) -> np.ndarray:
    """A rect's frame that shines down from a place."""
    return (translation(x, y, z) @ rotation((1, 0, 0), -90))[:3].astype(np.float32)


def gradient_image() -> Image:
    """A sky: bright at the horizon of one side."""
    rows, columns = np.mgrid[0:8, 0:16]
    level = 0.2 + rows / 8 * (1 + np.cos(columns / 16 * 2 * np.pi))
    return Image(np.repeat(level[..., None], 3, axis=2).astype(np.float32))


def build(
    pipeline: Pipeline, snapshot: SceneSnapshot | None = None, light_samples: int = 4, n_bounces: int = 6
) -> LiveLights:
    return LiveLights(
        snapshot or pipeline.snapshot,
        pipeline.tracer,
        pipeline.view,
        pipeline.gather,
        pipeline.bounces,
        n_bounces=n_bounces,
        light_samples=light_samples,
        seed=3,
    )


def settle(lights: LiveLights) -> LiveLights:
    for _ in range(1000):
        if not lights.refine():
            return lights
    raise AssertionError("refine never ends")


RECT = Light(LightKind.RECT, (5, 5, 5), down(0.3, 0.9, 0.0), (0.5, 0.4), path="/rect")
SPHERE = Light(LightKind.SPHERE, (9, 2, 2), translation(-0.5, 0.3, 0.5)[:3], (0.1, 0.0), path="/sphere")
DOME = Light(LightKind.DOME, (0.5, 0.6, 0.9), image=gradient_image(), path="/dome")


def room(*lights: Light) -> SceneSnapshot:
    """A Cornell box with a glowing lamp, these lights, and a pane of glass and a cut-out standing in it."""
    pane = Mesh(
        quad(0.8), Material(opacity=0.0, ior=1.5, roughness=0.0), transforms=[translation(0, 0.2, 0.5)], path="/pane"
    )
    lamp = Mesh(quad(0.4)[:, ::-1], Material(0.0, (8, 6, 3)), transforms=[translation(0, 0.99, 0)], path="/lamp")
    floor = Mesh(quad(1.0, -0.98), Material(0.3, roughness=0.3, ior=1.5), path="/shiny")
    camera = look_at((0, 0, 3.9), fov=39.3, width=16, height=12)
    return make_snapshot([*cornell_meshes(), lamp, pane, floor], lights=lights, camera=camera)


@pytest.fixture(scope="module")
def scene() -> Pipeline:
    return Pipeline(room(RECT, SPHERE, DOME), n_gather=120, bounce_rays=64)


def moved(light: Light) -> Light:
    return replace(light, to_world=down(-0.4, 0.7, 0.2))


def test_a_light_that_was_moved_about_ends_like_one_that_always_stood_there(scene: Pipeline) -> None:
    lights = settle(build(scene, room(RECT, SPHERE)))
    lights.change(0, to_world=down(0.0, 0.2, 0.9))
    lights.refine()
    lights.change(0, to_world=down(-0.4, 0.7, 0.2), size=(0.5, 0.4))
    moved_there = settle(lights)
    there = settle(build(scene, room(moved(RECT), SPHERE)))
    np.testing.assert_array_equal(moved_there.radiance, there.radiance)
    np.testing.assert_array_equal(moved_there.view_direct, there.view_direct)


def test_a_dome_that_was_turned_about_ends_like_one_that_always_stood_so(scene: Pipeline) -> None:
    turned = rotation((0, 1, 0), 70)[:3].astype(np.float32)
    lights = settle(build(scene))
    lights.change(2, to_world=rotation((0, 1, 0), 200)[:3])
    lights.refine()
    lights.change(2, to_world=turned)
    settle(lights)
    there = settle(build(scene, room(RECT, SPHERE, replace(DOME, to_world=turned))))
    np.testing.assert_array_equal(lights.radiance[2], there.radiance[2])
    np.testing.assert_array_equal(lights.view_direct[2], there.view_direct[2])


def test_bounces_of_more_rays_show_at_rest_whenever_they_come(scene: Pipeline) -> None:
    """Before a light is at rest, while it is on its way there, and after; what does not bounce stays."""
    more = more_bounces(scene.snapshot, scene.tracer, scene.gather, scene.bounces, 64, 192)
    at_once, at_rest, between = (build(scene) for _ in range(3))
    at_once.take_bounces(more)
    before = settle(at_rest).radiance.copy()
    at_rest.take_bounces(more)
    first, look = between.radiance[0].copy(), between.view_direct.copy()
    between.take_bounces(more)
    np.testing.assert_array_equal(between.radiance[0], first)
    np.testing.assert_array_equal(between.view_direct, look)
    for _ in range(12):
        assert between.refine()
    between.take_bounces(more)
    expected = settle(at_once)
    for lights in (settle(at_rest), settle(between)):
        np.testing.assert_array_equal(lights.radiance, expected.radiance)
        np.testing.assert_array_equal(lights.view_direct, expected.view_direct)
    assert (expected.radiance != before).any(axis=(1, 2)).all()
    lights = at_rest
    lights.change(0, to_world=moved(RECT).to_world)
    there = build(scene, room(moved(RECT), SPHERE, DOME))
    there.take_bounces(more)
    np.testing.assert_array_equal(settle(lights).radiance, settle(there).radiance)


def test_one_light_s_change_leaves_the_others_alone(scene: Pipeline) -> None:
    lights = build(scene)
    radiance, direct = lights.radiance.copy(), lights.view_direct.copy()
    lights.change(2, to_world=rotation((0, 1, 0), 70)[:3])
    assert not np.array_equal(lights.radiance[2], radiance[2])
    for other in (0, 1, 3):
        np.testing.assert_array_equal(lights.radiance[other], radiance[other])
        np.testing.assert_array_equal(lights.view_direct[other], direct[other])


def test_lights_come_and_go(scene: Pipeline) -> None:
    lights = settle(build(scene, room(RECT, SPHERE)))
    before = lights.total()
    number = lights.add(
        "/new", LightKind.DISTANT, to_world=rotation((1, 0, 0), 30)[:3], radiance=(3, 3, 3), size=(0.05, 0)
    )
    lights.remove(0)
    assert lights.paths == ("/sphere", "/lamp", "/new") and number == 3
    settle(lights)
    new = Light(LightKind.DISTANT, (3, 3, 3), rotation((1, 0, 0), 30)[:3], (0.05, 0), path="/new")
    fresh = settle(build(scene, room(SPHERE, new)))
    order = [fresh.paths.index(path) for path in lights.paths]
    np.testing.assert_array_equal(lights.radiance, fresh.radiance[order])
    np.testing.assert_array_equal(lights.view_direct, fresh.view_direct[order])
    assert not np.array_equal(lights.total(), before)


def test_gains_multiply_what_a_light_brings(scene: Pipeline) -> None:
    lights = build(scene)
    lights.set_gain(1, (0.5, 0, 2))
    factors = np.ones((4, 1, 3), np.float32)
    factors[1, 0] = 0.5, 0, 2
    np.testing.assert_allclose(lights.total(), (lights.radiance * factors).sum(0), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(lights.direct(), (lights.view_direct * factors).sum(0), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(lights.snapshot().lights.radiance[1], (4.5, 0, 4))


def test_at_rest_the_light_is_that_of_the_slow_way(scene: Pipeline) -> None:
    """Different random numbers, the same expectation: sums over many samples agree."""
    lights = build(scene, light_samples=64)
    lights.change(0, to_world=down(-0.4, 0.7, 0.2))
    settle(lights)
    snapshot = lights.snapshot()
    cells = light_cells(snapshot, scene.tracer, scene.gather, scene.bounces, n_bounces=6, light_samples=64)
    sampler = build_light_sampler(snapshot, scene.tracer, scene.view.points)
    direct = reflected_direct(snapshot, scene.tracer, sampler, scene.view.points, scene.view.to_eye, 5, 256)
    area = scene.gather.area[:, None]
    for light in range(4):
        np.testing.assert_allclose(
            (lights.radiance[light] * area).sum(0), (cells.radiance[light] * area).sum(0), rtol=0.04
        )
        np.testing.assert_allclose(lights.view_direct[light].mean(0), direct[light].mean(0), rtol=0.06)


def test_next_to_a_light_there_is_as_little_noise_as_elsewhere() -> None:
    """A large light just off a wall: points spread evenly over it leave 40 % on the wall after as many rays."""
    standing = (translation(0.97, 0, 0) @ rotation((0, 1, 0), -90))[:3].astype(np.float32)
    near = Light(LightKind.RECT, (5, 5, 5), standing, (1.0, 1.0), path="/near")
    camera = look_at((0, 0, 3.9), fov=39.3, width=24, height=18)
    wall = Pipeline(make_snapshot(cornell_meshes(), lights=[near], camera=camera), n_gather=1000, bounce_rays=16)
    parts = wall.snapshot, wall.tracer, wall.view, wall.gather, wall.bounces
    lights = settle(LiveLights(*parts, n_bounces=1, light_samples=16, seed=3))
    scene, points = (wall.snapshot, wall.tracer), wall.view.points
    cells = light_cells(*scene, wall.gather, wall.bounces, n_bounces=1, light_samples=1024).radiance[0]
    off = (lights.radiance[0] - cells) ** 2 * wall.gather.area[:, None]
    assert np.sqrt(off.sum() / (cells**2 * wall.gather.area[:, None]).sum()) < 0.03
    sampler = build_light_sampler(wall.snapshot, wall.tracer, points)
    direct = reflected_direct(*scene, sampler, points, wall.view.to_eye, 5, 1024)[0]
    assert np.sqrt(((lights.view_direct[0] - direct) ** 2).sum() / (direct**2).sum()) < 0.03


def test_rays_beyond_the_first_are_sent_at_rest_alone_and_take_its_noise(scene: Pipeline) -> None:
    lit = room(RECT, SPHERE)
    few, many = (build(scene, lit, n) for n in (2, 32))
    for _ in range(2):
        np.testing.assert_array_equal(many.radiance, few.radiance)
        np.testing.assert_array_equal(many.view_direct, few.view_direct)
        for lights in (few, many):
            lights.change(1, to_world=translation(-0.4, 0.2, 0.5)[:3])
    true = settle(build(scene, few.snapshot(), 90)).view_direct

    def off(lights: LiveLights) -> float:
        return float(np.square(settle(lights).view_direct - true).sum())

    assert off(many) < off(few) / 4


def test_any_number_of_threads_gives_the_same_light(scene: Pipeline) -> None:
    """At rest, and for a dome at first look."""
    without_dome = room(RECT, SPHERE)
    threads = numba.get_num_threads()
    both = build(scene), settle(build(scene, without_dome))
    try:
        numba.set_num_threads(1)
        alone = build(scene), settle(build(scene, without_dome))
    finally:
        numba.set_num_threads(threads)
    for found, expected in zip(alone, both, strict=True):
        np.testing.assert_array_equal(found.radiance, expected.radiance)
        np.testing.assert_array_equal(found.view_direct, expected.view_direct)


def test_what_cannot_be_changed_says_so(scene: Pipeline) -> None:
    lights = build(scene)
    with pytest.raises(LightError, match="/lamp is a mesh"):
        lights.change(3, to_world=down(0, 0, 0))
    with pytest.raises(LightError, match="no light 9"):
        lights.remove(9)
    with pytest.raises(LightError, match="only domes and rectangles"):
        lights.change(1, texture=np.ones((2, 2, 3), np.float32))
    with pytest.raises(LightError, match="finite"):
        lights.change(0, size=(np.nan, 1))
    with pytest.raises(LightError, match="not be negative"):
        lights.set_gain(0, -1.0)
    before = lights.gains.copy(), lights.revision, lights.snapshot().lights
    for gain in ((1, 2), "x", "abc", np.ones((3, 3)), np.inf, (1, 1, np.nan), None, 1e300):
        with pytest.raises(LightError, match="gain of /rect needs finite numbers"):
            lights.set_gain(0, gain)
    for change in ({"size": (-1, 1)}, {"radiance": (1, 1, -1e-3)}):
        with pytest.raises(LightError, match="of /rect must not be negative"):
            lights.change(0, **change)
        with pytest.raises(LightError, match="of /new must not be negative"):
            lights.add("/new", LightKind.RECT, **{"to_world": down(0, 0, 0), "radiance": (1, 1, 1), **change})
    for change in ({"size": "wide"}, {"size": 5}, {"radiance": (1, (2, 3))}, {"to_world": np.eye(3)}):
        with pytest.raises(LightError, match="of /rect needs finite numbers"):
            lights.change(0, **change)
    for image in ("x.exr", np.ones((4, 8)), ((1, 2), (3,))):
        with pytest.raises(LightError, match="image of"):
            lights.change(2, texture=image)
    assert lights.revision == before[1] and len(lights.paths) == 4
    np.testing.assert_array_equal(lights.gains, before[0])
    for now, then in zip(lights.snapshot().lights, before[2], strict=True):
        np.testing.assert_array_equal(now, then)
    with pytest.raises(LightError, match="can't be added live"):
        lights.add("/m", LightKind.MESH, to_world=down(0, 0, 0), radiance=(1, 1, 1))


def test_a_new_image_replaces_the_old_one(scene: Pipeline) -> None:
    lights = build(scene)
    image = np.full((4, 8, 3), 2.0, np.float32)
    lights.change(2, texture=image)
    settle(lights)
    plain = settle(build(scene, room(RECT, SPHERE, replace(DOME, image=Image(image)))))
    np.testing.assert_array_equal(lights.view_direct[2], plain.view_direct[2])
    np.testing.assert_array_equal(lights.snapshot().lights.texture, [-1, -1, 1, -1])


def test_two_lights_have_images_of_their_own(scene: Pipeline) -> None:
    """The scene with the lights as they are now holds each image once, wherever the lights keep theirs."""
    lights = build(scene, room(RECT, DOME))
    pictures = [np.full((4, 8, 3), level, np.float32) for level in (2.0, 3.0, 5.0)]
    for light, picture in ((1, pictures[0]), (0, pictures[1]), (1, pictures[2])):
        lights.change(light, texture=picture)
    now = lights.snapshot()
    for light, picture in ((0, pictures[1]), (1, pictures[2])):
        np.testing.assert_array_equal(texture_image(now.textures, int(now.lights.texture[light]))[..., :3], picture)


def test_the_sky_behind_a_view_follows_every_image(scene: Pipeline) -> None:
    away = look_at((0, 5, 0), (0, 9, 0.1), width=4, height=4)
    snapshot = make_snapshot(cornell_meshes(), camera=away, lights=[DOME])
    pipeline = Pipeline(snapshot, n_gather=30, bounce_rays=16)
    lights, seen = build(pipeline), SeenLight(snapshot, pipeline.view)
    for level in (2.0, 3.0):
        lights.change(0, radiance=(1, 1, 1), texture=np.full((4, 8, 3), level, np.float32))
        seen.update(lights.snapshot(), lights.images)
        np.testing.assert_allclose(seen.view.background, level, rtol=1e-5)


def test_the_sky_follows_every_image_of_two_domes(monkeypatch: pytest.MonkeyPatch) -> None:
    """However often arrays of texels are freed, and new ones lie where they lay."""
    monkeypatch.setattr(LiveLights, "_show", lambda *_: None)  # what they light does not matter here
    away = look_at((0, 5, 0), (0, 9, 0.1), width=4, height=4)
    snapshot = make_snapshot(cornell_meshes(), camera=away, lights=[replace(DOME, path="/a"), replace(DOME, path="/b")])
    pipeline = Pipeline(snapshot, n_gather=30, bounce_rays=16)
    lights, seen = build(pipeline), SeenLight(snapshot, pipeline.view)
    levels = [0.0, 0.0]

    def show(light: int, level: float) -> None:
        levels[light] = level
        lights.change(light, radiance=(1, 1, 1), texture=np.full((256, 512, 3), level, np.float32))

    show(0, 1.0)
    for light, level in [*((1, 2.0 + k) for k in range(16)), *((0, 30.0 + k) for k in range(6))]:
        show(light, level)
        seen.update(lights.snapshot(), lights.images)
        np.testing.assert_allclose(seen.view.background, sum(levels), rtol=1e-5)


def test_a_camera_that_sees_no_surface_needs_no_light() -> None:
    away = look_at((0, 5, 0), (0, 9, 0.1), width=4, height=4)
    snapshot = make_snapshot(cornell_meshes(), camera=away, lights=[Light(LightKind.DOME, 1.0), RECT])
    pipeline = Pipeline(snapshot, n_gather=30, bounce_rays=16)
    assert pipeline.view.n == 0
    lights = settle(build(pipeline))
    assert lights.view_direct.shape == (2, 0, 3)
    lights.change(0, to_world=down(0, 0, 0))
    settle(lights)


def test_light_that_is_moved_from_rest_bounces_with_little_noise() -> None:
    """As it bounces by all rays: rows for light on the move are made for the lights that rest, of which this is one."""
    parts = Pipeline(room(RECT, SPHERE), n_gather=1000, bounce_rays=1024)
    lights, new = (build(parts, n_bounces=16) for _ in range(2))
    settle(lights)
    direct, radiance = lights._lights[0].direct, lights.radiance[0].copy()
    assert direct is not None
    there = direct * np.linspace(0.8, 1.2, len(direct), dtype=np.float32)[:, None]
    lasting = replace(parts.bounces, albedo=lasting_albedo(parts.bounces.rows, parts.bounces.albedo, 16))
    exact = solve_bounces(lasting, there[None], 200)[0]

    def error(lights: LiveLights) -> float:
        found = radiance.copy()
        for before in (direct, *[there] * 5):
            lights._around.bounce(there, found, before)
        return float(np.sqrt(((found - exact) ** 2).sum()))

    assert error(lights) < 0.6 * error(new)
    seen = [lights.revision, lights.moves]
    assert not lights.refine()
    assert [lights.revision, lights.moves] == seen


def test_rows_for_light_on_the_move_are_made_of_more_rays_though_there_is_no_light_yet() -> None:
    parts = Pipeline(room(), n_gather=300, bounce_rays=64)
    lights = build(parts, n_bounces=16)
    lights.remove(0)
    assert not lights.paths
    before = _entries(settle(lights))
    lights.take_bounces(more_bounces(parts.snapshot, parts.tracer, parts.gather, parts.bounces, 64, 192))
    assert lights.refine()
    assert _entries(settle(lights)) > 1.1 * before


def _entries(lights: LiveLights) -> int:
    assert lights._around.quick_bounces is not None
    return len(lights._around.quick_bounces.entries)


def test_rows_that_are_being_made_are_dropped_while_nobody_looks() -> None:
    parts = Pipeline(room(RECT), n_gather=300, bounce_rays=64)
    lights = build(parts, n_bounces=16)
    while lights._suiting is None:
        assert lights.refine()
    lights.stop_following()
    assert lights._suiting is None
    before = lights._around.quick_bounces
    settle(lights)
    assert lights._around.quick_bounces is not before
