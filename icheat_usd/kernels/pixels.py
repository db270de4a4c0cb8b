"""Sums of view samples over their pixels."""

from __future__ import annotations

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import parallel_kernel


@parallel_kernel
def sum_samples(
    begin: NDArray[np.int64],
    throughput: NDArray[np.float32],
    values: NDArray[np.float32],
    pixel: NDArray[np.int64],
    out: NDArray[np.float64],
) -> None:
    """``out[pixel[p]]`` = sum over samples ``begin[p]:begin[p + 1]`` of `values` (n, k), one after the other.

    They are multiplied by `throughput` (n, k) in float32 first, unless it has no rows.
    """
    for p in prange(len(pixel)):
        for c in range(values.shape[1]):
            total = 0.0
            for i in range(begin[p], begin[p + 1]):
                value = values[i, c]
                if len(throughput) > 0:
                    value *= throughput[i, c]
                total += value
            out[pixel[p], c] = total
