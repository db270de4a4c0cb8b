"""Products of quantised transport tiles with light of few cells, whose large terms are found by coefficient.

Of the terms of a tile hardly any belongs to the few coefficients that such light
has. Terms of one coefficient lie side by side here, those that are worth most
first: what is large is found without a look at the others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packed import PARTS, share
from icheat_usd.kernels.paired_tiles import PairedTiles
from icheat_usd.kernels.simd import address_of, fetch
from icheat_usd.kernels.tile_product import QUANTA, multiply_tile, new_room, tables_of

_FEW = 24  # numbers that are sorted by inserting each
_AHEAD = 64  # pairs whose quanta are on their way to the cache while the product before them is made
_COST = 64  # of a product, beside its pairs of coefficients


class TermColumns(NamedTuple):
    """Terms of all tiles by their coefficients."""

    begin: NDArray[np.int64]  #: (m + 1,) first term of each coefficient
    most: NDArray[np.float32]  #: (m,) largest worth of its terms, 0 where there is none
    worth: NDArray[np.float32]  #: (n,) descending
    tile: NDArray[np.int32]  #: (n,)
    pair: NDArray[np.int32]  #: (n,) number of the pair of coefficients in `PairedTiles`


def order_terms(tiles: PairedTiles, m: int) -> TermColumns:
    """Columns of the terms that are worth anything, of tiles with `m` coefficients."""
    begin = np.empty(m + 1, np.int64)
    count_columns(tiles.index, tiles.worth, begin)
    n = int(begin[-1])
    terms = np.empty(n, np.float32), np.empty(n, np.int32), np.empty(n, np.int32)
    fill_columns(tiles.tile_begin, tiles.index, tiles.worth, begin, *terms)
    most = np.zeros(m, np.float32)
    sort_columns(begin, *terms, most)
    return TermColumns(begin, most, *terms)


def find_of_jobs(
    columns: TermColumns,
    n_tiles: int,
    size: NDArray[np.float32],
    least: NDArray[np.float32],
    tile: NDArray[np.int32],
    version: NDArray[np.int32],
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Pairs of coefficients with a large term, of jobs (n,) of a tile and a version each, as `multiply_found` has them.

    `size` and `least` as for `find_terms`, of all versions; of each tile and version there is one job at most.

    Returns
    -------
    found_begin : (n + 1,) int64
    found : (n_found,) int32
    """
    used, row = np.unique(version, return_inverse=True)
    n, none = len(tile), np.arange(len(used))
    job_of = np.empty((len(used), n_tiles), np.int32)
    job_of[:] = n + none[:, None]
    job_of[row, tile] = np.arange(n)
    count = np.zeros(n + len(used), np.int64)
    find_terms(*columns, size, least, used, job_of, count, np.empty(0, np.int32))
    begin = np.concatenate([[0], np.cumsum(count[:n])]).astype(np.int64)
    found = np.empty(begin[-1] + len(used), np.int32)
    find_terms(*columns, size, least, used, job_of, np.append(begin[:-1], begin[-1] + none), found)
    return begin, found


@kernel
def count_columns(index, worth, begin):  # type: ignore[no-untyped-def]
    """First term of each coefficient, to `begin (m + 1,)`."""
    begin[:] = 0
    for i in range(len(index)):
        begin[index[i] + 1] += worth[i] > 0
    for k in range(len(begin) - 1):
        begin[k + 1] += begin[k]


@kernel
def fill_columns(tile_begin, index, worth, begin, out_worth, out_tile, out_pair):  # type: ignore[no-untyped-def]
    """Terms in the order of tiles, to `out_worth`, `out_tile` and `out_pair`; see `TermColumns`."""
    end = begin[:-1].copy()
    for t in range(len(tile_begin) - 1):
        for i in range(tile_begin[t], tile_begin[t + 1]):
            if worth[i] > 0:
                place = end[index[i]]
                out_worth[place], out_tile[place], out_pair[place] = worth[i], t, i >> 1
                end[index[i]] += 1


@parallel_kernel
def sort_columns(begin, worth, tile, pair, most):  # type: ignore[no-untyped-def]
    """Put the terms of each coefficient in order of what they are worth, as in `TermColumns`."""
    for k in prange(len(begin) - 1):
        some = slice(begin[k], begin[k + 1])
        order = np.argsort(-worth[some], kind="mergesort")
        worth[some], tile[some], pair[some] = worth[some][order], tile[some][order], pair[some][order]
        if begin[k] < begin[k + 1]:
            most[k] = worth[begin[k]]


