"""Reflected direct light against quadrature over the sphere of directions."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.kernels.direct import meet_analytic
from icheat_usd.kernels.light_triangles import sample_mesh
from icheat_usd.kernels.lights import light_shape, sample_shape
from icheat_usd.lighting import build_light_sampler, environment_radiance, irradiance, reflected_direct
from icheat_usd.materials import evaluate
from icheat_usd.scene import LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import build_tracer
from tests.lighting import naive
from tests.lighting.test_irradiance import DOWN, POSES, SHEAR, UP, lamp, scene
from tests.scenes import Image, Light, Material, Mesh, quad, rotation, scaling, translation

EYE = np.array([[0.5, 0.7, 0.1]], np.float32) / np.float32(np.linalg.norm([0.5, 0.7, 0.1]))


def reflected_at(
    snapshot: SceneSnapshot, points: SurfacePoints, *, n_samples: int = 4096, seed: int = 5
) -> NDArray[np.float32]:
    eye = np.repeat(EYE, len(points.position), 0)
    tracer, sampler = build_tracer(snapshot), build_light_sampler(snapshot)
    return reflected_direct(snapshot, tracer, sampler, points, eye, seed, n_samples)


def glossy(roughness: float, n: int = 1) -> SurfacePoints:
    at = np.zeros((n, 3))
    return naive.receivers(
        at, UP, albedo=(0.3, 0.2, 0.1), specular=(0.9, 0.6, 0.3), specular_edge=1.0, roughness=roughness
    )


def over_directions(points: SurfacePoints, directions: NDArray, weight: NDArray) -> NDArray:
    """Sum of BRDF x cosine x weight (solid angle x radiance), (3,)."""
    many = SurfacePoints(*(np.repeat(column, len(directions), 0) for column in points))
    value = evaluate(many, np.repeat(EYE, len(directions), 0), directions.astype(np.float32)).astype(float)
    return (value * weight.reshape(len(directions), -1)).sum(0)


def mirror_direction() -> NDArray:
    return EYE[0] * (-1, 1, -1)


def test_a_diffuse_point_reflects_albedo_over_pi_of_its_irradiance() -> None:
    snapshot = scene(Light(LightKind.SPHERE, (1, 2, 3), translation(1, 2, 0), (0.5, 0)), Light(LightKind.DOME, 1.0))
    points = naive.receivers((0, 0, 0), UP, albedo=(0.3, 0.2, 0.1))
    arriving = irradiance(snapshot, build_tracer(snapshot), build_light_sampler(snapshot), points, 5, 256)
    result = reflected_at(snapshot, points, n_samples=256)
    np.testing.assert_allclose(result, arriving * np.array([0.3, 0.2, 0.1]) / np.pi, rtol=1e-5)


@pytest.mark.parametrize("roughness", [0.15, 0.4, 0.9])
@pytest.mark.parametrize("radius", [0.05, 1.2])
def test_a_glossy_point_reflects_a_sphere_light_as_quadrature_says(roughness: float, radius: float) -> None:
    centre = 2.0 * mirror_direction() + (0.1, 0, 0.05)
    snapshot = scene(Light(LightKind.SPHERE, 2.0, translation(*centre), (radius, 0)))
    points = glossy(roughness)
    distance = np.linalg.norm(centre)
    axis = centre / distance
    tangent = np.cross(axis, UP) / np.linalg.norm(np.cross(axis, UP))
    n = 600
    cap = 1 - np.sqrt(1 - (radius / distance) ** 2)
    c = 1 - cap * (np.arange(n)[:, None] + 0.5) / n
    phi = 2 * np.pi * (np.arange(n)[None] + 0.5) / n
    s = np.sqrt(1 - c * c)
    directions = (
        c[..., None] * axis
        + (s * np.cos(phi))[..., None] * tangent
        + (s * np.sin(phi))[..., None] * np.cross(axis, tangent)
    ).reshape(-1, 3)
    expected = over_directions(points, directions, np.full(n * n, 2.0 * 2 * np.pi * cap / n**2))
    np.testing.assert_allclose(reflected_at(snapshot, points)[0, 0], expected, rtol=1e-2)


@pytest.mark.parametrize("roughness", [0.15, 0.4])
def test_a_glossy_point_reflects_rect_and_mesh_light_alike_and_as_quadrature_says(roughness: float) -> None:
    to_world = translation(*(1.5 * mirror_direction())) @ rotation((0, 0, 1), -30) @ DOWN
    snapshot = scene(Light(LightKind.RECT, 1.0, to_world, (1.0, 0.7)), meshes=(lamp(1.0, transform=to_world),))
    # the mesh must not shadow the rect that lies in its plane: ask for them apart
    rect = scene(Light(LightKind.RECT, 1.0, to_world, (1.0, 0.7)))
    points = glossy(roughness)
    n = 800
    x, y = np.meshgrid(((np.arange(n) + 0.5) / n - 0.5) * 1.0, ((np.arange(n) + 0.5) / n - 0.5) * 0.7)
    place = np.stack([x, y, 0 * x, 0 * x + 1], -1).reshape(-1, 4) @ to_world.T
    d2 = (place[:, :3] ** 2).sum(1)
    directions = place[:, :3] / np.sqrt(d2)[:, None]
    solid_angle = np.abs(directions @ to_world[:3, 2]) / d2 * 0.7 / n**2
    expected = over_directions(points, directions, solid_angle)
    np.testing.assert_allclose(reflected_at(rect, points)[0, 0], expected, rtol=1e-2)
    np.testing.assert_allclose(reflected_at(snapshot, points)[1, 0], expected, rtol=1e-2)


@pytest.mark.parametrize("image", [False, True])
@pytest.mark.parametrize("roughness", [0.2, 0.6])
def test_a_glossy_point_reflects_a_dome_as_quadrature_says(roughness: float, image: bool) -> None:
    texels = np.random.default_rng(0).random((8, 16, 3)) ** 3
    light = Light(LightKind.DOME, 1.0, rotation((1, 1, 0), 30), image=Image(texels, (0, 1)) if image else None)
    snapshot = scene(light)
    points = glossy(roughness)
    h, w = 700, 1400
    theta = np.pi / 2 * (np.arange(h)[:, None] + 0.5) / h
    phi = 2 * np.pi * (np.arange(w)[None] + 0.5) / w
    directions = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta) + 0 * phi, np.sin(theta) * np.sin(phi)], -1)
    weight = np.broadcast_to(np.sin(theta) * (np.pi / 2 / h) * (2 * np.pi / w), (h, w)).reshape(-1, 1)
    directions = np.ascontiguousarray(directions.reshape(-1, 3), dtype=np.float32)
    expected = over_directions(points, directions, weight * environment_radiance(snapshot, directions))
    np.testing.assert_allclose(reflected_at(snapshot, points)[0, 0], expected, rtol=1e-2)


ANALYTIC = [
    Light(LightKind.SPHERE, (1, 2, 3), translation(*(2 * mirror_direction())), (0.8, 0)),
    Light(LightKind.DISK, 1.0, translation(*(2 * mirror_direction())) @ DOWN @ SHEAR, (0.8, 0)),
    Light(LightKind.RECT, 1.0, translation(*(2 * mirror_direction())) @ DOWN @ scaling(2, 1, 1), (0.8, 1)),
    Light(LightKind.RECT, 1.0, translation(*(2 * mirror_direction())) @ DOWN @ SHEAR, (0.8, 1)),
    Light(LightKind.CYLINDER, 1.0, translation(*(2 * mirror_direction())) @ SHEAR, (0.5, 2)),
    Light(LightKind.SPHERE, 1.0, translation(*(2 * mirror_direction())) @ SHEAR @ scaling(-1, 2, 1), (0.4, 0)),
    Light(LightKind.DISTANT, 1.0, rotation((0, 0, 1), 30) @ DOWN, (0.4, 0)),
    Light(LightKind.DOME, 1.0),
    Light(LightKind.DOME, 1.0, rotation((1, 2, 0), 30), image=Image(np.random.default_rng(1).random((8, 16, 3)))),
]


@pytest.mark.parametrize("light", ANALYTIC, ids=lambda light: light.kind.name)
def test_rays_meet_lights_where_and_as_probably_as_they_are_sampled(light: Light) -> None:
    snapshot = scene(light)
    sampler = build_light_sampler(snapshot)
    tables = sampler.tables
    place = (0.1, 0.0, -0.1, *UP)
    shape = light_shape(snapshot.lights, snapshot.textures, tables, 0)
    distributions = snapshot.textures.texels, tables.rows_cdf, tables.columns_cdf
    numbers = np.random.default_rng(0).random((500, 2))
    rows = np.array([sample_shape(*shape, *distributions, *place, *u) for u in numbers])
    assert (rows[:, 4] > 0).all()
    n = len(rows)
    at = np.tile(np.float32((0.1, 0.0, -0.1)), (n, 1))
    distance, pdf, radiance = np.zeros(n, np.float32), np.zeros(n), np.zeros((n, 3), np.float32)
    meet_analytic(
        snapshot.lights,
        snapshot.textures,
        tables,
        sampler.guide,
        0,
        at,
        np.tile(np.float32(UP), (n, 1)),
        rows[:, :3].astype(np.float32),
        distance,
        pdf,
        radiance,
    )
    # a few samples lie on the very rim, where rounding decides
    met = pdf > 0
    assert met.mean() > 0.98
    close = np.abs(pdf[met] / rows[met, 4] - 1) < 2e-3
    assert close.mean() > 0.98
    np.testing.assert_allclose(distance[met], rows[met, 3], rtol=2e-2)
    np.testing.assert_allclose(radiance[met], rows[met, 5:] * snapshot.lights.radiance[0], rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("roughness, radius", [(0.05, 1.5), (0.8, 0.05)])
def test_few_samples_are_enough_where_either_technique_alone_would_be_noisy(roughness: float, radius: float) -> None:
    snapshot = scene(Light(LightKind.SPHERE, 1.0, translation(*(2.0 * mirror_direction())), (radius, 0)))
    each = reflected_at(snapshot, glossy(roughness, 512), n_samples=8)[0, :, 0]
    truth = reflected_at(snapshot, glossy(roughness))[0, 0, 0]
    assert each.mean() == pytest.approx(truth, rel=0.02)
    assert each.std() < 0.25 * truth


def test_a_wall_hides_lights_from_specular_rays_too() -> None:
    direction = mirror_direction()
    lights = (
        Light(LightKind.SPHERE, 1.0, translation(*(2 * direction)), (0.3, 0)),
        Light(LightKind.DOME, 1.0),
        Light(LightKind.RECT, 1.0, POSES["overhead"], (1, 1)),
    )
    roof = Mesh(quad(400.0, y=1.0))
    snapshot = scene(*lights, meshes=(roof, lamp(1.0, transform=translation(0, 3, 0) @ DOWN)))
    result = reflected_at(snapshot, glossy(0.3), n_samples=256)
    assert result[[0, 2, 3]].max() == 0.0
    assert result[1].max() < 0.02


def test_mesh_lights_are_found_through_panes_as_brightly_as_shadow_rays_say() -> None:
    to_world = translation(*(1.5 * mirror_direction())) @ DOWN
    pane = Mesh(quad(20.0, y=0.5), Material(0.0, opacity=0.4))
    free = scene(meshes=(lamp(1.0, transform=to_world),))
    covered = scene(meshes=(pane, lamp(1.0, transform=to_world)))
    for roughness in (0.2, 0.6):
        clear = reflected_at(free, glossy(roughness))[0, 0]
        dimmed = reflected_at(covered, glossy(roughness))[0, 0]
        np.testing.assert_allclose(dimmed, 0.6 * clear, rtol=1e-2)


def test_a_point_in_a_uniform_white_world_reflects_its_directional_albedo() -> None:
    """Diffuse 0.5 under a constant dome of 1: exactly 0.5, from every sample count."""
    snapshot = scene(Light(LightKind.DOME, 1.0))
    for n in (1, 4, 64):
        result = reflected_at(snapshot, naive.receivers((0, 0, 0), UP), n_samples=n)
        np.testing.assert_allclose(result, 0.5, rtol=1e-5)


def test_mesh_samples_stay_on_their_triangles() -> None:
    snapshot = scene(meshes=(lamp(1.0, transform=POSES["sheared"]),))
    tables = build_light_sampler(snapshot).tables
    for u in np.random.default_rng(0).random((200, 2)):
        row, b1, b2, *_ = sample_mesh(tables.triangle_cdf, tables.triangle_corners, 0, 2, 0.0, 0.0, 0.0, *u)
        assert row in (0, 1)
        assert b1 >= 0 and b2 >= 0 and b1 + b2 <= 1 + 1e-12


def test_reflected_light_has_the_same_bits_for_any_number_of_threads_and_any_chunk(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    snapshot = scene(
        *ANALYTIC[:3],
        Light(LightKind.DOME, 1.0),
        meshes=(lamp(1.0, transform=POSES["overhead"]), Mesh(quad(0.5, y=0.5))),
    )
    points = glossy(0.3, 150)
    points.position[:, 0] = np.linspace(-1, 1, 150)
    points.specular_edge[::3] = 0.0
    points.specular[::3] = 0.0
    before = numba.get_num_threads()
    together = reflected_at(snapshot, points, n_samples=8)
    try:
        numba.set_num_threads(1)
        alone = reflected_at(snapshot, points, n_samples=8)
    finally:
        numba.set_num_threads(before)
    monkeypatch.setattr("icheat_usd.lighting.direct._RAYS", 64)
    monkeypatch.setattr("icheat_usd.lighting.specular_rays._RAYS", 64)
    pieces = reflected_at(snapshot, points, n_samples=8)
    np.testing.assert_array_equal(alone, together)
    np.testing.assert_array_equal(pieces, together)
