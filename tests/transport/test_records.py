"""Records: interpolation that is exact where it must be, and nothing across edges."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.materials import reflectance_to_eye, take_points
from icheat_usd.progress import silent
from icheat_usd.samples import ViewSamples, view_samples
from icheat_usd.scene import F32, F64, I64, SceneSnapshot
from icheat_usd.tracing import build_tracer
from icheat_usd.transport import Transport, build_bounces
from icheat_usd.transport.allotment import allot_rays
from icheat_usd.transport.fitting import fit_weights
from icheat_usd.transport.outliers import Survey, add_outliers, doubtful_samples
from icheat_usd.transport.progressive import build_transports
from icheat_usd.transport.rays import RowBuilder
from icheat_usd.transport.records import Records, RecordSettings, place_records, tile_order
from icheat_usd.transport.sparse import SparseRows
from icheat_usd.transport.training import training_radiance
from tests.pipeline import Pipeline
from tests.scenes import Material, Mesh, box, cornell, look_at, make_snapshot, quad, translation


def floor_scene(width: int = 48, height: int = 36) -> SceneSnapshot:
    """A floor at a slant, and a block in front of it."""
    block = Mesh(box((0.3, 0.6, 0.3)), transforms=[translation(0.2, 0.3, 0.3)], path="/block")
    camera = look_at((0.4, 1.2, 2.0), (0, 0.1, 0), fov=40, width=width, height=height)
    return make_snapshot([Mesh(quad(3), path="/floor"), block], camera=camera)


def diffuse_survey(halves: F32) -> Survey:
    """Of samples that reflect nothing specularly: (n_view, 2, n_lights)."""
    return Survey(halves, np.empty(0, np.int64), np.empty((0, 2, 2, halves.shape[2]), np.float32))


def white(view: ViewSamples) -> F32:
    """Tint of diffuse samples."""
    return np.stack([np.ones(view.n), np.zeros(view.n), np.zeros(view.n)]).astype(np.float32)


def place(scene: SceneSnapshot, response: F32, view: ViewSamples, **settings: float) -> list[Records]:
    """Records for lights whose response is given at every view sample: (n_view, n_lights)."""

    def probe(samples: I64) -> F32:
        return np.broadcast_to(response[samples], (2, 1, len(samples), response.shape[1]))

    tint = np.ones((1, view.n), np.float32)
    return list(place_records(view, scene.camera, probe, tint, RecordSettings(**settings)))  # type: ignore[arg-type]


def view_of(scene: SceneSnapshot) -> ViewSamples:
    return view_samples(scene, build_tracer(scene))


def linear(view: ViewSamples) -> F32:
    """Two lights whose response is linear in space, another on each surface."""
    on_floor = view.points.instance[:, None] == 0
    x, y, z = view.points.position.T
    return np.where(on_floor, np.stack([2 + x, 3 - z], 1), np.stack([5 + y + 0.5 * x, 0.1 + 0 * y], 1)).astype(
        np.float32
    )


def test_weights_sum_to_one_and_join_nothing_across_edges() -> None:
    scene = floor_scene()
    view = view_of(scene)
    for records in place(scene, linear(view), view, coarsest=8, max_share=0.5):
        spread = records.interpolation
        assert spread.shape == (view.n, len(records.view))
        np.testing.assert_allclose(spread.row_sums(), 1, rtol=1e-5)
        assert spread.weights.min() >= 0 and np.diff(spread.indptr).max() <= 8
        np.testing.assert_array_equal(
            spread.matmul(np.arange(len(records.view), dtype=np.float32)[:, None])[records.view, 0],
            np.arange(len(records.view)),
        )
    owner = np.repeat(np.arange(view.n), np.diff(spread.indptr))
    other = records.view[spread.indices]
    p, n = view.points.position, view.points.normal
    assert np.array_equal(view.points.instance[owner], view.points.instance[other])
    assert (n[owner] * n[other]).sum(1).min() > 0.99
    assert np.abs(((p[other] - p[owner]) * n[owner]).sum(1)).max() < 1e-5


def test_what_is_linear_on_a_plane_is_reproduced_exactly_across_blocks_of_all_sizes() -> None:
    scene = floor_scene()
    view = view_of(scene)
    light = linear(view)
    # A light that bends in one corner only, so that blocks there become small and their neighbours get nodes on edges.
    bend = np.where(view.points.position[:, :1] < -0.5, np.sin(9 * view.points.position), 0).astype(np.float32)
    records = place(scene, np.concatenate([light, 3 * bend[:, :1]], 1), view, coarsest=16, max_share=0.6)[-1]
    inside = records.fit > 1 - 1e-6
    assert inside.mean() > 0.5 and len(records.view) < 0.61 * view.n
    got = records.interpolation.matmul(light[records.view])
    np.testing.assert_allclose(got[inside], light[inside], rtol=2e-5)


def test_more_records_where_light_changes() -> None:
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=64, height=64))
    view = view_of(scene)
    edge = (view.points.position[:, :1] > 0.3).astype(np.float32) + 0.5
    flat = place(scene, np.ones((view.n, 1), np.float32), view, tolerance=0.005)[-1]
    found = place(scene, edge, view, tolerance=0.005, max_share=0.4)[-1]
    assert len(flat.view) < 0.02 * view.n
    near = np.abs(view.points.position[found.view, 0] - 0.3) < 0.2
    assert near.mean() > 0.5
    wrong = found.interpolation.matmul(edge[found.view]) - edge
    assert np.sqrt(np.mean(wrong**2) / np.mean(edge**2)) < 0.05


def test_interpolated_light_has_no_steps_between_blocks() -> None:
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=64, height=64))
    view = view_of(scene)
    x, z = view.points.position[:, 0], view.points.position[:, 2]
    smooth = (2 + np.sin(3 * x) * np.cos(2 * z) + 1 / (0.2 + (x - 0.6) ** 2 + z**2))[:, None].astype(np.float32)
    records = place(scene, smooth, view, tolerance=0.02, max_share=0.2)[-1]
    image = records.interpolation.matmul(smooth[records.view]).reshape(64, 64)
    exact = smooth.reshape(64, 64)
    for axis in (0, 1):
        step, true = np.abs(np.diff(image, axis=axis)), np.abs(np.diff(exact, axis=axis))
        assert step.max() < 1.5 * true.max()


def test_records_without_a_place_are_refused() -> None:
    for wrong in ({"tolerance": 0.0}, {"max_share": 2.0}, {"coarsest": 12}):
        with pytest.raises(ValueError, match="tolerance|coarsest"):
            RecordSettings(**wrong)  # type: ignore[arg-type]


def test_neighbours_in_tile_order_face_alike() -> None:
    rng = np.random.default_rng(0)
    position = rng.random((2048, 3)).astype(np.float32)
    normal = np.eye(3, dtype=np.float32)[rng.integers(0, 3, 2048)]
    order = tile_order(position, normal)
    assert np.array_equal(np.sort(order), np.arange(2048))
    spread = np.mean([normal[order[t : t + 64]].std(axis=0).sum() for t in range(0, 2048, 64)])
    assert spread < 0.4 * normal.std(axis=0).sum()


@pytest.fixture(scope="module")
def room() -> tuple[Pipeline, list[Transport]]:
    parts = Pipeline(cornell(40, 40), n_gather=300, rays=4096)
    bounces = build_bounces(parts.snapshot, parts.tracer, parts.gather, rays_per_row=32)
    training = training_radiance(parts.snapshot, parts.tracer, parts.gather, bounces, 12)
    settings = RecordSettings(tolerance=0.01, max_share=0.7, coarsest=8)
    found = build_transports(
        parts.snapshot, parts.tracer, parts.view, parts.gather, training, settings=settings, rays_per_row=4096
    )
    return parts, list(found)


def test_transports_get_better_and_end_close_to_rows_at_every_pixel(room: tuple[Pipeline, list[Transport]]) -> None:
    parts, transports = room
    light = parts.gather.points.position[:, [0, 1, 2]] * 0.4 + 1
    exact = parts.transport.to_view(light)
    errors = [np.sqrt(np.mean((t.to_view(light) - exact) ** 2) / np.mean(exact**2)) for t in transports]
    assert errors[-1] < 0.02 and errors[-1] < 0.5 * errors[0]
    last = transports[-1]
    assert last.stream is None and len(last.row_view) < 0.7 * parts.view.n
    assert last.counts is not None and last.counts.diffuse.mean() <= 4096
    assert len(transports[0].row_view) < len(last.row_view)


def test_rows_of_records_are_those_of_the_plain_transport(room: tuple[Pipeline, list[Transport]]) -> None:
    parts, transports = room
    for transport in transports[-3:]:
        assert transport.counts is not None
        rows, checked = transport.lobes[0].rows, set()
        for row in range(0, rows.n_rows, 37):
            sample, n_rays = int(transport.row_view[row]), int(transport.counts.diffuse[row])
            points = take_points(parts.view.points, np.array([sample]))
            builder = RowBuilder(parts.snapshot, parts.tracer, parts.gather, 0)
            plain = builder.diffuse_rows(points, np.arange(2), np.array([sample]), n_rays, 0, silent, "")
            one = rows.rows(row, row + 1)
            assert np.array_equal(one.indices, plain.indices)
            np.testing.assert_allclose(one.weights, plain.weights, rtol=1e-6)
            checked.add(n_rays)
    assert len(checked) > 1


def test_allotted_rays_leave_less_noise_than_as_many_for_each_row() -> None:
    rng = np.random.default_rng(3)
    n_rows, n_cells = 192, 64
    # Row r sees a light cell with probability p_r, and is shown by `use` pixels.
    use = np.repeat([1, 4, 64], n_rows // 3)
    seen = rng.uniform(0.02, 0.5, n_rows).astype(np.float32)
    spread = SparseRows(
        np.arange(use.sum() + 1),
        np.repeat(np.arange(n_rows, dtype=np.int32), use),
        np.ones(use.sum(), np.float32),
        n_rows,
    )
    columns = np.tile(np.array([3, 40], np.int32), n_rows)
    rows = SparseRows(np.arange(n_rows + 1) * 2, columns, np.stack([seen, 1 - seen], 1).reshape(-1), n_cells)
    none = SparseRows.empty(n_rows, n_cells)
    light = np.zeros((n_cells, 1), np.float32)
    light[3] = 1
    tint = np.ones(use.sum(), np.float32)
    counts = allot_rays([rows, none, none], [tint] * 3, spread, light, np.empty(0, np.int64), 1024)
    assert counts.diffuse.mean() <= 1024 and not counts.specular.any()
    assert np.array_equal(counts.diffuse, 2 ** np.log2(counts.diffuse).astype(int))

    def noise(n: np.ndarray) -> float:
        one = spread.matmul(rng.binomial(n, seen)[:, None].astype(np.float32) / n[:, None].astype(np.float32))
        return float(np.mean((one[:, 0] - np.repeat(seen, use)) ** 2))

    allotted = np.mean([noise(counts.diffuse) for _ in range(40)])
    uniform = np.mean([noise(np.full(n_rows, 1024)) for _ in range(40)])
    assert allotted < 0.7 * uniform  # 0.58 with counts that are no powers of two


def test_no_rows_are_allotted_no_rays() -> None:
    none = SparseRows.empty(0, 4)
    tint, light = np.zeros(0, np.float32), np.ones((4, 2), np.float32)
    counts = allot_rays([none] * 3, [tint] * 3, SparseRows.empty(0, 0), light, np.empty(0, np.int64), 1024)
    assert counts.diffuse.shape == counts.specular.shape == (0,)


def test_little_light_crosses_a_thin_wall_under_a_light_that_was_not_known() -> None:
    white = Material(diffuse=0.7)
    around = box((4, 1, 4), (0, 0.5, 0), inward=True)
    meshes = [
        Mesh(box((2, 0.02, 4), (-1, -0.01, 0)), white, path="/bright"),
        Mesh(box((2, 0.02, 4), (1, -0.01, 0)), white, path="/dark"),
        Mesh(box((0.02, 1, 4), (0, 0.5, 0)), white, path="/wall"),
        Mesh(np.concatenate([around[:6], around[8:]]), white, path="/around"),
    ]
    camera = look_at((0, 5, 0.01), fov=50, width=48, height=48)
    parts = Pipeline(make_snapshot(meshes, camera=camera), n_gather=512, rays=2048)
    bounces = build_bounces(parts.snapshot, parts.tracer, parts.gather, rays_per_row=32)
    training = training_radiance(parts.snapshot, parts.tracer, parts.gather, bounces)
    settings = RecordSettings(max_share=0.2, coarsest=16)
    found = list(
        build_transports(
            parts.snapshot, parts.tracer, parts.view, parts.gather, training, settings=settings, rays_per_row=1024
        )
    )
    cells, points = parts.gather.points, parts.view.points
    light = (cells.position + 0.03 * cells.normal)[:, :1] < 0  # all surfaces of one room shine
    exact = parts.transport.to_view(np.repeat(light, 3, axis=1).astype(np.float32))[:, 0]
    x = (points.position + 0.03 * points.normal)[:, 0]
    beside = (x > 0) & (x < 0.3) & (points.normal[:, 1] > 0.9) & (points.position[:, 1] < 0.5)
    bright = exact[(x < 0) & (x > -0.3)].mean()
    assert beside.sum() > 100 and exact[beside].max() < 0.1 * bright

    def leaked(transport: Transport) -> F64:
        wrong: F64 = transport.to_view(np.repeat(light, 3, axis=1).astype(np.float32))[beside, 0] - exact[beside]
        return np.abs(wrong) / bright

    assert np.sqrt(np.mean(leaked(found[-1]) ** 2)) < 0.02 and leaked(found[-1]).max() < 0.15


def test_placement_has_the_same_bits_for_any_number_of_threads() -> None:
    scene = floor_scene()
    view = view_of(scene)
    found = []
    before = numba.get_num_threads()
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            found.append(place(scene, linear(view), view, coarsest=8)[-1])
    finally:
        numba.set_num_threads(before)
    one, two = found
    assert np.array_equal(one.view, two.view)
    for name in ("indptr", "indices", "weights"):
        assert np.array_equal(getattr(one.interpolation, name), getattr(two.interpolation, name))


def stripes() -> tuple[ViewSamples, F32, Records]:
    """A floor that six lights meet in two ways, three pixels wide each, by turns; and records that know neither."""
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=64, height=64))
    view = view_of(scene)
    x, z = view.points.position[:, 0], view.points.position[:, 2]
    stripe = view.pixel % view.width // 3 % 2 == 0
    lights = [np.where(stripe, 1 + 0.2 * np.sin(k * x + z), 0.1 + 0.5 * k + 0.1 * np.cos(k * z)) for k in range(6)]
    light = np.stack(lights, axis=1).astype(np.float32)
    records = place(scene, light, view, coarsest=4, tolerance=1.0, max_share=0.3)[0]
    return view, light, records


def test_fitted_weights_find_the_records_that_see_the_same() -> None:
    view, light, records = stripes()
    survey = diffuse_survey(np.stack([light, light], axis=1))
    tint = white(view)
    found = fit_weights(records, survey, tint)

    def error(records: Records) -> float:
        wrong = records.interpolation.matmul(light[records.view]) - light
        return float(np.sqrt(np.mean(wrong**2) / np.mean(light**2)))

    assert error(found) < 0.3 * error(records)
    spread = found.interpolation
    np.testing.assert_allclose(spread.row_sums(), 1, rtol=1e-5)
    assert spread.weights.min() > 0
    own = spread.matmul(np.arange(len(found.view), dtype=np.float32)[:, None])[found.view, 0]
    np.testing.assert_array_equal(own, np.arange(len(found.view)))
    row = np.repeat(np.arange(view.n), np.diff(spread.indptr))
    assert np.all((np.diff(spread.indices) > 0) | (np.diff(row) > 0))


def test_fitted_weights_take_no_light_from_another_object() -> None:
    # A shelf beside a floor. The lights known make patterns that both share, another meets the shelf alone.
    shelf = Mesh(quad(4), transforms=[translation(2, 0.15, 0)], path="/shelf")
    scene = make_snapshot([Mesh(quad(8), path="/floor"), shelf], camera=look_at((0, 5, 0.01), width=64, height=64))
    view = view_of(scene)
    stripe = view.pixel % view.width // 3 % 2
    lights = [1 + 0.8 * np.cos(k + 3 * stripe + view.points.position[:, 2]) for k in range(6)]
    light = np.stack(lights, axis=1).astype(np.float32)
    records = place(scene, light, view, coarsest=4, tolerance=1.0, max_share=0.3)[0]
    survey = diffuse_survey(np.stack([light, light], axis=1))
    tint = white(view)
    found = fit_weights(records, survey, tint)
    on_shelf = (view.points.instance == 1).astype(np.float32)[:, None]
    leaked = found.interpolation.matmul(on_shelf[found.view])[:, 0] - on_shelf[:, 0]
    assert 0.2 < on_shelf.mean() < 0.8
    assert (np.diff(found.interpolation.indptr) != np.diff(records.interpolation.indptr)).mean() > 0.05
    assert np.abs(leaked).max() < 1e-5


def test_a_thin_bright_bar_gets_records_of_its_own() -> None:
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=64, height=64))
    view = view_of(scene)
    column = view.pixel % view.width
    light = np.where(column == 21, 4.0, 0.3 + 0.2 * view.points.position[:, 0])[:, None].astype(np.float32)
    records = place(scene, light, view, coarsest=16, tolerance=0.01, max_share=0.1)[0]
    survey = diffuse_survey(np.stack([light, light], axis=1))
    tint = white(view)
    found = add_outliers(records, survey, tint, RecordSettings(tolerance=0.01, max_share=0.1))

    def error(records: Records) -> float:
        wrong = records.interpolation.matmul(light[records.view]) - light
        return float(np.sqrt(np.mean(wrong**2) / np.mean(light**2)))

    assert np.array_equal(found.view[: len(records.view)], records.view)
    bar = np.flatnonzero(column == 21)
    assert np.isin(bar, found.view).all() and len(found.view) < 0.1 * view.n
    np.testing.assert_allclose(found.interpolation.row_sums(), 1, rtol=1e-5)
    assert error(records) > 0.2 and error(found) < 0.01
    assert found.error == pytest.approx(error(found), rel=0.05, abs=1e-4)


def test_creases_have_records_for_lights_that_nobody_knew() -> None:
    scene = floor_scene(96, 72)
    view = view_of(scene)
    known = np.ones((view.n, 1), np.float32)
    records = place(scene, known, view, coarsest=16)[-1]
    survey = diffuse_survey(np.stack([known, known], axis=1))
    tint = white(view)
    found = add_outliers(records, survey, tint, RecordSettings(tolerance=0.001))
    in_crease = np.flatnonzero(records.mesh.corners < 0.5)
    new = found.view[len(records.view) :]
    assert 20 < len(in_crease) < 0.05 * view.n and np.isin(new, in_crease).all()
    # One that hangs in the crease, and meets what lies beside it in the image in another way.
    light = np.exp(-2 * records.mesh.corners)[:, None] * (1.5 + np.sin(view.pixel[:, None] * 2.0)).astype(np.float32)

    def squared(records: Records) -> float:
        return float(np.sum((records.interpolation.matmul(light[records.view]) - light) ** 2))

    assert squared(found) < 0.5 * squared(records)


def test_outliers_leave_noise_alone_and_keep_to_the_share() -> None:
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=64, height=64))
    view = view_of(scene)
    rng = np.random.default_rng(0)
    tint = white(view)
    flat = np.ones((view.n, 8), np.float32)
    records = place(scene, flat, view, coarsest=16)[-1]
    start = len(records.view)
    noisy = (flat[:, None] + 0.05 * rng.standard_normal((view.n, 2, 8))).astype(np.float32)
    quiet = add_outliers(records, diffuse_survey(noisy), tint, RecordSettings(tolerance=0.02))
    assert len(quiet.view) == start
    rough = np.repeat(rng.random((view.n, 1, 8)).astype(np.float32), 2, axis=1)
    full = add_outliers(records, diffuse_survey(rough), tint, RecordSettings(max_share=0.2))
    assert 0.19 * view.n < len(full.view) <= 0.2 * view.n


def test_a_mirror_among_rough_samples_gets_its_own_reflection() -> None:
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=32, height=32))
    view = view_of(scene)
    flat = np.ones((view.n, 2, 1), np.float32)
    records = place(scene, flat[:, 0], view, coarsest=16)[-1]
    glossy = np.setdiff1d(np.arange(300, 304), records.view)
    tint = np.ones((3, view.n), np.float32)
    survey = Survey(flat, glossy, np.full((len(glossy), 2, 2, 1), 5, np.float32))
    found = add_outliers(records, survey, tint, RecordSettings(max_share=0.5))
    assert np.isin(glossy, found.view).all()


def test_more_rays_find_what_few_leave_in_noise() -> None:
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=64, height=64))
    view = view_of(scene)
    rng = np.random.default_rng(3)
    bar = view.pixel % view.width == 21
    light = np.repeat(np.where(bar, 1.4, 1.0)[:, None], 8, axis=1).astype(np.float32)
    noise = np.where(bar, 1.5, 0.1)[:, None, None] * rng.standard_normal((view.n, 2, 8))
    few = diffuse_survey((light[:, None] + noise).astype(np.float32))
    records = place(scene, np.ones_like(light), view, coarsest=8)[-1]
    doubted = doubtful_samples(records, few, white(view), 0.1)
    assert np.isin(np.flatnonzero(bar & (records.mesh.record < 0)), doubted).all()
    settings = RecordSettings(tolerance=0.02, max_share=0.2)
    more = replace(few, close=doubted, closer=np.stack([light, light], axis=1)[doubted])
    again = place(scene, np.ones_like(light), view, coarsest=8)[-1]

    def error(records: Records) -> float:
        wrong = records.interpolation.matmul(light[records.view]) - light
        return float(np.sqrt(np.mean(wrong**2)))

    by_more = error(add_outliers(records, more, white(view), settings))
    by_few = error(add_outliers(again, few, white(view), settings))
    assert by_more < 0.02 and by_few > 2 * by_more, (by_more, by_few)


def test_what_many_rays_know_is_not_given_up_for_what_few_say() -> None:
    # Few rays show two neighbours alike and bright, of which the one by many rays is not.
    scene = make_snapshot([Mesh(quad(8))], camera=look_at((0, 3, 0.01), width=64, height=64))
    view = view_of(scene)
    seen = np.ones((view.n, 1), np.float32)
    records = place(scene, seen, view, coarsest=8)[-1]
    one = np.arange(20, 40, 5) * view.width + 21
    other = one + 1
    assert view.n == view.width * view.height and (records.mesh.record[[one, other]] < 0).all()
    seen[[one, other]] = 9
    few = diffuse_survey(np.stack([seen, seen], axis=1))
    used = [records.interpolation.indices[slice(*records.interpolation.indptr[k : k + 2])] for k in one]
    close = np.union1d(one, records.view[np.concatenate(used)])
    known = np.where(np.isin(close, one), 5, 1).astype(np.float32)
    many = replace(few, close=close, closer=np.repeat(known, 2).reshape(-1, 2, 1))
    found = add_outliers(records, many, white(view), RecordSettings(tolerance=1e-3, max_share=0.2))
    assert np.isin([one, other], found.view).all()


def test_weights_are_fitted_to_what_more_rays_saw() -> None:
    view, light, records = stripes()
    noise = 0.8 * np.random.default_rng(1).standard_normal((view.n, 2, 6))
    few = diffuse_survey((light[:, None] + noise).astype(np.float32))
    close = doubtful_samples(records, few, white(view), 0.5)
    many = replace(few, close=close, closer=np.stack([light, light], axis=1)[close])
    doubted = np.setdiff1d(close, records.view)

    def error(records: Records) -> float:
        wrong = (records.interpolation.matmul(light[records.view]) - light)[doubted]
        return float(np.sqrt(np.mean(wrong**2)))

    by_many, by_few = (fit_weights(records, survey, white(view)) for survey in (many, few))
    assert error(by_many) < 0.5 * error(by_few)
    # Those that few rays alone saw take no part, but where they did before.
    table, given = by_many.interpolation, records.interpolation
    unknown = ~np.isin(by_many.view, close)
    for sample in doubted:
        found = table.indices[table.indptr[sample] : table.indptr[sample + 1]]
        before = given.indices[given.indptr[sample] : given.indptr[sample + 1]]
        assert not np.setdiff1d(found[unknown[found]], before).size


def test_what_reflects_at_grazing_angles_alone_has_records_for_its_reflection() -> None:
    # A dielectric floor that mirrors one bright post among dark ones; it reflects 4 % where it is looked at from above.
    floor = Mesh(quad(6), Material(0.05, roughness=0.15, ior=1.5), path="/floor")
    posts = [
        Mesh(box((0.15, 1.5, 0.15)), Material(0.8), transforms=[translation(x, 0.75, -2)], path=f"/post{k}")
        for k, x in enumerate(np.linspace(-2, 2, 7))
    ]
    camera = look_at((0, 0.35, 3), (0, 0.1, -2), fov=45, width=64, height=48)
    parts = Pipeline(make_snapshot([floor, *posts], camera=camera), n_gather=512, rays=4096)
    scene = parts.snapshot, parts.tracer
    bounces = build_bounces(*scene, parts.gather, rays_per_row=32)
    training = training_radiance(*scene, parts.gather, bounces, 24)
    settings = RecordSettings(tolerance=0.01, max_share=0.6, coarsest=16)
    found = build_transports(*scene, parts.view, parts.gather, training, settings=settings, rays_per_row=1024)
    last = list(found)[-1]
    points = parts.view.points
    mirrors = points.instance == 0
    mirrors &= reflectance_to_eye(points, parts.view.to_eye).max(axis=1) >= 0.2
    light = np.where(parts.gather.points.instance == 4, 1.02, 0.02).astype(np.float32)
    light = np.repeat(light[:, None], 3, axis=1)
    exact = parts.transport.to_view(light)[mirrors]
    wrong = last.to_view(light)[mirrors] - exact
    assert mirrors.sum() > 500 and len(last.row_view) < 0.6 * parts.view.n
    assert np.sqrt(np.mean(wrong**2) / np.mean(exact**2)) < 0.05
