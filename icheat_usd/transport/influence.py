"""How much the light of each gather cell moves the image."""

from __future__ import annotations

import numpy as np

from icheat_usd.scene import F32, F64
from icheat_usd.steps import Steps
from icheat_usd.transport.build import Transport
from icheat_usd.transport.sparse import SparseRows

#: Entries that are gone through in one step: some tens of milliseconds.
_TOGETHER = 1 << 20


def influence_on_view(transport: Transport, importance: F32) -> Steps[F32]:
    """Root mean square that the image is off by, up to a factor, if one cell is off by one and no other is.

    By it errors at cells compare as an image shows them. Of what the view receives in all a cell next to what is in
    sight may bring little, but all of that to few pixels.

    Parameters
    ----------
    importance : (n_gather,)
        Part of what the view receives that comes from each cell, also over reflections. As these spread it, all
        samples are taken to get the same of it: so cells that are not in sight count, too.

    Returns
    -------
    (n_gather,) float32, of sum 1
    """
    squares = np.zeros(len(importance))
    for lobe in transport.lobes:
        if not lobe.rows.n_entries:
            continue
        of_rows = np.square(lobe.tint, dtype=np.float64).mean(axis=1)
        squares += of_rows.sum() * np.square(importance, dtype=np.float64)
        if transport.interpolation is not None:
            # Rows that a sample lies between are taken to be alike.
            of_rows = yield from _column_sums(transport.interpolation, of_rows)
        squares += yield from _column_sums(lobe.rows, of_rows, square=True)
    influence = np.sqrt(squares)
    return (influence / max(influence.sum(), 1e-300)).astype(np.float32)


def _column_sums(rows: SparseRows, of_rows: F64, *, square: bool = False) -> Steps[F64]:
    """Of weights or their squares, times a factor of each row (n_rows,): (n_columns,)."""
    sums, first = np.zeros(rows.n_columns), 0
    while first < rows.n_rows:
        end = rows.indptr[first] + _TOGETHER
        last = max(first + 1, int(np.searchsorted(rows.indptr, end, side="right")) - 1)
        some = rows.rows(first, last)
        weights = some.weights.astype(np.float64)
        values = (weights * weights if square else weights) * np.repeat(of_rows[first:last], np.diff(some.indptr))
        sums += np.bincount(some.indices, values, some.n_columns)
        first = last
        yield
    return sums
