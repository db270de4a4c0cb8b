"""Products of chosen rows of a sparse matrix."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel


@parallel_kernel
def multiply_rows(indptr, indices, weights, rows, b, out):  # type: ignore[no-untyped-def]
    """``out[k] = matrix[rows[k]] @ b`` for `b` (n_columns, 3); each row is summed serially."""
    for k in prange(len(rows)):
        row = rows[k]
        red = np.float32(0)
        green = np.float32(0)
        blue = np.float32(0)
        for entry in range(indptr[row], indptr[row + 1]):
            weight = weights[entry]
            column = indices[entry]
            red += weight * b[column, 0]
            green += weight * b[column, 1]
            blue += weight * b[column, 2]
        out[k, 0] = red
        out[k, 1] = green
        out[k, 2] = blue
