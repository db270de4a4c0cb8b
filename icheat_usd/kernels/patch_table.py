"""Patches of surface by their keys, in a table that is open to new ones: how many paths each has, and their light.

A key is hashed already, so its last bits are where the search for it begins. Patches are asked for in the order of
hits by one thread: who comes first does not depend on the threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel

_CHUNK = 4096  # hits that a thread takes


class PatchTable(NamedTuple):
    """Rows of a table, a power of two of them."""

    key: NDArray[np.uint64]  #: (room,)
    number: NDArray[np.int32]  #: (room,) of paths that were asked for; -1: there is no patch
    total: NDArray[np.float64]  #: (room, 3) radiance of the paths that were taken


@kernel
def _row_of(keys, number, key):  # type: ignore[no-untyped-def]
    """Row of a patch, or where there is room for it."""
    last = np.uint64(len(keys) - 1)
    row = key & last
    while number[row] >= 0 and keys[row] != key:
        row = (row + np.uint64(1)) & last
    return row


@kernel
def ask(keys, number, used, key, first, most, is_wanted):  # type: ignore[no-untyped-def]
    """Which hits need a path, so that no patch gets more than `most`; they count as taken.

    Parameters
    ----------
    keys, number
        Columns of `PatchTable`, `used` rows of which hold a patch.
    key : (n,) uint64
        Patches of the hits, of which those from `first` on are asked for.
    is_wanted : (n,) bool, out

    Returns
    -------
    (int, int)
        The first hit that is left because the table is half full, n where none is; and rows that are used now.
    """
    for hit in range(first, len(key)):
        row = _row_of(keys, number, key[hit])
        if number[row] < 0:
            if 2 * used >= len(keys):
                return hit, used
            keys[row] = key[hit]
            number[row] = 0
            used += 1
        is_wanted[hit] = number[row] < most
        number[row] += is_wanted[hit]
    return len(key), used


@kernel
def move_patches(keys, number, total, to_keys, to_number, to_total):  # type: ignore[no-untyped-def]
    """Put what a table knows into a larger one, which is empty."""
    for row in range(len(keys)):
        if number[row] >= 0:
            to = _row_of(to_keys, to_number, keys[row])
            to_keys[to], to_number[to] = keys[row], number[row]
            for c in range(3):
                to_total[to, c] = total[row, c]


@kernel
def add_light(keys, number, total, key, light):  # type: ignore[no-untyped-def]
    """Add the radiance `light` (n, 3) of paths from patches `key` (n,), which have been asked for."""
    for path in range(len(key)):
        row = _row_of(keys, number, key[path])
        for c in range(3):
            total[row, c] += np.float64(light[path, c])


@parallel_kernel
def mean_light(keys, number, total, key, out):  # type: ignore[no-untyped-def]
    """Mean radiance of the paths of patches `key` (n,), each of which has some, to `out` (n, 3)."""
    n = len(key)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        for hit in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            row = _row_of(keys, number, key[hit])
            for c in range(3):
                out[hit, c] = total[row, c] / number[row]
