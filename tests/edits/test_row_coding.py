"""Sparse Haar rows: the stated bound holds for any row and any light, quantisation and truncation included."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from icheat_usd.edits.encodings.coding import CodedRows, ColumnsDiffer, RowCoder
from icheat_usd.edits.encodings.sampled import cell_begins, contract, needed_nodes, tree_shape
from icheat_usd.kernels import row_coding
from icheat_usd.samples.tree import ClusterTree, build_tree
from icheat_usd.samples.wavelets import haar_forward


def random_tree(n: int, seed: int) -> ClusterTree:
    """A lopsided tree of `n` leaves whose weights span four decades."""
    rng = np.random.default_rng(seed)
    sizes, ranges = [], [(0, n)]
    while ranges:
        begin, end = ranges.pop()
        if end - begin < 2:
            continue
        size = int(rng.integers(1, end - begin))
        sizes.append(size)
        ranges += [(begin + size, end), (begin, begin + size)]
    weight = 10.0 ** rng.uniform(-3, 1, n)
    return build_tree(tree_shape(np.array(sizes, np.int32), n), weight.astype(np.float32).astype(np.float64), b"")


def random_rows(n_rows: int, n: int, k: int, seed: int) -> np.ndarray:
    """Flat stretches, ramps, noise and rows that are 0."""
    rng = np.random.default_rng(seed)
    steps = np.repeat(rng.normal(0, 1, (n_rows, -(-n // 7), k)), 7, axis=1)[:, :n]
    ramp = np.linspace(-1, 1, n)[None, :, None] * rng.normal(0, 1, (n_rows, 1, k))
    kind = rng.integers(0, 4, (n_rows, 1, 1))
    noise = rng.normal(0, 1, (n_rows, n, k))
    return np.select([kind == 0, kind == 1, kind == 2], [steps, ramp, noise], 0.0).astype(np.float32)


def decode(tree: ClusterTree, coded: CodedRows) -> np.ndarray:
    known = np.maximum(coded.row_pattern, 0)
    out = np.zeros((len(known), tree.n_leaves, coded.row_step.shape[1]), np.float32)
    if len(coded.indptr) < 2:
        return out
    row_coding.decode_rows(
        tree.left,
        tree.right,
        tree.weight,
        tree.node_weight,
        coded.indptr,
        coded.indices,
        coded.numbers,
        coded.row_step,
        known.astype(np.int32),
        out,
    )
    return np.where(coded.row_pattern[:, None, None] < 0, 0, out)


def coded(tree: ClusterTree, values: np.ndarray, tolerance: float, n_kept: int | None = None) -> CodedRows:
    coder = RowCoder(tree, np.full(values.shape[2], tolerance), n_kept)
    half = len(values) // 2
    coder.add(values[:half])
    coder.add(values[half:])
    return coder.finish()


shapes = st.tuples(st.integers(1, 90), st.integers(0, 2**31), st.sampled_from([0.5, 0.1, 0.02, 0.001]))


@settings(max_examples=60, deadline=None)
@given(shape=shapes, n_kept=st.sampled_from([None, None, 0, 1, 5, 100]), light=st.integers(0, 2**31))
def test_light_is_off_by_at_most_the_stated_share_under_any_lighting(shape, n_kept, light):
    n, seed, tolerance = shape
    tree, values = random_tree(n, seed), random_rows(6, n, 3, seed)
    result = coded(tree, values, tolerance, n_kept)
    stated = result.error.max(axis=0)
    if n_kept is None:
        assert (stated <= tolerance * 1.001 + 1e-4 * np.abs(values).max()).all()
    decoded = decode(tree, result)
    assert (np.abs(decoded.astype(np.float64) - values).max(axis=(0, 1), initial=0) <= stated).all()
    # What leaves the gather samples and how it travels: anything that is not negative, also one leaf alone.
    rng = np.random.default_rng(light)
    arriving = rng.uniform(0, 1, (n, 3)) ** rng.integers(1, 40) * 10.0 ** rng.integers(-6, 7)
    off = np.einsum("rnc,nc->rc", decoded.astype(np.float64) - values, arriving)
    assert (np.abs(off) <= stated * arriving.sum(axis=0) * (1 + 1e-9)).all()


def test_all_coefficients_are_those_of_the_orthonormal_transform():
    tree, values = random_tree(40, 3), random_rows(1, 40, 1, 4)
    result = coded(tree, np.concatenate([values, values]), 0.0)
    exact = haar_forward(tree, values[0])[:, 0]
    a = np.where(tree.left < 0, tree.weight[np.maximum(-1 - tree.left, 0)], tree.node_weight[np.maximum(tree.left, 0)])
    b = tree.node_weight - a
    norm = np.concatenate([[np.sqrt(tree.weight.sum())], np.sqrt(a * b / (a + b))])
    found = np.zeros(40)
    found[result.indices] = result.numbers[:, 0] * float(result.row_step[0, 0])
    assert np.allclose(found * norm, exact, atol=float(result.row_step[0, 0]) * norm.max())


def test_more_coefficients_are_never_less_exact_in_the_mean_and_errors_are_stated_as_they_are():
    tree, values = random_tree(300, 5), random_rows(8, 300, 3, 6)
    squares = []
    for k in (5, 25, 100, 300):
        result = coded(tree, values, 0.0, k)
        off = decode(tree, result).astype(np.float64) - values
        squares.append(float((off**2 * tree.weight[None, :, None]).sum()))
        stated = result.error
        measured = np.abs(off).max(axis=1)
        assert (measured <= stated).all()
        assert (stated <= measured * 1.001 + 1e-5).all()
    assert squares == sorted(squares, reverse=True)


def test_rows_below_the_tolerance_are_the_identity_and_equal_ones_are_kept_once():
    tree = random_tree(64, 7)
    one = random_rows(1, 64, 3, 8) + np.float32(1)
    small = np.full_like(one, 0.009)
    result = coded(tree, np.concatenate([one, small, one, -small, one * 0]), 0.01)
    assert (result.row_pattern[[1, 3, 4]] == -1).all()
    assert result.row_pattern[0] == result.row_pattern[2] >= 0
    assert len(result.indptr) == 2
    assert result.error[1].max() == pytest.approx(0.009, rel=1e-4)


def test_channels_share_their_indices():
    tree = random_tree(64, 9)
    values = random_rows(4, 64, 3, 10)
    values[..., 1] = 0
    result = coded(tree, values, 0.05)
    assert result.numbers.shape == (len(result.indices), 3)
    assert not result.numbers[:, 1].any()
    assert (np.abs(decode(tree, result)[..., 1]) == 0).all()


@settings(max_examples=40, deadline=None)
@given(n=st.integers(1, 80), seed=st.integers(0, 2**31))
def test_walking_a_row_gives_the_bits_of_decoding_it(n, seed):
    tree, values = random_tree(n, seed), random_rows(6, n, 3, seed)
    result = coded(tree, values, 0.05)
    if len(result.indptr) < 2:
        return
    rows = np.flatnonzero(result.row_pattern >= 0).astype(np.int32)
    table = decode(tree, result)
    rng = np.random.default_rng(seed)
    pairs = 200
    mixture = rng.choice(np.append(np.arange(len(rows)), -1), (pairs, 4)).astype(np.int32)
    weights = rng.uniform(0, 1, (pairs, 4)).astype(np.float32)
    leaf = rng.integers(-1, n, pairs).astype(np.int32)
    fast, slow = np.empty((pairs, 3), np.float32), np.empty((pairs, 3), np.float32)
    row_coding.mix_decoded(np.ascontiguousarray(table[rows]), mixture, weights, leaf, fast)
    row_coding.mix_coded(
        tree.mid,
        tree.left,
        tree.right,
        tree.weight,
        tree.node_weight,
        result.indptr,
        result.indices,
        result.numbers,
        result.row_step[rows],
        result.row_pattern[rows],
        mixture,
        weights,
        leaf,
        slow,
    )
    assert np.array_equal(fast, slow)
    expected = np.zeros((pairs, 3))
    for q in range(pairs):
        for s in range(4):
            if mixture[q, s] >= 0 and leaf[q] >= 0:
                expected[q] += float(weights[q, s]) * table[rows[mixture[q, s]], leaf[q]]
    assert np.allclose(fast, expected, atol=1e-5)


def test_contracting_a_tree_keeps_ranges_and_order():
    tree = random_tree(50, 11)
    rng = np.random.default_rng(12)
    keep = rng.uniform(size=50) < 0.4
    smaller = contract(tree.lo, tree.mid, tree.hi, keep)
    shape = tree_shape(smaller.split_size, len(smaller.first))
    assert np.array_equal(smaller.first, np.flatnonzero(keep))
    kept = {
        tuple(np.flatnonzero(keep[lo:hi]) + lo)
        for lo, mid, hi in zip(tree.lo, tree.mid, tree.hi, strict=True)
        if keep[lo:mid].any() and keep[mid:hi].any()
    }
    assert {tuple(smaller.first[lo:hi]) for lo, hi in zip(shape.lo, shape.hi, strict=True)} == kept


def test_cells_are_where_no_coefficient_divides():
    tree = random_tree(50, 13)
    indices = np.array([0, 1, 1 + 7], np.int32)
    needed = needed_nodes(tree, indices)
    begins = cell_begins(tree, needed)
    for node in range(49):
        inside = begins[tree.lo[node] + 1 : tree.hi[node]].any()
        assert inside == needed[node]


@pytest.mark.parametrize("sizes", [[0], [2], [1, 1], [1, 5, 1], [-1, 1, 1]])
def test_splits_that_are_no_tree_are_refused(sizes):
    with pytest.raises(ValueError, match="binary tree"):
        tree_shape(np.array(sizes, np.int32), 2 if len(sizes) < 3 else 4)


def test_columns_said_to_be_alike_are_coded_once_and_checked():
    tree = random_tree(64, 14)
    values = random_rows(4, 64, 6, 15)
    values[..., 1] = values[..., 0]
    values[..., 3:] = 0
    alike = np.array([0, 0, 2, -1, -1, -1])
    coder = RowCoder(tree, np.full(6, 0.05), alike=alike)
    coder.add(values)
    assert np.array_equal(decode(tree, coder.finish()), decode(tree, coded(tree, values, 0.05)))
    for broken in (1, 4):
        other = values.copy()
        other[2, 5, broken] += 1
        with pytest.raises(ColumnsDiffer):
            RowCoder(tree, np.full(6, 0.05), alike=alike).add(other)
