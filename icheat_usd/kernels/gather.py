"""Random numbers of gather paths."""

from __future__ import annotations

from numba import prange

from icheat_usd.kernels._jit import parallel_kernel
from icheat_usd.kernels.random import uniform


@parallel_kernel
def uniforms(seed, index, out):  # type: ignore[no-untyped-def]
    """Independent numbers in [0, 1), one for each of `index` (n,)."""
    for i in prange(len(index)):
        out[i] = uniform(seed, index[i], 0)
