"""Packed rows against the exact ones."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.kernels.packing import Light, _refit_tile
from icheat_usd.samples import ClusterTree
from icheat_usd.samples.tree import build_tree, split_samples
from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32
from icheat_usd.transport import PackedTransport, SparseRows, Transport, lossless, residual
from icheat_usd.transport.build import Lobe
from icheat_usd.transport.packed import LargeTerms
from icheat_usd.transport.packing import pack_on_tree

N_LEAVES, N_ROWS = 900, 300  # four tiles and a part of one


def small_tree() -> tuple[ClusterTree, F32]:
    """A tree over two walls of a unit box and one leaf besides, and where its leaves are."""
    rng = np.random.default_rng(4)
    position = rng.random((N_LEAVES, 3)).astype(np.float32)
    begin = np.array([0, 400, N_LEAVES - 1, N_LEAVES], np.int64)
    position[:400, 0], position[400:, 1] = 0, 0
    shape = split_samples([("a",), ("b",), ("c",)], begin, position, np.zeros((N_LEAVES, 3), np.float32))
    return build_tree(shape, rng.uniform(0.5, 1.5, N_LEAVES), b""), position[shape.order]


def smooth_rows(position: F32, seed: int = 0) -> SparseRows:
    """Rows like those of points along a line through the box: hits of random rays, more of them where it is near."""
    rng = np.random.default_rng(seed)
    indptr, indices, weights = [0], [], []
    for along in np.linspace(0.1, 0.9, N_ROWS):
        squared = np.sum((position - np.float32([along, 0.4, 0.5])) ** 2, axis=1) + 0.05
        share = 1 / squared**2
        count = rng.multinomial(512, share / share.sum() * 0.9999)[:N_LEAVES]
        hit = np.flatnonzero(count)
        indices.append(hit)
        weights.append(count[hit] / 512)
        indptr.append(indptr[-1] + len(hit))
    return SparseRows(
        np.array(indptr, np.int64),
        np.concatenate(indices).astype(np.int32),
        np.concatenate(weights).astype(np.float32),
        N_LEAVES,
    )


def lights(position: F32, n: int, seed: int) -> F32:
    """Point lights in the box: (n, n_leaves)."""
    rng = np.random.default_rng(seed)
    place = rng.uniform(0.15, 0.85, (n, 3)).astype(np.float32)
    return 1 / (0.01 + np.sum((position[None] - place[:, None]) ** 2, axis=2))


def transport_of(rows: SparseRows) -> Transport:
    tint = np.random.default_rng(7).uniform(0.2, 1, (N_ROWS, 3)).astype(np.float32)
    return Transport((Lobe("diffuse", rows, tint),), np.arange(N_ROWS, dtype=np.int32), None)


def error(packed: PackedTransport, exact: Transport, light: F32) -> float:
    b = np.repeat(light[:, None], 3, axis=1)
    difference = packed.to_view(b) - exact.to_view(b)
    return float(np.sqrt(np.mean(difference**2) / np.mean(exact.to_view(b) ** 2)))


@pytest.fixture(scope="module")
def scene() -> tuple[ClusterTree, F32, Transport]:
    tree, position = small_tree()
    return tree, position, transport_of(smooth_rows(position))


def test_all_coefficients_unrounded_are_the_exact_product(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    rows = transport.lobes[0].rows
    packed = lossless(rows, tree)
    b = lights(position, 3, 1).T.copy()
    exact = rows.matmul(b)
    assert np.sqrt(np.mean((packed.matmul(b) - exact) ** 2) / np.mean(exact**2)) < 1e-6
    assert packed.value.shape[1] == 64
    assert packed.n_tiles == 5
    last = packed.value[packed.tile_begin[4] :]
    assert not last[:, N_ROWS - 256 :].any()


def test_lights_that_were_not_trained_on_are_about_as_far_off_as_asked_for(
    scene: tuple[ClusterTree, F32, Transport],
) -> None:
    tree, position, transport = scene
    training, others = lights(position, 24, 2), lights(position, 24, 3)
    sizes = []
    for tolerance in (0.04, 0.01):
        packed = pack_on_tree(transport, tree, training, tolerance)
        assert packed.report is not None
        assert packed.report.error == pytest.approx(tolerance, rel=0.2)
        measured = np.array([error(packed, transport, light) for light in others])
        assert np.median(measured) < 1.25 * tolerance
        # What was trained on is better than when it is left out.
        trained = np.array([error(packed, transport, light) for light in training])
        assert np.median(trained) < packed.report.error
        sizes.append(packed.n_bytes)
    assert sizes[0] < sizes[1]


def test_what_is_spare_is_kept_until_the_error_is_a_third_less(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    training = lights(position, 24, 2)

    def packed(spare: int) -> PackedTransport:
        return pack_on_tree(transport, tree, training, 0.003, spare=spare)

    def n_kept(found: PackedTransport) -> float:
        rows = found.lobes[0].rows
        return len(rows.index) / rows.n_tiles

    plain, finest = packed(0), packed(10 * tree.n_leaves)
    assert plain.report is not None and finest.report is not None
    assert finest.report.error == pytest.approx(0.7 * 0.003, rel=0.2)
    assert n_kept(finest) > 1.1 * n_kept(plain)
    # Where so many are kept anyway, it makes no difference.
    same = packed(int(0.5 * n_kept(plain))).lobes[0].rows
    for name in ("tile_begin", "index", "scale", "value"):
        np.testing.assert_array_equal(getattr(same, name), getattr(plain.lobes[0].rows, name))
    between = packed(int((n_kept(plain) + n_kept(finest)) / 2))
    assert n_kept(plain) < n_kept(between) < n_kept(finest)


def test_lights_that_the_view_hardly_sees_do_not_tell_how_much_to_keep(
    scene: tuple[ClusterTree, F32, Transport],
) -> None:
    """Beams onto cells that hardly any ray meets: none knows another's, so each would be wrong by all that there is."""
    tree, position, _ = scene
    rows = smooth_rows(position)
    hidden = np.arange(100, 130)
    rows = replace(rows, weights=rows.weights * np.where(np.isin(rows.indices, hidden), np.float32(1e-4), 1))
    transport = transport_of(rows)
    training = lights(position, 24, 2)
    beams = np.full((len(hidden), N_LEAVES), 1e-9, np.float32)
    beams[np.arange(len(hidden)), hidden] = 10
    alone, both = (pack_on_tree(transport, tree, some, 0.03) for some in (training, np.concatenate([training, beams])))
    assert alone.report is not None and both.report is not None
    assert len(both.report.light_error) == len(alone.report.light_error) == 24
    assert both.report.error == pytest.approx(0.03, rel=0.2)
    # Where nothing but such beams is known, they do.
    only = pack_on_tree(transport, tree, beams, 0.03)
    assert only.report is not None and len(only.report.light_error) == len(hidden)


