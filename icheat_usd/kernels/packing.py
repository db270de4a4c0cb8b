"""Packing of sparse rows into tiles of shared Haar coefficients, and the plain product with them."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel


@parallel_kernel
def multiply_tiles(tile_begin, index, scale, value, coefficients, out):  # type: ignore[no-untyped-def]
    """Rows (n_tiles * lanes, k) of `out` = tiles times coefficients (m, k)."""
    lanes, k = value.shape[1], coefficients.shape[1]
    for t in prange(len(tile_begin) - 1):
        sums = np.zeros((k, lanes), np.float32)
        for e in range(tile_begin[t], tile_begin[t + 1]):
            for c in range(k):
                factor = scale[e] * coefficients[index[e], c]
                for r in range(lanes):
                    sums[c, r] += factor * np.float32(value[e, r])
        for r in range(lanes):
            for c in range(k):
                out[t * lanes + r, c] = sums[c, r]
