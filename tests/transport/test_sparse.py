"""Sparse products against dense ones."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.transport import SparseRows
from icheat_usd.transport.rays import scatter_rows
from icheat_usd.transport.sparse import concatenate_rows, placed_rows, select_rows, take_rows


def random_rows(n_rows: int, n_columns: int, seed: int = 0) -> tuple[SparseRows, np.ndarray]:
    rng = np.random.default_rng(seed)
    dense = np.where(rng.random((n_rows, n_columns)) < 0.15, rng.random((n_rows, n_columns)), 0).astype(np.float32)
    dense[n_rows // 2] = 0
    row, column = np.nonzero(dense)
    indptr = np.searchsorted(row, np.arange(n_rows + 1)).astype(np.int64)
    return SparseRows(indptr, column.astype(np.int32), dense[row, column], n_columns), dense


@pytest.mark.parametrize("k", [1, 2, 3, 7])
def test_product_equals_the_dense_one(k: int) -> None:
    rows, dense = random_rows(40, 90)
    b = np.random.default_rng(1).random((90, k)).astype(np.float32)
    np.testing.assert_allclose(rows.matmul(b), dense @ b, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows.row_sums(), dense.sum(1), rtol=1e-6)


def test_product_has_the_same_bits_for_any_number_of_threads() -> None:
    rows, _ = random_rows(500, 90)
    b = np.random.default_rng(1).random((90, 3)).astype(np.float32)
    both = []
    for threads in (1, 2):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        both.append(rows.matmul(b))
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert np.array_equal(*both)


def test_product_refuses_the_wrong_number_of_columns() -> None:
    rows, _ = random_rows(4, 9)
    with pytest.raises(ValueError, match="shape"):
        rows.matmul(np.zeros((8, 3), np.float32))


def test_parts_of_a_matrix_stack_up_to_it_again() -> None:
    rows, _ = random_rows(40, 90)
    again = concatenate_rows([rows.rows(0, 7), rows.rows(7, 7), rows.rows(7, 40)], 90)
    assert np.array_equal(again.indptr, rows.indptr)
    assert np.array_equal(again.indices, rows.indices)
    assert np.array_equal(again.weights, rows.weights)


def dense_of(rows: SparseRows) -> np.ndarray:
    return rows.matmul(np.eye(rows.n_columns, dtype=np.float32))


def test_rows_are_taken_replaced_and_placed() -> None:
    rows, dense = random_rows(40, 90)
    other, of_other = random_rows(30, 90, seed=1)
    which = np.array([3, 39, 3, 20, 0])
    assert np.array_equal(dense_of(take_rows(rows, which)), dense[which])

    places, of = np.array([1, 0, 39]), np.array([29, 4, 15])
    expected = dense.copy()
    expected[places] = of_other[of]
    assert np.array_equal(dense_of(select_rows(rows, other, places, of)), expected)

    apart = placed_rows([(places, other, of), (np.array([7]), rows, np.array([12]))], 41, 90)
    expected = np.zeros((41, 90), np.float32)
    expected[places], expected[7] = of_other[of], dense[12]
    assert np.array_equal(dense_of(apart), expected)
    assert np.array_equal(dense_of(scatter_rows([(np.arange(0, 80, 2), rows)], 80, 90))[::2], dense)
