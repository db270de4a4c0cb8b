"""Rows measured in one compiled pass: the same as by separate steps, in parts, and exact cells."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numba
import numpy as np
import pytest

from icheat_usd.errors import IcheatError
from icheat_usd.kernels import cell_map as cell_kernels
from icheat_usd.kernels.random import sobol_pair
from icheat_usd.kernels.transport import cells_of_hits, divide
from icheat_usd.materials import points_on_surface, take_points
from icheat_usd.samples import GatherSamples, gather_samples, view_samples
from icheat_usd.samples.cell_map import HitCells, build_cell_map
from icheat_usd.samples.view import ViewSamples
from icheat_usd.scene import SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import SparseRows
from icheat_usd.transport.progressive import build_transports
from icheat_usd.transport.rays import MOST_RAYS, MeasuredRows, RowBuilder
from icheat_usd.transport.sparse import add_shares
from tests.scenes import (
    Material,
    Mesh,
    box,
    cornell,
    look_at,
    make_snapshot,
    quad,
    rotation,
    scaling,
    sphere,
    translation,
)


class Apart(RowBuilder):
    """Traces, looks up and counts in separate steps over arrays."""

    def _trace_table(self) -> None:
        return None


def porch() -> SceneSnapshot:
    """An open room with a mirror, a pane of glass, a half transparent card, and turned balls."""
    ball, normals = sphere(0.3, 8)
    placed = [
        translation(0.5 * i - 0.5, 0.3, -0.4) @ rotation((1, 2, i), 40.0 * i) @ scaling(1, 0.5, 1.2) for i in range(3)
    ]
    mirror = Material(diffuse=0.9, metallic=1.0, roughness=0.0)
    glass = Material(diffuse=0.0, roughness=0.0, opacity=0.0, ior=1.5)
    return make_snapshot(
        [
            Mesh(quad(4), path="/floor"),
            Mesh(quad(2), mirror, transforms=[translation(0, 1, -1.2) @ rotation((1, 0, 0), 90)], path="/mirror"),
            Mesh(quad(1.5), glass, transforms=[translation(1.2, 0.8, 0) @ rotation((0, 0, 1), 90)], path="/pane"),
            Mesh(quad(1), Material(0.5, opacity=0.4), transforms=[translation(-0.8, 1.5, 0)], path="/card"),
            Mesh(ball, normals=normals, transforms=placed, path="/balls"),
        ],
        camera=look_at((0, 1.2, 3), (0, 0.4, 0), width=12, height=10),
    )


@cache
def prepared(open_scene: bool) -> tuple[SceneSnapshot, Tracer, ViewSamples, GatherSamples]:
    scene = porch() if open_scene else cornell(10, 10)
    tracer = build_tracer(scene)
    view = view_samples(scene, tracer)
    gather = gather_samples(scene, tracer, view, n=600)
    gather.hit_cells.table(scene.geometry, 1 << 40)  # enough look-ups for a map
    return scene, tracer, view, gather


def measure(
    kind: type[RowBuilder] = RowBuilder,
    n_rays: int = 100,
    *,
    open_scene: bool = True,
    cells: bool = False,
    rows: slice = slice(None),
    **options: int,
) -> MeasuredRows:
    scene, tracer, view, gather = prepared(open_scene)
    builder = kind(scene, tracer, gather, 3)
    if cells:
        return builder.measure(gather.patch_points, gather.cell_begin, np.arange(gather.n), n_rays, 1, **options)
    stream = np.arange(view.n)[rows]
    begin = np.arange(len(stream) + 1)
    return builder.measure(take_points(view.points, stream), begin, stream, n_rays, 0, **options)


def assert_same(a: SparseRows, b: SparseRows) -> None:
    assert a.shape == b.shape
    assert np.array_equal(a.indptr, b.indptr) and np.array_equal(a.indices, b.indices)
    assert np.array_equal(a.weights, b.weights)


def assert_all_same(a: MeasuredRows, b: MeasuredRows) -> None:
    assert_same(a.cells, b.cells)


# Rays exactly between two triangles may be given to either by packets and single rays; none is in these scenes.
@pytest.mark.parametrize("open_scene", [True, False], ids=["porch", "cornell"])
@pytest.mark.parametrize("n_rays", [1, 100, 5000])
def test_one_pass_gives_the_rows_of_separate_steps(open_scene: bool, n_rays: int) -> None:
    rows = slice(0, None, 1 if n_rays < 1000 else 9)
    one = measure(n_rays=n_rays, open_scene=open_scene, rows=rows)
    assert one.cells.n_entries > 0
    assert_all_same(one, measure(Apart, n_rays, open_scene=open_scene, rows=rows))


def test_one_pass_gives_the_rows_of_separate_steps_from_many_points() -> None:
    for n_rays in (7, 64):
        assert_all_same(measure(n_rays=n_rays, cells=True), measure(Apart, n_rays, cells=True))


def test_scenes_of_many_placements_are_traced_ray_by_ray() -> None:
    ball, normals = sphere(0.2, 6)
    grid = [translation(0.5 * (i % 20) - 5, 0.1, 0.5 * (i // 20) - 5) for i in range(300)]
    scene = make_snapshot(
        [Mesh(ball, normals=normals, transforms=grid), Mesh(quad(12))], camera=look_at((0, 3, 6), width=8, height=8)
    )
    with_instances = build_tracer(scene)
    table = with_instances.compiled()
    assert table is not None and table.packets  # small meshes are copied
    from icheat_usd.tracing.embree import EmbreeTracer

    tracer = EmbreeTracer(scene, copied_triangles=0)
    assert not tracer.compiled().packets
    view = view_samples(scene, tracer)
    gather = gather_samples(scene, tracer, view, n=700)
    stream = np.arange(view.n)
    found = [
        kind(scene, tracer, gather, 0).measure(view.points, np.arange(view.n + 1), stream, 40, 0)
        for kind in (RowBuilder, Apart)
    ]
    assert_all_same(*found)


def test_the_reference_tracer_finds_nearly_the_same_rows() -> None:
    scene, _, view, gather = prepared(False)
    slow = RowBuilder(scene, build_tracer(scene, "reference"), gather, 3)
    stream = np.arange(0, view.n, 7)
    points = take_points(view.points, stream)
    a = slow.measure(points, np.arange(len(stream) + 1), stream, 64, 0)
    b = measure(n_rays=64, open_scene=False, rows=slice(0, None, 7))
    dense = [np.zeros(a.cells.shape, np.float32) for _ in range(2)]
    for out, rows in zip(dense, (a.cells, b.cells), strict=True):
        out[np.repeat(np.arange(rows.n_rows), np.diff(rows.indptr)), rows.indices] = rows.weights
    assert np.abs(dense[0] - dense[1]).sum() < 0.002 * len(stream)


def test_rays_in_parts_are_the_rays_at_once() -> None:
    whole = measure(n_rays=96)
    parts = [measure(n_rays=n, first_ray=first) for first, n in ((0, 32), (32, 51), (83, 13))]
    assert_all_same(whole, parts[0].continued(parts[1]).continued(parts[2]))
    assert parts[0].continued(parts[1]).n_rays == 83
    whole = measure(n_rays=96, cells=True)
    parts = [measure(n_rays=48, cells=True, first_ray=first, of_rays=96) for first in (0, 48)]
    assert_all_same(whole, parts[0].continued(parts[1]))


def test_rays_in_parts_are_exact_up_to_the_most_and_more_are_refused() -> None:
    rng = np.random.default_rng(0)
    units, n = 1024, 4000
    of_a, of_b = 3000 * units, (MOST_RAYS - 3000) * units
    a, b = (rng.integers(1, of, n, endpoint=True) for of in (of_a, of_b))
    a[:2], b[:2] = (of_a, of_a - 1), (of_b, of_b - 1)

    def shares(count: np.ndarray, of: int) -> SparseRows:
        weights = count.astype(np.float32)
        divide(weights, float(of))
        return SparseRows(np.arange(n + 1), np.zeros(n, np.int32), weights, 1)

    assert_same(add_shares(shares(a, of_a), of_a, shares(b, of_b), of_b, of_a + of_b), shares(a + b, of_a + of_b))
    scene, tracer, view, gather = prepared(False)
    with pytest.raises(IcheatError, match="8193 gather rays a row are more"):
        next(build_transports(scene, tracer, view, gather, np.ones((2, gather.n), np.float32), rays_per_row=8193))
    nothing = SparseRows.empty(1, 1)
    with pytest.raises(ValueError, match="too many"):
        MeasuredRows(nothing, MOST_RAYS).continued(MeasuredRows(nothing, 1))


def test_a_row_does_not_depend_on_the_rows_beside_it() -> None:
    whole = measure(n_rays=64)
    some = measure(n_rays=64, rows=slice(5, None, 11))
    for row in range(some.cells.n_rows):
        at = 5 + 11 * row
        assert_same(some.cells.rows(row, row + 1), whole.cells.rows(at, at + 1))


def test_rows_are_the_same_for_any_number_of_threads() -> None:
    found = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        found.append(measure(n_rays=300))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert_all_same(*found)


def test_the_table_finds_the_cells_of_the_walk() -> None:
    walls = box(4, inward=True)
    room = np.concatenate([walls, box(1) + np.float32([0.3, -1.4, 0.2]), box((2, 2, 1e-3))])
    ball, normals = sphere(1.0, 24)
    placed = [
        translation(50 * i, 3e3 * i, 0) @ rotation((1, i, 2), 33.0 * i) @ scaling(1 + i, 1, 0.2) for i in range(3)
    ]
    scene = make_snapshot(
        [
            Mesh(room, path="/room"),
            Mesh(ball, normals=normals, transforms=placed, path="/balls"),
            Mesh(quad(3, 1.5), path="/lamp"),
            Mesh(np.float32([[[0, 0, 0], [9, 1e-4, 0], [9.5, 0, 2e-4]]]), path="/sliver"),
        ],
        camera=look_at((0.2, 0.5, 1.8)),
    )
    tracer = build_tracer(scene)
    gather = gather_samples(scene, tracer, view_samples(scene, tracer), n=2500)
    rng = np.random.default_rng(1)
    n = 60_000
    geometry = scene.geometry
    instance = rng.integers(0, scene.n_instances, n).astype(np.int32)
    begin = geometry.mesh_begin[geometry.instance_mesh[instance]]
    end = geometry.mesh_begin[geometry.instance_mesh[instance] + 1]
    triangle = rng.integers(begin, end).astype(np.int32)
    uv = rng.random((n, 2)).astype(np.float32)
    uv[: n // 4] = rng.integers(0, 9, (n // 4, 2)).astype(np.float32) / 8  # corners, edges, borders of squares
    uv = np.where(uv.sum(1, keepdims=True) > 1, 1 - uv, uv).astype(np.float32)
    side = rng.integers(0, 2, n)
    points = points_on_surface(scene, instance, triangle, uv, side.astype(np.uint8))
    found = {}
    for fineness in (0.3, 1.0):
        found[fineness] = np.empty(n, np.int32)
        table = build_cell_map(geometry, gather.locator, fineness=fineness).table
        assert np.any(table.square >= 0) and np.mean(table.square == cell_kernels.WALK) < 0.7
        cells_of_hits(
            table,
            gather.locator.table,
            gather.locator.depth,
            geometry.points,
            geometry.instance_to_world,
            geometry.instance_to_object,
            np.zeros(len(geometry.points), np.uint8),
            np.ascontiguousarray(-points.normal),
            instance,
            triangle,
            np.ascontiguousarray(uv[:, 0]),
            np.ascontiguousarray(uv[:, 1]),
            found[fineness],
            np.empty(n, np.uint8),
        )
    assert np.array_equal(found[0.3], found[1.0])
    walked = gather.locate(points)
    differ = np.flatnonzero(walked != found[1.0])
    # Places are rounded by other steps there: only ties differ.
    distance = [
        np.linalg.norm(gather.points.position[c[differ]] - points.position[differ], axis=1)
        for c in (walked, found[1.0])
    ]
    np.testing.assert_allclose(*distance, rtol=1e-4, atol=1e-3)
    assert len(differ) < 0.002 * n


@pytest.mark.parametrize("first", [0, 1, 2])
def test_squares_of_a_sliver_are_short(first: int) -> None:
    """A wall that is a fan of slivers: none of their squares crosses more samples than a list holds."""
    rim = np.stack([np.linspace(-2, 2, 41), np.full(41, 4), np.zeros(41)], axis=1)
    hub = np.broadcast_to(np.float64([0, -4, 0]), (40, 3))
    fan = np.roll(np.stack([hub, rim[1:], rim[:-1]], axis=1), -first, axis=1).astype(np.float32)
    floor = quad(4, 4) + np.float32([0, 0, 5])
    scene = make_snapshot([Mesh(fan, path="/fan"), Mesh(floor, path="/floor")], camera=look_at((0, 0, 4)))
    tracer = build_tracer(scene)
    gather = gather_samples(scene, tracer, view_samples(scene, tracer), n=2000)
    table = build_cell_map(scene.geometry, gather.locator).table
    rng = np.random.default_rng(4)
    u, v = np.sort(rng.random((2, 4000)), axis=0)
    entries = [
        cell_kernels.entry_at(table.place, table.face, table.square, 0, t, 0, a, np.float32(b - a))
        for t, a, b in zip(rng.integers(0, 40, 4000), u.astype(np.float32), v, strict=True)
    ]
    assert not np.any(np.equal(entries, cell_kernels.WALK))
    listed = np.unique([-1 - e for e in entries if e < 0])
    assert len(listed) and table.candidates[listed].mean() < 4


def test_placements_with_too_many_triangles_go_without_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, tracer, view, gather = prepared(True)
    monkeypatch.setattr("icheat_usd.samples.cell_map.MOST_PLACED", 10)
    table = build_cell_map(scene.geometry, gather.locator).table
    assert np.any(table.place == cell_kernels.NO_FACES) and np.any(table.place != cell_kernels.NO_FACES)
    whole = measure(n_rays=50)
    bare = replace(gather)
    assert len(bare.hit_cells.table(scene.geometry, 1 << 40).face) == len(table.face)
    stream = np.arange(view.n)
    builder = RowBuilder(scene, tracer, bare, 3)
    assert_all_same(whole, builder.measure(view.points, np.arange(view.n + 1), stream, 50, 0))


def test_few_look_ups_go_without_a_map_and_find_the_same() -> None:
    scene, tracer, view, gather = prepared(True)
    mapped = measure(n_rays=50)
    fresh = replace(gather)
    stream, begin = np.arange(view.n), np.arange(view.n + 1)
    walked = RowBuilder(scene, tracer, fresh, 3).measure(view.points, begin, stream, 50, 0)
    assert_all_same(mapped, walked)
    triangles = np.diff(scene.geometry.mesh_begin)[scene.geometry.instance_mesh].sum()
    look_ups = HitCells(gather.locator)
    assert len(look_ups.table(scene.geometry, 1000).face) == 0
    assert len(look_ups.table(scene.geometry, 4 * int(triangles) + 16 * gather.n).face) == 2 * triangles
    assert len(look_ups.table(scene.geometry, 1).face) == 2 * triangles


def test_the_sequence_is_sobols() -> None:
    """First dimension van der Corput, second by its recurrence, both Owen-scrambled: every elementary interval once."""
    points = np.array([sobol_pair(k, 77) for k in range(256)])
    for a in range(9):
        columns, rows = 2**a, 2 ** (8 - a)
        place = (points[:, 0] * columns).astype(int) * rows + (points[:, 1] * rows).astype(int)
        assert np.array_equal(np.sort(place), np.arange(256))
