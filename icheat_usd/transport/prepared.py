"""A packed transport laid out for frames: the same product, in a fraction of the time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels.assemble import InterpolationTable, assemble_view, interpolation_table
from icheat_usd.kernels.packed import LANES, PairedTiles, multiply_paired_tiles, pair_coefficients
from icheat_usd.samples.wavelets import HaarPlan, haar_of_versions, plan_haar
from icheat_usd.scene import F32, I32
from icheat_usd.transport.packed import PackedRows, PackedTransport


@dataclass(frozen=True, eq=False)
class PreparedTransport:
    """What `PackedTransport.to_view` needs, found once.

    Light is rounded to 16 bits per tile (see `multiply_paired_tiles`), except
    for rows that are kept as float32. One thread at a time: products are
    written to arrays that stay.
    """

    plan: HaarPlan
    lobes: tuple[PairedTiles | PackedRows, ...]  #: those that have rows; `PackedRows` where values are float32
    tint: F32  #: (n_lobes, n_view, 3)
    table: InterpolationTable
    tile: I32  #: (n_tiles,) all of them
    version: I32  #: (n_tiles,) zeros
    coefficients: F32  #: (1, n_leaves, 4) room for the light
    products: F32  #: (n_lobes, n_tiles * 64, 4) room for products at records

    def multiply(self, radiance: F32) -> F32:
        """Products (n_lobes, n_tiles * 64, 4) of all records with what leaves the cells (n_gather, 3)."""
        haar_of_versions(self.plan, np.ascontiguousarray(radiance, np.float32)[None], self.coefficients)
        for lobe, rows in enumerate(self.lobes):
            if isinstance(rows, PackedRows):
                self.products[lobe, : rows.n_rows, :3] = rows.multiply(
                    np.ascontiguousarray(self.coefficients[0, :, :3])
                )
            else:
                out = self.products[lobe].reshape(-1, LANES, 4)
                multiply_paired_tiles(*rows, self.coefficients, self.tile, self.version, out)
        return self.products

    def to_view(self, radiance: F32, out: F32 | None = None) -> F32:
        """Indirect radiance that view samples send to the eye: (n_view, 3).

        Parameters
        ----------
        radiance : (n_gather, 3) float32
            What leaves the cells.
        out : (n_view, 3) float32, optional
            Receives the result.
        """
        if out is None:
            out = np.empty(self.tint.shape[1:], np.float32)
        if not self.lobes:
            out[:] = 0
            return out
        assemble_view(*self.table, self.multiply(radiance), self.tint, out)
        return out


def prepare_transport(packed: PackedTransport) -> PreparedTransport:
    """Lay a packed transport out for frames; takes as much memory as its values, once more."""
    kept = [lobe for lobe in packed.lobes if len(lobe.rows.index)]
    n_view = len(packed.lobes[0].tint)
    n_tiles = packed.lobes[0].rows.n_tiles
    tree = packed.lobes[0].rows.tree
    spread = packed.interpolation
    if spread is None:
        each: I32 = np.arange(n_view, dtype=np.int32)
        table = interpolation_table(np.arange(n_view + 1), each, np.ones(n_view, np.float32))
    else:
        table = interpolation_table(spread.indptr, spread.indices, spread.weights)
    tint = np.stack([lobe.tint for lobe in kept]) if kept else np.zeros((0, n_view, 3))
    return PreparedTransport(
        plan_haar(tree),
        tuple(_laid_out(lobe.rows) for lobe in kept),
        np.ascontiguousarray(tint, np.float32),
        table,
        np.arange(n_tiles, dtype=np.int32),
        np.zeros(n_tiles, np.int32),
        np.empty((1, tree.n_leaves, 4), np.float32),
        np.zeros((len(kept), n_tiles * LANES, 4), np.float32),
    )


def _laid_out(rows: PackedRows) -> PairedTiles | PackedRows:
    if rows.value.dtype == np.float32:
        return rows
    return pair_coefficients(rows.tile_begin, rows.index, rows.scale, rows.value.astype(np.int8, copy=False))
