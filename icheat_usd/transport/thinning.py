"""Rows of few entries that stand for rows of many."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels import thinning as kernels
from icheat_usd.scene import F32
from icheat_usd.transport.sparse import SparseRows


def thin_rows(rows: SparseRows, n: int, importance: F32, first_row: int = 0) -> SparseRows:
    """Rows of about `n` entries each at most, whose products are right in the mean whatever they multiply.

    Entries are as large as their weight times the importance of their column. Large ones stay as they are; others
    stay with a probability in proportion to their size, and then stand for what is as large as all of them that the
    step to the next one passes (systematic sampling with probability proportional to size [1]_, in the order of the
    columns, so that what stands for something is near it). The product with the importance itself stays what it is,
    up to one step of a row, and is close for what is like it.

    Parameters
    ----------
    importance : (n_columns,) float32
        Above 0.
    first_row : int
        Number of the first row, where `rows` are some of a matrix: a row is thinned the same, whatever it comes with.

    References
    ----------
    .. [1] Madow 1949, On the Theory of Systematic Sampling, II, Annals of Mathematical Statistics 20(3).
    """
    given = first_row, rows.indptr, rows.indices, rows.weights, importance
    steps, counts = np.empty(rows.n_rows, np.float64), np.empty(rows.n_rows, np.int64)
    kernels.count_kept(*given, n, steps, counts)
    indptr = np.concatenate([[0], np.cumsum(counts)])
    out = SparseRows(indptr, np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32), rows.n_columns)
    kernels.keep(*given, steps, out.indptr, out.indices, out.weights)
    return out
