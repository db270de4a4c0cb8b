"""Paths over mirrors, glass and holes, and what crosses a segment, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from icheat_usd.materials import points_on_surface
from icheat_usd.scene import SceneSnapshot, Texture
from icheat_usd.tracing import build_tracer, first_surfaces, spawn_origins, spawn_points, transmittance
from icheat_usd.tracing.paths import passing_materials
from tests.scenes import (
    Image,
    Material,
    Mesh,
    TextureUse,
    box,
    cornell,
    make_snapshot,
    quad,
    quads,
    rotation,
    scaling,
    sphere,
    translation,
)

MIRROR = Material((0.9, 0.5, 0.1), metallic=1.0, roughness=0.0, ior=1.5)
GLASS = Material(1.0, opacity=0.0, ior=1.5)
WALL = Material(0.5)
DOWN = (0, -1, 0)


def f32(values: Any) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def at_height(y: float, material: Material, size: float = 4.0, **more: object) -> Mesh:
    return Mesh(quad(size), material, transforms=[translation(0, y, 0)], **more)  # type: ignore[arg-type]


def through(snapshot: SceneSnapshot, origin: ArrayLike, direction: ArrayLike, t_max: float | None = None) -> NDArray:
    return transmittance(snapshot, build_tracer(snapshot), f32([origin]), f32([direction]), t_max)[0]


def fresnel(cosine: float, ior: float = 1.5) -> float:
    beyond = np.sqrt(1 - (1 - cosine**2) / ior**2)
    s = (cosine - ior * beyond) / (cosine + ior * beyond)
    p = (ior * cosine - beyond) / (ior * cosine + beyond)
    return (s * s + p * p) / 2


def test_a_path_without_deltas_is_its_ray() -> None:
    snapshot = cornell()
    tracer = build_tracer(snapshot)
    ends = first_surfaces(snapshot, tracer, f32([[0, 0, 0.9], [0, 0, 0]]), f32([[0, 0, 3], [0, -2, 0]]), seed=1)
    np.testing.assert_array_equal(ends.points.instance, [-1, 2])
    np.testing.assert_array_equal(ends.throughput, np.ones((2, 3)))
    np.testing.assert_array_equal(ends.direction, [[0, 0, 1], [0, -1, 0]])
    # Embree's distances are rounded differently by different instruction sets.
    np.testing.assert_array_max_ulp(ends.distance, np.array([np.inf, 1], np.float32), maxulp=1)


def test_a_mirror_turns_the_path_and_tints_it() -> None:
    snapshot = make_snapshot([at_height(0, MIRROR), at_height(1, WALL, size=9)])
    direction = f32([[0.6, -0.8, 0]])
    ends = first_surfaces(snapshot, build_tracer(snapshot), f32([[-0.6, 0.8, 0]]), 5 * direction, seed=1)
    assert ends.points.instance[0] == 1 and ends.points.side[0] == 1
    np.testing.assert_allclose(ends.direction, [[0.6, 0.8, 0]], atol=1e-6)
    np.testing.assert_allclose(ends.points.position, [[0.75, 1, 0]], atol=1e-4)
    np.testing.assert_allclose(ends.distance, [1 + 1.25], rtol=1e-4)
    # A metal keeps its colour at all angles.
    np.testing.assert_allclose(ends.throughput[0], f32([0.9, 0.5, 0.1]), rtol=1e-5)


def test_between_two_mirrors_a_path_is_given_up_and_carries_nothing() -> None:
    snapshot = make_snapshot([at_height(0, MIRROR), at_height(1, MIRROR)])
    tracer = build_tracer(snapshot)
    ends = first_surfaces(snapshot, tracer, f32([[0, 0.5, 0]]), f32([DOWN]), seed=1, max_depth=5)
    assert ends.points.instance[0] == -1 and not ends.throughput.any() and np.isinf(ends.distance).all()
    assert not any(column[0].any() for column in ends.points[:3])


def test_glass_reflects_as_often_as_fresnel_says_and_shifts_what_it_lets_through_by_snell() -> None:
    slab = Mesh(box((50, 1, 50), (0, -0.5, 0)), GLASS)
    snapshot = make_snapshot([slab, at_height(-2, WALL, 99), at_height(9, WALL, 99)])
    n, angle = 40_000, 0.9
    direction = f32([np.sin(angle), -np.cos(angle), 0])
    ends = first_surfaces(
        snapshot, build_tracer(snapshot), np.tile(f32([[0, 1, 0]]), (n, 1)), np.tile(direction, (n, 1)), seed=7
    )
    np.testing.assert_array_equal(np.unique(ends.points.instance), [1, 2])
    np.testing.assert_array_equal(ends.throughput, 1)  # clear glass: nothing is lost, no factor of index squared
    f = fresnel(np.cos(angle))
    down = ends.points.instance == 1
    total = (1 - f) ** 2 / (1 - f * f)  # 1, 3, 5, ... passes through the slab
    assert abs(down.mean() - total) < 4 * np.sqrt(total * (1 - total) / n)
    inner = np.arcsin(np.sin(angle) / 1.5)
    straight = down & (ends.distance < np.min(ends.distance[down]) * 1.0001)
    assert abs(straight.mean() - (1 - f) ** 2) < 4 * np.sqrt(f / n)
    expected = np.tan(angle) * 2 + np.tan(inner)
    np.testing.assert_allclose(ends.points.position[straight, 0], expected, atol=1e-3)
    np.testing.assert_allclose(ends.direction[straight], direction[None].repeat(straight.sum(), 0), atol=1e-5)


def test_total_internal_reflection_keeps_a_path_inside() -> None:
    wedge = quads([[[-9, 0, 9], [9, 0, 9], [9, 0, -9], [-9, 0, -9]]])  # front is up: below is inside
    snapshot = make_snapshot([Mesh(wedge, GLASS), at_height(-1, WALL, 99)])
    n = 100
    direction = np.tile(f32([[np.sin(0.8), np.cos(0.8), 0]]), (n, 1))  # critical angle 0.7297
    ends = first_surfaces(snapshot, build_tracer(snapshot), np.tile(f32([[0, -0.5, 0]]), (n, 1)), direction, seed=3)
    assert (ends.points.instance == 1).all() and (ends.throughput == 1).all()


def test_translucent_surfaces_stop_the_share_of_paths_that_their_opacity_is() -> None:
    snapshot = make_snapshot([at_height(1, Material(0.5, opacity=0.3)), at_height(0, WALL)])
    n = 40_000
    ends = first_surfaces(
        snapshot, build_tracer(snapshot), np.tile(f32([[0.3, 2, 0]]), (n, 1)), np.tile(f32([DOWN]), (n, 1)), seed=5
    )
    assert abs((ends.points.instance == 0).mean() - 0.3) < 4 * np.sqrt(0.21 / n)
    assert (ends.throughput == 1).all() and (ends.points.delta == 0).all()


def test_a_textured_cut_out_lets_paths_and_light_through_its_holes_alone() -> None:
    checker = TextureUse(Image(f32([[[1], [0]], [[0], [1]]]), wrap=(1, 1)), channel=0)
    leaf = Material(0.5, opacity_threshold=0.5, textures={Texture.OPACITY: checker})
    st = quads([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])[..., :2]
    snapshot = make_snapshot([at_height(1, leaf, st=st), at_height(0, WALL)])
    origins = f32([[-1.5, 2, -1.5], [1.5, 2, -1.5], [-1.5, 2, 1.5], [1.5, 2, 1.5]])  # s = x, t = -z
    directions = np.tile(f32([DOWN]), (4, 1))
    tracer = build_tracer(snapshot)
    ends = first_surfaces(snapshot, tracer, origins, directions, seed=1)
    np.testing.assert_array_equal(ends.points.instance, [0, 1, 1, 0])
    np.testing.assert_array_equal(transmittance(snapshot, tracer, origins, directions, 1.5)[:, 1], [0, 1, 1, 0])


def test_paths_are_the_same_bits_for_a_seed_whatever_runs_beside_them() -> None:
    snapshot = make_snapshot([Mesh(box(1), GLASS), Mesh(box(8, inward=True), WALL)])
    tracer = build_tracer(snapshot)
    rng = np.random.default_rng(0)
    origins = rng.uniform(-3, 3, (500, 3)).astype(np.float32)
    directions = -origins
    one = first_surfaces(snapshot, tracer, origins, directions, seed=3)
    again = first_surfaces(snapshot, tracer, origins, directions, seed=3)
    fewer = first_surfaces(snapshot, tracer, origins[:200], directions[:200], seed=3)
    other = first_surfaces(snapshot, tracer, origins, directions, seed=4)
    assert one.distance.tobytes() == again.distance.tobytes()
    np.testing.assert_allclose(one.distance[:200], fewer.distance, rtol=1e-5)
    rest = np.arange(200, 500, dtype=np.int32)
    rest_ends = first_surfaces(snapshot, tracer, origins[200:], directions[200:], seed=3, counters=rest)
    np.testing.assert_allclose(one.distance[200:], rest_ends.distance, rtol=1e-5)
    assert (one.distance != other.distance).any()
    assert not np.shares_memory(one.direction, directions) and (directions == -origins).all()


def test_nothing_opaque_is_crossed_and_free_segments_are_clear() -> None:
    snapshot = make_snapshot([at_height(0, WALL)])
    np.testing.assert_array_equal(through(snapshot, (0, 1, 0), DOWN, 2.0), 0)
    np.testing.assert_array_equal(through(snapshot, (0, 1, 0), DOWN, 0.9), 1)
    mixed = make_snapshot([at_height(0, WALL), at_height(0.5, GLASS)])
    np.testing.assert_array_equal(through(mixed, (0, 1, 0), DOWN, 2.0), 0)
    np.testing.assert_array_equal(through(mixed, (0, 1, 0), (0, 1, 0)), 1)


@pytest.mark.parametrize("angle", [0.0, 0.7, 1.3])
def test_a_pane_of_glass_lets_one_minus_fresnel_through_at_each_face(angle: float) -> None:
    pane = Mesh(box((50, 0.01, 50)), GLASS)
    direction = (np.sin(angle), -np.cos(angle), 0)
    expected = (1 - fresnel(np.cos(angle))) ** 2
    np.testing.assert_allclose(through(make_snapshot([pane]), (0, 1, 0), direction, 20.0), expected, rtol=1e-4)
    ends_inside = through(make_snapshot([pane]), (0, 1, 0), DOWN, 1.0)
    np.testing.assert_allclose(ends_inside, 1 - fresnel(1.0), rtol=1e-4)


def test_layers_multiply() -> None:
    layers = [at_height(0.1 * i, Material(0.5, opacity=0.25)) for i in range(6)]
    np.testing.assert_allclose(through(make_snapshot(layers), (0, 1, 0), DOWN), 0.75**6, rtol=1e-5)


def test_only_materials_that_can_pass_light_are_looked_at() -> None:
    picture = TextureUse(Image(np.ones((1, 1, 1), np.float32)))
    some = [
        Material(opacity=1.0),
        Material(opacity=0.5),
        Material(opacity=0.5, opacity_threshold=0.4),
        Material(opacity=0.3, opacity_threshold=0.4),
        Material(opacity=0.0, ior=1.5),
        Material(textures={Texture.OPACITY: picture}),
    ]
    snapshot = make_snapshot([Mesh(quad(), material) for material in some])
    np.testing.assert_array_equal(passing_materials(snapshot.materials)[1:], [0, 1, 0, 1, 1, 1])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_rays_leave_convex_surfaces_without_meeting_them_again(scale: float) -> None:
    points, _ = sphere(1.0, 24)
    matrix = scaling(scale) @ translation(40, -7, 3) @ rotation((1, 2, 3), 40) @ scaling(2, -0.1, 1)
    snapshot = make_snapshot([Mesh(points, transforms=[matrix])])
    rng = np.random.default_rng(1)
    n = 20_000
    triangle = rng.integers(0, len(points), n)
    places = points_on_surface(snapshot, np.zeros(n), triangle, rng.dirichlet([1, 1, 1], n)[:, 1:], 0)
    directions = rng.normal(size=(n, 3)).astype(np.float32)
    directions[(directions * places.normal).sum(1) < 0] *= -1
    tracer = build_tracer(snapshot)
    assert tracer.occluded(places.position, directions).mean() > 0.1  # without an offset
    assert not tracer.occluded(spawn_points(snapshot, places, directions), directions).any()
    assert tracer.occluded(spawn_points(snapshot, places, -directions), -directions).mean() > 0.999
    by_radius = spawn_origins(places.position, places.normal, directions, snapshot.radius)
    assert not tracer.occluded(by_radius, directions).any()


def test_large_triangles_through_the_origin_do_not_shadow_themselves() -> None:
    snapshot = make_snapshot([Mesh(quad(100), WALL, transforms=[rotation((1, 0.2, 0.3), 33)])])
    rng = np.random.default_rng(2)
    n = 20_000
    near = f32(np.column_stack([0.5 + rng.uniform(-1e-4, 1e-4, (n, 1)), 1e-4 * rng.random((n, 1))]))
    places = points_on_surface(snapshot, np.zeros(n), np.zeros(n), near[:, ::-1], 0)
    assert np.abs(places.position).max() < 0.1
    directions = rng.normal(size=(n, 3)).astype(np.float32)
    directions[(directions * places.normal).sum(1) < 0] *= -1
    assert not build_tracer(snapshot).occluded(spawn_points(snapshot, places, directions), directions).any()


def test_offsets_scale_with_the_scene() -> None:
    rng = np.random.default_rng(3)
    p, n, d = (rng.normal(size=(100, 3)).astype(np.float32) for _ in range(3))
    np.testing.assert_array_equal(spawn_origins(1024 * p, n, d), 1024 * spawn_origins(p, n, d))
