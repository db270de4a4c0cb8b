"""Gather samples cover every surface, cells hold what is nearest, and look-ups agree with brute force."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.lighting import build_light_sampler, irradiance
from icheat_usd.materials import points_on_surface, take_points
from icheat_usd.samples import GatherSamples, cell_direct, gather_samples, view_samples
from icheat_usd.scene import F32, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import build_tracer, first_surfaces
from tests.pipeline import Pipeline
from tests.scenes import (
    Light,
    Material,
    Mesh,
    box,
    closed_box,
    cornell,
    cornell_meshes,
    look_at,
    make_snapshot,
    quad,
    quad_scene,
    rotation,
    scaling,
    sphere,
    translation,
)


def gather_of(scene: SceneSnapshot, n: int, seed: int = 0, patches: int = 8) -> GatherSamples:
    tracer = build_tracer(scene)
    return gather_samples(scene, tracer, view_samples(scene, tracer), n=n, seed=seed, n_patches_per_cell=patches)


def random_places(scene: SceneSnapshot, n: int, seed: int = 0) -> SurfacePoints:
    """Places all over the triangles of all instances, both sides."""
    rng = np.random.default_rng(seed)
    geometry = scene.geometry
    instance = rng.integers(0, scene.n_instances, n)
    begin = geometry.mesh_begin[geometry.instance_mesh[instance]]
    end = geometry.mesh_begin[geometry.instance_mesh[instance] + 1]
    triangle = rng.integers(begin, end)
    uv = rng.random((n, 2))
    uv = np.where(uv.sum(1, keepdims=True) > 1, 1 - uv, uv)
    return points_on_surface(scene, instance, triangle, uv, rng.integers(0, 2, n))


def brute_force(gather: GatherSamples, points: SurfacePoints) -> F32:
    """Nearest sample on the same side of the same instance, agreeing normals first, lowest index on ties."""
    own = gather.points
    found = np.empty(len(points.instance), np.int64)
    for i in range(len(found)):
        same = (own.instance == points.instance[i]) & (own.side == points.side[i])
        agrees = same & (own.normal @ points.normal[i] > 0.5)
        candidates = np.flatnonzero(agrees if agrees.any() else same)
        distance = ((own.position[candidates] - points.position[i]) ** 2).sum(1)
        found[i] = candidates[np.argmin(distance)]
    return found


def meadow() -> SceneSnapshot:
    """Turned and stretched instances of two meshes over a ground."""
    ball, normals = sphere(0.4, 10)
    rng = np.random.default_rng(5)
    placed = [
        translation(*rng.uniform(-2, 2, 3)) @ rotation(rng.normal(size=3), 50.0 * i) @ scaling(1, 1 + 0.2 * i, 0.7)
        for i in range(6)
    ]
    meshes = [
        Mesh(quad(6, -2.5), path="/ground"),
        Mesh(ball, normals=normals, transforms=placed, path="/field/balls"),
        Mesh(box(0.5), transforms=placed[::2], path="/field/boxes"),
    ]
    return make_snapshot(meshes, camera=look_at((0, 2, 6)))


@pytest.mark.parametrize("scene", [cornell(16, 16), meadow()], ids=["cornell", "meadow"])
def test_look_up_equals_brute_force(scene: SceneSnapshot) -> None:
    gather = gather_of(scene, 700)
    points = random_places(scene, 3000)
    found = gather.locate(points)
    expected = brute_force(gather, points)
    distance = np.linalg.norm(gather.points.position[found] - points.position, axis=1)
    nearest = np.linalg.norm(gather.points.position[expected] - points.position, axis=1)
    np.testing.assert_allclose(distance, nearest, rtol=1e-5, atol=1e-6)
    assert np.mean(found == expected) > 0.999
    assert np.array_equal(gather.points.instance[found], points.instance)
    assert np.array_equal(gather.points.side[found], points.side)


def test_samples_find_themselves_and_misses_find_nothing() -> None:
    gather = gather_of(cornell(16, 16), 500)
    assert np.array_equal(gather.locate(gather.points), np.arange(gather.n))
    assert gather.locate(gather.points._replace(instance=np.full(gather.n, -1, np.int32))).tolist() == [-1] * gather.n


def test_a_thin_closed_wall_never_answers_from_its_other_face() -> None:
    scene = make_snapshot([Mesh(box((2, 2, 1e-3)))], camera=look_at((0, 0, 4)))
    gather = gather_of(scene, 200)
    points = random_places(scene, 2000)
    facing = np.abs(points.normal[:, 2]) > 0.5
    cosine = (gather.points.normal[gather.locate(points)] * points.normal).sum(1)
    assert np.all(cosine[facing] > 0.5)


def test_both_sides_of_a_card_have_cells_of_their_own() -> None:
    scene = make_snapshot([Mesh(quad(1), double_sided=True), Mesh(box(6, inward=True))], camera=look_at((1, 1, 2)))
    gather = gather_of(scene, 300)
    points = random_places(scene, 1000)
    assert np.array_equal(gather.points.side[gather.locate(points)], points.side)


def test_areas_of_cells_add_up_to_both_sides_of_every_surface() -> None:
    scene = meadow()
    gather = gather_of(scene, 900)
    geometry = scene.geometry
    for instance in range(scene.n_instances):
        mesh = geometry.instance_mesh[instance]
        corners = geometry.points[geometry.mesh_begin[mesh] : geometry.mesh_begin[mesh + 1]].astype(float)
        world = corners @ geometry.instance_to_world[instance, :, :3].T.astype(float)
        area = np.linalg.norm(np.cross(world[:, 1] - world[:, 0], world[:, 2] - world[:, 0]), axis=1).sum() / 2
        for side in (0, 1):
            own = (gather.points.instance == instance) & (gather.points.side == side)
            assert gather.area[own].sum() == pytest.approx(area, rel=1e-4)
    assert np.all(gather.area > 0)


def test_cell_areas_are_those_of_the_nearest_neighbour_cells() -> None:
    gather = gather_of(quad_scene(), 60, patches=400)
    front = np.flatnonzero(gather.points.side == 0)
    x, z = np.meshgrid(*[(np.arange(400) + 0.5) / 400 - 0.5] * 2)
    places = np.stack([x.ravel(), z.ravel()], 1)
    own = gather.points.position[front][:, [0, 2]]
    nearest = np.argmin(((places[:, None] - own[None]) ** 2).sum(2), axis=1)
    expected = np.bincount(nearest, minlength=len(front)) / len(places)
    np.testing.assert_allclose(gather.area[front], expected, rtol=0.25)
    assert np.corrcoef(gather.area[front], expected)[0, 1] > 0.99


def test_patch_points_lie_in_their_cells_and_every_cell_has_some() -> None:
    gather = gather_of(cornell(16, 16), 500)
    assert np.array_equal(gather.locate(gather.patch_points), gather.patch_cell)
    assert np.all(np.diff(gather.cell_begin) >= 1)
    assert np.array_equal(np.repeat(np.arange(gather.n), np.diff(gather.cell_begin)), gather.patch_cell)


def test_patch_points_of_some_cells_come_one_cell_after_the_other() -> None:
    gather = gather_of(meadow(), 60)
    cells = np.array([7, 3, 41])
    patches, ends = gather.patches_of(cells)
    for cell, first, last in zip(cells, ends[:-1], ends[1:], strict=True):
        np.testing.assert_array_equal(patches[first:last], np.flatnonzero(gather.patch_cell == cell))
    assert ends[0] == 0 and ends[-1] == len(patches)


def test_samples_on_a_surface_are_uniform_in_area() -> None:
    fan = [[[0, 0, 0], [0, 0, 1], [0.1 * (k + 1) ** 2, 0, 0.5]] for k in range(5)]
    scene = make_snapshot([Mesh(np.array(fan, np.float32))], camera=look_at((1, 3, 1)))
    gather = gather_of(scene, 5000)
    front = gather.points.side == 0
    share = np.bincount(gather.points.triangle[front], minlength=5) / front.sum()
    area = np.array([0.1 * (k + 1) ** 2 / 2 for k in range(5)])
    np.testing.assert_allclose(share, area / area.sum(), atol=2e-3)


def test_ten_surfaces_with_a_budget_of_four_share_clusters_that_are_counted() -> None:
    spheres = [translation(3 * i, 0, 0) for i in range(10)]
    scene = make_snapshot([Mesh(box(1), transforms=spheres)], camera=look_at((13.5, 10, 30), (13.5, 0, 0), fov=70))
    gather = gather_of(scene, 4)
    assert gather.n == 4
    assert gather.n_shared_clusters >= 1
    assert gather.n_surfaces_without_own >= 6
    points = random_places(scene, 2000)
    found = gather.locate(points)
    assert found.min() >= 0
    visitors = [set(points.instance[found == cell]) for cell in range(4)]
    assert sum(len(instances) > 1 for instances in visitors) == gather.n_shared_clusters
    assert gather.area.sum() == pytest.approx(2 * 10 * 6, rel=1e-4)


def test_every_surface_has_samples_of_its_own_when_the_budget_allows() -> None:
    scene = meadow()
    gather = gather_of(scene, 400)
    assert gather.n_shared_clusters == gather.n_surfaces_without_own == 0
    assert set(gather.points.instance) == set(range(scene.n_instances))
    assert gather.n <= 400


def test_surfaces_that_the_view_receives_more_from_have_denser_samples() -> None:
    near, far = Mesh(quad(1), transforms=[translation(0, 0.3, 0)], path="/near"), Mesh(quad(1), path="/far")
    far = Mesh(quad(1), transforms=[translation(0, 8, 30)], path="/far")
    floor = Mesh(quad(2), path="/floor")
    near = Mesh(quad(1), transforms=[translation(0, 0.6, 0) @ rotation((1, 0, 0), 180)], path="/near")
    scene = make_snapshot([near, far, floor], camera=look_at((0, 0.3, 2.5), (0, 0, 0)))
    gather = gather_of(scene, 2000)
    count = np.bincount(2 * gather.points.instance + gather.points.side, minlength=6)
    assert count[0] > 10 * count[2:4].max()


def test_importance_is_what_the_view_receives_if_all_cells_shine_alike() -> None:
    """By rays of their own: directly, and over one reflection."""
    pipeline = Pipeline(cornell(), n_gather=512)
    gather, rows = pipeline.gather, pipeline.transport.lobes[0].rows
    sides = 2 * gather.points.instance + gather.points.side
    albedo = gather.points.albedo.max(axis=1)[:, None]
    received = []
    for side in np.unique(sides):
        alone = np.repeat((sides == side)[:, None], 3, axis=1).astype(np.float32)
        over_one = albedo * pipeline.bounces.rows.matmul(alone)
        received.append(float(rows.matmul(alone + over_one)[:, 0].mean()))
    found = [float(gather.importance[sides == side].sum()) for side in np.unique(sides)]
    assert sum(found) == pytest.approx(1.0, abs=1e-5) and (gather.importance >= 0.0).all()
    np.testing.assert_allclose(found, np.array(received) / sum(received), atol=0.01)
    assert max(found) > 0.1


def test_leaves_of_one_surface_are_one_range_of_the_tree() -> None:
    gather = gather_of(meadow(), 600)
    key = 2 * gather.points.instance.astype(int) + gather.points.side
    assert np.count_nonzero(np.diff(key)) == len(np.unique(key)) - 1


def test_the_same_seed_gives_the_same_bits_for_any_number_of_threads() -> None:
    scene = meadow()
    sets = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        sets.append(gather_of(scene, 500))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    first, second = sets
    assert first.tree.digest == second.tree.digest
    for a, b in zip(first.points, second.points, strict=True):
        assert np.array_equal(a, b)
    assert np.array_equal(first.area, second.area)
    assert np.array_equal(first.patch_points.position, second.patch_points.position)
    assert gather_of(scene, 500, seed=1).tree.digest != first.tree.digest


def test_cells_reflect_the_mean_of_the_light_on_their_patches() -> None:
    lamp = Light(LightKind.DISTANT, np.pi, rotation((1, 0, 0), -90), (0.0, 0.0))
    scene = quad_scene(Material(diffuse=(0.2, 0.4, 0.8)), lights=[lamp])
    gather = gather_of(scene, 50)
    direct = cell_direct(scene, build_tracer(scene), build_light_sampler(scene), gather, 1, 0)
    assert direct.shape == (1, gather.n, 3)
    front = gather.points.side == 0
    one = direct[0, front][0]
    np.testing.assert_allclose(direct[0, front], np.broadcast_to(one, (front.sum(), 3)), rtol=1e-5)
    np.testing.assert_allclose(one / one[0], [1, 2, 4], rtol=1e-5)
    assert np.all(direct[0, ~front] == 0)


def dark_room() -> SceneSnapshot:
    """A floor of one piece, half of it in a room without windows; light comes in under the room's right wall."""
    grey = Material(diffuse=0.5)
    room = [
        box((4.2, 0.1, 4.2), (-2, 2.05, 0)),
        box((0.1, 1.2, 4.2), (0.05, 1.4, 0)),
        box((0.1, 2, 4.2), (-4.05, 1, 0)),
        box((4.2, 2, 0.1), (-2, 1, 2.05)),
        box((4.2, 2, 0.1), (-2, 1, -2.05)),
    ]
    meshes = [Mesh(quad(8), grey, path="/floor"), *(Mesh(m, grey, path=f"/wall{i}") for i, m in enumerate(room))]
    lamp = Light(LightKind.DISTANT, np.pi, rotation((1, 0, 0), -90), (0.0, 0.0))
    return make_snapshot(meshes, lights=[lamp], camera=look_at((-3.5, 1, 0), (0, 1, 0), fov=80))


