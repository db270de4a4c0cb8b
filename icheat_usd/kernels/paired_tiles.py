"""Quantised transport tiles as `tile_product` reads them, which multiplies two coefficients at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import parallel_kernel
from icheat_usd.kernels.packed import LANES


class QuantisedTiles(NamedTuple):
    """Tiles of 64 rows with one coefficient after another."""

    tile_begin: NDArray[np.int64]  #: (n_tiles + 1,)
    index: NDArray[np.int32]  #: (n,)
    scale: NDArray[np.float32]  #: (n,)
    worth: NDArray[np.float32]  #: (n,) what a coefficient counts
    value: NDArray[np.int8]  #: (n, 64) quanta


class PairedTiles(NamedTuple):
    """The same with the quanta of every two successive coefficients of a tile side by side."""

    tile_begin: NDArray[np.int64]  #: (n_tiles + 1,) even numbers
    index: NDArray[np.int32]  #: (n,)
    scale: NDArray[np.float32]  #: (n,) 0 where a tile was filled up
    worth: NDArray[np.float32]  #: (n,) 0 where a tile was filled up
    value: NDArray[np.int8]  #: (n / 2, 64, 2)


def pair_tiles(lobes: list[QuantisedTiles]) -> PairedTiles:
    """Tiles of several lobes as paired tiles of one, those of the first lobe first."""
    counts = np.concatenate([np.diff(lobe.tile_begin) for lobe in lobes])
    begin = np.concatenate([[0], np.cumsum(counts + counts % 2)]).astype(np.int64)
    n, first = int(begin[-1]), 0
    index, (scale, worth) = np.zeros(n, np.int32), np.zeros((2, n), np.float32)
    value = np.zeros((n // 2, LANES, 2), np.int8)
    for lobe in lobes:
        _pair_tiles(*lobe, begin[first:], index, scale, worth, value)
        first += len(lobe.tile_begin) - 1
    return PairedTiles(begin, index, scale, worth, value)


@parallel_kernel
def _pair_tiles(tile_begin, index, scale, worth, value, begin, out_index, out_scale, out_worth, out_value):  # type: ignore[no-untyped-def]
    """Tiles to places from `begin` on; what fills a tile up is 0 already."""
    for t in prange(len(tile_begin) - 1):
        source, target, n = tile_begin[t], begin[t], tile_begin[t + 1] - tile_begin[t]
        for k in range(n):
            out_index[target + k] = index[source + k]
            out_scale[target + k] = scale[source + k]
            out_worth[target + k] = worth[source + k]
        for pair in range(n // 2):
            out = out_value[target // 2 + pair]
            one, two = value[source + 2 * pair], value[source + 2 * pair + 1]
            for lane in range(LANES):
                out[lane, 0], out[lane, 1] = one[lane], two[lane]
        if n % 2:
            for lane in range(LANES):
                out_value[target // 2 + n // 2, lane, 0] = value[source + n - 1, lane]
