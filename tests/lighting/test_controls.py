"""Lights that shine on some surfaces only, in some directions only: closed forms, and bits that stay."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.lighting import build_light_sampler, irradiance, reflected_direct
from icheat_usd.lighting.controls import tracer_for
from icheat_usd.lighting.ies import read_profile
from icheat_usd.lighting.quick import build_shadows, direct_at, prepare_places
from icheat_usd.materials import points_on_surface
from icheat_usd.scene import F32, LightControls, LightKind, SceneSnapshot, Shaping, SurfacePoints
from icheat_usd.tracing import build_tracer
from icheat_usd.tracing.embree import EmbreeTracer
from tests.ies import profile_text
from tests.lighting import naive
from tests.lighting.test_irradiance import UP
from tests.scenes import Image, Light, Material, Mesh, make_snapshot, quad, rotation, scaling, translation

DOWN = rotation((1, 0, 0), -90)
OVER = (translation(0.1, 1.5, 0.2) @ DOWN)[:3]
LIGHTS = {
    "rect": Light(LightKind.RECT, (3, 2, 1), OVER, (0.8, 0.5)),
    "sphere": Light(LightKind.SPHERE, (3, 2, 1), OVER, (0.3, 0)),
    "cylinder": Light(LightKind.CYLINDER, (3, 2, 1), OVER, (0.1, 0.9)),
    "disk": Light(LightKind.DISK, (3, 2, 1), OVER, (0.3, 0)),
    "sun": Light(LightKind.DISTANT, (3, 2, 1), DOWN[:3], (0.2, 0)),
    "beam": Light(LightKind.DISTANT, (3, 2, 1), DOWN[:3]),
    "dome": Light(LightKind.DOME, (3, 2, 1)),
    "sky": Light(LightKind.DOME, 1.0, image=Image(np.random.default_rng(1).uniform(0.1, 2, (4, 8, 3)))),
}
KINDS = (*LIGHTS, "mesh")
EVEN = Shaping(np.full(2, np.inf), 0.0, np.zeros(3), 0.0, np.zeros(0), np.zeros(0), np.zeros((0, 0)))


def room(kind: str, *, has_leaf: bool = True) -> SceneSnapshot:
    """Two floors under a leaf in the air, lit from above: surfaces 0 to 2, and a lamp."""
    floor = Material((0.5, 0.4, 0.3), roughness=0.3, ior=1.5)
    meshes = [
        Mesh(quad(1.0), floor, [translation(-0.6, 0, 0)], "/left"),
        Mesh(quad(1.0), floor, [translation(0.6, 0, 0)], "/right"),
        Mesh(quad(0.5), Material(0.5), [translation(0, 0.6 if has_leaf else -9.0, 0)], "/leaf"),
    ]
    if kind == "mesh":
        meshes.append(Mesh(quad(0.5)[:, ::-1], Material(0.0, (9, 6, 3)), [translation(0, 1.5, 0)], "/lamp"))
    return make_snapshot(meshes, lights=[LIGHTS[kind]] if kind in LIGHTS else [])


def under(snapshot: SceneSnapshot, *controls: LightControls) -> SceneSnapshot:
    return replace(snapshot, light_controls=controls)


def flags(snapshot: SceneSnapshot, *out: str) -> NDArray[np.uint8]:
    """1 for every instance but those of some surfaces."""
    return np.array([surface.path not in out for surface in snapshot.surfaces], np.uint8)


def on_floors(snapshot: SceneSnapshot, n: int = 64) -> SurfacePoints:
    uv = np.random.default_rng(2).uniform(0, 1, (n, 2))
    uv = np.where(uv.sum(1, keepdims=True) > 1, 1 - uv, uv) * 0.999
    instance = np.arange(n) % 2
    return points_on_surface(snapshot, instance, 2 * instance + np.arange(n) // 2 % 2, uv, 0)


def arriving(snapshot: SceneSnapshot, points: SurfacePoints, n: int = 16, engine: str = "embree") -> F32:
    tracer = build_tracer(snapshot, engine)
    return irradiance(snapshot, tracer, build_light_sampler(snapshot, tracer, points), points, 5, n)


def reflected(snapshot: SceneSnapshot, points: SurfacePoints, n: int = 16) -> F32:
    eye = np.tile(np.array([0.0, 0.6, 0.8], np.float32), (len(points.instance), 1))
    tracer = build_tracer(snapshot)
    return reflected_direct(snapshot, tracer, build_light_sampler(snapshot, tracer, points), points, eye, 5, n)


# Links ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_surface_that_is_left_out_gets_nothing_and_the_others_what_they_had(kind: str) -> None:
    plain = room(kind)
    points = on_floors(plain)
    linked = under(plain, LightControls(receivers=flags(plain, "/left")))
    left = points.instance == 0
    for light in (arriving, reflected):
        before, after = light(plain, points)[0], light(linked, points)[0]
        assert (before[left] > 0).any()
        np.testing.assert_array_equal(after[left], 0.0)
        np.testing.assert_array_equal(after[~left], before[~left])


def test_one_light_s_link_is_no_other_light_s() -> None:
    floor = Mesh(quad(1.0), Material(0.5, roughness=0.2, ior=1.5), path="/floor")
    plain = make_snapshot([floor], lights=[LIGHTS["rect"], LIGHTS["sphere"]])
    points = naive.receivers([(0.1, 0, 0)], UP, specular=0.5, specular_edge=1.0)
    linked = under(plain, LightControls(receivers=flags(plain, "/floor")), LightControls())
    np.testing.assert_array_equal(reflected(linked, points)[0], 0.0)
    np.testing.assert_array_equal(reflected(linked, points)[1], reflected(plain, points)[1])


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_left_out_of_the_shadows_casts_none(kind: str) -> None:
    """As if it were not there, bit for bit: the random numbers are the same."""
    plain, bare = room(kind), room(kind, has_leaf=False)
    points = on_floors(plain)
    linked = under(plain, LightControls(blockers=flags(plain, "/leaf")))
    for light in (arriving, reflected):
        assert not np.array_equal(light(plain, points), light(bare, points))
        np.testing.assert_array_equal(light(linked, points), light(bare, points))


def test_both_tracers_leave_the_same_out() -> None:
    linked = room("rect")
    linked = under(linked, LightControls(blockers=flags(linked, "/leaf")))
    points = on_floors(linked)
    np.testing.assert_allclose(arriving(linked, points, engine="reference"), arriving(linked, points), rtol=1e-5)


def test_a_light_that_nothing_blocks_shines_through_everything() -> None:
    plain, bare = room("rect"), room("rect", has_leaf=False)
    points = on_floors(plain)
    nothing = np.zeros(plain.n_instances, np.uint8)
    np.testing.assert_array_equal(
        arriving(under(plain, LightControls(blockers=nothing)), points), arriving(bare, points)
    )


def test_a_glowing_mesh_blocks_its_own_light_whatever_its_link_says() -> None:
    plain = room("mesh")
    points = on_floors(plain)
    linked = under(plain, LightControls(blockers=flags(plain, "/lamp")))
    np.testing.assert_array_equal(reflected(linked, points), reflected(plain, points))


def test_lights_that_are_blocked_alike_share_a_tracer() -> None:
    plain = make_snapshot([Mesh(quad(1.0), path="/a"), Mesh(quad(1.0), path="/b")], lights=[LIGHTS["rect"]] * 4)
    a, b = (LightControls(blockers=flags(plain, path)) for path in ("/a", "/b"))
    snapshot = under(plain, a, LightControls(blockers=flags(plain, "/a")), b, LightControls())
    tracer = build_tracer(snapshot)
    found = [tracer_for(snapshot, tracer, light) for light in range(4)]
    assert found[0] is found[1] and found[2] is not found[0] and found[3] is tracer


# Multipliers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_multipliers_scale_each_response_by_itself(kind: str) -> None:
    plain = room(kind)
    points = on_floors(plain)

    def of(diffuse: float, specular: float) -> F32:
        return reflected(under(plain, LightControls(diffuse=diffuse, specular=specular)), points)

    matte, shine = of(1.0, 0.0), of(0.0, 1.0)
    assert matte.any() and shine.any()
    np.testing.assert_allclose(matte + shine, reflected(plain, points), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(of(0.25, 3.0), 0.25 * matte + 3.0 * shine, rtol=1e-5, atol=1e-7)
    halved = under(plain, LightControls(diffuse=0.5, specular=7.0))
    np.testing.assert_array_equal(arriving(halved, points), 0.5 * arriving(plain, points))


# Shaping ----------------------------------------------------------------------------------------


def ratio(shaping: Shaping, degrees: NDArray, light: Light, turn: float = 0.0) -> NDArray:
    """What a light gives to points off its axis by some angles, over what it gives without shaping."""
    angle, phi = np.radians(degrees), np.radians(turn)
    centre = np.asarray(light.to_world)[:3, 3]
    away = np.stack([np.sin(angle) * np.cos(phi), -np.cos(angle), -np.sin(angle) * np.sin(phi)], 1)
    points = naive.receivers(centre + 3.0 * away, -away)
    far_away = make_snapshot([Mesh(quad(0.01, y=-20.0))], lights=[light])
    shaped = under(far_away, LightControls(shaping=shaping))
    return arriving(shaped, points)[0] / arriving(far_away, points)[0]


SMALL = Light(LightKind.SPHERE, (3, 2, 1), OVER, (0.01, 0))


def test_a_hard_cone_is_all_or_nothing() -> None:
    degrees = np.array([0.0, 10, 29.5, 30.5, 60, 90, 150])
    found = ratio(EVEN._replace(cone=np.radians([30.0, 30.0])), degrees, SMALL)
    np.testing.assert_array_equal(found[:, 0], degrees < 30)


def test_a_soft_cone_is_a_smooth_step() -> None:
    degrees = np.array([0.0, 10, 20, 25, 30, 35, 39, 41])
    found = ratio(EVEN._replace(cone=np.radians([20.0, 40.0])), degrees, SMALL)
    t = np.clip((degrees - 20) / 20, 0, 1)
    np.testing.assert_allclose(found[:, 1], 1 - t * t * (3 - 2 * t), atol=2e-3)


@pytest.mark.parametrize("stretch", [1.0, 4.0])
def test_focus_is_a_power_of_the_cosine_towards_the_tint(stretch: float) -> None:
    """Off the axis in the world, however the light is scaled along it."""
    degrees = np.array([0.0, 20, 40, 60, 80, 100, 180])
    tint = np.array([0.0, 0.3, 1.0])
    stretched = replace(SMALL, to_world=(translation(0.1, 1.5, 0.2) @ DOWN @ scaling(1, 1, stretch))[:3])
    found = ratio(EVEN._replace(focus=3.0, focus_tint=tint), degrees, stretched)
    power = np.abs(np.cos(np.radians(degrees)))[:, None] ** 3
    np.testing.assert_allclose(found, power + (1 - power) * tint, atol=6e-3 * stretch)


def profile(scale: float = 0.0) -> Shaping:
    """Four sectors and a fall-off that is linear between the angles."""
    text = profile_text((0, 30, 60, 90), (0, 90, 180, 270, 360), np.outer((1, 2, 3, 4, 1), (10, 8, 4, 0)))
    read = read_profile(text.encode(), "a.ies")
    return EVEN._replace(
        vertical=read.vertical, horizontal=read.horizontal, intensity=read.intensity, profile_scale=scale
    )


@pytest.mark.parametrize("turn", [0.0, 45.0, 90.0, 200.0, 315.0])
def test_a_profile_is_looked_up_linearly_in_both_angles(turn: float) -> None:
    degrees = np.array([1.0, 15, 30, 45, 75, 89, 95, 150])
    found = ratio(profile(), degrees, SMALL, turn)
    # Light that leaves along +X of the light comes from where its own -X points: half a turn round.
    around = np.interp((turn + 180.0) % 360.0, (0, 90, 180, 270, 360), (1, 2, 3, 4, 1))
    down = np.interp(degrees, (0, 30, 60, 90), (10, 8, 4, 0)) * (degrees <= 90)
    np.testing.assert_allclose(found[:, 0], around * down, rtol=0.03, atol=0.05)


@pytest.mark.parametrize("scale", [0.5, 2.0, -0.5, -2.0])
def test_a_scaled_profile_is_looked_up_at_other_angles(scale: float) -> None:
    degrees = np.array([5.0, 20, 40, 70, 120, 170])
    shaping = profile(scale)._replace(intensity=np.outer(np.ones(5), (10, 8, 4, 0)))
    looked_up = degrees / scale if scale > 0 else (degrees - 180) / -scale + 180
    looked_up = np.clip(looked_up, 0, 180)
    down = np.interp(looked_up, (0, 30, 60, 90), (10, 8, 4, 0)) * (looked_up <= 90)
    np.testing.assert_allclose(ratio(shaping, degrees, SMALL)[:, 0], down, rtol=0.03, atol=0.06)


# Lights at interactive rates --------------------------------------------------------------------


def rounds(snapshot: SceneSnapshot, points: SurfacePoints, eye: F32 | None, n: int = 128) -> NDArray:
    tracer = build_tracer(snapshot)
    assert isinstance(tracer, EmbreeTracer)
    blockers = snapshot.controls(0).blockers
    shadows = build_shadows(snapshot, tracer, None if blockers is None else blockers == 0)
    places = prepare_places(snapshot, points, points.albedo, eye)
    total, found = np.zeros((len(points.instance), 3)), np.empty((len(points.instance), 3), np.float32)
    for turn in range(n):
        direct_at(snapshot, shadows, places, 7, False, found, turn)
        total += found
    return total / n


CONTROLS = {
    "links": lambda s: LightControls(flags(s, "/left"), flags(s, "/leaf")),
    "multipliers": lambda s: LightControls(diffuse=0.5, specular=2.0),
    "cone": lambda s: LightControls(shaping=EVEN._replace(cone=np.array([0.2, 0.5]))),
    "focus": lambda s: LightControls(shaping=EVEN._replace(focus=8.0, focus_tint=np.array([0.1, 0.0, 0.5]))),
    "profile": lambda s: LightControls(flags(s, "/right"), None, 0.7, 1.3, profile()),
}


@pytest.mark.parametrize("kind", ["rect", "sphere", "sun"])
@pytest.mark.parametrize("name", CONTROLS)
def test_rounds_of_one_ray_come_to_what_the_general_sampler_finds(kind: str, name: str) -> None:
    snapshot = room(kind)
    snapshot = under(snapshot, CONTROLS[name](snapshot))
    points = on_floors(snapshot, 256)
    eye = np.tile(np.array([0.0, 0.6, 0.8], np.float32), (256, 1))
    found, expected = rounds(snapshot, points, eye), reflected(snapshot, points, 512)[0]
    assert expected.any()
    np.testing.assert_array_equal(found[(expected == 0).all(axis=1) & (points.instance == 0)].sum(), 0.0)
    np.testing.assert_allclose(found.mean(0), expected.mean(0), rtol=0.03)
    assert np.sqrt(((found - expected) ** 2).sum() / (expected**2).sum()) < 0.08
