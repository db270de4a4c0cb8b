"""What a packed transport loses of one light."""

from __future__ import annotations

import numpy as np

from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32
from icheat_usd.transport.packed import LANES, PackedTransport

_TILES_AT_ONCE = 64


def residual(transport: PackedTransport, radiance: F32) -> list[F32]:
    """What packing loses of one light, to be added to the products at the records.

    Parameters
    ----------
    radiance : (n_gather, 3)

    Returns
    -------
    list of (n_rows, 3) float32
        Exact minus packed product of each lobe; linear in `radiance`.

    Raises
    ------
    ValueError
        The exact rows were not kept.
    """
    if transport.source is None:
        raise ValueError("a packed transport without its exact rows does not know what it lost")
    out = [np.zeros((lobe.rows.n_rows, 3), np.float32) for lobe in transport.lobes]
    coefficients = haar_forward(transport.lobes[0].rows.tree, radiance).astype(np.float32)
    exact = [lobe.rows for lobe in transport.source.lobes]
    n_tiles = transport.lobes[0].rows.n_tiles
    for first in range(0, n_tiles, _TILES_AT_ONCE):
        last = min(first + _TILES_AT_ONCE, n_tiles)
        for lobe, rows, lost in zip(transport.lobes, exact, out, strict=True):
            if rows.n_entries:
                some = slice(first * LANES, min(last * LANES, rows.n_rows))
                product = lobe.rows.tiles(first, last).multiply(coefficients)
                lost[some] = rows.rows(some.start, some.stop).matmul(radiance) - product
    return out
