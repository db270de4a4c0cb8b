"""What view samples are interpolated from, laid out for one pass over them: rows, weights and tints, four at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ENTRIES = 4  # of a group


class FilmTable(NamedTuple):
    """Groups of up to four weighted products of one lobe, times that lobe's tint.

    Each view sample has one group; those with more lobes or more records have
    others behind. Entries that a group does not need have weight 0 and a row
    that is read anyway. A row is one of a lobe's flat products, 64 times the
    tile (or the sum of a tile and a group) plus the lane.
    """

    row: NDArray[np.int32]  #: (n_view, 4)
    weight: NDArray[np.float32]  #: (n_view, 4)
    tint: NDArray[np.float32]  #: (n_view, 4) and a pad
    lobe: NDArray[np.uint8]  #: (n_view,)
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
    counts = np.diff(indptr)
    shown = (tints != 0).any(axis=2)
    # Groups of a sample: of its first lobe, first; of lobes that it does not show, none.
    groups = np.where(shown, np.maximum(-(-counts // ENTRIES), 1), 0)
    groups[0, ~shown.any(axis=0)] = 1
    view = np.repeat(np.tile(np.arange(n_view, dtype=np.int32), len(tints)), groups.ravel())
    lobe = np.repeat(np.repeat(np.arange(len(tints), dtype=np.uint8), n_view), groups.ravel())
    ends = np.cumsum(groups.ravel())
    rank = np.arange(len(view)) - np.repeat(ends - groups.ravel(), groups.ravel())
    order = np.argsort(view, kind="stable")
    view, lobe, rank = view[order], lobe[order], rank[order]
    row, weight = _entries(indptr, indices, weights, view, ENTRIES * rank)
    tint = np.zeros((len(view), 4), np.float32)
    tint[:, :3] = tints[lobe, view]
    is_first = np.concatenate([[True], view[1:] != view[:-1]])[: len(view)]
    first, more = np.flatnonzero(is_first), np.flatnonzero(~is_first)
    return FilmTable(
        row[first],
        weight[first],
        tint[first],
        lobe[first],
        view[more],
        row[more],
        weight[more],
        tint[more],
        lobe[more],
    )


def _entries(
    indptr: NDArray[np.int64],
    indices: NDArray[np.int32],
    weights: NDArray[np.float32],
    view: NDArray[np.int32],
    skipped: NDArray[np.int64],
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Four entries of each of some samples, behind those `skipped`."""
    row, weight = np.zeros((len(view), ENTRIES), np.int32), np.zeros((len(view), ENTRIES), np.float32)
    begin, end = indptr[view] + skipped, indptr[view + 1]
    for k in range(ENTRIES):
        has = np.flatnonzero(begin + k < end)
        row[:, k] = row[:, 0]  # already read: a row elsewhere would cost a cache line
        row[has, k], weight[has, k] = np.take(indices, begin[has] + k), np.take(weights, begin[has] + k)
    return row, weight