def test_uniform_light_stays_right_however_little_is_kept(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    packed = pack_on_tree(transport, tree, lights(position, 8, 2), 0.2)
    assert error(packed, transport, np.ones(N_LEAVES, np.float32)) < 5e-5


def test_no_rows_are_packed_to_nothing(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    (lobe,) = transport.lobes
    none = replace(transport, lobes=(replace(lobe, rows=lobe.rows.rows(0, 0), tint=lobe.tint[:0]),))
    packed = pack_on_tree(replace(none, row_view=none.row_view[:0]), tree, lights(position, 8, 2), 0.01)
    assert len(packed.lobes[0].rows.index) == 0
    b = np.ones((N_LEAVES, 3), np.float32)
    assert packed.lobes[0].rows.matmul(b).shape == (0, 3)


def test_residual_makes_a_light_exact(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    packed = pack_on_tree(transport, tree, lights(position, 8, 2), 0.1)
    b = np.repeat(lights(position, 1, 5)[0][:, None], 3, axis=1)
    (lost,) = residual(packed, b)
    assert np.abs(lost).max() > 0
    np.testing.assert_allclose(
        packed.lobes[0].rows.matmul(b) + lost, transport.lobes[0].rows.matmul(b), rtol=1e-6, atol=1e-6
    )


def test_residuals_of_lights_add_up_with_their_gains(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    packed = pack_on_tree(transport, tree, lights(position, 8, 2), 0.1)
    size = np.ones(N_LEAVES, np.float32)
    narrow = packed.narrowed(size, packed.n_bytes // 3)
    each = [np.repeat(light[:, None], 3, axis=1) for light in lights(position, 2, 5)]
    gains = np.array([[2, 0.5, 0], [0.25, 1, 3]], np.float32)
    total = sum(gain * b for gain, b in zip(gains, each, strict=True))
    apart = sum(gain * residual(narrow, b)[0] for gain, b in zip(gains, each, strict=True))
    exact = transport.lobes[0].rows.matmul(total)
    np.testing.assert_allclose(narrow.lobes[0].rows.matmul(total) + apart, exact, rtol=2e-6, atol=2e-6 * exact.max())
    assert np.abs(apart).max() > 1e-3 * exact.max()


def test_narrowed_to_a_light_it_serves_that_light_better_than_another(
    scene: tuple[ClusterTree, F32, Transport],
) -> None:
    tree, position, transport = scene
    packed = pack_on_tree(transport, tree, lights(position, 24, 2), 0.005)
    two = lights(position, 2, 6)
    narrow = [
        packed.narrowed(np.abs(haar_forward(tree, light)).astype(np.float32), packed.n_bytes // 2) for light in two
    ]
    for i in (0, 1):
        assert narrow[i].n_bytes < 0.51 * packed.n_bytes
        assert error(packed, transport, two[i]) < error(narrow[i], transport, two[i])
        assert error(narrow[i], transport, two[i]) < 0.8 * error(narrow[1 - i], transport, two[i])
        assert error(narrow[i], transport, np.ones(N_LEAVES, np.float32)) < 5e-5


def test_packing_has_the_same_bits_for_any_number_of_threads(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    both = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        rows = pack_on_tree(transport, tree, lights(position, 8, 2), 0.05).lobes[0].rows
        both.append((rows, rows.matmul(lights(position, 2, 9).T.copy())))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    for name in ("tile_begin", "index", "scale", "value"):
        assert np.array_equal(getattr(both[0][0], name), getattr(both[1][0], name))
    assert np.array_equal(both[0][1], both[1][1])


def test_empty_lobes_pack_to_nothing(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    empty = Lobe("specular_base", SparseRows.empty(N_ROWS, N_LEAVES), transport.lobes[0].tint)
    both = Transport((*transport.lobes, empty), transport.row_view, None)
    packed = pack_on_tree(both, tree, lights(position, 8, 2), 0.05)
    assert not len(packed.lobes[1].rows.index)
    assert packed.lobes[1].rows.matmul(np.ones((N_LEAVES, 3), np.float32)).shape == (N_ROWS, 3)
    alone = pack_on_tree(transport, tree, lights(position, 8, 2), 0.05)
    b = np.repeat(lights(position, 1, 5)[0][:, None], 3, axis=1)
    assert np.array_equal(packed.to_view(b), alone.to_view(b))


def test_training_light_of_other_cells_is_refused(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    with pytest.raises(ValueError, match="gather samples"):
        pack_on_tree(transport, tree, lights(position, 8, 2)[:, 1:], 0.05)


def test_what_is_left_out_of_a_light_is_a_share_of_its_terms(scene: tuple[ClusterTree, F32, Transport]) -> None:
    tree, position, transport = scene
    packed = pack_on_tree(transport, tree, lights(position, 8, 2), 0.02)
    size = np.abs(haar_forward(tree, lights(position, 1, 5)[0])).astype(np.float32)
    rows = packed.lobes[0].rows
    terms = np.sort((rows.worth * size[rows.index])[rows.index != 0])
    for share in (0.001, 0.1):
        least = LargeTerms(packed, 10**9).least_of_error(size, np.inf, 10**12, share)
        left_out = np.count_nonzero(terms < np.float32(least))
        squares = np.cumsum(terms.astype(np.float64) ** 2) / np.sum(terms.astype(np.float64) ** 2)
        assert squares[left_out - 1] <= share < squares[left_out]


@pytest.mark.parametrize("n_lights", [1, 16, 37])
def test_kept_coefficients_stand_in_for_others_by_ridge_regression(n_lights: int) -> None:
    rng = np.random.default_rng(n_lights)
    light = rng.normal(size=(400, n_lights)).astype(np.float32)
    alone = rng.uniform(0.1, 2, 400).astype(np.float32)
    index = np.sort(np.append(rng.choice(np.arange(1, 400), 150, replace=False), 0)).astype(np.int32)
    value = rng.normal(size=(len(index), 64)).astype(np.float32)
    exact = rng.normal(scale=20, size=(n_lights, 64)).astype(np.float32)

    kept = light[index].astype(np.float64)
    weighted = kept / alone[index, None]
    weighted[0] = 0  # the root stays as it is
    lost = exact - kept.T @ value
    share = np.linalg.solve(weighted.T @ kept + n_lights * np.eye(n_lights), lost)
    expected = value + weighted @ share

    refitted = value.copy()
    _refit_tile(Light(light, alone, alone), index, refitted, exact.copy())
    np.testing.assert_allclose(refitted, expected, rtol=1e-4, atol=1e-4)
    assert np.abs(refitted - value).max() > 0.1
    assert np.array_equal(refitted[0], value[0])
