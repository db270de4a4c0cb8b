"""Some of a row's entries in place of all: the large ones, and of the others one for each step of their sum."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

# Where the steps of a row begin: successive rows, which are much alike, stand in for what the others leave out. None
# begins at 0, as rounding would decide on its last one.
_GOLDEN = 0.6180339887498949


@kernel
def _step(first: int, last: int, indices: np.ndarray, weights: np.ndarray, importance: np.ndarray, n: int) -> float:
    """Size of entries from which on they are kept, so that about `n` are; 0 where there are no more."""
    if last - first <= n:
        return 0.0
    step, n_large = 0.0, -1
    while True:
        count, others = 0, 0.0
        for e in range(first, last):
            size = np.float64(weights[e]) * importance[indices[e]]
            if n_large >= 0 and size >= step:
                count += 1
            else:
                others += size
        # What is large stays so, as the step shrinks when it leaves the sum; but for rounding.
        if count <= n_large or count >= n:
            return step
        n_large, step = count, others / (n - count)


@kernel
def _start(row: int) -> float:
    """Where along its steps a row begins."""
    return ((row + 0.5) * _GOLDEN) % 1.0


@kernel
def _stays(size: float, step: float, along: float) -> tuple[bool, float]:
    """Whether an entry stays, and how far along the steps the next one begins."""
    if size < step:
        along += size / step
        if along < 1.0:
            return False, along
        along -= 1.0
    return True, along


@parallel_kernel
def count_kept(
    first_row: int, indptr: np.ndarray, indices: np.ndarray, weights: np.ndarray, importance: np.ndarray, n: int,
    steps: np.ndarray, counts: np.ndarray,
) -> None:  # fmt: skip
    """Step and number of entries that `keep` writes of each row; see there."""
    for r in prange(len(counts)):
        first, last = indptr[r], indptr[r + 1]
        step = _step(first, last, indices, weights, importance, n)
        along, count = _start(first_row + r), 0
        for e in range(first, last):
            stays, along = _stays(np.float64(weights[e]) * importance[indices[e]], step, along)
            count += stays
        steps[r], counts[r] = step, count


@parallel_kernel
def keep(
    first_row: int, indptr: np.ndarray, indices: np.ndarray, weights: np.ndarray, importance: np.ndarray,
    steps: np.ndarray, out_indptr: np.ndarray, out_indices: np.ndarray, out_weights: np.ndarray,
) -> None:  # fmt: skip
    """Entries as large as the step of their row, and others by their share of a step, with what they stand for.

    Parameters
    ----------
    first_row : number of the first row here
    indptr (n_rows + 1,) int64, indices (n,) int32, weights (n,) float32, importance (n_columns,) float32
        Rows; an entry's size is its weight times the importance of its column.
    steps : (n_rows,) float64
    out_indptr (n_rows + 1,) int64, out_indices (m,) int32, out_weights (m,) float32
    """
    for r in prange(len(steps)):
        step, along, to = steps[r], _start(first_row + r), out_indptr[r]
        for e in range(indptr[r], indptr[r + 1]):
            size = np.float64(weights[e]) * importance[indices[e]]
            stays, along = _stays(size, step, along)
            if stays:
                out_indices[to] = indices[e]
                out_weights[to] = step / importance[indices[e]] if size < step else weights[e]
                to += 1
