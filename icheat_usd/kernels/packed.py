"""Products of quantised transport tiles with the light of gather cells, with float32 sums."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import (
    address_of,
    fetch,
    load_color,
    load_int8,
    load_spread,
    multiply_add,
    scaled,
    store_color,
    store_colors,
    zeros,
)

LANES = 64  # rows of a tile: four vectors of sums for each of three channels stay in registers
PARTS = 32  #: runs of equal work: threads take equal shares of the parts, one behind the other


@kernel
def _scale_coefficients(begin, end, index, scale, value, coefficients, colors):  # type: ignore[no-untyped-def]
    """The colours that the quanta of one tile multiply, (n, 4); meanwhile the quanta come into the cache."""
    source, target = address_of(coefficients), address_of(colors)
    quanta = address_of(value) + LANES * begin
    for k in range(np.uint64(begin), np.uint64(end)):
        fetch(quanta)
        store_color(target, scaled(load_color(source + 16 * np.int64(index[k])), scale[k]))
        target += 16
        quanta += LANES


@kernel
def _multiply_one(begin, end, value, colors, out):  # type: ignore[no-untyped-def]
    """One tile times one version."""
    r0 = r1 = r2 = r3 = g0 = g1 = g2 = g3 = b0 = b1 = b2 = b3 = zeros()
    quanta, place = address_of(value) + LANES * begin, address_of(colors)
    for _ in range(begin, end):
        r, g, b = load_spread(place), load_spread(place + 4), load_spread(place + 8)
        x = load_int8(quanta)
        r0, g0, b0 = multiply_add(x, r, r0), multiply_add(x, g, g0), multiply_add(x, b, b0)
        x = load_int8(quanta + 16)
        r1, g1, b1 = multiply_add(x, r, r1), multiply_add(x, g, g1), multiply_add(x, b, b1)
        x = load_int8(quanta + 32)
        r2, g2, b2 = multiply_add(x, r, r2), multiply_add(x, g, g2), multiply_add(x, b, b2)
        x = load_int8(quanta + 48)
        r3, g3, b3 = multiply_add(x, r, r3), multiply_add(x, g, g3), multiply_add(x, b, b3)
        quanta += LANES
        place += 16
    place = address_of(out)
    store_colors(place, r0, g0, b0)
    store_colors(place + 256, r1, g1, b1)
    store_colors(place + 512, r2, g2, b2)
    store_colors(place + 768, r3, g3, b3)


@kernel
def sum_costs(tile_begin, pair_tile):  # type: ignore[no-untyped-def]
    """Work up to and with each pair (n,)."""
    total = 0
    cost_end = np.empty(len(pair_tile), np.int64)
    for p in range(len(pair_tile)):
        total += tile_begin[pair_tile[p] + 1] - tile_begin[pair_tile[p]] + 8
        cost_end[p] = total
    return cost_end


@kernel
def share(cost_end, part):  # type: ignore[no-untyped-def]
    """First item of a part when items are divided into runs of equal cost; `cost_end` (n,) sums the costs."""
    if part == PARTS or len(cost_end) == 0:
        return len(cost_end)
    return np.searchsorted(cost_end, cost_end[-1] * part / PARTS, side="right")


@kernel
def _most_coefficients(tile_begin, pair_tile, first, last):  # type: ignore[no-untyped-def]
    most = 0
    for p in range(first, last):
        most = max(most, tile_begin[pair_tile[p] + 1] - tile_begin[pair_tile[p]])
    return most


@kernel
def _multiply_run(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, value, coefficients, pair_tile, pair_version, first, last, out
):
    """Pairs `first` to `last`."""
    colors = np.empty((_most_coefficients(tile_begin, pair_tile, first, last), 4), np.float32)
    for p in range(first, last):
        begin, end = tile_begin[pair_tile[p]], tile_begin[pair_tile[p] + 1]
        _scale_coefficients(begin, end, index, scale, value, coefficients[pair_version[p]], colors)
        _multiply_one(begin, end, value, colors, out[p])


@parallel_kernel
def multiply_tiles(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, value, coefficients, pair_tile, pair_version, out
):
    """Rows of tiles times versions of the light.

    Parameters
    ----------
    tile_begin : (n_tiles + 1,) int64
        First coefficient of each tile.
    index : (n,) int32
        Row of `coefficients`.
    scale : (n,) float32
        Value of one quantum.
    value : (n, 64) int8
        Quanta, one column per row of the tile.
    coefficients : (n_versions, m, 4) float32
        Colour of each Haar coefficient and a pad.
    pair_tile, pair_version : (n_pairs,) int32
        What to multiply with what; faster where pairs of one tile are neighbours.
    out : (n_pairs, 64, 4) float32
        Products; the pad is 0.

    Notes
    -----
    Sums run in the order of the tile's coefficients, so a product has the same
    bits whatever other pairs or threads there are.
    """
    cost_end = sum_costs(tile_begin, pair_tile)
    for part in prange(PARTS):
        first, last = share(cost_end, part), share(cost_end, part + 1)
        _multiply_run(tile_begin, index, scale, value, coefficients, pair_tile, pair_version, first, last, out)
