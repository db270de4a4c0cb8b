"""Transport at records in few shared, quantised wavelet coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import packing as kernels
from icheat_usd.samples import ClusterTree
from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32, I32, I64
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
    index: I32  #: (n,) coefficient, ascending within a tile
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


@dataclass(frozen=True, eq=False)
class PackedLobe:
    """One part of the view samples' reflection, with its colour outside the rows."""

    name: str  #: as of `Lobe`
    rows: PackedRows
    tint: F32  #: (n_view, 3) multiplies the interpolated product


@dataclass(frozen=True, eq=False)
class PackedTransport:
    """A `Transport` whose rows are packed; rows beyond interpolation are the only thing that is lost."""

    lobes: tuple[PackedLobe, ...]
    row_view: I32  #: (n_rows,) the view sample that each row was computed at
    interpolation: SparseRows | None  #: (n_view x n_rows); None where rows are view samples
    source: Transport | None = None  #: the exact rows, while there is memory for them

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