def test_light_of_cells_is_that_of_the_places_which_the_view_sees() -> None:
    scene = dark_room()
    tracer = build_tracer(scene)
    sampler = build_light_sampler(scene)
    view = view_samples(scene, tracer)
    gather = gather_of(scene, 200)
    own = cell_direct(scene, tracer, sampler, gather, 1, 0)[0]
    rng = np.random.default_rng(8)
    start = np.repeat(np.arange(view.n), 64)
    normal = view.points.normal[start]
    # A point on a unit ball that touches the plane: directions by the cosine.
    ball = rng.normal(size=(len(start), 3))
    towards = (normal + ball / np.linalg.norm(ball, axis=1, keepdims=True)).astype(np.float32)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    origins = view.points.position[start] + np.float32(1e-4) * normal
    hits = first_surfaces(scene, tracer, origins, towards, 3).points
    there = np.flatnonzero(hits.instance >= 0)
    hits = take_points(hits, there)
    true = irradiance(scene, tracer, sampler, hits, 4, 1)[0].mean() * 0.5 / np.pi
    assert 0.005 < true < 0.05
    found = own[gather.locate(hits)].mean()
    # Cells below the wall reach out of the room: by their areas they send 1.7 times as much.
    assert found == pytest.approx(true, rel=0.1)


def test_seen_places_stay_where_they_are_when_something_moves() -> None:
    lamp = Mesh(quad(0.5)[:, ::-1], Material(0.0, 1.0), transforms=[translation(0, 0.995, 0)], path="/lamp")
    found = []
    for x in (-0.6, 0.6):
        toy = Mesh(box(0.1), Material(), [translation(x, -0.9, 0.9)], path="/toy")
        camera = look_at((0, 0, 3.9), (0, 0, 0), fov=39.3, width=16, height=16)
        patches = gather_of(make_snapshot([*cornell_meshes(), lamp, toy], camera=camera), 500).patch_points.position
        found.append({tuple(place) for place in patches.tolist()})
    assert len(found[0] & found[1]) > 0.8 * len(found[0])


def test_a_set_without_samples_or_surfaces_is_refused() -> None:
    scene = closed_box()
    tracer = build_tracer(scene)
    view = view_samples(scene, tracer)
    with pytest.raises(ValueError, match="at least one"):
        gather_samples(scene, tracer, view, n=0)
    flat = make_snapshot([Mesh(np.zeros((1, 3, 3)))])
    with pytest.raises(ValueError, match="area"):
        gather_samples(flat, build_tracer(flat), view_samples(flat, build_tracer(flat)), n=10)
