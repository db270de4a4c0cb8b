"""How much of an image the terms of each Haar coefficient can be, and how small those must be that do not count.

For light with few coefficients, as that of an edit of one object: a sample of
all terms would meet hardly any of its own.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

STEPS = 24  #: classes of terms of one coefficient by their worth: the next begins at twice the worth
_CLASSES = 512  # of terms of all coefficients: the next begins at the root of twice the square
_LOWEST = -384  # the first one begins at 2^-192: what is below is nothing
_TINY = np.float32(np.finfo(np.float32).tiny)


@kernel
def _step_of(size):  # type: ignore[no-untyped-def]
    """Class of a positive number: those of 2^k or more and less than 2^(k + 1) have k."""
    return np.int64(math.floor(math.log2(np.float64(size))))


@kernel
def sum_energies(index, worth, largest, energy):  # type: ignore[no-untyped-def]
    """Add squares of worths to those of their coefficients and classes.

    Parameters
    ----------
    index : (n,) int32, worth : (n,) float32
        Of a packed transport; see `icheat_usd.transport.PackedRows`.
    largest : float
        Largest worth: the last class begins there, and the first one holds all that is below the others.
    energy : (n_leaves, `STEPS`) float32
        Added to.
    """
    last = _step_of(largest)
    for i in range(len(index)):
        if worth[i] > 0:
            step = max(0, STEPS - 1 - last + _step_of(worth[i]))
            energy[index[i], step] += worth[i] * worth[i]


@parallel_kernel
def least_of_versions(versions, sizes, energy, largest, squared_error, share, least):  # type: ignore[no-untyped-def]
    """How large terms of some versions must be, so that squares of the smaller ones sum up to at most an error.

    Parameters
    ----------
    versions : (n,) int64
    sizes : (n_versions, n_leaves) float32
        Largest channels of each version's coefficients.
    energy, largest
        See `sum_energies`.
    squared_error : float
    share : (n_versions,) float64
        The error, or that share of the sum over all terms of the version, whichever is less.
    least : (n_versions,) float32
        Set for these versions: terms ``worth * size`` below may be left out. Infinite where all may, but the mean,
        which always stays.

    Notes
    -----
    Where any term of a class could be left out, all of it counts as if it were: the error is never larger than was
    asked for.
    """
    first = _step_of(largest) - (STEPS - 1)
    for i in prange(len(versions)):
        v = versions[i]
        sums = np.zeros(_CLASSES, np.float64)
        for k in range(1, sizes.shape[1]):
            size = sizes[v, k]
            if not size > 0:
                continue
            square, of_size = np.float64(size) * np.float64(size), math.log2(np.float64(size))
            for step in range(STEPS):
                some = energy[k, step]
                if some > 0:
                    lowest = np.int64(math.floor(2.0 * (of_size + np.float64(first + step)))) - _LOWEST
                    sums[min(max(lowest, 0), _CLASSES - 1) if step > 0 else 0] += square * some
        allowed = min(squared_error, share[v] * sums.sum())
        total, found = 0.0, np.inf
        for c in range(_CLASSES):
            total += sums[c]
            if total > allowed:
                found = 2.0 ** (0.5 * (c + _LOWEST))
                break
        least[v] = max(np.float32(found), _TINY)
