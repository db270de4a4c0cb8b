"""Distances between points: their powers, their mean."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

_BLOCK = 1024


@parallel_kernel
def distance_powers(a, b, unit, least, power, out):  # type: ignore[no-untyped-def]
    """``max(|a - b| / unit, least) ** power`` of n pairs of points; `a` and `b` (n or 1, 3) float32."""
    n = len(out)
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        _distance_powers(block * _BLOCK, min(n, (block + 1) * _BLOCK), a, b, unit, least, power, out)


@kernel
def _distance_powers(first, end, a, b, unit, least, power, out):  # type: ignore[no-untyped-def]
    for q in range(first, end):
        i = q if len(a) > 1 else 0
        j = q if len(b) > 1 else 0
        x, y, z = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1], a[i, 2] - b[j, 2]
        distance = np.sqrt(x * x + y * y + z * z)
        out[q] = max(distance / unit, least) ** power


@kernel
def mean_distance(a, b):  # type: ignore[no-untyped-def]
    """Mean over all pairs of two sets of points, (n, 3) and (m, 3) float64."""
    total = 0.0
    for i in range(len(a)):
        of_one = 0.0
        for j in range(len(b)):
            x, y, z = b[j, 0] - a[i, 0], b[j, 1] - a[i, 1], b[j, 2] - a[i, 2]
            of_one += np.sqrt(x * x + y * y + z * z)
        total += of_one / len(b)
    return total / len(a)
