"""Irradiance of every light kind against closed forms and quadrature."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from icheat_usd.lighting import build_light_sampler, irradiance
from icheat_usd.scene import LightKind, SceneSnapshot, SurfacePoints, Texture
from icheat_usd.tracing import build_tracer
from tests.lighting import naive
from tests.scenes import (
    IDENTITY,
    Image,
    Light,
    Material,
    Mesh,
    TextureUse,
    closed_box,
    make_snapshot,
    quad,
    quads,
    rotation,
    scaling,
    translation,
)

UP = (0.0, 1.0, 0.0)
DOWN = rotation((1, 0, 0), -90)  #: turns local -Z, where rects and disks shine, to world -Y
MIRROR = scaling(-1.0, 1.0, 1.0)
SHEAR = np.array([[1, 0.4, 0, 0], [0, 1, 0.3, 0], [0.2, 0, 1, 0], [0, 0, 0, 1.0]])


def scene(*lights: Light, meshes: tuple[Mesh, ...] = ()) -> SceneSnapshot:
    far_away = Mesh(quad(0.01, y=-20.0))
    return make_snapshot([far_away, *meshes], lights=lights)


def irradiance_at(
    snapshot: SceneSnapshot, points: SurfacePoints, *, n_samples: int = 1024, seed: int = 3
) -> NDArray[np.float32]:
    return irradiance(snapshot, build_tracer(snapshot), build_light_sampler(snapshot), points, seed, n_samples)


def one(light: Light, point: ArrayLike = (0, 0, 0), normal: ArrayLike = UP, n_samples: int = 4096) -> float:
    result = irradiance_at(scene(light), naive.receivers(point, normal), n_samples=n_samples)
    assert np.ptp(result[0, 0]) < 1e-6 * max(result.max(), 1.0)
    return float(result[0, 0, 0])


POSES = {
    "overhead": translation(0, 2, 0) @ DOWN,
    "aside and turned": translation(0.6, 1.5, -0.8) @ rotation((0, 0, 1), 25) @ DOWN,
    "close": translation(0.1, 0.05, 0) @ DOWN,
    "far": translation(30, 200, 0) @ DOWN,
    "tilted": translation(1, 1.5, 0) @ rotation((0, 0, 1), -50) @ DOWN,
    "stretched": translation(0, 2, 0.5) @ DOWN @ scaling(3, 0.4, 7),
    "mirrored": translation(0.2, 2, 0) @ DOWN @ MIRROR,
    "sheared": translation(0, 2, 0) @ DOWN @ SHEAR,
}


@pytest.mark.parametrize("pose", POSES)
def test_rect_light_follows_lamberts_polygon_formula(pose: str) -> None:
    to_world, (width, height) = POSES[pose], (1.0, 0.7)
    corners = [(x * width / 2, y * height / 2, 0, 1) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    expected = naive.polygon_irradiance((corners @ to_world.T)[:, :3], (0, 0, 0), UP)
    assert one(Light(LightKind.RECT, 1.0, to_world, (width, height))) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("mirror", [np.eye(4), MIRROR, scaling(1, 1, -1), scaling(-1, -1, -1)])
@pytest.mark.parametrize("kind", [LightKind.RECT, LightKind.DISK])
def test_flat_lights_shine_where_their_own_minus_z_went_and_nowhere_else(kind: LightKind, mirror: np.ndarray) -> None:
    light = Light(kind, 1.0, translation(0, 2, 0) @ DOWN @ mirror, (1.0, 1.0))
    down = (translation(0, 2, 0) @ DOWN @ mirror)[:3, :3] @ (0, 0, -1)
    lit, unlit = ((0, 0, 0), UP), ((0, 4, 0), (0, -1, 0))
    if down[1] > 0:
        lit, unlit = unlit, lit
    assert one(light, *lit) > 0.1
    assert one(light, *unlit) == 0.0


def test_rect_image_is_upright_for_who_looks_at_the_lit_side() -> None:
    texels = np.zeros((2, 2, 3))
    texels[0, 0] = 4.0  # top left
    # lit side seen from below, local +Y towards -Z of the world: left is where local +X points
    to_world = translation(0, 0.1, 0) @ DOWN
    snapshot = scene(Light(LightKind.RECT, 1.0, to_world, (2, 2), Image(texels, (1, 1))))
    left, top = to_world[:3, :3] @ (1, 0, 0), to_world[:3, :3] @ (0, 1, 0)
    places = np.array([(a * left + b * top) * 0.6 for a, b in ((1, 1), (-1, 1), (1, -1), (-1, -1))])
    result = irradiance_at(snapshot, naive.receivers(places, UP), n_samples=512)[0, :, 0]
    assert result.argmax() == 0
    assert result[0] > 5 * result[3]


@pytest.mark.parametrize("radius, height", [(0.7, 2.0), (0.001, 1.0), (1.9, 2.0)])
def test_sphere_light_overhead_gives_pi_sine_squared(radius: float, height: float) -> None:
    value = one(Light(LightKind.SPHERE, 1.0, translation(0, height, 0), (radius, 0)))
    assert value == pytest.approx(np.pi * (radius / height) ** 2, rel=1e-4)


def test_sphere_light_shines_outwards_only() -> None:
    assert one(Light(LightKind.SPHERE, 1.0, translation(0.1, 0, 0), (1.0, 0))) == 0.0


def test_disk_light_on_its_axis_gives_its_form_factor() -> None:
    value = one(Light(LightKind.DISK, 2.0, translation(0, 2, 0) @ DOWN, (0.7, 0)))
    assert value == pytest.approx(2 * np.pi * 0.49 / (0.49 + 4), rel=1e-3)


SHAPES = {
    LightKind.SPHERE: (naive.sphere_shape(0.5), (0.5, 0.0)),
    LightKind.DISK: (naive.disk_shape(0.6), (0.6, 0.0)),
    LightKind.CYLINDER: (naive.cylinder_shape(0.3, 1.5), (0.3, 1.5)),
}


@pytest.mark.parametrize("pose", ["aside and turned", "tilted", "stretched", "mirrored", "sheared"])
@pytest.mark.parametrize("kind", SHAPES)
def test_curved_lights_match_quadrature_under_any_affine_map(kind: LightKind, pose: str) -> None:
    shape, size = SHAPES[kind]
    to_world = POSES[pose]
    if pose == "stretched":
        to_world = translation(0, 2, 0.5) @ DOWN @ scaling(2, 0.4, 1.5)
    normal = np.array([0.2, 1.0, -0.1])
    normal /= np.linalg.norm(normal)
    expected = naive.surface_irradiance(shape, to_world, (0, 0, 0), normal)
    assert expected > 1e-3
    assert one(Light(kind, 1.0, to_world, size), (0, 0, 0), normal) == pytest.approx(expected, rel=3e-3)


def test_distant_light_with_an_angle_gives_pi_sine_squared_and_ignores_scale() -> None:
    half_angle = 0.3
    for to_world in (DOWN, translation(5, 1, 0) @ DOWN @ scaling(0.01)):
        value = one(Light(LightKind.DISTANT, 2.0, to_world, (half_angle, 0)))
        assert value == pytest.approx(2 * np.pi * np.sin(half_angle) ** 2, rel=1e-4)


def test_distant_light_without_an_angle_is_an_irradiance_times_cosine() -> None:
    value = one(Light(LightKind.DISTANT, 3.0, rotation((1, 0, 0), -60), (0, 0)))
    assert value == pytest.approx(3 * np.cos(np.radians(30)), rel=1e-6)


def test_constant_dome_gives_pi_with_and_without_an_image() -> None:
    assert one(Light(LightKind.DOME, 1.0)) == pytest.approx(np.pi, rel=1e-6)
    for to_world in (np.eye(4), rotation((1, 2, 0), 40), rotation((0, 0, 1), 30) @ MIRROR):
        image = Image(np.ones((8, 16, 3)), (0, 1))
        assert one(Light(LightKind.DOME, 1.0, to_world, image=image)) == pytest.approx(np.pi, rel=2e-3)


def test_textured_dome_matches_quadrature_of_the_bilinear_image() -> None:
    rng = np.random.default_rng(1)
    texels = rng.random((6, 12, 3)) ** 4
    texels[2, 5] = 30.0
    turn = rotation((1, 0.5, 0.2), 70)
    snapshot = scene(Light(LightKind.DOME, (1, 2, 3), turn, image=Image(texels, (0, 1))))
    result = irradiance_at(snapshot, naive.receivers((0, 0, 0), UP), n_samples=1 << 14)[0, 0]

    h, w = 600, 1200
    theta = np.pi * (np.arange(h)[:, None] + 0.5) / h
    longitude = np.pi - 2 * np.pi * (np.arange(w)[None] + 0.5) / w
    local = np.stack(
        [np.sin(theta) * np.sin(longitude), np.cos(theta) + 0 * longitude, np.sin(theta) * np.cos(longitude)], -1
    )
    y = np.clip((np.arange(h) + 0.5) / h * 6 - 0.5, 0, 5)
    x = (np.arange(w) + 0.5) / w * 12 - 0.5
    y0, x0 = np.floor(y).astype(int), np.floor(x).astype(int)
    y1, fy, fx = np.minimum(y0 + 1, 5), (y - y0)[:, None, None], (x - x0)[None, :, None]
    top = texels[y0][:, x0 % 12] * (1 - fx) + texels[y0][:, (x0 + 1) % 12] * fx
    bottom = texels[y1][:, x0 % 12] * (1 - fx) + texels[y1][:, (x0 + 1) % 12] * fx
    image = top * (1 - fy) + bottom * fy
    cosine = np.maximum((local @ turn[:3, :3].T)[..., 1], 0)
    weight = cosine * np.sin(theta) * (np.pi / h) * (2 * np.pi / w)
    expected = (image * weight[..., None]).sum((0, 1)) * (1, 2, 3)
    np.testing.assert_allclose(result, expected, rtol=5e-3)


def test_dome_image_that_is_black_gives_nothing() -> None:
    assert one(Light(LightKind.DOME, 1.0, image=Image(np.zeros((4, 8, 3))))) == 0.0


def lamp(emission: ArrayLike, *, transform: ArrayLike = IDENTITY, textures: dict | None = None) -> Mesh:
    points = quads([[(-0.5, -0.35, 0), (-0.5, 0.35, 0), (0.5, 0.35, 0), (0.5, -0.35, 0)]])
    st = quads([[(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)]])[..., :2]
    return Mesh(points, Material(0.0, emission, textures=textures or {}), transforms=[transform], st=st)


@pytest.mark.parametrize("pose", ["overhead", "tilted", "stretched", "mirrored", "sheared"])
def test_mesh_light_equals_the_rect_light_of_its_outline(pose: str) -> None:
    to_world = POSES[pose]
    both = scene(Light(LightKind.RECT, 2.0, to_world, (1.0, 0.7)), meshes=(lamp(2.0, transform=to_world),))
    result = irradiance_at(both, naive.receivers((0, 0, 0), UP), n_samples=8192)[:, 0, 0]
    assert result[1] == pytest.approx(result[0], rel=4e-3)


def test_mesh_light_emits_on_both_sides() -> None:
    snapshot = scene(meshes=(lamp(1.0, transform=translation(0, 2, 0) @ DOWN),))
    points = naive.receivers([(0, 0, 0), (0, 4, 0)], [(0, 1, 0), (0, -1, 0)])
    below, above = irradiance_at(snapshot, points, n_samples=4096)[0, :, 0]
    assert below > 0.1
    assert above == pytest.approx(below, rel=2e-3)


def test_mesh_light_of_uneven_triangles_is_sampled_without_bias() -> None:
    to_world = translation(0, 1.5, 0) @ DOWN
    snapshot = scene(meshes=(lamp(1.0, transform=to_world),))
    dim = Material(0.0, 0.1)
    small = quads([[(0.5, -0.35, 0), (0.5, 0.35, 0), (0.51, 0.35, 0), (0.51, -0.35, 0)]])
    points = np.concatenate([np.asarray(lamp(1.0).points), small])
    parts = [Material(0.0, 1.0), dim, Material(0.0, 20.0), Material(0.0, 0.0)]
    uneven = scene(meshes=(Mesh(points, parts, transforms=[to_world]),))
    at = naive.receivers((0.2, 0, 0.1), UP)
    corners = (np.concatenate([points, np.ones((4, 3, 1))], -1) @ to_world.T)[..., :3]
    expected = sum(
        radiance * naive.polygon_irradiance(triangle, (0.2, 0, 0.1), UP)
        for triangle, radiance in zip(corners, (1.0, 0.1, 20.0, 0.0), strict=True)
    )
    assert irradiance_at(uneven, at, n_samples=8192)[0, 0, 0] == pytest.approx(expected, rel=3e-3)
    assert irradiance_at(snapshot, at)[0, 0, 0] > 0


def test_textured_mesh_light_equals_the_textured_rect_light() -> None:
    texels = np.random.default_rng(0).random((4, 4, 3)) ** 3
    image = Image(texels, (1, 1))
    to_world = translation(0, 0.8, 0) @ DOWN
    mesh = lamp(1.0, transform=to_world, textures={Texture.EMISSION: TextureUse(image)})
    # the rect's image runs from local +X to -X; the lamp's texture the other way
    flipped = Image(texels[:, ::-1], (1, 1))
    snapshot = scene(Light(LightKind.RECT, 1.0, to_world, (1.0, 0.7), flipped), meshes=(mesh,))
    result = irradiance_at(snapshot, naive.receivers([(0, 0, 0), (0.4, 0, 0.2)], UP), n_samples=8192)
    np.testing.assert_allclose(result[1], result[0], rtol=1e-2)


def test_an_occluder_over_half_of_a_light_halves_it() -> None:
    light = Light(LightKind.RECT, 1.0, translation(0, 2, 0) @ DOWN, (1, 1))
    half = Mesh(np.asarray(quad(2.0)) + np.float32((1.0, 1.0, 0.0)))  # covers x > 0 at half height
    at = naive.receivers((0, 0, 0), UP)
    free = irradiance_at(scene(light), at)[0, 0, 0]
    shadowed = irradiance_at(scene(light, meshes=(half,)), at)[0, 0, 0]
    assert shadowed == pytest.approx(free / 2, rel=5e-3)


def test_a_wall_behind_the_light_does_not_shadow_it_and_one_before_it_does() -> None:
    light = Light(LightKind.RECT, 1.0, translation(0, 2, 0) @ DOWN, (1, 1))
    at = naive.receivers((0, 0, 0), UP)
    free = irradiance_at(scene(light), at)
    np.testing.assert_array_equal(irradiance_at(scene(light, meshes=(Mesh(quad(9.0, y=2.01)),)), at), free)
    assert irradiance_at(scene(light, meshes=(Mesh(quad(9.0, y=1.99)),)), at).max() == 0.0


def test_nothing_arrives_from_below_either_horizon() -> None:
    light = Light(LightKind.SPHERE, 1.0, translation(0, -2, 0), (0.5, 0))
    assert one(light) == 0.0
    leaning = naive.receivers((0, 0, 0), (0, -1, 0), shading_normal=UP)
    assert irradiance_at(scene(light), leaning).max() == 0.0
    leaning = naive.receivers((0, 0, 0), UP, shading_normal=(0, -1, 0))
    assert irradiance_at(scene(light), leaning).max() == 0.0


def test_points_that_are_no_surface_receive_nothing() -> None:
    points = naive.receivers(np.zeros((3, 3)), UP)
    points.instance[1] = -1
    result = irradiance_at(scene(Light(LightKind.DOME, 1.0)), points)
    assert result[0, 1].max() == 0.0
    assert result[0, 0].min() > 3.0


def many_lights() -> SceneSnapshot:
    return scene(
        Light(LightKind.RECT, 1.0, POSES["tilted"], (1, 1)),
        Light(LightKind.SPHERE, (1, 2, 3), translation(0, 2, 0), (0.5, 0)),
        Light(LightKind.CYLINDER, 1.0, translation(1, 2, 0), (0.1, 2)),
        Light(LightKind.DOME, 1.0, image=Image(np.random.default_rng(0).random((8, 16, 3)), (0, 1))),
        meshes=(lamp(1.0, transform=POSES["overhead"]),),
    )


def test_the_same_bits_for_any_number_of_threads_and_any_chunk() -> None:
    snapshot = many_lights()
    points = naive.receivers(np.random.default_rng(0).uniform(-1, 1, (500, 3)), UP)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        alone = irradiance_at(snapshot, points, n_samples=8)
        numba.set_num_threads(before)
        together = irradiance_at(snapshot, points, n_samples=8)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(alone, together)
    assert not np.array_equal(alone, irradiance_at(snapshot, points, n_samples=8, seed=4))


def test_chunks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    snapshot = many_lights()
    points = naive.receivers(np.random.default_rng(0).uniform(-1, 1, (100, 3)), UP)
    whole = irradiance_at(snapshot, points, n_samples=8)
    monkeypatch.setattr("icheat_usd.lighting.direct._RAYS", 64)
    np.testing.assert_array_equal(irradiance_at(snapshot, points, n_samples=8), whole)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_scene_scaled_as_a_whole_receives_the_same_light(scale: float) -> None:
    def build(s: float) -> NDArray[np.float32]:
        big = scaling(s)
        snapshot = make_snapshot(
            [
                Mesh(quad(4.0), transforms=[big]),
                Mesh(quad(1.0), transforms=[big @ translation(0.5, 1, 0)]),
                lamp(1.0, transform=big @ POSES["overhead"]),
            ],
            lights=[
                Light(LightKind.RECT, 1.0, big @ POSES["tilted"], (1, 1)),
                Light(LightKind.SPHERE, 1.0, big @ translation(0, 1.7, 0), (0.3, 0)),
                Light(LightKind.CYLINDER, 1.0, big @ translation(1, 1.6, 0), (0.1, 1)),
            ],
        )
        at = np.random.default_rng(0).uniform(-0.5, 0.5, (64, 3)) * (1, 0, 1) * s
        return irradiance_at(snapshot, naive.receivers(at, UP), n_samples=64)

    np.testing.assert_allclose(build(scale), build(1.0), rtol=0.05, atol=2e-3)
    assert build(scale).mean() == pytest.approx(build(1.0).mean(), rel=1e-3)


def test_no_lights_at_all_is_an_empty_table() -> None:
    assert irradiance_at(scene(), naive.receivers((0, 0, 0), UP)).shape == (0, 1, 3)


def test_inside_a_closed_shining_box_every_wall_receives_pi() -> None:
    snapshot = closed_box(0.5, 1.0)
    across = np.random.default_rng(0).uniform(-0.8, 0.8, (64, 3))
    for axis in range(3):
        at, normal = across.copy(), np.zeros(3)
        at[:, axis], normal[axis] = -1.0, 1.0
        result = irradiance_at(snapshot, naive.receivers(at, normal), n_samples=2048)[0, :, 0]
        np.testing.assert_allclose(result, np.pi, rtol=0.1)
        assert result.mean() == pytest.approx(np.pi, rel=5e-3)
