"""Lights at interactive rates against the general sampler and known values."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from icheat_usd.kernels.place_columns import RUN
from icheat_usd.kernels.shadow import (
    APPEARED,
    BURIED,
    PART,
    SHARED_PART,
    TURNED,
    is_turned_away,
    light_places,
)
from icheat_usd.lighting import build_light_sampler, irradiance, reflected_direct
from icheat_usd.lighting.change import LightImages, changed_light, one_light, texture_image
from icheat_usd.lighting.domes import BinnedSky, see_sky, white_sky
from icheat_usd.lighting.quick import (
    LastLook,
    Shadows,
    build_shadows,
    direct_at,
    look_and_tell,
    prepare_places,
    shining_points,
)
from icheat_usd.lighting.sampler import prepare_light_sampler
from icheat_usd.materials import points_on_surface, take_points
from icheat_usd.scene import F32, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import build_tracer, transmittance
from icheat_usd.tracing.embree import EmbreeTracer
from tests.scenes import (
    IDENTITY,
    Image,
    Light,
    Material,
    Mesh,
    Texture,
    TextureUse,
    make_snapshot,
    quad,
    quads,
    rotation,
    scaling,
    sphere,
    translation,
)

DOWN = translation(0.2, 1.5, 0.1) @ rotation((1, 0, 0), -70)
CHECKS = Image(np.array([[[1.0, 0.2, 0.1], [0.3, 1.0, 0.2]], [[0.1, 0.4, 2.0], [1.0, 1.0, 1.0]]], np.float32))
LIGHTS = {
    "rect": Light(LightKind.RECT, (3, 2, 1), DOWN[:3], (0.8, 0.5)),
    "image": Light(LightKind.RECT, (3, 2, 1), DOWN[:3], (0.8, 0.5), CHECKS),
    "disk": Light(LightKind.DISK, (3, 2, 1), (DOWN @ scaling(1, 2, 1))[:3], (0.3, 0)),
    "sphere": Light(LightKind.SPHERE, (3, 2, 1), (translation(0.2, 1.0, 0) @ scaling(1, 0.5, 1))[:3], (0.3, 0)),
    "cylinder": Light(LightKind.CYLINDER, (3, 2, 1), translation(0.2, 1.0, 0)[:3], (0.1, 0.9)),
    "sun": Light(LightKind.DISTANT, (3, 2, 1), rotation((1, 0, 0), -60)[:3], (0.2, 0)),
    "beam": Light(LightKind.DISTANT, (3, 2, 1), rotation((1, 0, 0), -60)[:3]),
    "mirrored": Light(LightKind.RECT, (3, 2, 1), (DOWN @ scaling(-1, 1, 1))[:3], (0.8, 0.5)),
}


def scene(light: Light, floor: Material) -> SceneSnapshot:
    """A floor under a ball, a leaf with holes and a pane of glass."""
    ball, normals = sphere(0.25, 12)
    st = quads([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])[..., :2]
    holes = Image(np.array([[[1.0], [0.0]], [[0.0], [1.0]]], np.float32).repeat(3, axis=2))
    leaf = Material(0.5, opacity_threshold=0.5, textures={Texture.OPACITY: TextureUse(holes, channel=0)})
    glass = Material(0.0, opacity=0.0, ior=1.5, roughness=0.0)
    return make_snapshot(
        [
            Mesh(quad(3.0), floor, path="/floor"),
            Mesh(ball, Material(0.5), [translation(-0.3, 0.4, 0)], "/ball", normals),
            Mesh(quad(0.6), leaf, [translation(0.4, 0.5, 0.3)], "/leaf", st=st),
            Mesh(quad(0.6), glass, [translation(0.4, 0.5, -0.4)], "/glass"),
        ],
        lights=[light],
    )


def on_floor(snapshot: SceneSnapshot, n: int) -> SurfacePoints:
    uv = np.random.default_rng(2).uniform(0, 1, (n, 2))
    uv = np.where(uv.sum(1, keepdims=True) > 1, 1 - uv, uv) * 0.999
    triangle = np.arange(n) % 2
    return points_on_surface(snapshot, np.zeros(n, int), triangle, uv, 0)


def tracer_of(snapshot: SceneSnapshot) -> EmbreeTracer:
    tracer = build_tracer(snapshot)
    assert isinstance(tracer, EmbreeTracer)
    return tracer


def rounds(snapshot: SceneSnapshot, points: SurfacePoints, eye: F32 | None, n: int) -> np.ndarray:
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    places = prepare_places(snapshot, points, points.albedo, eye)
    total, found = np.zeros((len(points.instance), 3)), np.empty((len(points.instance), 3), np.float32)
    for turn in range(n):
        direct_at(snapshot, shadows, places, 7, False, found, turn)
        total += found
    return total / n


@pytest.mark.parametrize("name", LIGHTS)
def test_rounds_of_one_ray_come_to_what_the_general_sampler_finds(name: str) -> None:
    snapshot = scene(LIGHTS[name], Material(0.5))
    points = on_floor(snapshot, 300)
    found = rounds(snapshot, points, None, 128)
    tracer = tracer_of(snapshot)
    expected = irradiance(snapshot, tracer, build_light_sampler(snapshot), points, 4, 1024)[0] * (0.5 / np.pi)
    np.testing.assert_allclose(found.mean(0), expected.mean(0), rtol=0.01)
    assert np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()) < 0.06


def test_glossy_surfaces_reflect_what_the_general_sampler_finds() -> None:
    snapshot = scene(LIGHTS["rect"], Material((0.4, 0.2, 0.1), roughness=0.4, ior=1.5, metallic=0.3))
    points = on_floor(snapshot, 300)
    eye = np.tile(np.array([0.0, 0.6, 0.8], np.float32), (300, 1))
    found = rounds(snapshot, points, eye, 64)
    tracer = tracer_of(snapshot)
    expected = reflected_direct(snapshot, tracer, build_light_sampler(snapshot), points, eye, 4, 512)[0]
    np.testing.assert_allclose(found.mean(0), expected.mean(0), rtol=0.02)
    assert np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()) < 0.06


def test_runs_that_share_rays_agree_with_rays_of_their_own() -> None:
    """Where all of a run is in the light or all in shadow nothing changes; at shadow edges every place has its ray."""
    snapshot = scene(LIGHTS["beam"], Material(0.5))
    points = on_floor(snapshot, 6400)
    order = np.lexsort((points.position[:, 0], np.floor(points.position[:, 2] * 20)))
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    own, shared = np.empty((2, 6400, 3), np.float32)
    for share, out in ((False, own), (True, shared)):
        direct_at(snapshot, shadows, prepare_places(snapshot, points, points.albedo, None, order), 0, share, out)
    assert (own[:, 0] == 0).mean() > 0.01
    assert (np.abs(own - shared) > 1e-6).any(axis=1).mean() < 0.01


@pytest.mark.parametrize("share", [False, True])
def test_a_light_that_moves_finds_its_shadows_within_a_round_of_looks(
    monkeypatch: pytest.MonkeyPatch, share: bool
) -> None:
    """Near the look before a part of the rays is enough, also of those through glass and leaves; where the light then
    stays, none of what was kept is old."""
    crossed: list[int] = []
    dim = Shadows.dim
    monkeypatch.setattr(Shadows, "dim", lambda *a: (crossed.append(int((a[5] > 0).sum())), dim(*a))[1])
    first = scene(LIGHTS["rect"], Material(0.5))
    points = on_floor(first, 3000)
    order = np.lexsort((points.position[:, 0], np.floor(points.position[:, 2] * 20)))
    shadows, places = build_shadows(first, tracer_of(first)), prepare_places(first, points, points.albedo, None, order)
    found, fresh = np.empty((2, 3000, 3), np.float32)
    last, images = LastLook(places), LightImages(first.textures)
    alone = one_light(first, 0)
    old = []
    for step in range(8 + (SHARED_PART if share else PART)):
        moved = translation(0.02 * min(step, 8), 0, 0) @ np.vstack([LIGHTS["rect"].to_world, [0, 0, 0, 1]])
        alone = changed_light(images, alone, to_world=moved[:3])
        direct_at(alone, shadows, places, 5, share, found, last=last)
        direct_at(alone, shadows, places, 5, share, fresh)
        old.append((abs(found - fresh) > 0.02 * fresh.max()).any(axis=1).mean())
    assert (fresh.sum(axis=1) == 0).mean() > 0.01
    assert old[0] == 0.0 and max(old) < 0.02
    of_found, of_fresh = crossed[::2], crossed[1::2]
    assert of_found[0] == of_fresh[0] > 200
    assert np.sum(of_found[1:]) < np.sum(of_fresh[1:]) / 2
    if share:  # at last every place has had its ray, of which one look spares some
        assert (found != fresh).any(axis=1).mean() < 0.01
        for _ in range(SHARED_PART):
            direct_at(alone, shadows, places, 5, share, fresh, last=last)
    np.testing.assert_array_equal(found, fresh)


@pytest.mark.parametrize("has_table", [False, True])
def test_of_a_light_that_is_pushed_into_a_wall_and_pulled_out_some_places_tell_the_others(
    has_table: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is told of the points that cross the wall makes up for rays, where other places see all others alike."""
    light = Light(LightKind.RECT, (3, 2, 1), (translation(-0.3, 1.0, 0) @ rotation((1, 0, 0), -90))[:3], (0.8, 0.5))
    floor = quads([[[-2, 0, 2], [0, 0, 2], [0, 0, -2], [-2, 0, -2]]])
    wall = quads([[[0, -1, -2], [0, -1, 2], [0, 3, 2], [0, 3, -2]]])
    table = quads([[[-1.2, 0.5, 0.6], [-0.6, 0.5, 0.6], [-0.6, 0.5, -0.2], [-1.2, 0.5, -0.2]]])
    meshes = [Mesh(floor, Material(0.5)), Mesh(wall, Material(0.5)), Mesh(table, Material(0.5))]
    snapshot = make_snapshot(meshes[: 2 + has_table], lights=[light])
    shadows, images = build_shadows(snapshot, tracer_of(snapshot)), LightImages(snapshot.textures)
    points = on_floor(snapshot, 8000)
    order = np.lexsort((points.position[:, 0], np.floor(points.position[:, 2] * 20)))
    many = prepare_places(snapshot, points, points.albedo, None, order)
    others = on_floor(snapshot, 40_000)
    some = prepare_places(snapshot, others, others.albedo, None)
    of_some, of_many, untold = LastLook(some), LastLook(many), LastLook(many)
    has_gaps: list[bool] = []

    def look(*given: Any) -> None:
        has_gaps.extend(not array.flags.c_contiguous for array in given if isinstance(array, np.ndarray))
        light_places(*given)

    monkeypatch.setattr("icheat_usd.lighting.quick.light_places", look)
    found, alike, fresh = np.empty((3, 8000, 3), np.float32)
    behind, wrong, missed, n_crossed = np.zeros(0, bool), [], [], 0
    for step in (0, 1, 2, 3, 4, 5, 5, 4, 3, 2, 1):
        to_world = translation(0.04 * step, 0, 0) @ np.vstack([light.to_world, [0, 0, 0, 1]])
        alone = changed_light(images, one_light(snapshot, 0), to_world=to_world[:3])
        shining = shining_points(alone, 5)
        was_behind, behind = behind, shining.table[:, 0] > 0
        told = look_and_tell(alone, shadows, some, 5, np.empty((some.n, 3), np.float32), of_some, shining)
        direct_at(alone, shadows, many, 5, False, found, last=of_many, told=told)
        direct_at(alone, shadows, many, 5, False, alike, last=untold)
        direct_at(alone, shadows, many, 5, False, fresh)
        assert len(told) == (len(was_behind) > 0 and (behind != was_behind).any()) * len(behind)
        if len(told):
            np.testing.assert_array_equal(told & APPEARED != 0, was_behind & ~behind)
            np.testing.assert_array_equal(told & BURIED != 0, behind)
            assert (told[behind != was_behind] & TURNED).all()
            n_crossed += np.count_nonzero(behind != was_behind)
        wrong.append((found != fresh).any(axis=1).mean())
        missed.append((alike != fresh).any(axis=1).mean())
    assert ((fresh == 0).all(axis=1).mean() > 0.2) == has_table  # below it, beside those whose point is behind the wall
    # Without a word, by runs of which no ray went to a point that has crossed; with it, at the border of the shadow.
    assert np.mean(missed) > 0.005
    assert max(wrong) < np.mean(missed) / 2 if has_table else max(wrong) == 0
    assert n_crossed > 40 and 0.1 < behind.mean() < 0.9
    # For other arrays the kernel would be compiled once more, in the middle of a move.
    assert has_gaps and not any(has_gaps)


