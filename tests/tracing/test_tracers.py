"""One suite for every tracer: what is true of rays and triangles, whatever finds the hits."""

from __future__ import annotations

import gc
from collections.abc import Callable

import numba
import numpy as np
import pytest

from icheat_usd.errors import IcheatError
from icheat_usd.scene import SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.tracing.embree import INSTANCES_FOR_PACKETS, EmbreeTracer
from icheat_usd.tracing.reference import ReferenceTracer
from tests.scenes import Mesh, box, cornell, make_snapshot, quad_scene, rotation, scaling, soup, sphere, translation

Build = Callable[[SceneSnapshot], Tracer]
ENGINES: dict[str, Build] = {
    "embree": EmbreeTracer,
    "embree with instances": lambda snapshot: EmbreeTracer(snapshot, copied_triangles=0),
    "reference": ReferenceTracer,
}
PLACED_BESIDE = [translation(8 + 0.001 * i, 0, 0) for i in range(INSTANCES_FOR_PACKETS + 1)]


@pytest.fixture(params=ENGINES)
def build(request: pytest.FixtureRequest) -> Build:
    return ENGINES[request.param]


def rows(*values: tuple[float, ...]) -> np.ndarray:
    return np.array(values, np.float32)


def assert_rounded(distance: np.ndarray, expected: list[float]) -> None:
    """Embree divides by a reciprocal, which instruction sets round differently: AVX2's distances may be a bit less."""
    np.testing.assert_array_max_ulp(distance, np.array(expected, np.float32), maxulp=1)


def test_a_ray_meets_a_square_where_geometry_says(build: Build) -> None:
    tracer = build(quad_scene(size=2))
    hits = tracer.intersect(rows((0.5, 3, 0.25)), rows((0, -2, 0)))
    assert_rounded(hits.distance, [1.5])  # in units of the direction as given
    assert hits.instance[0] == 0
    corners = quad_scene(size=2).geometry.points[hits.triangle[0]]
    place = corners[0] + hits.u[0] * (corners[1] - corners[0]) + hits.v[0] * (corners[2] - corners[0])
    np.testing.assert_allclose(place, (0.5, 0, 0.25), atol=1e-6)


def test_both_sides_of_a_triangle_are_hit(build: Build) -> None:
    tracer = build(quad_scene())
    hits = tracer.intersect(rows((0.1, 1, 0.2), (0.1, -1, 0.2)), rows((0, -1, 0), (0, 1, 0)))
    assert_rounded(hits.distance, [1, 1])


def test_a_ray_past_everything_misses_with_minus_one_and_infinity(build: Build) -> None:
    tracer = build(quad_scene())
    hits = tracer.intersect(rows((0, 1, 0), (9, 1, 0)), rows((0, 1, 0), (0, -1, 0)))
    assert (hits.instance == -1).all() and (hits.triangle == -1).all()
    assert np.isposinf(hits.distance).all() and (hits.u == 0).all() and (hits.v == 0).all()


def test_t_max_ends_a_ray_in_units_of_its_direction(build: Build) -> None:
    tracer = build(quad_scene())
    origin, direction = np.tile(rows((0.1, 1, 0.2)), (4, 1)), np.tile(rows((0, -0.5, 0)), (4, 1))
    limits = np.array([1.99, 2.01, 0.0, -1.0], np.float32)
    np.testing.assert_array_equal(tracer.intersect(origin, direction, limits).instance, [-1, 0, -1, -1])
    np.testing.assert_array_equal(tracer.occluded(origin, direction, limits), [False, True, False, False])
    assert tracer.occluded(origin, direction, 2.01).all() and tracer.occluded(origin, direction).all()


def test_rays_without_direction_or_with_nan_hit_nothing_and_spoil_no_neighbour(build: Build) -> None:
    tracer = build(quad_scene())
    origin = np.tile(rows((0.1, 1, 0.2)), (5, 1))
    direction = rows((0, 0, 0), (0, -1, 0), (np.nan, -1, 0), (0, -np.inf, 0), (0, -1, 0))
    origin[4, 0] = np.nan
    np.testing.assert_array_equal(tracer.intersect(origin, direction).instance, [-1, 0, -1, -1, -1])
    np.testing.assert_array_equal(tracer.occluded(origin, direction), [False, True, False, False, False])


def test_no_ray_leaks_through_the_shared_edges_of_a_closed_mesh(build: Build) -> None:
    points, _ = sphere(1.0, 12)
    tracer = build(make_snapshot([Mesh(points, transforms=[rotation((1, 2, 3), 40)])]))
    matrix = rotation((1, 2, 3), 40)[:3, :3]
    edges = (points @ matrix.T).astype(np.float32)
    targets = np.concatenate([edges.reshape(-1, 3), (0.5 * (edges[:, 0] + edges[:, 1]))])
    origin = np.zeros_like(targets)
    assert tracer.occluded(origin, targets).mean() > 0.999  # aimed exactly at corners and edges
    inside = np.random.default_rng(0).normal(size=(20000, 3)).astype(np.float32)
    assert tracer.occluded(np.zeros_like(inside), inside).all()