@kernel
def _walk(begin, most, worth, tile, pair, size, least, n_jobs, job_of, place, found):  # type: ignore[no-untyped-def]
    """Number of the pair of each large term of one version, to ``found[place[job]]``, of which each moves on."""
    n = 1 if least == np.inf else len(size)  # the mean alone, which is the first
    counts = len(found) == 0
    for k in range(n):
        if not size[k] * most[k] >= least:
            continue
        for i in range(begin[k], begin[k + 1]):
            if not size[k] * worth[i] >= least:
                break
            # Without a branch, of which half would be guessed wrong: what has no job goes to a place that stays.
            job = job_of[tile[i]]
            at = place[job]
            if not counts:
                found[at] = pair[i]
            place[job] = at + np.int64(job < n_jobs)


@kernel
def _each_once(numbers):  # type: ignore[no-untyped-def]
    """Sort numbers and leave out those that are there before; how many remain."""
    if len(numbers) > _FEW:
        numbers.sort()
    for i in range(1, len(numbers) if len(numbers) <= _FEW else 0):
        number, j = numbers[i], i
        while j > 0 and numbers[j - 1] > number:
            numbers[j] = numbers[j - 1]
            j -= 1
        numbers[j] = number
    count, last = 0, np.int32(-1)
    for i in range(len(numbers)):
        number = numbers[i]
        numbers[count] = number
        count += number != last
        last = number
    return count


@kernel
def _prepare(numbers, value):  # type: ignore[no-untyped-def]
    """Put the pairs of a job in order, and begin to load their quanta; how many they are."""
    count = _each_once(numbers)
    for i in range(min(count, _AHEAD)):
        place = address_of(value) + QUANTA * np.int64(numbers[i])
        fetch(place)
        fetch(place + 64)
    return count


@parallel_kernel
def find_terms(begin, most, worth, tile, pair, size, least, versions, job_of, place, found):  # type: ignore[no-untyped-def]
    """Pairs of coefficients with a term ``worth * size`` that is `least` or more, of some tiles and versions.

    Parameters
    ----------
    begin, most, worth, tile, pair
        `TermColumns`.
    size : (n_versions, m) float32, least : (n_versions,) float32
        As `multiply_terms` takes them; `least` is above 0.
    versions : (n,) int64
        Which are meant.
    job_of : (n, n_tiles) int32
        Job of each of these versions with each tile; where there is none, number ``n_jobs + i`` for the i-th.
    place : (n_jobs + n,) int64
        First place of each job's pairs in `found`, which moves to the end of them; of the others a place to scribble.
    found : (n_found,) int32
        Numbers of pairs, in no order and some twice; empty: they are but counted, in `place`.
    """
    n = len(versions)
    for i in prange(n):
        v = versions[i]
        _walk(begin, most, worth, tile, pair, size[v], least[v], len(place) - n, job_of[i], place, found)


@parallel_kernel
def multiply_found(  # type: ignore[no-untyped-def]
    index, scale, value, coefficients, found_begin, found, job_version, job_out, out
):
    """Products of tiles and versions of which `find_terms` found the pairs: the same bits as those of `multiply_terms`.

    Parameters
    ----------
    index, scale, value
        As in `PairedTiles`.
    coefficients : (n_versions, m, 4) float32
        See `multiply_terms`.
    found_begin : (n + 1,) int64, found : (n_found,) int32
        Pairs of each job; they are put in order.
    job_version, job_out : (n,) int32
        Light of each job, and where its product goes.
    out : (n_out, 64, 4) float32
        Products; the pad is 0.
    """
    n = len(job_version)
    cost_end = found_begin[1:] + _COST * np.arange(1, n + 1)
    for turn in prange(PARTS):
        part = 2 * turn % PARTS + 2 * turn // PARTS
        first, last = share(cost_end, part), share(cost_end, part + 1)
        room, tables, numbers = new_room(), tables_of(index, scale, value, coefficients, out), address_of(found)
        n, n_ready = 0, 0
        for job in range(first, last + 1):
            n_following, version = 0, 0
            if job < last:
                n_following = _prepare(found[found_begin[job] : found_begin[job + 1]], value)
                version = job_version[job]
            if job > first:
                number, following = numbers + 4 * found_begin[job - 1], numbers + 4 * found_begin[job]
                work = tables, job_version[job - 1], job_out[job - 1], number, n, n_ready, following, n_following
                n_ready = multiply_tile(*work, version, address_of(room))
            n = n_following
        room[0] = np.float32(0)  # keeps it