@pytest.mark.parametrize("name", ["rect", "sun"])
def test_some_runs_of_places_get_what_all_would(name: str) -> None:
    """To the bit, through holes and glass as well; what is kept of others stays."""
    snapshot = scene(LIGHTS[name], Material(0.5))
    points = on_floor(snapshot, 1000)
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    places = prepare_places(snapshot, points, points.albedo, None)
    found, every = np.full((2, 1000, 3), -1, np.float32)
    last, of_all = LastLook(places), LastLook(places)
    runs = np.array([1, 4, 15], np.int32)
    direct_at(snapshot, shadows, places, 5, False, found, last=last, runs=runs)
    direct_at(snapshot, shadows, places, 5, False, every, last=of_all)
    meant = np.isin(np.arange(1000) // RUN, runs)
    np.testing.assert_array_equal(found[meant], every[meant])
    np.testing.assert_array_equal(last.known[meant], of_all.known[meant])
    assert (last.known[~meant] == -1).all() and (found[~meant] == -1).all()
    last.forget(np.array([4]))
    assert (last.known[4 * RUN : 5 * RUN] == -1).all() and (
        last.known[RUN : 2 * RUN] == of_all.known[RUN : 2 * RUN]
    ).all()


def test_light_crosses_layers_as_it_does_for_all_shadow_rays() -> None:
    snapshot = scene(LIGHTS["beam"], Material(0.5))
    points = on_floor(snapshot, 2000)
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    direction = np.array([0.1, 1.0, 0.2], np.float32) + 0.2 * np.random.default_rng(0).normal(size=(2000, 3))
    origin, direction = points.position + np.float32([0, 1e-4, 0]), direction.astype(np.float32)
    assert shadows.passing is not None
    for limit in (np.inf, 0.4):
        expected = transmittance(snapshot, shadows.passing, origin, direction, limit)[:, 0]
        found = shadows.crossing(snapshot, origin, direction, limit)
        np.testing.assert_allclose(found, expected, atol=2e-3)
    assert len(np.unique(np.round(found, 3))) > 1


def test_places_are_dimmed_by_what_their_rays_cross_or_crossed_before() -> None:
    snapshot = scene(LIGHTS["rect"], Material(0.5))
    points = on_floor(snapshot, 1500)  # the last run is not full
    shadows, places = (
        build_shadows(snapshot, tracer_of(snapshot)),
        prepare_places(snapshot, points, points.albedo, None),
    )
    shining = shining_points(snapshot, 3)
    rng = np.random.default_rng(0)
    through = rng.integers(-20, 20, places.n).astype(np.int32) * (rng.uniform(size=places.n) < 0.3)
    through[4 * RUN : 6 * RUN] = 0
    through[6 * RUN : 7 * RUN] = -abs(through[6 * RUN : 7 * RUN])  # no ray was sent
    runs = np.array([0, 3, 5, 6, 20, 23], np.int32)
    meant = np.isin(np.arange(places.n) // RUN, runs)
    crossing = rng.uniform(0, 1, places.n).astype(np.float32)
    expected_crossing, out = crossing.copy(), rng.uniform(0, 1, (places.n, 3)).astype(np.float32)
    sent = np.flatnonzero(meant & (through > 0))
    origin = places.columns[places.column[sent // RUN, :3], (sent % RUN)[:, None]]
    expected_crossing[sent] = shadows.crossing(
        snapshot, origin, shining.table[through[sent] - 1, :3] - origin, 1.0 - 1e-4
    )
    expected = np.where((meant & (through != 0))[:, None], out * expected_crossing[:, None], out)
    assert len(np.unique(expected_crossing[sent])) > 3
    shadows.dim(snapshot, shining, places, runs, through, crossing, out)
    np.testing.assert_array_equal(crossing, expected_crossing)
    np.testing.assert_array_equal(out, expected)


def test_columns_of_one_value_are_there_once() -> None:
    snapshot = scene(LIGHTS["rect"], Material(0.5, roughness=0.5, ior=1.5))
    points = on_floor(snapshot, 1000)
    eye = np.random.default_rng(1).normal(size=(1000, 3)).astype(np.float32)
    places = prepare_places(snapshot, points, points.albedo, eye / np.linalg.norm(eye, axis=1, keepdims=True))
    values = places.columns[places.column].transpose(0, 2, 1).reshape(-1, places.column.shape[1])[:1000]
    np.testing.assert_array_equal(values[:, 3:6], points.normal)
    np.testing.assert_array_equal(values[:, 6:9], points.shading_normal)
    np.testing.assert_array_equal(values[:, 9:12], points.albedo / np.float32(np.pi))
    np.testing.assert_array_equal(values[:, 12:15], points.specular)
    np.testing.assert_array_equal(values[:, 18], np.float32(points.roughness.astype(np.float64) ** 2))
    np.testing.assert_allclose(values[:, 21:24], eye / np.linalg.norm(eye, axis=1, keepdims=True), rtol=1e-6)
    # Of full runs the normals, albedo and lobe of a floor are the same.
    shared = places.column[:-1, 3:19]
    assert (shared == shared[:1]).all() and places.columns.ctypes.data % 64 == 0


def test_a_turned_dome_shines_as_the_general_sampler_says() -> None:
    rows, columns = np.mgrid[0:16, 0:32]
    image = Image(np.stack([1 + rows, 2 + columns, 4 + 0 * rows], -1).astype(np.float32) / 8)
    plain = scene(Light(LightKind.DOME, (1, 2, 1), image=image), Material(0.5, roughness=0.5, ior=1.5))
    points = on_floor(plain, 200)
    eye = np.tile(np.array([0.0, 0.6, 0.8], np.float32), (200, 1))
    tracer = tracer_of(plain)
    even, sampler = white_sky(plain, tracer, points, 1)
    seen = see_sky(even, sampler, build_shadows(plain, tracer), points, points.albedo / np.pi, eye, 64, 1)
    bins = BinnedSky(one_light(plain, 0))
    for degrees in (0, 100):
        turned = changed_light(
            LightImages(plain.textures), one_light(plain, 0), to_world=rotation((0.3, 1, 0), degrees)[:3]
        )
        found = np.empty((200, 3), np.float32)
        seen.light(bins.under(turned), found)
        expected = reflected_direct(turned, tracer, build_light_sampler(turned), points, eye, 3, 512)[0]
        np.testing.assert_allclose(found.mean(0), expected.mean(0), rtol=0.02)
        assert np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()) < 0.1


def test_an_even_sky_fills_every_bin_alike() -> None:
    snapshot = make_snapshot([Mesh(quad())], lights=[Light(LightKind.DOME, (1, 2, 3), IDENTITY)])
    sky = BinnedSky(snapshot).under(snapshot)
    np.testing.assert_allclose(sky, np.broadcast_to((1, 2, 3, 0), sky.shape))


def test_images_of_lights_follow_one_another() -> None:
    """A new image copies no others, and those that lights had before stay as they were."""
    plain = scene(Light(LightKind.DOME, 1.0), Material(0.5))
    images = LightImages(plain.textures)
    first, row = images.add(np.full((2, 4, 3), 3.0, np.float32))
    second, row_2 = images.add(np.full((1, 2, 4), 5.0, np.float32))
    assert row == row_2 == len(plain.textures.begin)
    assert second.texels.ctypes.data == first.texels.ctypes.data
    assert second.begin[row] == first.begin[row] + 8
    np.testing.assert_array_equal(texture_image(first, row)[..., :3], 3.0)
    np.testing.assert_array_equal(texture_image(second, row), 5.0)
    large, _ = images.add(np.full((32, 64, 3), 7.0, np.float32))
    np.testing.assert_array_equal(large.texels[: len(plain.textures.texels)], plain.textures.texels)
    np.testing.assert_array_equal(texture_image(large, row)[..., :3], 7.0)
    np.testing.assert_array_equal(texture_image(first, row)[..., :3], 3.0)


def test_learning_the_sky_pauses_often() -> None:
    plain = scene(Light(LightKind.DOME, 1.0), Material(0.5))
    points = on_floor(plain, 12000)
    steps = prepare_light_sampler(plain, tracer_of(plain), points, 1)
    assert sum(1 for _ in steps) > 6


@pytest.mark.parametrize("name", LIGHTS)
def test_runs_behind_a_light_are_dark_without_a_look(name: str) -> None:
    """Of places that a light cannot reach nothing is looked at; that changes no bit, whichever way they face."""
    snapshot = scene(LIGHTS[name], Material(0.5))
    rng = np.random.default_rng(5)
    mesh = np.repeat([0, 1], [1500, 2500])
    triangle = np.where(mesh == 0, rng.integers(0, 2, 4000), 2 + rng.integers(0, len(sphere(0.25, 12)[0]), 4000))
    uv = rng.uniform(0, 0.5, (4000, 2))
    points = points_on_surface(snapshot, mesh, triangle, uv, rng.integers(0, 2, 4000))
    order = np.lexsort((*points.normal.T, points.instance))
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    places = prepare_places(snapshot, points, points.albedo, None, order)
    bounds = np.broadcast_to(np.float32([[-9, -9, -9], [9, 9, 9], [-1, -1, -1], [1, 1, 1]]), places.bounds.shape)
    everywhere = replace(places, bounds=np.ascontiguousarray(bounds))
    found, looked_at = np.full((2, 4000, 3), 7, np.float32)
    for out, some in ((found, places), (looked_at, everywhere)):
        direct_at(snapshot, shadows, some, 5, False, out)
    np.testing.assert_array_equal(found.view(np.uint32), looked_at.view(np.uint32))
    assert 0.1 < (found.sum(axis=1) > 0).mean() < 0.9
    light = shining_points(snapshot, 5)
    turned_away = [is_turned_away(some, light.bounds, light.distant) for some in places.bounds]
    assert 0.1 < np.mean(turned_away) < 0.9


def by_form(
    light: Light, points: SurfacePoints, share_rays: bool, blocker: bool = True, turns: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Mean of some looks at a floor by a light's form, and of many by its points."""
    meshes = [Mesh(quad(3.0), Material(0.5), path="/floor")]
    if blocker:
        meshes.append(Mesh(quad(0.5), Material(0.5), [translation(0.1, 0.4, 0.1)], "/table"))
    snapshot = make_snapshot(meshes, lights=[light])
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    places = prepare_places(snapshot, points, points.albedo, None)
    total, look = np.zeros((len(points.instance), 3)), np.empty((len(points.instance), 3), np.float32)
    shining = shining_points(snapshot, 7, by_form=True)
    for turn in range(turns):
        direct_at(snapshot, shadows, places, 7, share_rays, look, turn, shining=shining)
        total += look
    return total / turns, rounds(snapshot, points, None, 256)


WHOLE = {
    "ball": Light(LightKind.SPHERE, (3, 2, 1), translation(0.2, 1.0, 0)[:3], (0.3, 0)),
    "rect": LIGHTS["rect"],
    "mirrored": LIGHTS["mirrored"],
}


@pytest.mark.parametrize(
    ("name", "share_rays"), [("ball", False), ("ball", True), ("rect", False), ("mirrored", False)]
)
def test_by_its_form_a_light_that_nothing_hides_has_no_noise(name: str, share_rays: bool) -> None:
    points = on_floor(scene(WHOLE[name], Material(0.5)), 2000)
    look, expected = by_form(WHOLE[name], points, share_rays, blocker=False)
    np.testing.assert_allclose(look, expected, rtol=0.03)
    assert np.sqrt(((look - expected) ** 2).sum() / (expected**2).sum()) < 0.01


@pytest.mark.parametrize("height", [0.0, -0.4])
def test_a_rectangle_that_stands_in_a_floor_has_no_noise_beside_it(height: float) -> None:
    """Also where places look at points below the floor alone."""
    light = Light(LightKind.RECT, (3, 2, 1), translation(0.0, height, 0.5)[:3], (1.0, 1.0))  # shines to -Z
    points = on_floor(scene(light, Material(0.5)), 2000)
    # Nearer, the points of the light are too few.
    points = take_points(points, np.flatnonzero(points.position[:, 2] < -0.1))
    look, expected = by_form(light, points, False, blocker=False)
    assert np.sqrt(((look - expected) ** 2).sum() / (expected**2).sum()) < 0.02
    assert look.sum() == pytest.approx(expected.sum(), rel=0.005)


@pytest.mark.parametrize("name", WHOLE)
def test_shadows_of_a_light_by_its_form_are_where_they_are_by_its_points(name: str) -> None:
    points = on_floor(scene(WHOLE[name], Material(0.5)), 20_000)
    look, expected = by_form(WHOLE[name], points, False, turns=16)
    clear = by_form(WHOLE[name], points, False, blocker=False)[0]
    found, true = look.sum(1) / clear.sum(1), expected.sum(1) / clear.sum(1)
    assert found[true < 1e-3].mean() < 1e-3 and found[true > 0.999].mean() > 0.999
    for low in np.arange(0.05, 0.95, 0.1):  # places of some darkness at the border
        some = (true >= low) & (true < low + 0.1)
        assert some.sum() > 20 and abs(found[some].mean() - true[some].mean()) < 0.06


@pytest.mark.parametrize(
    ("name", "share_rays"),
    [(name, False) for name in ("image", "disk", "sphere", "cylinder", "sun", "beam")] + [("rect", True)],
)
def test_lights_without_a_form_look_as_they_do_by_their_points(name: str, share_rays: bool) -> None:
    snapshot = scene(LIGHTS[name], Material(0.5))
    points = on_floor(snapshot, 500)
    places = prepare_places(snapshot, points, points.albedo, None)
    shadows, looks = build_shadows(snapshot, tracer_of(snapshot)), []
    for whole in (True, False):
        looks.append(np.empty((500, 3), np.float32))
        shining = shining_points(snapshot, 7, by_form=whole)
        direct_at(snapshot, shadows, places, 7, share_rays, looks[-1], shining=shining)
    np.testing.assert_array_equal(*looks)


def test_a_rectangle_that_is_partly_hidden_next_to_places_brings_what_its_points_do() -> None:
    """Few points say too little of how much of it is hidden: near ones bring a hundred times what far ones do."""
    upright = translation(0.0, 0.12, 0.0) @ rotation((0, 1, 0), 90)
    light = Light(LightKind.RECT, (3, 2, 1), upright[:3], (2.0, 0.1))
    screen = quads([[[-0.05, 0, -0.2], [-0.05, 1, -0.2], [-0.05, 1, 2], [-0.05, 0, 2]]])
    snapshot = make_snapshot(
        [Mesh(quad(3.0), Material(0.5), path="/floor"), Mesh(screen, Material(0.5))], lights=[light]
    )
    points = on_floor(snapshot, 20_000)
    shadows = build_shadows(snapshot, tracer_of(snapshot))
    places = prepare_places(snapshot, points, points.albedo, None)
    expected = rounds(snapshot, points, None, 256).sum()
    total, look = 0.0, np.empty((20_000, 3), np.float32)
    shining = shining_points(snapshot, 7, by_form=True)
    for turn in range(16):
        direct_at(snapshot, shadows, places, 7, False, look, turn, shining=shining)
        total += look.sum(dtype=np.float64) / 16
    assert total == pytest.approx(expected, rel=0.01)