@pytest.mark.parametrize("engine", ["embree", "embree with instances"])
@pytest.mark.parametrize("place", [(0, 0, 0), (30, 20, 50)], ids=["near", "far"])
@pytest.mark.parametrize("fineness", [4, 150], ids=["coarse", "fine"])
def test_no_ray_aimed_at_an_edge_passes_between_two_triangles(
    engine: str, place: tuple[float, float, float], fineness: int
) -> None:
    stretched = scaling(1.3, 0.4, 1.0) if engine == "embree with instances" else np.eye(4)
    matrix = translation(*place) @ rotation((1, 2, 3), 40) @ stretched
    points, _ = sphere(1.0, fineness)
    away = translation(0, 5, 0) @ matrix  # placed twice, so that it can be an instance
    tracer = ENGINES[engine](make_snapshot([Mesh(points, transforms=[matrix, away])]))
    world = points @ matrix[:3, :3].T + matrix[:3, 3]
    rng = np.random.default_rng(fineness)
    n = 300_000
    first = rng.integers(3, size=n)
    triangle, along = world[rng.integers(len(world), size=n)], rng.random((n, 1))
    rows_of = np.arange(n)
    target = triangle[rows_of, first] * along + triangle[rows_of, (first + 1) % 3] * (1 - along)
    origin = np.asarray(place, np.float32) + rng.uniform(-0.1, 0.1, (n, 3)).astype(np.float32)
    direction = (target - origin).astype(np.float32)
    assert (tracer.intersect(origin, direction).distance < 1.01).all()
    assert tracer.occluded(origin, direction, 1.01).all()


def test_instances_carry_their_own_number_and_the_rows_of_their_mesh(build: Build) -> None:
    first, second = Mesh(box(1)), Mesh(box(0.5), transforms=[translation(-3, 0, 0), translation(3, 0, 0)])
    tracer = build(make_snapshot([first, second]))
    hits = tracer.intersect(rows((-3, 5, 0.1), (0, 5, 0.1), (3, 5, 0.1)), np.tile(rows((0, -1, 0)), (3, 1)))
    np.testing.assert_array_equal(hits.instance, [1, 0, 2])
    assert hits.triangle[1] < 12 and (hits.triangle[[0, 2]] >= 12).all() and (hits.triangle < 24).all()
    np.testing.assert_allclose(hits.distance, [4.75, 4.5, 4.75], rtol=1e-6)


