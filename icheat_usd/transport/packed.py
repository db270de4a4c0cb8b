"""Transport at records in few shared, quantised wavelet coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import packing as kernels
from icheat_usd.samples import ClusterTree
from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32, F64, I32, I64, Bool
from icheat_usd.transport.build import Transport
from icheat_usd.transport.sparse import SparseRows

LANES = 64  #: rows of a tile


@dataclass(frozen=True, eq=False)
class PackedRows:
    """Rows in tiles of 64 neighbours that share the indices of their Haar coefficients.

    A row stands for the density ``row / area`` of the leaves, in the basis of
    `haar_forward`; its product with leaf values is a dot product of
    coefficients [1]_. Values are int8 quanta, or float32 where nothing may be lost.

    References
    ----------
    .. [1] Hasan, Pellacini, Bala: Direct-to-Indirect Transfer for Cinematic Relighting, SIGGRAPH 2006.
    """

    tree: ClusterTree
    n_rows: int
    tile_begin: I64  #: (n_tiles + 1,) first coefficient of each tile
    index: I32  #: (n,) coefficient, ascending within a tile; what rounding left of it may follow as a second entry
    scale: F32  #: (n,) value of one quantum
    value: NDArray[np.int8] | F32  #: (n, 64) quanta, one column per row of the tile; 0 beyond the last row

    @property
    def n_tiles(self) -> int:
        return len(self.tile_begin) - 1

    @property
    def n_bytes(self) -> int:
        """Memory that a product reads."""
        return self.tile_begin.nbytes + self.index.nbytes + self.scale.nbytes + self.value.nbytes

    def matmul(self, b: F32) -> F32:
        """Product with leaf values, bitwise the same for any number of threads.

        Parameters
        ----------
        b : (n_leaves, k) float32

        Returns
        -------
        (n_rows, k) float32

        Raises
        ------
        ValueError
            `b` has another number of rows than the tree has leaves.
        """
        return self.multiply(haar_forward(self.tree, b).astype(np.float32))

    def multiply(self, coefficients: F32) -> F32:
        """Product with Haar coefficients (n_leaves, k): (n_rows, k)."""
        out = np.empty((self.n_tiles * LANES, coefficients.shape[1]), np.float32)
        kernels.multiply_tiles(self.tile_begin, self.index, self.scale, self.value, coefficients, out)
        return out[: self.n_rows]

    def keep(self, kept: Bool) -> PackedRows:
        """Without the entries that are not marked in `kept` (n,)."""
        count = np.concatenate([[0], np.cumsum(kept)]).astype(np.int64)
        return replace(
            self,
            tile_begin=count[self.tile_begin],
            index=self.index[kept],
            scale=self.scale[kept],
            value=self.value[kept],
        )


@dataclass(frozen=True, eq=False)
class PackedLobe:
    """One part of the view samples' reflection, with its colour outside the rows."""

    name: str  #: as of `Lobe`
    rows: PackedRows
    tint: F32  #: (n_view, 3) multiplies the interpolated product


@dataclass(frozen=True)
class PackingReport:
    """What packing was measured to lose at the records, as the pixels weight them, with lights it did not know."""

    light_error: F64  #: (n_lights,) relative RMS of each training light, for tiles packed by others

    @property
    def error(self) -> float:
        """Median over the lights: a beam on a few cells that others never lit may be off by any amount."""
        return float(np.median(self.light_error)) if len(self.light_error) else 0.0

    @property
    def worst(self) -> float:
        """Of any light."""
        return float(self.light_error.max(initial=0.0))


@dataclass(frozen=True, eq=False)
class PackedTransport:
    """A `Transport` with packed rows; otherwise the same."""

    lobes: tuple[PackedLobe, ...]
    row_view: I32  #: (n_rows,) the view sample that each row was computed at
    interpolation: SparseRows | None  #: (n_view x n_rows); None where rows are view samples
    source: Transport | None = None  #: the exact rows, while there is memory for them
    report: PackingReport | None = None

    @property
    def n_bytes(self) -> int:
        """Memory that the products of a frame read."""
        return sum(lobe.rows.n_bytes for lobe in self.lobes)

    def to_view(self, radiance: F32) -> F32:
        """Indirect radiance that view samples send to the eye.

        Parameters
        ----------
        radiance : (n_gather, 3) float32
            What leaves the cells.

        Returns
        -------
        (n_view, 3) float32
        """
        coefficients = haar_forward(self.lobes[0].rows.tree, radiance).astype(np.float32)
        out = np.zeros((len(self.lobes[0].tint), 3), np.float32)
        for lobe in self.lobes:
            if len(lobe.rows.index):
                product = lobe.rows.multiply(coefficients)
                out += lobe.tint * (product if self.interpolation is None else self.interpolation.matmul(product))
        return out

    def narrowed(self, coefficients: F32, max_bytes: int) -> PackedTransport:
        """Only what adds most to products with some lights, for frames that keep to these lights.

        Parameters
        ----------
        coefficients : (n_leaves,)
            Largest size that each Haar coefficient of the light will have.
        max_bytes
            Of the tiles together.

        Notes
        -----
        Which coefficients matter to a light depends on the light: for one that
        is known, an eighth of them serves as well as all. `residual` of the result
        tells what is lost of a light.
        """
        worth = []
        for lobe in self.lobes:
            tint = np.sqrt(np.mean(np.square(lobe.tint), dtype=np.float64))
            size = np.take(coefficients, lobe.rows.index) * lobe.rows.scale * np.float32(tint)
            worth.append(np.where(lobe.rows.index == 0, np.float32(np.inf), size))
        n_kept = max_bytes // (LANES + 8)
        every = np.concatenate(worth)
        if n_kept >= len(every):
            return self
        least = np.partition(every, len(every) - n_kept)[len(every) - n_kept] if n_kept > 0 else np.inf
        lobes = [
            replace(lobe, rows=lobe.rows.keep(size >= least)) for lobe, size in zip(self.lobes, worth, strict=True)
        ]
        return replace(self, lobes=tuple(lobes))
