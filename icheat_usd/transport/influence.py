"""How much the light of each gather cell moves the image."""

from __future__ import annotations

import numpy as np

from icheat_usd.scene import F32, F64
from icheat_usd.steps import Steps
from icheat_usd.transport.build import Transport
from icheat_usd.transport.sparse import SparseRows

#: Rows that are gone through in one step: some tens of milliseconds.
_TOGETHER = 4096


def influence_on_view(transport: Transport) -> Steps[F32]:
    """Root mean square that the image is off by, up to a factor, if one cell is off by one and no other is.

    By it errors at cells compare as an image shows them. Of what the view receives in all a cell next to what is in
    sight may bring little, but all of that to few pixels.

    Returns
    -------
    (n_gather,) float32, of sum 1
    """
    squares = np.zeros(transport.lobes[0].rows.n_columns)
    for lobe in transport.lobes:
        of_rows = np.square(lobe.tint, dtype=np.float64).mean(axis=1)
        if transport.interpolation is not None:
            # Rows that a sample lies between are taken to be alike.
            of_rows = _column_sums(transport.interpolation, of_rows)
        for first in range(0, lobe.rows.n_rows, _TOGETHER):
            rows = lobe.rows.rows(first, min(first + _TOGETHER, lobe.rows.n_rows))
            squares += _column_sums(rows, of_rows[first:][: rows.n_rows], square=True)
            yield
    influence = np.sqrt(squares)
    return (influence / max(influence.sum(), 1e-300)).astype(np.float32)


def _column_sums(rows: SparseRows, of_rows: F64, *, square: bool = False) -> F64:
    """Of weights or their squares, times a factor of each row (n_rows,): (n_columns,)."""
    weights = rows.weights.astype(np.float64)
    values = (weights * weights if square else weights) * np.repeat(of_rows, np.diff(rows.indptr))
    return np.bincount(rows.indices, values, rows.n_columns).astype(np.float64)
