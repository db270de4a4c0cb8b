"""Bins of directions: the octahedral map of the sphere to a square, divided by a grid."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def octahedral_bin(x, y, z, n):  # type: ignore[no-untyped-def]
    """Bin of a direction of any length in an n by n grid, row by row; y is up, in the middle of the square.

    Cigolle et al. 2014, A Survey of Efficient Representations for Independent Unit Vectors, JCGT 3(2).
    """
    total = abs(x) + abs(y) + abs(z)
    scale = np.float32(0.5) / max(total, np.float32(1e-30))
    a, b = x * scale, z * scale
    half = np.float32(0.5)
    folded_a = half - abs(b)
    folded_b = half - abs(a)
    if y < np.float32(0.0):
        a, b = (folded_a if a >= np.float32(0.0) else -folded_a), (folded_b if b >= np.float32(0.0) else -folded_b)
    column = min(max(np.int32((a + half) * np.float32(n)), np.int32(0)), np.int32(n - 1))
    row = min(max(np.int32((b + half) * np.float32(n)), np.int32(0)), np.int32(n - 1))
    return row * np.int32(n) + column


@parallel_kernel
def bins_of_directions(directions, n, out):  # type: ignore[no-untyped-def]
    """Bins of directions (m, 3) in an n by n grid."""
    for i in prange(len(out)):
        out[i] = octahedral_bin(directions[i, 0], directions[i, 1], directions[i, 2], n)
