"""Products of quantised transport tiles with the light of gather cells, of the terms that are large in this light.

Which coefficients of a tile matter depends on the light: many are there for
lights at other places. An index and a worth tell how large a term is; the
quanta of small ones are not read. Light is rounded to 16 bits and products are
summed as integers, exactly, some hundred terms at a time.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packed import LANES, PARTS, choose_steps, round_pairs, share, sum_costs
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
    plus,
    plus_size,
    scaled,
    spread_pair,
    store,
    store_color,
    store_colors,
    store_large,
    widen,
)

_AT_ONCE = 128  # pairs of coefficients: their quanta are in the second-level cache before they are multiplied
QUANTA = 2 * LANES  #: bytes of a pair of coefficients


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
def _find_large_pairs(begin, end, index, worth, size, least, number):  # type: ignore[no-untyped-def]
    """Numbers of the pairs of coefficients with a term that is `least` or more, and how many they are."""
    if least == np.inf:  # the mean alone, which is the first
        number[0] = begin >> 1
        return 1 if begin < end and worth[begin] > 0 and size[index[begin]] == np.inf else 0
    count = _find_large(begin, end, index, worth, size, least, number)
    n_pairs, last = 0, np.int32(-1)
    for i in range(count):
        pair = number[i] >> 1
        number[n_pairs] = pair
        n_pairs += pair != last
        last = pair
    return n_pairs


@kernel
def _all_pairs(begin, end, number):  # type: ignore[no-untyped-def]
    for k in range((end - begin) >> 1):
        number[k] = (begin >> 1) + k
    return (end - begin) >> 1


@kernel
def _scale_pairs(number, index, scale, value, coefficients, even, odd, bounds):  # type: ignore[no-untyped-def]
    """Colours that the quanta multiply, every second one apart; largest size and sum of sizes to `bounds` (2, 4).

    Meanwhile the quanta come into the cache.
    """
    source, targets, quanta = address_of(coefficients), (address_of(even), address_of(odd)), address_of(value)
    largest_even = largest_odd = sum_even = sum_odd = black()
    offset = 0
    for i in range(len(number)):
        ahead = quanta + QUANTA * np.int64(number[i])
        fetch(ahead)
        fetch(ahead + 64)
        k = np.uint64(2 * np.int64(number[i]))
        other = k + np.uint64(1)
        a = scaled(load_color(source + 16 * np.int64(index[k])), scale[k])
        b = scaled(load_color(source + 16 * np.int64(index[other])), scale[other])
        store_color(targets[0] + offset, a)
        store_color(targets[1] + offset, b)
        largest_even, sum_even = larger_size(largest_even, a), plus_size(sum_even, a)
        largest_odd, sum_odd = larger_size(largest_odd, b), plus_size(sum_odd, b)
        offset += 16
    store_color(address_of(bounds), larger_size(largest_even, largest_odd))
    store_color(address_of(bounds) + 16, plus_size(sum_even, sum_odd))


@kernel
def _add(place, sums, step):  # type: ignore[no-untyped-def]
    store(place, plus(load(place), as_floats(sums, step)))


@kernel
def _multiply_pairs(number, value, words, steps, ahead, sums):  # type: ignore[no-untyped-def]
    """Add pairs times words to `sums` (12, 16); meanwhile pairs `ahead` come into the cache, of which there is one."""
    r0 = r1 = r2 = r3 = g0 = g1 = g2 = g3 = b0 = b1 = b2 = b3 = no_sum()
    base, place, last = address_of(value), address_of(words), np.uint64(len(ahead) - 1)
    for i in range(np.uint64(len(number))):
        soon = base + QUANTA * np.int64(ahead[min(i, last)])
        fetch(soon)
        fetch(soon + 64)
        quanta = base + QUANTA * np.int64(number[i])
        r, g, b = spread_pair(place), spread_pair(place + 4), spread_pair(place + 8)
        x = widen(quanta)
        r0, g0, b0 = add_dot(x, r, r0), add_dot(x, g, g0), add_dot(x, b, b0)
        x = widen(quanta + 32)
        r1, g1, b1 = add_dot(x, r, r1), add_dot(x, g, g1), add_dot(x, b, b1)
        x = widen(quanta + 64)
        r2, g2, b2 = add_dot(x, r, r2), add_dot(x, g, g2), add_dot(x, b, b2)
        x = widen(quanta + 96)
        r3, g3, b3 = add_dot(x, r, r3), add_dot(x, g, g3), add_dot(x, b, b3)
        place += 16
    r, g, b = steps[0], steps[1], steps[2]
    place = address_of(sums)
    _add(place, r0, r)
    _add(place + 64, r1, r)
    _add(place + 128, r2, r)
    _add(place + 192, r3, r)
    _add(place + 256, g0, g)
    _add(place + 320, g1, g)
    _add(place + 384, g2, g)
    _add(place + 448, g3, g)
    _add(place + 512, b0, b)
    _add(place + 576, b1, b)
    _add(place + 640, b2, b)
    _add(place + 704, b3, b)


@kernel
def new_room():  # type: ignore[no-untyped-def]
    """Work space of `multiply_tile`: one allocation, since six cost as much as a tile."""
    return np.empty((3 * _AT_ONCE + 67, 4), np.float32)


@kernel
def multiply_tile(number, following, index, scale, value, coefficients, room, out):  # type: ignore[no-untyped-def]
    """Some pairs of coefficients of one tile times one version; `room` is from `new_room`.

    Pairs of the `following` product come into the cache meanwhile.
    """
    n = _AT_ONCE + 4  # `round_pairs` works in whole vectors
    even, odd, words = room[:n], room[n : 2 * n], room[2 * n : 3 * n]
    bounds, steps, per_step = room[3 * n : 3 * n + 2], room[3 * n + 2], room[3 * n + 3 : 3 * n + 7].reshape(16)
    sums = room[3 * n + 7 : 3 * n + 55]
    sums[:] = np.float32(0)
    for first in range(0, len(number), _AT_ONCE):
        some, ahead = number[first : first + _AT_ONCE], number[first + _AT_ONCE : first + 2 * _AT_ONCE]
        if len(ahead) == 0:
            ahead = following if len(following) > 0 else some
        _scale_pairs(some, index, scale, value, coefficients, even, odd, bounds)
        choose_steps(2 * len(some), bounds, steps, per_step)
        round_pairs(len(some), even, odd, per_step, words)
        _multiply_pairs(some, value, words, steps, ahead, sums)
    place, target = address_of(sums), address_of(out)
    for k in range(4):
        store_colors(target + 256 * k, load(place + 64 * k), load(place + 256 + 64 * k), load(place + 512 + 64 * k))


@kernel
def _find_pairs(begin, end, index, worth, size, least, version, number):  # type: ignore[no-untyped-def]
    """Those of a tile's pairs that are multiplied with a version, put into `number`."""
    if len(least) > 0:
        return number[: _find_large_pairs(begin, end, index, worth, size[version], least[version], number)]
    return number[: _all_pairs(begin, end, number)]


