"""Sparse matrices of transport weights, by rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
    def shape(self) -> tuple[int, int]:
        return self.n_rows, self.n_columns

    def matmul(self, b: F32) -> F32:
        """Product with `b` (n_columns, k): (n_rows, k). Bitwise the same for any number of threads."""
        raise NotImplementedError

    def row_sums(self) -> F32:
        """Sum of the weights of each row: (n_rows,)."""
        return self.matmul(np.ones((self.n_columns, 1), np.float32))[:, 0]
