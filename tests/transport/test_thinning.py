"""Thinned rows against the rows that they stand for."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.transport import SparseRows
from icheat_usd.transport.sparse import concatenate_rows
from icheat_usd.transport.thinning import thin_rows

_COLUMNS = 900


def _rows(n_rows: int, entries: int, seed: int = 0) -> SparseRows:
    """Rows of so many entries, some of which are many times as large as others."""
    rng = np.random.default_rng(seed)
    indices = np.stack([np.sort(rng.choice(_COLUMNS, entries, replace=False)) for _ in range(n_rows)])
    weights = rng.pareto(2, (n_rows, entries)) + 0.1
    weights /= weights.sum(axis=1, keepdims=True)
    indptr = np.arange(n_rows + 1, dtype=np.int64) * entries
    return SparseRows(indptr, indices.ravel().astype(np.int32), weights.ravel().astype(np.float32), _COLUMNS)


def _repeated(rows: SparseRows, times: int) -> SparseRows:
    """One row many times."""
    return SparseRows(
        np.arange(times + 1, dtype=np.int64) * rows.n_entries,
        np.tile(rows.indices, times),
        np.tile(rows.weights, times),
        rows.n_columns,
    )


def _importance(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.2, 5, _COLUMNS).astype(np.float32)


def test_rows_of_few_entries_stay_as_they_are() -> None:
    rows = _rows(20, 32)
    thin = thin_rows(rows, 32, _importance())
    for name in ("indptr", "indices", "weights"):
        np.testing.assert_array_equal(getattr(thin, name), getattr(rows, name))


@pytest.mark.parametrize("n", [8, 64, 200])
def test_rows_are_those_of_plain_loops(n: int) -> None:
    """Beside sizes that are sorted to find the step, and every whole number that their sum passes."""
    rows, importance = _rows(50, 300), _importance()
    thin = thin_rows(rows, n, importance)
    for r in range(rows.n_rows):
        columns, weights = (a[300 * r : 300 * (r + 1)] for a in (rows.indices, rows.weights.astype(np.float64)))
        size = weights * importance[columns]
        falling = np.sort(size)[::-1]
        # the first number of large ones with which the next is below the step that the others have
        steps = [falling[k:].sum() / (n - k) for k in range(n)]
        step = next(step for k, step in enumerate(steps) if falling[k] < step)
        large = size >= step
        passed = np.floor(np.cumsum(np.where(large, 0, size / step)) + ((r + 0.5) * 0.6180339887498949) % 1.0)
        picked = np.diff(passed, prepend=0) > 0
        kept = large | picked
        first, last = thin.indptr[r], thin.indptr[r + 1]
        assert abs(last - first - n) <= 1
        np.testing.assert_array_equal(thin.indices[first:last], columns[kept])
        wanted = np.where(large, weights, step / importance[columns])[kept]
        np.testing.assert_allclose(thin.weights[first:last], wanted, rtol=1e-5)


def test_products_are_right_in_the_mean_whatever_they_multiply() -> None:
    """Of a row four thousand times, each with a beginning of its own."""
    row = _rows(1, 400)
    light = np.random.default_rng(2).exponential(size=(_COLUMNS, 3)).astype(np.float32)
    light[:40] *= 50
    thin = thin_rows(_repeated(row, 4000), 48, _importance()).matmul(light)
    np.testing.assert_allclose(thin.mean(axis=0), row.matmul(light)[0], rtol=2e-3)
    assert thin.std(axis=0).min() > 0.02 * thin.mean()


def test_light_like_the_importance_has_little_noise() -> None:
    rows, importance = _rows(400, 400), _importance()
    thin = thin_rows(rows, 48, importance)

    def error(light: np.ndarray) -> float:
        true = rows.matmul(light[:, None])
        return float(np.sqrt(((thin.matmul(light[:, None]) - true) ** 2).mean() / (true**2).mean()))

    assert error(importance) < 1e-6
    little = 1 + 0.05 * np.random.default_rng(3).standard_normal(_COLUMNS).astype(np.float32)
    assert error(importance * little) < 0.1 * error(np.ascontiguousarray(importance[::-1]))


def test_noise_of_successive_rows_is_not_the_same() -> None:
    """The mean of many rows that are alike is closer to the truth than chance would have it."""
    row = _rows(1, 400)
    light = np.random.default_rng(4).exponential(size=(_COLUMNS, 1)).astype(np.float32)
    thin, true = thin_rows(_repeated(row, 4096), 48, _importance()).matmul(light), row.matmul(light)[0]
    means = thin.reshape(-1, 16).mean(axis=1)
    assert np.sqrt(((means - true) ** 2).mean()) < 0.6 * np.sqrt(((thin - true) ** 2).mean() / 16)


def test_parts_of_a_matrix_are_thinned_as_the_whole_is() -> None:
    rows, importance = _rows(100, 200), _importance()
    whole = thin_rows(rows, 32, importance)
    cuts = [0, 7, 60, 100]
    parts = [
        thin_rows(rows.rows(first, last), 32, importance, first)
        for first, last in zip(cuts[:-1], cuts[1:], strict=True)
    ]
    joined = concatenate_rows(parts, _COLUMNS)
    for name in ("indptr", "indices", "weights"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(whole, name))


def test_threads_make_no_difference() -> None:
    rows, importance = _rows(300, 200), _importance()
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = thin_rows(rows, 32, importance)
    finally:
        numba.set_num_threads(threads)
    two = thin_rows(rows, 32, importance)
    for name in ("indptr", "indices", "weights"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_rows_without_entries_have_none() -> None:
    thin = thin_rows(SparseRows.empty(3, _COLUMNS), 8, _importance())
    assert thin.shape == (3, _COLUMNS) and thin.n_entries == 0
