"""Products of quantised transport tiles with the light of gather cells, of the terms that are large in this light.

Which coefficients of a tile matter depends on the light: many are there for
lights at other places. An index and a worth tell how large a term is; the
quanta of small ones are not read.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packed import LANES, choose_steps, round_pairs, share, sum_costs
from icheat_usd.kernels.simd import (
    add_dot,
    address_of,
    as_floats,
    black,
    fetch,
    larger_size,
    load,
    load_color,
    no_sum,
    plus_size,
    scaled,
    spread_pair,
    store,
    store_color,
    store_colors,
    store_large,
    widen_two,
)

_PARTS = 32


@kernel
def _find_large(begin, end, index, worth, size, least, number):  # type: ignore[no-untyped-def]
    """Numbers of the coefficients whose terms are `least` or more, and how many they are."""
    count = 0
    indices, worths, sizes, numbers = address_of(index), address_of(worth), address_of(size), address_of(number)
    whole = begin + (end - begin) // 16 * 16
    for k in range(begin, whole, 16):
        count += store_large(indices + 4 * k, worths + 4 * k, sizes, least, k, numbers + 4 * count)
    for k in range(whole, end):
        if size[index[k]] * worth[k] >= least:
            number[count] = k
            count += 1
    return count


@kernel
def _scale_large(count, number, index, scale, value, coefficients, even, odd, bounds):  # type: ignore[no-untyped-def]
    """Colours that the quanta multiply, every second one apart; largest size and sum of sizes to `bounds` (2, 4)."""
    source, targets, quanta = address_of(coefficients), (address_of(even), address_of(odd)), address_of(value)
    largest_even = largest_odd = sum_even = sum_odd = black()
    offset = 0
    for i in range(0, count, 2):
        k, other = np.int64(number[i]), np.int64(number[i + 1])
        fetch(quanta + LANES * k)
        fetch(quanta + LANES * other)
        a = scaled(load_color(source + 16 * np.int64(index[k])), scale[k])
        b = scaled(load_color(source + 16 * np.int64(index[other])), scale[other])
        if i + 1 == count:
            b = black()
        store_color(targets[0] + offset, a)
        store_color(targets[1] + offset, b)
        largest_even, sum_even = larger_size(largest_even, a), plus_size(sum_even, a)
        largest_odd, sum_odd = larger_size(largest_odd, b), plus_size(sum_odd, b)
        offset += 16
    store_color(address_of(bounds), larger_size(largest_even, largest_odd))
    store_color(address_of(bounds) + 16, plus_size(sum_even, sum_odd))


@kernel
def _multiply_large(count, number, value, pairs, steps, out):  # type: ignore[no-untyped-def]
    """One tile times one version, in integers."""
    r0 = r1 = r2 = r3 = g0 = g1 = g2 = g3 = b0 = b1 = b2 = b3 = no_sum()
    quanta, place = address_of(value), address_of(pairs)
    for i in range(0, count, 2):
        k, other = quanta + LANES * np.int64(number[i]), quanta + LANES * np.int64(number[i + 1])
        r, g, b = spread_pair(place), spread_pair(place + 4), spread_pair(place + 8)
        x = widen_two(k, other)
        r0, g0, b0 = add_dot(x, r, r0), add_dot(x, g, g0), add_dot(x, b, b0)
        x = widen_two(k + 16, other + 16)
        r1, g1, b1 = add_dot(x, r, r1), add_dot(x, g, g1), add_dot(x, b, b1)
        x = widen_two(k + 32, other + 32)
        r2, g2, b2 = add_dot(x, r, r2), add_dot(x, g, g2), add_dot(x, b, b2)
        x = widen_two(k + 48, other + 48)
        r3, g3, b3 = add_dot(x, r, r3), add_dot(x, g, g3), add_dot(x, b, b3)
        place += 16
    r, g, b = steps[0], steps[1], steps[2]
    place = address_of(out)
    store_colors(place, as_floats(r0, r), as_floats(g0, g), as_floats(b0, b))
    store_colors(place + 256, as_floats(r1, r), as_floats(g1, g), as_floats(b1, b))
    store_colors(place + 512, as_floats(r2, r), as_floats(g2, g), as_floats(b2, b))
    store_colors(place + 768, as_floats(r3, r), as_floats(g3, g), as_floats(b3, b))


@kernel
def _multiply_run(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, worth, value, coefficients, size, least, pair_tile, pair_version, first, last, out
):
    """Pairs `first` to `last`."""
    most = 0
    for p in range(first, last):
        most = max(most, tile_begin[pair_tile[p] + 1] - tile_begin[pair_tile[p]])
    number = np.empty(most + 18, np.int32)
    room = most // 2 + 5  # `round_pairs` works in whole vectors
    space = np.empty((3 * room + 7, 4), np.float32)
    even, odd, pairs = space[:room], space[room : 2 * room], space[2 * room : 3 * room]
    bounds, steps, per_step = space[3 * room : 3 * room + 2], space[3 * room + 2], space[3 * room + 3 :].reshape(16)
    for p in range(first, last):
        version = pair_version[p]
        begin, end = tile_begin[pair_tile[p]], tile_begin[pair_tile[p] + 1]
        count = _find_large(begin, end, index, worth, size[version], least[version], number)
        if count % 2:
            number[count] = number[count - 1]  # counts nothing
        _scale_large(count, number, index, scale, value, coefficients[version], even, odd, bounds)
        choose_steps(count, bounds, steps, per_step)
        round_pairs((count + 1) // 2, even, odd, per_step, pairs)
        _multiply_large(count, number, value, pairs, steps, out[p])


@parallel_kernel
def multiply_large_terms(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, worth, value, coefficients, size, least, pair_tile, pair_version, out
):
    """`multiply_paired_tiles` without small terms, from tiles as `multiply_tiles` takes them.

    Parameters
    ----------
    worth : (n,) float32
        What a coefficient counts.
    size : (n_versions, m) float32
        Largest size of each coefficient's channels.
    least : (n_versions,) float32
        Terms ``worth * size`` below are left out; 0 leaves out none.
    """
    cost_end = sum_costs(tile_begin, pair_tile)
    for part in prange(_PARTS):
        first, last = share(cost_end, part), share(cost_end, part + 1)
        _multiply_run(
            tile_begin, index, scale, worth, value, coefficients, size, least, pair_tile, pair_version, first, last, out
        )


@parallel_kernel
def find_large_terms(tile_begin, index, worth, size, least, number, count):  # type: ignore[no-untyped-def]
    """Coefficients of each tile whose terms ``worth * size (m,)`` are at least `least`.

    Their numbers go to `number` (n,) from each tile's begin on, and how many they are to `count` (n_tiles,).
    """
    for t in prange(len(tile_begin) - 1):
        begin, end = tile_begin[t], tile_begin[t + 1]
        count[t] = _find_large(begin, end, index, worth, size, least, number[begin:end])


@kernel
def _copy_terms(number, index, scale, worth, value, out_index, out_scale, out_worth, out_value):  # type: ignore[no-untyped-def]
    n_bytes = value.shape[1]
    source, target = address_of(value), address_of(out_value)
    for i in range(len(number)):
        k = np.int64(number[i])
        out_index[i], out_scale[i], out_worth[i] = index[k], scale[k], worth[k]
        for offset in range(0, n_bytes, 64):
            store(target + offset, load(source + n_bytes * k + offset))
        target += n_bytes


@parallel_kernel
def copy_terms(  # type: ignore[no-untyped-def]
    tile_begin, number, begin, index, scale, worth, value, out_index, out_scale, out_worth, out_value
):
    """Terms found by `find_large_terms` to tiles, those of tile t from ``begin[t]`` on; values are bytes (n, 64 k)."""
    for t in prange(len(tile_begin) - 1):
        some = slice(begin[t], begin[t + 1])
        found = number[tile_begin[t] : tile_begin[t] + begin[t + 1] - begin[t]]
        outputs = out_index[some], out_scale[some], out_worth[some], out_value[some]
        _copy_terms(found, index, scale, worth, value, *outputs)
