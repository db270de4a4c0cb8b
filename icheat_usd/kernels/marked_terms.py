"""Products of quantised transport tiles with light of many cells, whose large terms are marked where they stand.

They are found as in `found_terms`, by coefficient, in no order of tiles; marks
put them in order, and say once of each pair of coefficients that it is there.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packed import PARTS, share, sum_costs
from icheat_usd.kernels.simd import address_of, load_word, lowest_bit, set_byte
from icheat_usd.kernels.tile_product import multiply_tile, new_room, tables_of

WORD = 8  #: marks that are looked at together
_RUNS = 64  # of coefficients: a thread takes one at a time


@kernel
def _mark(first, last, begin, most, worth, pair, size, least, marks):  # type: ignore[no-untyped-def]
    place = address_of(marks)
    for k in range(first, last):
        if not size[k] * most[k] >= least:
            continue
        for i in range(begin[k], begin[k + 1]):
            if not size[k] * worth[i] >= least:
                break
            set_byte(place + np.int64(pair[i]))


@parallel_kernel
def mark_terms(begin, most, worth, pair, size, least, marks):  # type: ignore[no-untyped-def]
    """Set the marks of pairs of coefficients with a term ``worth * size`` that is `least` or more; others stay.

    Parameters
    ----------
    begin, most, worth, pair
        As in `TermColumns`.
    size : (m,) float32
        Largest size of each coefficient's channels.
    least : float32
        Above 0; infinite where the mean alone counts.
    marks : (at least n_pairs) uint8
        Several threads may set one of them, all to 1.
    """
    n = 1 if least == np.inf else len(size)
    for run in prange(_RUNS):
        r = np.int64(run)
        _mark(n * r // _RUNS, n * (r + 1) // _RUNS, begin, most, worth, pair, size, least, marks)


@kernel
def _find_marked(first, last, marks, number):  # type: ignore[no-untyped-def]
    """Numbers of pairs `first` to `last` that are marked, ascending, and how many they are."""
    count, place = 0, address_of(marks)
    for k in range(first, last, WORD):
        word = load_word(place + k)
        if last - k < WORD:
            word &= (np.uint64(1) << np.uint64(8 * (last - k))) - np.uint64(1)
        while word != 0:
            number[count] = k + (lowest_bit(word) >> 3)
            count += 1
            word &= word - np.uint64(1)
    return count


@kernel
def _multiply_run(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, value, coefficients, marks, job_tile, job_version, job_marks, job_out, first, last, out
):
    """Jobs `first` to `last`; the pairs of each are found before the one before it is multiplied."""
    most = 0
    for job in range(first, last):
        most = max(most, tile_begin[job_tile[job] + 1] - tile_begin[job_tile[job]])
    rooms, room = np.empty((2, most // 2), np.int32), new_room()
    tables, n_following, n_ready = tables_of(index, scale, value, coefficients, out), 0, 0
    for job in range(first, last + 1):
        n, n_following, version = n_following, 0, 0
        if job < last:
            version = job_version[job]
            begin, end = tile_begin[job_tile[job]] >> 1, tile_begin[job_tile[job] + 1] >> 1
            n_following = _find_marked(begin, end, marks[job_marks[job]], rooms[job % 2])
        if job > first:
            made, number, following = job - 1, address_of(rooms[(job - 1) % 2]), address_of(rooms[job % 2])
            work = tables, job_version[made], job_out[made], number, n, n_ready, following, n_following
            n_ready = multiply_tile(*work, version, address_of(room))
    room[0] = np.float32(0)  # keeps it


@parallel_kernel
def multiply_marked(  # type: ignore[no-untyped-def]
    tile_begin, index, scale, value, coefficients, marks, job_tile, job_version, job_marks, job_out, out
):
    """Products of tiles and versions whose large terms are marked: the same bits as those of `multiply_terms`.

    Parameters
    ----------
    tile_begin, index, scale, value
        As in `PairedTiles`.
    coefficients : (n_versions, m, 4) float32
        See `multiply_terms`.
    marks : (n_marked, at least n_pairs + `WORD`) uint8
        Of some versions, 0 or 1; see `mark_terms`.
    job_tile, job_version, job_marks, job_out : (n,) int32
        What to multiply with what, which marks are those of the version, and where the product goes.
    out : (n_out, 64, 4) float32
        Products; the pad is 0.
    """
    cost_end = sum_costs(tile_begin, job_tile)
    for turn in prange(PARTS):
        part = 2 * turn % PARTS + 2 * turn // PARTS
        first, last = share(cost_end, part), share(cost_end, part + 1)
        tables = tile_begin, index, scale, value, coefficients, marks
        _multiply_run(*tables, job_tile, job_version, job_marks, job_out, first, last, out)
