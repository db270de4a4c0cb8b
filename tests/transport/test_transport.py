"""Transport against form factors, furnaces and energy balances that are known."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.lighting import build_light_sampler
from icheat_usd.samples import GatherSamples, ViewSamples, cell_direct, gather_samples, view_samples
from icheat_usd.scene import F32, SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import Bounces, Transport, build_bounces, build_transport, more_bounces, solve_bounces
from tests.scenes import (
    Light,
    Material,
    Mesh,
    box,
    closed_box,
    cornell,
    look_at,
    make_snapshot,
    quad,
    rotation,
    sphere,
    translation,
)


def prepare(scene: SceneSnapshot, n: int) -> tuple[Tracer, ViewSamples, GatherSamples]:
    tracer = build_tracer(scene)
    view = view_samples(scene, tracer)
    return tracer, view, gather_samples(scene, tracer, view, n=n)


def transport_of(
    scene: SceneSnapshot, n: int, rays: int, **options: int
) -> tuple[ViewSamples, GatherSamples, Transport, Bounces]:
    tracer, view, gather = prepare(scene, n)
    transport = build_transport(scene, tracer, view, gather, rays_per_row=rays, **options)
    return view, gather, transport, build_bounces(scene, tracer, gather, rays_per_row=rays)


def side_factors(gather: GatherSamples, bounces: Bounces, receiver: int, caster: int) -> tuple[float, F32]:
    """Form factor from one side (2 * instance + side) to another: area mean of bounce rows, and its parts."""
    key = 2 * gather.points.instance + gather.points.side
    seen = bounces.rows.matmul((key == caster).astype(np.float32)[:, None])[key == receiver, 0]
    return float(np.average(seen, weights=gather.area[key == receiver])), seen


def test_every_ray_in_a_closed_room_lands_in_a_cell() -> None:
    _, gather, transport, bounces = transport_of(closed_box(), 300, 64)
    np.testing.assert_allclose(transport.lobes[0].rows.row_sums(), 1, rtol=1e-6)
    inside = gather.points.side == 0
    np.testing.assert_allclose(bounces.rows.row_sums()[inside], 1, rtol=1e-6)
    assert np.all(bounces.rows.row_sums()[~inside] == 0)
    assert len(transport.lobes) == 1


def test_bounces_by_more_rays_are_closer_to_the_truth() -> None:
    scene = cornell(8, 8)
    tracer, _, gather = prepare(scene, 400)
    one_each = np.eye(gather.n, dtype=np.float32)
    true = build_bounces(scene, tracer, gather, rays_per_row=4096, seed=1).rows.matmul(one_each)
    bounces = build_bounces(scene, tracer, gather, rays_per_row=256)
    more = more_bounces(scene, tracer, gather, bounces, 256, 768)
    assert more.albedo is bounces.albedo
    before, after = (np.linalg.norm(rows.matmul(one_each) - true) for rows in (bounces.rows, more.rows))
    assert after < 0.6 * before  # four times the rays: half the noise
    inside = gather.points.side == 0
    np.testing.assert_allclose(more.rows.row_sums()[inside].mean(), bounces.rows.row_sums()[inside].mean(), rtol=1e-3)


def test_parallel_unit_squares_one_apart_see_a_fifth_of_each_other() -> None:
    lower, upper = Mesh(quad(1)), Mesh(quad(1), transforms=[translation(0, 1, 0) @ rotation((1, 0, 0), 180)])
    scene = make_snapshot([lower, upper], camera=look_at((0, 0.5, 2.5)))
    _, gather, transport, bounces = transport_of(scene, 400, 256)
    factor, parts = side_factors(gather, bounces, 0, 2)
    # Howell, A Catalog of Radiation Heat Transfer Configuration Factors, C-11: side 1, distance 1.
    expected = 0.199825
    sigma = np.sqrt(expected * (1 - expected) / (256 * len(parts)))
    assert abs(factor - expected) < 3 * sigma


def test_squares_that_share_an_edge_at_a_right_angle_see_a_fifth_of_each_other() -> None:
    wall = translation(0, 0.5, -0.5) @ rotation((1, 0, 0), 90)
    scene = make_snapshot([Mesh(quad(1)), Mesh(quad(1), transforms=[wall])], camera=look_at((0.3, 1, 2)))
    _, gather, transport, bounces = transport_of(scene, 400, 256)
    factor, parts = side_factors(gather, bounces, 0, 2)
    expected = 0.200044  # Howell, C-14: equal squares with a common edge
    sigma = np.sqrt(expected * (1 - expected) / (256 * len(parts)))
    assert abs(factor - expected) < 3 * sigma


def test_areas_times_form_factors_are_the_same_both_ways() -> None:
    wall = translation(0.2, 0.8, -0.6) @ rotation((1, 0, 0), 70)
    scene = make_snapshot([Mesh(quad(1)), Mesh(quad(1.7), transforms=[wall])], camera=look_at((0.3, 1, 2)))
    _, gather, transport, bounces = transport_of(scene, 500, 256)
    there, parts = side_factors(gather, bounces, 0, 2)
    back, parts_back = side_factors(gather, bounces, 2, 0)
    sigma = 1 / np.sqrt(256 * min(len(parts), len(parts_back)))
    assert abs(1.0 * there - 1.7**2 * back) < 3 * sigma
    assert there > 0.1


def test_every_part_of_a_closed_sphere_sees_every_other_alike() -> None:
    shell, _ = sphere(1, 24)
    scene = make_snapshot([Mesh(shell[:, ::-1])], camera=look_at((0, 0, 0), (0, 0, -1), fov=90))
    tracer = build_tracer(scene)
    view = view_samples(scene, tracer)
    gather = gather_samples(scene, tracer, view, n=60, n_patches_per_cell=300)
    bounces = build_bounces(scene, tracer, gather, rays_per_row=4096)
    inside = np.flatnonzero(gather.points.side == 0)
    dense = bounces.rows.matmul(np.eye(gather.n, dtype=np.float32))[np.ix_(inside, inside)]
    share = gather.area[inside] / gather.area[inside].sum()
    # Flat facets bend the sphere's law for the nearest ones: a cell sees a little more of itself.
    others = ~np.eye(len(inside), dtype=bool)
    np.testing.assert_allclose(dense[others], np.broadcast_to(share, dense.shape)[others], rtol=0.3, atol=2e-3)
    np.testing.assert_allclose(dense.mean(0), share, rtol=0.1)
    np.testing.assert_allclose(dense.sum(1), 1, atol=1e-5)


@pytest.mark.parametrize("albedo", [0.3, 0.8])
def test_light_in_a_closed_glowing_room_adds_up_to_the_geometric_series(albedo: float) -> None:
    scene = closed_box(albedo, emission=1.0)
    tracer, view, gather = prepare(scene, 200)
    transport = build_transport(scene, tracer, view, gather, rays_per_row=64)
    bounces = build_bounces(scene, tracer, gather, rays_per_row=64)
    direct = cell_direct(scene, tracer, build_light_sampler(scene), gather, 256, 0)
    total = solve_bounces(bounces, direct, 100)
    inside = gather.points.side == 0
    # b = albedo * emission: what the walls reflect; all reflections together: albedo / (1 - albedo).
    expected = albedo / (1 - albedo)
    assert np.average(total[0, inside, 0], weights=gather.area[inside]) == pytest.approx(expected, rel=0.02)
    assert transport.to_view(total[0]).mean() == pytest.approx(albedo * expected, rel=0.02)
    two = solve_bounces(bounces, direct, 2)
    mean = np.average(two[0, inside, 0], weights=gather.area[inside])
    assert mean == pytest.approx(albedo + albedo**2, rel=0.02)
    assert np.array_equal(solve_bounces(bounces, direct, 1), direct)


def test_a_mirror_lets_rows_see_what_it_shows() -> None:
    mirror = Material(diffuse=0.9, metallic=1.0, roughness=0.0)
    walls = box(2, inward=True)
    room = [Mesh(walls[:10], Material(0.5), path="/room"), Mesh(walls[10:], mirror, path="/mirror")]
    scene = make_snapshot(room, camera=look_at((0, 0, 0), (0, 0, -1), fov=90))
    _, gather, transport, bounces = transport_of(scene, 300, 64)
    rows = transport.lobes[0].rows
    on_mirror = (gather.points.instance == 1).astype(np.float32)[:, None]
    assert rows.matmul(on_mirror).max() == 0
    sums = rows.row_sums()
    assert np.all(sums <= 1.0 + 1e-6)
    # Some rays come back from the mirror with 0.9 to 1 of their light, none are lost.
    assert 0.9 < sums.min() < sums.max() <= 1.0 + 1e-6
    assert sums.mean() < 0.999


def test_glossy_points_have_rows_that_multiply_their_specular_colours() -> None:
    floor = Material(diffuse=0.0, use_specular=True, specular=(0.3, 0.6, 0.9), roughness=0.4, ior=1.5)
    scene = make_snapshot(
        [Mesh(quad(1), floor, path="/floor"), Mesh(box(20, inward=True), Material(1.0), path="/sky")],
        camera=look_at((0, 1.5, 0.5)),
    )
    view, gather, transport, bounces = transport_of(scene, 400, 256)
    assert [lobe.name for lobe in transport.lobes] == ["diffuse", "specular_base", "specular_edge"]
    on_floor = view.points.instance == 0
    base, edge = (lobe.rows.row_sums() for lobe in transport.lobes[1:])
    assert np.all(base[~on_floor] == 0)
    # Near normal incidence Schlick's lobe is specular * ~1 + edge * ~0, less what single scattering loses.
    assert np.all((base[on_floor] > 0.85) & (base[on_floor] <= 1.0))
    assert np.all((edge[on_floor] >= 0) & (edge[on_floor] < 0.05))
    seen = transport.to_view(np.ones((gather.n, 3), np.float32))[on_floor]
    expected = base[on_floor, None] * np.float32([0.3, 0.6, 0.9]) + edge[on_floor, None]
    np.testing.assert_allclose(seen, expected, rtol=1e-4)


def test_lamps_and_skies_send_nothing_through_the_transport() -> None:
    from icheat_usd.scene import LightKind

    scene = make_snapshot([Mesh(quad(1))], lights=[Light(LightKind.DOME)], camera=look_at((0, 1, 1)))
    _, _, transport, bounces = transport_of(scene, 50, 32)
    assert transport.lobes[0].rows.n_entries == 0


def test_rows_have_ascending_columns_without_repetition() -> None:
    _, gather, transport, bounces = transport_of(cornell(8, 8), 200, 64)
    for rows in (transport.lobes[0].rows, bounces.rows):
        assert rows.indptr[-1] == rows.n_entries
        for r in range(rows.n_rows):
            columns = rows.indices[rows.indptr[r] : rows.indptr[r + 1]]
            assert np.all(np.diff(columns) > 0)
        assert rows.weights.min() > 0


def test_the_same_seed_gives_the_same_bits_for_any_number_of_threads() -> None:
    results = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        _, gather, transport, bounces = transport_of(cornell(12, 12), 200, 64)
        light = np.random.default_rng(0).random((1, gather.n, 3)).astype(np.float32)
        results.append((transport, bounces, transport.to_view(solve_bounces(bounces, light, 4)[0])))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    (one, bounces_one, seen_one), (two, bounces_two, seen_two) = results
    assert np.array_equal(one.lobes[0].rows.indices, two.lobes[0].rows.indices)
    assert np.array_equal(one.lobes[0].rows.weights, two.lobes[0].rows.weights)
    assert np.array_equal(bounces_one.rows.weights, bounces_two.rows.weights)
    assert np.array_equal(seen_one, seen_two)


def test_a_row_depends_on_its_view_sample_alone() -> None:
    scene = cornell(24, 24)
    tracer, view, gather = prepare(scene, 300)
    whole = build_transport(scene, tracer, view, gather, rays_per_row=64)
    sparse = build_transport(scene, tracer, view, gather, rays_per_row=64, row_spacing=4)
    assert len(sparse.row_view) < view.n / 4
    for row, sample in enumerate(sparse.row_view.tolist()):
        a, b = sparse.lobes[0].rows.rows(row, row + 1), whole.lobes[0].rows.rows(sample, sample + 1)
        assert np.array_equal(a.indices, b.indices) and np.array_equal(a.weights, b.weights)


def test_interpolated_rows_are_close_and_stay_on_their_surface() -> None:
    scene = cornell(48, 48)
    tracer, view, gather = prepare(scene, 400)
    whole = build_transport(scene, tracer, view, gather, rays_per_row=256)
    sparse = build_transport(scene, tracer, view, gather, rays_per_row=256, row_spacing=3)
    weights = sparse.interpolation
    assert weights is not None
    np.testing.assert_allclose(weights.row_sums(), 1, rtol=1e-5)
    own = np.repeat(view.points.normal, np.diff(weights.indptr), axis=0)
    other = view.points.normal[sparse.row_view[weights.indices]]
    assert (own * other).sum(1).min() > 0.7
    # A row's own sample takes it as it is.
    assert np.array_equal(
        weights.matmul(np.arange(len(sparse.row_view), dtype=np.float32)[:, None])[sparse.row_view, 0],
        np.arange(len(sparse.row_view)),
    )
    light = gather.points.position * 0.3 + 1
    exact, approximate = whole.to_view(light), sparse.to_view(light)
    assert np.sqrt(np.mean((exact - approximate) ** 2) / np.mean(exact**2)) < 0.1


def test_bounces_refuse_light_of_another_gather_set() -> None:
    _, gather, transport, bounces = transport_of(closed_box(), 60, 8)
    with pytest.raises(ValueError, match="gather cells"):
        solve_bounces(bounces, np.zeros((1, gather.n + 1, 3), np.float32), 2)
    with pytest.raises(ValueError, match="at least one"):
        solve_bounces(bounces, np.zeros((1, gather.n, 3), np.float32), 0)


def test_progress_runs_from_nothing_to_all_of_each_step() -> None:
    scene = closed_box()
    tracer, view, gather = prepare(scene, 60)
    seen: dict[str, list[float]] = {}
    build_transport(
        scene,
        tracer,
        view,
        gather,
        rays_per_row=8,
        progress=lambda s, f: seen.setdefault(s, []).append(f),
    )
    build_bounces(scene, tracer, gather, rays_per_row=8, progress=lambda s, f: seen.setdefault(s, []).append(f))
    assert len(seen) == 2
    for fractions in seen.values():
        assert fractions[0] == 0 and fractions[-1] == 1 and fractions == sorted(fractions)