@kernel
def _multiply_run(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, worth, value, coefficients, size, least, job_tile, job_version, job_out, first, last, out
):
    """Jobs `first` to `last`; the pairs of each are found before the one before it is multiplied."""
    most = 0
    for job in range(first, last):
        most = max(most, tile_begin[job_tile[job] + 1] - tile_begin[job_tile[job]])
    rooms, room = np.empty((2, most + 18), np.int32), new_room()
    following = rooms[1, :0]
    for job in range(first, last + 1):
        number = following
        if job < last:
            begin, end = tile_begin[job_tile[job]], tile_begin[job_tile[job] + 1]
            following = _find_pairs(begin, end, index, worth, size, least, job_version[job], rooms[job % 2])
        else:
            following = rooms[0, :0]
        if job > first:
            made = job - 1
            multiply_tile(
                number, following, index, scale, value, coefficients[job_version[made]], room, out[job_out[made]]
            )


@parallel_kernel
def multiply_terms(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, worth, value, coefficients, size, least, job_tile, job_version, job_out, out
):
    """Rows of tiles times versions of the light, of all terms or of large ones.

    Parameters
    ----------
    tile_begin, index, scale, worth, value
        As in `PairedTiles`.
    coefficients : (n_versions, m, 4) float32
        Colour of each Haar coefficient and a pad.
    size : (n_versions, m) float32
        Largest size of each coefficient's channels.
    least : (n_versions,) float32
        Terms ``worth * size`` below are left out, but where they stand beside a larger one; empty leaves out none.
    job_tile, job_version, job_out : (n,) int32
        What to multiply with what, and where it goes.
    out : (n_out, 64, 4) float32
        Products; the pad is 0.

    Notes
    -----
    Rounding moves a product by at most half a step for each coefficient, the
    step being the largest |scale * coefficient| of some hundred and the channel / 32767
    (or slightly more, where 32 bits could overflow): small against the half
    quantum that the transport was rounded by. Sums run in the order of a
    tile's coefficients, so a product has the same bits whatever other jobs or threads there are.
    """
    cost_end = sum_costs(tile_begin, job_tile)
    for turn in prange(PARTS):
        # Threads take turns from left to right: what is lit may lie on one side of the image.
        part = 2 * turn % PARTS + 2 * turn // PARTS
        first, last = share(cost_end, part), share(cost_end, part + 1)
        _multiply_run(
            tile_begin,
            index,
            scale,
            worth,
            value,
            coefficients,
            size,
            least,
            job_tile,
            job_version,
            job_out,
            first,
            last,
            out,
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