@pytest.mark.parametrize("engine", ["embree", "embree with instances", "single rays"])
def test_embree_finds_what_the_reference_finds_in_a_soup_of_mirrored_and_skewed_instances(engine: str) -> None:
    skew = np.eye(4)
    skew[0, 1] = 0.7
    transforms = [
        translation(0.5, 0, 0) @ rotation((1, 1, 0), 33),
        translation(-1, 0.3, 0) @ scaling(-1, 1, 1),
        translation(0, -1, 0.5) @ skew @ scaling(0.3, 1.7, 0.9),
    ]
    meshes = [soup(150, 1), Mesh(soup(60, 2).points, transforms=transforms)]
    snapshot = make_snapshot(meshes)
    rng = np.random.default_rng(3)
    origins = rng.uniform(-3, 3, (4000, 3)).astype(np.float32)
    directions = (rng.uniform(-1, 1, (4000, 3)) - origins).astype(np.float32)
    limits = rng.uniform(0.1, 2.0, 4000).astype(np.float32)
    slow = ReferenceTracer(snapshot)
    if engine == "single rays":  # chosen for scenes of many instances: these are out of the way
        meshes.append(Mesh(box(0.1), transforms=PLACED_BESIDE))
        fast: Tracer = EmbreeTracer(make_snapshot(meshes), copied_triangles=0)
    else:
        fast = ENGINES[engine](snapshot)
    found, expected = fast.intersect(origins, directions, limits), slow.intersect(origins, directions, limits)
    hit = expected.instance >= 0
    assert 0.3 < hit.mean() < 0.95
    same = (found.instance == expected.instance) & (found.triangle == expected.triangle)
    assert same.mean() > 0.999  # an edge or the end of a segment may round to either side
    both = same & hit
    np.testing.assert_allclose(found.distance[both], expected.distance[both], rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(found.u[both], expected.u[both], atol=5e-4)
    np.testing.assert_allclose(found.v[both], expected.v[both], atol=5e-4)
    blocked = fast.occluded(origins, directions, limits)
    assert (blocked == slow.occluded(origins, directions, limits)).mean() > 0.999
    assert (blocked == (found.instance >= 0)).mean() > 0.999


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_a_scaled_scene_gives_the_same_hits(build: Build, factor: float) -> None:
    meshes = [soup(100, 1), soup(100, 2)]
    scaled = [Mesh(np.asarray(mesh.points) * factor) for mesh in meshes]
    rng = np.random.default_rng(4)
    origins = rng.uniform(-1, 1, (2000, 3)).astype(np.float32)
    directions = rng.normal(size=(2000, 3)).astype(np.float32)
    one = build(make_snapshot(meshes)).intersect(origins, directions)
    other = build(make_snapshot(scaled)).intersect((origins * factor).astype(np.float32), directions)
    assert ((one.instance == other.instance) & (one.triangle == other.triangle)).mean() > 0.999
    hit = (one.triangle == other.triangle) & (one.instance >= 0)
    np.testing.assert_allclose(other.distance[hit], one.distance[hit] * factor, rtol=1e-4, atol=1e-4 * factor)


def test_a_scene_without_triangles_and_no_rays_at_all_are_fine(build: Build) -> None:
    empty = build(make_snapshot([Mesh(np.zeros((0, 3, 3)))]))
    assert empty.intersect(rows((0, 0, 0)), rows((0, 0, 1))).instance[0] == -1
    assert not empty.occluded(rows((0, 0, 0)), rows((0, 0, 1))).any()
    nothing = np.zeros((0, 3), np.float32)
    assert build(cornell()).intersect(nothing, nothing).instance.shape == (0,)
    assert build(cornell()).occluded(nothing, nothing).shape == (0,)


def test_rays_of_the_wrong_shape_are_refused(build: Build) -> None:
    tracer = build(quad_scene())
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        tracer.intersect(np.zeros((2, 3), np.float32), np.zeros((3, 3), np.float32))
    with pytest.raises(ValueError, match="t_max"):
        tracer.occluded(np.zeros((2, 3), np.float32), np.ones((2, 3), np.float32), np.ones(3, np.float32))


def test_any_number_of_threads_gives_the_same_bits() -> None:
    tracer = build_tracer(cornell())
    rng = np.random.default_rng(5)
    origins = rng.uniform(-0.9, 0.9, (20011, 3)).astype(np.float32)
    directions = rng.normal(size=origins.shape).astype(np.float32)
    before = numba.get_num_threads()
    results = []
    try:
        for n in (1, before):
            numba.set_num_threads(n)
            results.append([*tracer.intersect(origins, directions), tracer.occluded(origins, directions, 0.7)])
    finally:
        numba.set_num_threads(before)
    for one, other in zip(*results, strict=True):
        assert one.tobytes() == other.tobytes()


def test_a_tracer_outlives_its_snapshot_and_frees_itself() -> None:
    snapshot = cornell()
    tracer = EmbreeTracer(snapshot)
    expected = tracer.intersect(rows((0, 0, 0)), rows((0, -1, 0))).distance
    del snapshot
    gc.collect()
    assert_rounded(expected, [1])
    np.testing.assert_array_equal(tracer.intersect(rows((0, 0, 0)), rows((0, -1, 0))).distance, expected)
    finalizer = tracer._finalizer
    del tracer
    gc.collect()
    assert not finalizer.alive


def test_a_closed_tracer_says_so() -> None:
    tracer = build_tracer(quad_scene())
    tracer.close()
    tracer.close()
    with pytest.raises(ValueError, match="closed"):
        tracer.intersect(rows((0, 1, 0)), rows((0, -1, 0)))


def test_an_unknown_engine_is_named() -> None:
    with pytest.raises(IcheatError, match="'optix'"):
        build_tracer(quad_scene(), "optix")


def test_many_instances_share_one_mesh() -> None:
    n = 3000
    points, _ = sphere(0.01, 24)
    places = [translation(0.03 * (i % 60), 0.03 * (i // 60), 0) for i in range(n)]
    snapshot = make_snapshot([Mesh(points, transforms=places)])
    tracer = EmbreeTracer(snapshot)  # 3 M triangles as copies: instances by default
    origin = np.array([[0.03 * (i % 60), 0.03 * (i // 60), 1] for i in range(n)], np.float32)
    hits = tracer.intersect(origin + rows((0.001, 0.002, 0)), np.tile(rows((0, 0, -1)), (n, 1)))
    np.testing.assert_array_equal(hits.instance, np.arange(n))
    np.testing.assert_allclose(hits.distance, 0.9902, atol=3e-4)  # inside the sphere: facets
