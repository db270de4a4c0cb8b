"""Sparse matrices of transport weights, by rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels import rows as kernels
from icheat_usd.scene import F32, I32, I64


@dataclass(frozen=True)
class SparseRows:
    """A matrix in compressed rows: row `i` holds entries ``indptr[i]:indptr[i + 1]``, columns ascending."""

    indptr: I64  #: (n_rows + 1,)
    indices: I32  #: (n_entries,) columns
    weights: F32  #: (n_entries,)
    n_columns: int

    @property
    def n_rows(self) -> int:
        return len(self.indptr) - 1

    @property
    def n_entries(self) -> int:
        return len(self.indices)

    @property
    def shape(self) -> tuple[int, int]:
        return self.n_rows, self.n_columns

    @classmethod
    def empty(cls, n_rows: int, n_columns: int) -> SparseRows:
        """All zero."""
        return cls(np.zeros(n_rows + 1, np.int64), np.empty(0, np.int32), np.empty(0, np.float32), n_columns)

    def matmul(self, b: F32) -> F32:
        """Product with a dense matrix, bitwise the same for any number of threads.

        Parameters
        ----------
        b : (n_columns, k) float32

        Returns
        -------
        (n_rows, k) float32

        Raises
        ------
        ValueError
            `b` has another number of rows than this matrix has columns.
        """
        if b.ndim != 2 or len(b) != self.n_columns:
            raise ValueError(f"the right side of a product with {self.shape} rows has shape {b.shape}")
        b = np.require(b, np.float32, ["C", "W"])
        out = np.empty((self.n_rows, b.shape[1]), np.float32)
        product = kernels.rows_times_3 if b.shape[1] == 3 else kernels.rows_times
        product(self.indptr, self.indices, self.weights, b, out)
        return out

    def row_sums(self) -> F32:
        """Sum of the weights of each row: (n_rows,)."""
        out = np.empty(self.n_rows, np.float32)
        kernels.row_sums(self.indptr, self.weights, out)
        return out

    def rows(self, begin: int, end: int) -> SparseRows:
        """Rows ``begin:end`` as a matrix of their own."""
        first, last = self.indptr[begin], self.indptr[end]
        return SparseRows(
            self.indptr[begin : end + 1] - first, self.indices[first:last], self.weights[first:last], self.n_columns
        )


def concatenate_rows(parts: list[SparseRows], n_columns: int) -> SparseRows:
    """Stack matrices on top of each other; `parts` is emptied on the way, so memory never holds two copies."""
    counts = [part.n_entries for part in parts]
    indptr = np.zeros(sum(part.n_rows for part in parts) + 1, np.int64)
    indices = np.empty(sum(counts), np.int32)
    weights = np.empty(sum(counts), np.float32)
    row = entry = 0
    parts.reverse()
    while parts:
        part = parts.pop()
        indptr[row + 1 : row + part.n_rows + 1] = part.indptr[1:] + entry
        indices[entry : entry + part.n_entries] = part.indices
        weights[entry : entry + part.n_entries] = part.weights
        row += part.n_rows
        entry += part.n_entries
    return SparseRows(indptr, indices, weights, n_columns)


def add_shares(a: SparseRows, of_a: float, b: SparseRows, of_b: float, of_sum: float) -> SparseRows:
    """Sum of two matrices of counts that were divided: ``(a * of_a + b * of_b) / of_sum``.

    Exact in the counts while none is above `of_a` or `of_b`, and these are at most 2^23: rounded to float32,
    a share is off by at most 2^-24 of itself.

    Parameters
    ----------
    of_a, of_b, of_sum
        What the counts of each matrix were divided by, and those of the sum will be.
    """
    counts = np.empty(a.n_rows, np.int64)
    kernels.count_union(a.indptr, a.indices, b.indptr, b.indices, counts)
    indptr = np.concatenate([[0], np.cumsum(counts)])
    out = SparseRows(indptr, np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32), a.n_columns)
    kernels.add_shares(
        a.indptr,
        a.indices,
        a.weights,
        float(of_a),
        b.indptr,
        b.indices,
        b.weights,
        float(of_b),
        float(of_sum),
        out.indptr,
        out.indices,
        out.weights,
    )
    return out


def placed_rows(parts: list[tuple[I64, SparseRows, I64]], n_rows: int, n_columns: int) -> SparseRows:
    """One matrix of parts of others: places in it, each named once, a matrix, and its rows that belong there.

    Rows that nothing belongs to are empty.
    """
    count = np.zeros(n_rows, np.int64)
    for place, rows, which in parts:
        count[place] = rows.indptr[which + 1] - rows.indptr[which]
    indptr = np.concatenate([[0], np.cumsum(count)])
    out = SparseRows(indptr, np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32), n_columns)
    for place, rows, which in parts:
        source, begin = rows.indptr[which], indptr[place]
        kernels.copy_rows(source, count[place], begin, rows.indices, rows.weights, out.indices, out.weights)
    return out


def select_rows(base: SparseRows, other: SparseRows, rows: I64, of_other: I64) -> SparseRows:
    """`base`, its `rows`, each named once, replaced by the rows `of_other` of another matrix, whose width it gets."""
    kept = np.ones(base.n_rows, np.bool_)
    kept[rows] = False
    left = np.flatnonzero(kept)
    return placed_rows([(left, base, left), (rows, other, of_other)], base.n_rows, other.n_columns)


def take_rows(rows: SparseRows, which: I64) -> SparseRows:
    """Some rows of a matrix, in the order given."""
    return placed_rows([(np.arange(len(which)), rows, which)], len(which), rows.n_columns)
