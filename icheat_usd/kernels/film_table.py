"""What view samples are interpolated from, laid out for one pass over them: rows, weights and tints, four at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel

ENTRIES = 4  # of a group


class FilmTable(NamedTuple):
    """Groups of up to four weighted products of one lobe, times that lobe's tint.

    Each view sample has one group. Those with more lobes have it again with the
    tint of another lobe, and those with more records have others behind: for one
    pass over the image, time is bytes. Entries that a group does not need have
    weight 0 and a row that is read anyway. A row is one of a lobe's flat products,
    64 times the tile (or the sum of a tile and a group) plus the lane.
    """

    row: NDArray[np.int32]  #: (n_view, 4)
    weight: NDArray[np.float32]  #: (n_view, 4)
    tint: NDArray[np.float32]  #: (n_view, 4) and a pad
    lobe: NDArray[np.uint8]  #: (n_view,)
    again_begin: NDArray[np.int32]  #: (n_view + 1,) of the lobes for which a sample's group counts, too
    again_tint: NDArray[np.float32]  #: (n_again, 4)
    again_lobe: NDArray[np.uint8]  #: (n_again,)
    more_view: NDArray[np.int32]  #: (n_more,) samples with more groups, ascending; once for each
    more_row: NDArray[np.int32]  #: (n_more, 4)
    more_weight: NDArray[np.float32]  #: (n_more, 4)
    more_tint: NDArray[np.float32]  #: (n_more, 4)
    more_lobe: NDArray[np.uint8]  #: (n_more,)


def film_table(
    indptr: NDArray[np.int64],
    indices: NDArray[np.int32],
    weights: NDArray[np.float32],
    tints: NDArray[np.float32],
) -> FilmTable:
    """The table of an interpolation (n_view x n_rows, in compressed rows) and the lobes' tints (n_lobes, n_view, 3)."""
    n_view = len(indptr) - 1
    if not len(tints):
        tints = np.zeros((1, n_view, 3), np.float32)
    end = np.zeros((2, n_view + 1), np.int64)
    _count_more(indptr, tints, end[:, 1:])
    np.cumsum(end, axis=1, out=end)
    n_again, n_more = end[:, -1].tolist()
    table = FilmTable(
        np.empty((n_view, ENTRIES), np.int32),
        np.empty((n_view, ENTRIES), np.float32),
        np.zeros((n_view, 4), np.float32),
        np.empty(n_view, np.uint8),
        end[0].astype(np.int32),
        np.zeros((n_again, 4), np.float32),
        np.empty(n_again, np.uint8),
        np.empty(n_more, np.int32),
        np.empty((n_more, ENTRIES), np.int32),
        np.empty((n_more, ENTRIES), np.float32),
        np.zeros((n_more, 4), np.float32),
        np.empty(n_more, np.uint8),
    )
    _fill_table(indptr, indices, weights, tints, end[1], *table)
    return table


@kernel
def _is_shown(tints, lobe, v):  # type: ignore[no-untyped-def]
    zero = np.float32(0)
    return tints[lobe, v, 0] != zero or tints[lobe, v, 1] != zero or tints[lobe, v, 2] != zero


@parallel_kernel
def _count_more(indptr, tints, count):  # type: ignore[no-untyped-def]
    """How often each sample has its first group again, and groups behind it, of lobes that it shows: (2, n_view)."""
    for v in prange(count.shape[1]):
        behind = max((indptr[v + 1] - indptr[v] + ENTRIES - 1) // ENTRIES, 1) - 1
        n_lobes = 0
        for lobe in range(tints.shape[0]):
            if _is_shown(tints, lobe, v):
                n_lobes += 1
        count[0, v], count[1, v] = max(n_lobes - 1, 0), behind * n_lobes


@kernel
def _fill_group(indptr, indices, weights, v, skipped, row, weight):  # type: ignore[no-untyped-def]
    """Up to four entries of a sample, behind those `skipped`."""
    begin, end = indptr[v] + skipped, indptr[v + 1]
    for k in range(ENTRIES):
        has = begin + k < end
        # Else one that is read anyway: a row elsewhere would cost a cache line.
        row[k] = indices[begin + k] if has else (row[0] if k > 0 else np.int32(0))
        weight[k] = weights[begin + k] if has else np.float32(0)


@parallel_kernel
def _fill_table(  # type: ignore[no-untyped-def]
    indptr,
    indices,
    weights,
    tints,
    more_begin,
    row,
    weight,
    tint,
    lobe,
    again_begin,
    again_tint,
    again_lobe,
    more_view,
    more_row,
    more_weight,
    more_tint,
    more_lobe,
):
    """The columns of a `FilmTable`; further groups of sample v begin at ``more_begin[v]``."""
    for index in prange(len(lobe)):
        v = np.int64(index)
        again, more = again_begin[v], more_begin[v]
        _fill_group(indptr, indices, weights, v, 0, row[v], weight[v])
        lobe[v] = 0
        is_first = True
        for of in range(tints.shape[0]):
            if not _is_shown(tints, of, v):
                continue
            if is_first:
                lobe[v] = of
                tint[v, :3] = tints[of, v]
                is_first = False
            else:
                again_lobe[again] = of
                again_tint[again, :3] = tints[of, v]
                again += 1
            for skipped in range(ENTRIES, indptr[v + 1] - indptr[v], ENTRIES):
                _fill_group(indptr, indices, weights, v, skipped, more_row[more], more_weight[more])
                more_view[more], more_lobe[more] = v, of
                more_tint[more, :3] = tints[of, v]
                more += 1
