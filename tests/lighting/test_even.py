"""Rays that are spread evenly over a rectangle: against the general sampler with many, and where nothing hides it."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.even_look import light_of_clear_places
from icheat_usd.kernels.place_columns import RUN
from icheat_usd.lighting import build_light_sampler, irradiance
from icheat_usd.lighting.even import can_look_evenly, look_evenly
from icheat_usd.lighting.quick import build_shadows, diffuse_places, direct_at, prepare_places, shining_points
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I64, LightKind, SceneSnapshot, SurfacePoints
from tests.lighting.test_quick import LIGHTS, on_floor, tracer_of
from tests.scenes import Light, Material, Mesh, make_snapshot, quad, quads, rotation, translation

#: Long and upright, with a hand's breadth between it and the floor.
LONG = Light(LightKind.RECT, (3, 2, 1), (translation(0.0, 0.12, 0.0) @ rotation((0, 1, 0), 90))[:3], (2.0, 0.1))
SCREEN = quads([[[-0.05, 0, -0.2], [-0.05, 1, -0.2], [-0.05, 1, 2], [-0.05, 0, 2]]])


def room(light: Light, *meshes: Mesh) -> SceneSnapshot:
    return make_snapshot([Mesh(quad(3.0), Material(0.5), path="/floor"), *meshes], lights=[light])


def even(snapshot: SceneSnapshot, points: SurfacePoints, seed: int, n_rays: int, before: float = 0.0) -> F32:
    places = prepare_places(snapshot, points, points.albedo, None)
    found = np.full((len(points.instance), 3), before, np.float32)
    shadows, shining = build_shadows(snapshot, tracer_of(snapshot)), shining_points(snapshot, 7, by_form=True)
    look_evenly(snapshot, shadows, places, shining, seed, n_rays, each_once(places.n), found)
    return found


def each_once(n: int) -> I64:
    return np.stack([np.arange(n), np.zeros(n, np.int64)], axis=1)


def expected(snapshot: SceneSnapshot, points: SurfacePoints, n_rays: int = 4096) -> F32:
    tracer, sampler = tracer_of(snapshot), build_light_sampler(snapshot)
    arriving: F32 = irradiance(snapshot, tracer, sampler, points, 3, n_rays)[0]
    return arriving * points.albedo / np.float32(np.pi)


def off(found: F32, exact: F32) -> float:
    return float(np.sqrt(np.square(found - exact).sum(dtype=np.float64) / np.square(exact).sum(dtype=np.float64)))


@pytest.mark.parametrize("name", ["rect", "mirrored"])
def test_a_rectangle_that_nothing_hides_has_no_noise(name: str) -> None:
    snapshot = room(LIGHTS[name])
    points = on_floor(snapshot, 500)
    np.testing.assert_allclose(even(snapshot, points, 1, 1), expected(snapshot, points), rtol=2e-3)


def test_of_a_rectangle_that_is_partly_hidden_nearly_all_noise_is_gone() -> None:
    """Beside as many looks at points of it, next to it; and nothing is lost in the mean."""
    snapshot = room(LONG, Mesh(SCREEN, Material(0.5)))
    points = on_floor(snapshot, 4000)
    near = np.abs(points.position[:, 0]) < 0.3
    points = take_points(points, np.flatnonzero(near & (np.abs(points.position[:, 2]) < 0.8)))
    exact = expected(snapshot, points)
    places = prepare_places(snapshot, points, points.albedo, None)
    shadows, shining = build_shadows(snapshot, tracer_of(snapshot)), shining_points(snapshot, 7, by_form=True)
    look, by_points = np.empty_like(exact), np.zeros_like(exact)
    for turn in range(4):
        direct_at(snapshot, shadows, places, 7, False, look, turn, shining=shining)
        by_points += look / 4
    evenly = [even(snapshot, points, seed, 4) for seed in range(16)]
    assert 0.2 < np.mean(exact.sum(axis=1) < 0.9 * expected(room(LONG), points, 64).sum(axis=1)) < 0.9
    assert off(by_points, exact) > 0.2
    assert off(evenly[0], exact) < 0.5 * off(by_points, exact)
    assert off(np.mean(evenly, axis=0), exact) < 0.03
    assert np.mean(evenly, axis=0).sum() == pytest.approx(exact.sum(), rel=0.01)


def test_where_a_surface_cuts_a_rectangle_what_is_above_it_counts() -> None:
    light = Light(LightKind.RECT, (3, 2, 1), translation(0.0, -0.1, 0.5)[:3], (1.0, 1.0))  # shines to -Z
    snapshot = room(light)
    points = on_floor(snapshot, 1000)
    points = take_points(points, np.flatnonzero(points.position[:, 2] < 0.4))
    assert off(even(snapshot, points, 1, 4), expected(snapshot, points)) < 0.01


def test_places_behind_glass_keep_what_they_have() -> None:
    panes = [
        Mesh(quad(0.8), Material(0.0, opacity=opacity, ior=1.5, roughness=0.0), [translation(0.4, 0.3, -0.4)], "/pane")
        for opacity in (0.0, 1.0)
    ]
    glass, opaque = (room(LIGHTS["rect"], pane) for pane in panes)
    points = on_floor(glass, 2000)
    kept = even(glass, points, 1, 4, before=-1.0)[:, 0] == -1.0
    open_share = expected(opaque, points, 256)[:, 0] / expected(room(LIGHTS["rect"]), points, 256)[:, 0]
    assert kept[open_share < 0.1].all() and not kept[open_share == 1.0].any()
    assert np.count_nonzero(kept) > 20


def test_without_a_closed_form_rays_alone_tell() -> None:
    """Where the horizon of a bent surface cuts the light, and nothing is lost in the mean."""
    snapshot = room(Light(LightKind.RECT, (3, 2, 1), translation(0.0, 0.1, 0.5)[:3], (1.0, 1.0)))
    points = on_floor(snapshot, 500)
    bent = points.normal + np.float32([0.0, 0.0, 0.5])
    bent /= np.linalg.norm(bent, axis=1, keepdims=True)
    points = points._replace(shading_normal=bent)
    places = prepare_places(snapshot, points, points.albedo, None)
    whole = np.empty(places.n_runs * RUN, np.float32)
    runs, white = np.arange(places.n_runs, dtype=np.int32), np.ones(3, np.float32)
    form = shining_points(snapshot, 7, by_form=True).form
    light_of_clear_places(form, white, *places.table, runs, 1.0, whole)
    exact = expected(snapshot, points)
    has_none = np.flatnonzero((whole[:500] == 0.0) & (exact[:, 0] > 0.0))
    assert len(has_none) > 100
    # What they had before has no part in it, also where all of the few rays are below the horizon.
    evenly = [even(snapshot, points, seed, 4, before=9.0)[has_none] for seed in range(64)]
    assert off(evenly[0], exact[has_none]) < 0.3
    assert off(np.mean(evenly, axis=0), exact[has_none]) < 0.02
    assert np.mean(evenly, axis=0).sum() == pytest.approx(exact[has_none].sum(), rel=0.01)


def test_a_skewed_rectangle_is_as_large_as_it_is() -> None:
    """Beyond 32 of its diagonals no closed form is used."""
    skew = np.array([[1, 0.8, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
    light = translation(0.0, 2.5, 0.0) @ rotation((1, 0, 0), -90) @ np.vstack([skew, [0, 0, 0, 1]])
    snapshot = room(Light(LightKind.RECT, (300, 200, 100), light[:3], (0.03, 0.03)))
    points = on_floor(snapshot, 300)
    exact = expected(snapshot, points)
    assert exact.min() > 0.0
    np.testing.assert_allclose(even(snapshot, points, 1, 64, before=9.0), exact, rtol=0.01)


def test_light_of_clear_places_is_what_they_get_if_nothing_hides_it() -> None:
    snapshot, hidden = room(LIGHTS["rect"]), room(LIGHTS["rect"], Mesh(SCREEN, Material(0.5)))
    points = on_floor(snapshot, 300)
    places = prepare_places(hidden, points, points.albedo, None)
    whole = np.full(places.n_runs * RUN, -1.0, np.float32)
    shining = shining_points(hidden, 7, by_form=True)
    color, runs = np.ascontiguousarray(shining.table[0, 6:9]), np.array([0, 2, 4], np.int32)
    light_of_clear_places(shining.form, color, *places.table, runs, 0.5, whole)
    wanted = np.isin(np.arange(len(whole)) // RUN, (0, 2, 4))
    exact = np.pad(0.5 * expected(snapshot, points).sum(axis=1), (0, len(whole) - 300))
    np.testing.assert_allclose(whole[wanted], exact[wanted], rtol=2e-3)
    assert (whole[~wanted] == -1.0).all()


def test_places_may_be_there_several_times_with_other_rays() -> None:
    """Some of all see what they see among all, and more rays tell more."""
    snapshot = room(LONG, Mesh(SCREEN, Material(0.5)))
    points = on_floor(snapshot, 500)
    places = prepare_places(snapshot, points, points.albedo, None)
    which = np.repeat(np.random.default_rng(8).choice(500, 200, replace=False), 4)
    some = diffuse_places(places, which)
    assert some.n == 800 and some.n_runs == 13
    found = np.zeros((800, 3), np.float32)
    shadows, shining = build_shadows(snapshot, tracer_of(snapshot)), shining_points(snapshot, 7, by_form=True)
    sequence = np.stack([which, np.arange(800) % 4 * 4], axis=1)
    look_evenly(snapshot, shadows, some, shining, 5, 4, sequence, found)
    among_all, exact = even(snapshot, points, 5, 4)[which[::4]], expected(snapshot, points)[which[::4]]
    # What all of the light brings is rounded otherwise beside other places.
    np.testing.assert_allclose(found[::4], among_all, rtol=1e-3)
    assert np.count_nonzero(among_all) > 150
    assert off(found.reshape(200, 4, 3).mean(axis=1), exact) < 0.5 * off(among_all, exact)


def test_other_lights_are_not_looked_at_so() -> None:
    can = {
        name: can_look_evenly(snapshot, shining_points(snapshot, 7, by_form=True))
        for name, snapshot in ((name, room(light)) for name, light in LIGHTS.items())
    }
    assert [name for name, is_so in can.items() if is_so] == ["rect", "mirrored"]
