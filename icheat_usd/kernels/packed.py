"""Products of quantised transport tiles with the light of gather cells.

Two ways of the same product: `multiply_tiles` with float32 sums, and
`multiply_paired_tiles`, which rounds the light to 16 bits per tile and sums
integers exactly; it takes the quanta of two coefficients at a time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import (
    add_dot,
    address_of,
    as_floats,
    black,
    fetch,
    larger_size,
    load,
    load_color,
    load_int8,
    load_spread,
    multiply_add,
    no_sum,
    plus_size,
    product,
    rounded_pairs,
    scaled,
    spread_pair,
    store_color,
    store_colors,
    store_words,
    widen,
    zeros,
)

LANES = 64  # rows of a tile: four vectors of sums for each of three channels stay in registers
_PARTS = 32  # runs of equal work: threads take equal shares of the parts, one behind the other
_LARGEST_WORD = 32767.0
_LARGEST_SUM = 2.0**31 / 128 * (1 - 1e-3)  # of the sizes of a tile's words: no sum with quanta overflows 32 bits


class PairedTiles(NamedTuple):
    """Quantised tiles as `multiply_paired_tiles` reads them."""

    tile_begin: NDArray[np.int64]  #: (n_tiles + 1,) even numbers
    index: NDArray[np.int32]  #: (n,)
    scale: NDArray[np.float32]  #: (n,) 0 where a tile was filled up
    value: NDArray[np.int8]  #: (n / 2, 64, 2)


def pair_coefficients(
    tile_begin: NDArray[np.int64],
    index: NDArray[np.int32],
    scale: NDArray[np.float32],
    value: NDArray[np.int8],
) -> PairedTiles:
    """Put the quanta (n, 64) of every two successive coefficients of a tile side by side."""
    counts = np.diff(tile_begin)
    begin = np.concatenate([[0], np.cumsum(counts + counts % 2)]).astype(np.int64)
    place = np.arange(len(index)) + np.repeat(begin[:-1] - tile_begin[:-1], counts)
    n = int(begin[-1])
    paired_index, paired_scale = np.zeros(n, np.int32), np.zeros(n, np.float32)
    quanta = np.zeros((n // 2, LANES, 2), np.int8)
    paired_index[place], paired_scale[place] = index, scale
    quanta[place // 2, :, place % 2] = value
    return PairedTiles(begin, paired_index, paired_scale, quanta)


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
def _scale_pairs(begin, end, index, scale, value, coefficients, even, odd, bounds):  # type: ignore[no-untyped-def]
    """As `_scale_coefficients`, every second one apart; the largest size and the sum of sizes go to `bounds` (2, 4)."""
    source, targets = address_of(coefficients), (address_of(even), address_of(odd))
    quanta = address_of(value) + LANES * begin
    largest_even = largest_odd = sum_even = sum_odd = black()
    offset = 0
    for k in range(np.uint64(begin), np.uint64(end), np.uint64(2)):
        fetch(quanta + 8 * offset)
        fetch(quanta + 8 * offset + 64)
        a = scaled(load_color(source + 16 * np.int64(index[k])), scale[k])
        b = scaled(load_color(source + 16 * np.int64(index[k + np.uint64(1)])), scale[k + np.uint64(1)])
        store_color(targets[0] + offset, a)
        store_color(targets[1] + offset, b)
        largest_even, sum_even = larger_size(largest_even, a), plus_size(sum_even, a)
        largest_odd, sum_odd = larger_size(largest_odd, b), plus_size(sum_odd, b)
        offset += 16
    store_color(address_of(bounds), larger_size(largest_even, largest_odd))
    store_color(address_of(bounds) + 16, plus_size(sum_even, sum_odd))


@kernel
def choose_steps(n, bounds, steps, per_step):  # type: ignore[no-untyped-def]
    """Units (4,) of the words of each channel, and four times their inverse, for `n` coefficients."""
    for i in range(16):
        c = i % 4
        steps[c] = max(bounds[0, c] / _LARGEST_WORD, bounds[1, c] / (_LARGEST_SUM - n))
        per_step[i] = 1.0 / steps[c] if steps[c] > 0.0 else 0.0


@kernel
def round_pairs(n, even, odd, per_step, pairs):  # type: ignore[no-untyped-def]
    """`n` pairs of colours in steps, as int16; whole vectors, so up to three pairs more."""
    factor = load(address_of(per_step))
    for offset in range(0, 16 * n, 64):
        a, b = load(address_of(even) + offset), load(address_of(odd) + offset)
        store_words(address_of(pairs) + offset, rounded_pairs(product(a, factor), product(b, factor)))


@kernel
def _multiply_pairs(begin, end, value, pairs, steps, out):  # type: ignore[no-untyped-def]
    """One tile times one version, in integers."""
    r0 = r1 = r2 = r3 = g0 = g1 = g2 = g3 = b0 = b1 = b2 = b3 = no_sum()
    quanta, place = address_of(value) + LANES * begin, address_of(pairs)
    for _ in range(begin, end, 2):
        r, g, b = spread_pair(place), spread_pair(place + 4), spread_pair(place + 8)
        x = widen(quanta)
        r0, g0, b0 = add_dot(x, r, r0), add_dot(x, g, g0), add_dot(x, b, b0)
        x = widen(quanta + 32)
        r1, g1, b1 = add_dot(x, r, r1), add_dot(x, g, g1), add_dot(x, b, b1)
        x = widen(quanta + 64)
        r2, g2, b2 = add_dot(x, r, r2), add_dot(x, g, g2), add_dot(x, b, b2)
        x = widen(quanta + 96)
        r3, g3, b3 = add_dot(x, r, r3), add_dot(x, g, g3), add_dot(x, b, b3)
        quanta += 2 * LANES
        place += 16
    r, g, b = steps[0], steps[1], steps[2]
    place = address_of(out)
    store_colors(place, as_floats(r0, r), as_floats(g0, g), as_floats(b0, b))
    store_colors(place + 256, as_floats(r1, r), as_floats(g1, g), as_floats(b1, b))
    store_colors(place + 512, as_floats(r2, r), as_floats(g2, g), as_floats(b2, b))
    store_colors(place + 768, as_floats(r3, r), as_floats(g3, g), as_floats(b3, b))


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
    if part == _PARTS or len(cost_end) == 0:
        return len(cost_end)
    return np.searchsorted(cost_end, cost_end[-1] * part / _PARTS, side="right")


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


@kernel
def _multiply_paired_run(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, value, coefficients, pair_tile, pair_version, first, last, out
):
    """Pairs `first` to `last`, in integers."""
    room = _most_coefficients(tile_begin, pair_tile, first, last) // 2 + 4  # `round_pairs` works in whole vectors
    space = np.empty((3 * room + 7, 4), np.float32)  # one allocation: six cost as much as a tile
    even, odd, pairs = space[:room], space[room : 2 * room], space[2 * room : 3 * room]
    bounds, steps, per_step = space[3 * room : 3 * room + 2], space[3 * room + 2], space[3 * room + 3 :].reshape(16)
    for p in range(first, last):
        begin, end = tile_begin[pair_tile[p]], tile_begin[pair_tile[p] + 1]
        _scale_pairs(begin, end, index, scale, value, coefficients[pair_version[p]], even, odd, bounds)
        choose_steps(end - begin, bounds, steps, per_step)
        round_pairs((end - begin) // 2, even, odd, per_step, pairs)
        _multiply_pairs(begin, end, value, pairs, steps, out[p])


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
    for part in prange(_PARTS):
        first, last = share(cost_end, part), share(cost_end, part + 1)
        _multiply_run(tile_begin, index, scale, value, coefficients, pair_tile, pair_version, first, last, out)


@parallel_kernel
def multiply_paired_tiles(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, value, coefficients, pair_tile, pair_version, out
):
    """`multiply_tiles` with the light of each tile rounded to 16 bits, in about two thirds of the time.

    Parameters
    ----------
    value : (n / 2, 64, 2) int8
        Quanta of successive coefficients side by side. Every tile has an even
        number of coefficients; one of scale 0 may fill up. The others as in `multiply_tiles`.

    Notes
    -----
    Rounding moves a product by at most half a step for each coefficient, the
    step being the largest |scale * coefficient| of the tile and channel / 32767
    (or slightly more, where 32 bits could overflow): small against the half
    quantum that the transport was rounded by. Sums of integers are exact.
    """
    cost_end = sum_costs(tile_begin, pair_tile)
    for part in prange(_PARTS):
        first, last = share(cost_end, part), share(cost_end, part + 1)
        _multiply_paired_run(tile_begin, index, scale, value, coefficients, pair_tile, pair_version, first, last, out)
