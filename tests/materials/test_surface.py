"""Places on triangles become surfaces with normals, sides, textures and UsdPreviewSurface reflectance."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.materials import points_on_surface, shade_hits, take_points
from icheat_usd.scene import DeltaKind, Hits, SceneSnapshot, SurfacePoints, Texture
from tests.scenes import (
    Image,
    Material,
    Mesh,
    TextureUse,
    cornell,
    make_snapshot,
    quad,
    quad_scene,
    rotation,
    scaling,
    sphere,
    translation,
)

RNG = np.random.default_rng(0)


def f32(values: Any) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def material_point(material: Material) -> SurfacePoints:
    return points_on_surface(quad_scene(material), [0], [0], [[0.3, 0.3]], [0])


def texture_value(use: TextureUse, s: float, t: float, slot: Texture = Texture.EMISSION) -> np.ndarray:
    """Emission of a triangle with constant texture coordinates (s, t)."""
    mesh = Mesh(quad(), Material(textures={slot: use}, ior=1.0), st=np.full((2, 3, 2), (s, t)))
    points = points_on_surface(make_snapshot([mesh]), [0], [0], [[0.2, 0.5]], [0])
    return points.emission[0] if slot == Texture.EMISSION else points.roughness[:1]


def random_places(snapshot: SceneSnapshot, n: int = 500) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    instance = RNG.integers(0, snapshot.n_instances, n)
    begin = snapshot.geometry.mesh_begin[snapshot.geometry.instance_mesh[instance]]
    end = snapshot.geometry.mesh_begin[snapshot.geometry.instance_mesh[instance] + 1]
    triangle = begin + RNG.integers(0, 1 << 30, n) % (end - begin)
    return instance, triangle, RNG.dirichlet([1, 1, 1], n)[:, 1:]


@pytest.mark.parametrize("mirror", [1, -1])
def test_normals_of_an_ellipsoid_are_its_gradients_also_when_mirrored(mirror: int) -> None:
    points, normals = sphere(1.0, 64)
    matrix = translation(1, 2, 3) @ rotation((1, 2, 3), 70) @ scaling(2 * mirror, 0.5, 1)
    snapshot = make_snapshot([Mesh(points, normals=normals, transforms=[matrix])])
    assert snapshot.geometry.instance_flip[0] == (mirror < 0)
    found = points_on_surface(snapshot, *random_places(snapshot), 0)
    inverse = np.linalg.inv(matrix)
    on_sphere = found.position @ inverse[:3, :3].T + inverse[:3, 3]
    gradient = on_sphere @ inverse[:3, :3]
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(found.shading_normal, gradient, atol=0.01)
    assert ((found.normal * gradient).sum(1) > 0.98).all()  # outward also where the transform mirrors
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-6)


def test_the_position_lies_where_the_corners_are_mixed() -> None:
    snapshot = cornell()
    instance, triangle, bary = random_places(snapshot)
    found = points_on_surface(snapshot, instance, triangle, bary, 0)
    matrix = snapshot.geometry.instance_to_world[instance].astype(float)
    corners = snapshot.geometry.points[triangle].astype(float)
    weights = np.column_stack([1 - bary.sum(1), bary])
    mixed = np.einsum("nij,nj->ni", matrix[..., :3], np.einsum("nk,nkj->nj", weights, corners)) + matrix[..., 3]
    np.testing.assert_allclose(found.position, mixed, atol=1e-6)


def test_the_back_is_the_front_with_both_normals_turned() -> None:
    points, normals = sphere(1.0, 8)
    snapshot = make_snapshot([Mesh(points, normals=normals)])
    places = random_places(snapshot)
    front, back = points_on_surface(snapshot, *places, 0), points_on_surface(snapshot, *places, 1)
    np.testing.assert_array_equal(front.normal, -back.normal)
    np.testing.assert_array_equal(front.shading_normal, -back.shading_normal)
    np.testing.assert_array_equal(front.position, back.position)
    assert (front.side == 0).all() and (back.side == 1).all()


def test_hits_are_seen_from_the_side_their_rays_come_from() -> None:
    snapshot = quad_scene()
    ones = np.ones(3, np.float32)
    hits = Hits(ones, np.array([0, 0, -1], np.int32), np.array([0, 0, -1], np.int32), 0.25 * ones, 0.25 * ones)
    points = shade_hits(snapshot, hits, f32([[0.3, -2, 0], [0.3, 2, 0], [0, 1, 0]]))
    np.testing.assert_array_equal(points.side, [0, 1, 0])
    np.testing.assert_array_equal(points.normal, [[0, 1, 0], [0, -1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(points.instance, [0, 0, -1])
    for column in take_points(points, [2])[:3]:
        assert not column.any()
    again = points_on_surface(snapshot, hits.instance, hits.triangle, np.full((3, 2), 0.25), points.side)
    for one, other in zip(points, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_normals_authored_for_the_other_winding_are_turned_over() -> None:
    points, normals = sphere(1.0, 16)
    places = random_places(make_snapshot([Mesh(points)]))
    right = points_on_surface(make_snapshot([Mesh(points, normals=normals)]), *places, 0)
    wrong = points_on_surface(make_snapshot([Mesh(points, normals=-normals)]), *places, 0)
    np.testing.assert_allclose(wrong.shading_normal, right.shading_normal, atol=1e-6)


def test_shading_normals_stay_above_the_surface() -> None:
    corner = f32([[0, 1, 0], [1, -0.2, 0], [-1, -0.9, 0]])
    snapshot = make_snapshot([Mesh(quad(), normals=np.tile(corner, (2, 1, 1)))])
    found = points_on_surface(snapshot, np.zeros(300), np.zeros(300), RNG.dirichlet([1, 1, 1], 300)[:, 1:], 0)
    assert ((found.normal * found.shading_normal).sum(1) >= 0.0099).all()
    np.testing.assert_allclose(np.linalg.norm(found.shading_normal, axis=1), 1, atol=1e-6)


def test_face_coordinates_are_interpolated_between_corners() -> None:
    points = points_on_surface(quad_scene(size=4), [0, 0], [0, 1], [[0.25, 0.5], [0.25, 0.5]], 0)
    np.testing.assert_allclose(points.face_uv, [[0.75, 0.5], [0.25, 0.75]])
    np.testing.assert_allclose(points.position[:, [0, 2]], f32([[1, 0], [-1, -1]]), atol=1e-6)
    np.testing.assert_array_equal(points.face, [0, 0])


def test_display_colour_is_the_fallback_material() -> None:
    colour = f32([[1, 0, 0], [0, 1, 0], [0, 0, 1]])
    points = points_on_surface(make_snapshot([Mesh(quad(), color=colour)]), [0], [0], [[0.3, 0.5]], 0)
    np.testing.assert_allclose(points.albedo, [[0.2, 0.3, 0.5]], atol=1e-6)


def test_texture_lookup_interpolates_between_texel_centres_with_v_upward() -> None:
    texels = RNG.random((4, 8, 3)).astype(np.float32)
    use = TextureUse(Image(texels))
    # The centre of the texel in row 1 from the top, column 5.
    np.testing.assert_allclose(texture_value(use, 5.5 / 8, 1 - 1.5 / 4), texels[1, 5], rtol=1e-5)
    expected = 0.25 * texels[1, 5] + 0.75 * texels[1, 6]
    np.testing.assert_allclose(texture_value(use, 6.25 / 8, 1 - 1.5 / 4), expected, rtol=1e-5)
    np.testing.assert_allclose(texture_value(use, 6 / 8, 1 - 2 / 4), texels[1:3, 5:7].mean((0, 1)), rtol=1e-5)


@pytest.mark.parametrize(("wrap", "column"), [(0, 1), (1, 7), (2, 6), (3, -1)])
def test_wrap_modes_place_what_lies_past_the_image(wrap: int, column: int) -> None:
    texels = RNG.random((1, 8, 3)).astype(np.float32)
    expected = texels[0, column] if column >= 0 else np.zeros(3)
    use = TextureUse(Image(texels, wrap=(wrap, 1)))
    np.testing.assert_allclose(texture_value(use, 1 + 1.5 / 8, 0.5), expected, rtol=1e-5)
    before = {0: 6, 1: 0, 2: 1, 3: -1}[wrap]
    expected = texels[0, before] if before >= 0 else np.zeros(3)
    np.testing.assert_allclose(texture_value(use, -1.5 / 8, 0.5), expected, rtol=1e-5)


def test_texture_transform_scale_bias_and_channel_are_applied() -> None:
    texels = RNG.random((4, 4, 4)).astype(np.float32)
    transform = ((0, 1, 0.25), (1, 0, 0))  # swap s and t, move by one texel
    use = TextureUse(Image(texels), transform=transform, scale=(2, 3, 4, 5), bias=(0.1, 0.2, 0.3, 0.4))
    texel = texels[3, 2]  # s' = 0.375 + 0.25, t' = 0.125
    expected = texel[:3] * (2, 3, 4) + f32([0.1, 0.2, 0.3])
    np.testing.assert_allclose(texture_value(use, 0.125, 0.375), expected, rtol=1e-5)
    use = TextureUse(Image(texels), channel=3, transform=transform, scale=(2, 3, 4, 0.5), bias=(0, 0, 0, 0.4))
    np.testing.assert_allclose(texture_value(use, 0.125, 0.375), texel[3] * 0.5 + 0.4, rtol=1e-5)
    np.testing.assert_allclose(texture_value(use, 0.125, 0.375, Texture.ROUGHNESS), texel[3] * 0.5 + 0.4, rtol=1e-5)


def test_a_dielectric_has_the_fresnel_reflectance_of_its_index() -> None:
    point = material_point(Material(diffuse=(0.2, 0.4, 0.6), ior=1.5))
    np.testing.assert_allclose(point.specular[0], 0.04, rtol=1e-6)
    np.testing.assert_allclose(point.albedo[0], 0.96 * f32([0.2, 0.4, 0.6]), rtol=1e-6)
    assert (point.specular_edge[0] == 1).all() and point.delta[0] == DeltaKind.NONE


def test_index_one_is_no_interface() -> None:
    point = material_point(Material(ior=1.0, roughness=0.0))
    assert not point.specular.any() and not point.specular_edge.any()


def test_metalness_moves_the_colour_from_diffuse_to_specular() -> None:
    colour = f32([0.9, 0.6, 0.3])
    point = material_point(Material(diffuse=colour, metallic=0.25, ior=1.5))
    np.testing.assert_allclose(point.specular[0], 0.75 * 0.04 + 0.25 * colour, rtol=1e-6)
    np.testing.assert_allclose(point.specular_edge[0], 0.75 + 0.25 * colour, rtol=1e-6)
    np.testing.assert_allclose(point.albedo[0], 0.75 * colour * (1 - point.specular[0]), rtol=1e-6)


def test_the_specular_workflow_takes_its_colour_as_given() -> None:
    point = material_point(Material(0.3, specular=(0.1, 0.2, 0.3), use_specular=True, metallic=1.0, ior=1.5))
    np.testing.assert_allclose(point.specular[0], (0.1, 0.2, 0.3))
    np.testing.assert_allclose(point.albedo[0], 0.3 * (1 - point.specular[0]), rtol=1e-6)


@pytest.mark.parametrize(
    ("material", "kind"),
    [
        (Material(0.9, metallic=1.0, roughness=0.0, ior=1.5), DeltaKind.MIRROR),
        (Material(0.9, metallic=1.0, roughness=0.2, ior=1.5), DeltaKind.NONE),
        (Material(0.9, metallic=0.5, roughness=0.0, ior=1.5), DeltaKind.NONE),
        (Material(0.9, opacity=0.0, ior=1.5), DeltaKind.GLASS),
        (Material(0.9, opacity=0.0, ior=1.0), DeltaKind.PASS),
        (Material(0.9, opacity=0.4, opacity_threshold=0.5), DeltaKind.PASS),
        (Material(0.9, opacity=0.6, opacity_threshold=0.5), DeltaKind.NONE),
        (Material(0.9, opacity=0.4), DeltaKind.NONE),
    ],
)
def test_delta_kinds_follow_opacity_and_smoothness(material: Material, kind: DeltaKind) -> None:
    point = material_point(material)
    assert point.delta[0] == kind
    assert bool(point.albedo.any()) == (kind == DeltaKind.NONE and material.metallic < 1)


def test_a_cut_out_is_whole_or_absent() -> None:
    assert material_point(Material(0.9, opacity=0.6, opacity_threshold=0.5)).opacity[0] == 1
    hole = material_point(Material(0.9, emission=3.0, opacity=0.4, opacity_threshold=0.5))
    assert hole.opacity[0] == 0 and not hole.emission.any()


def test_reflectance_is_kept_below_one_and_emission_is_not() -> None:
    point = material_point(Material(diffuse=(3, -1, 0.5), emission=(40, 0, 2)))
    np.testing.assert_array_equal(point.albedo[0], f32([1, 0, 0.5]))
    np.testing.assert_array_equal(point.emission[0], f32([40, 0, 2]))


def test_points_are_c_contiguous_in_the_declared_types_and_the_same_for_any_thread_count() -> None:
    snapshot = cornell()
    places = random_places(snapshot, 3001)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = points_on_surface(snapshot, *places, 0)
    finally:
        numba.set_num_threads(before)
    other = points_on_surface(snapshot, *places, 0)
    a: Any
    b: Any
    for name, a, b in zip(SurfacePoints._fields, one, other, strict=True):
        kind = {"instance": "i4", "triangle": "i4", "face": "i4", "side": "u1", "delta": "u1"}.get(name, "f4")
        assert a.dtype == np.dtype(kind) and a.flags.c_contiguous, name
        assert a.tobytes() == b.tobytes()
