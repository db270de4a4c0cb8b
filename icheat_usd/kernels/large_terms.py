"""Products of quantised transport tiles with the light of gather cells, of the terms that are large in this light.

Which coefficients of a tile matter depends on the light: many are there for
lights at other places. An index and a worth tell how large a term is; the
quanta of small ones are not read.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packed import PARTS, share, sum_costs
from icheat_usd.kernels.simd import address_of, load, store, store_large
from icheat_usd.kernels.tile_product import multiply_tile, new_room, tables_of


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
def _find_pairs(begin, end, index, worth, size, least, version, number):  # type: ignore[no-untyped-def]
    """Put those of a tile's pairs that are multiplied with a version into `number`; how many they are."""
    if len(least) > 0:
        return _find_large_pairs(begin, end, index, worth, size[version], least[version], number)
    return _all_pairs(begin, end, number)


@kernel
def _multiply_run(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, worth, value, coefficients, size, least, job_tile, job_version, job_out, first, last, out
):
    """Jobs `first` to `last`; the pairs of each are found before the one before it is multiplied."""
    most = 0
    for job in range(first, last):
        most = max(most, tile_begin[job_tile[job] + 1] - tile_begin[job_tile[job]])
    rooms, room = np.empty((2, most + 18), np.int32), new_room()
    tables, n_following, n_ready = tables_of(index, scale, value, coefficients, out), 0, 0
    for job in range(first, last + 1):
        n, n_following, version = n_following, 0, 0
        if job < last:
            begin, end = tile_begin[job_tile[job]], tile_begin[job_tile[job] + 1]
            version = job_version[job]
            n_following = _find_pairs(begin, end, index, worth, size, least, version, rooms[job % 2])
        if job > first:
            made, number, following = job - 1, address_of(rooms[(job - 1) % 2]), address_of(rooms[job % 2])
            work = tables, job_version[made], job_out[made], number, n, n_ready, following, n_following
            n_ready = multiply_tile(*work, version, address_of(room))
    room[0] = np.float32(0)  # keeps it


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
    step being the largest |scale * coefficient| of some hundred and the channel / 32767:
    small against the half quantum that the transport was rounded by. Sums run in the order of a
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
