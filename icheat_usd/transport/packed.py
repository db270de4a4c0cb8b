"""Transport at records in few shared, quantised wavelet coefficients."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import packing as kernels
from icheat_usd.kernels.large_terms import copy_terms, find_large_terms
from icheat_usd.kernels.least_term import least_term
from icheat_usd.kernels.term_energy import STEPS, sum_energies
from icheat_usd.samples import ClusterTree
from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32, F64, I32, I64
from icheat_usd.transport.build import Transport
from icheat_usd.transport.sparse import SparseRows

LANES = 64  #: rows of a tile
_BYTES_OF_TERM = LANES + 8


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
    worth: F32  #: (n,) root of the sum over pixels of the squared value times tint
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

    def of_large_terms(self, size: F32, least: float) -> PackedRows:
        """With the entries alone whose terms ``worth * size (n_leaves,)`` are at least `least`, and the roots."""
        of_roots = np.append(np.float32(np.inf), size[1:])
        number, count = np.empty(len(self.index), np.int32), np.empty(self.n_tiles, np.int64)
        find_large_terms(self.tile_begin, self.index, self.worth, of_roots, np.float32(least), number, count)
        begin = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
        index, (scale, worth) = np.empty(begin[-1], np.int32), np.empty((2, begin[-1]), np.float32)
        value = np.empty((begin[-1], LANES), self.value.dtype)
        terms = self.index, self.scale, self.worth, self.value.view(np.int8)
        copy_terms(self.tile_begin, number, begin, *terms, index, scale, worth, value.view(np.int8))
        return replace(self, tile_begin=begin, index=index, scale=scale, worth=worth, value=value)

    def tiles(self, first: int, last: int) -> PackedRows:
        """Tiles ``first:last`` as rows of their own."""
        begin = self.tile_begin[first : last + 1]
        some = slice(begin[0], begin[-1])
        n_rows = max(min(self.n_rows, last * LANES) - first * LANES, 0)
        floats = self.scale[some], self.worth[some]
        return PackedRows(self.tree, n_rows, begin - begin[0], self.index[some], *floats, self.value[some])


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

    def narrowed(self, size: F32, max_bytes: int) -> PackedTransport:
        """The coefficients alone that add most to products with some light, for frames that keep to it.

        `residual` of the result tells what is lost of a light.

        Parameters
        ----------
        size : (n_leaves,) float32
            Largest size that each Haar coefficient of the light will have.
        max_bytes
            Of the tiles together, about.
        """
        if max_bytes >= self.n_bytes:
            return self
        size = np.ascontiguousarray(size, np.float32)
        least = LargeTerms(self).least(size, max_bytes)
        lobes = (replace(lobe, rows=lobe.rows.of_large_terms(size, least)) for lobe in self.lobes)
        return replace(self, lobes=tuple(lobes))

    def term_energies(self) -> tuple[F32, float]:
        """Squares of all worths by coefficient and class, (n_leaves, `STEPS`), and the largest worth of all."""
        largest = max((float(lobe.rows.worth.max(initial=0.0)) for lobe in self.lobes), default=0.0) or 1.0
        energy = np.zeros((self.lobes[0].rows.tree.n_leaves, STEPS), np.float32)
        for lobe in self.lobes:
            sum_energies(lobe.rows.index, lobe.rows.worth, largest, energy)
        return energy, largest


class LargeTerms:
    """How large a term of a packed transport must be to be among the largest in a light.

    A term is a coefficient of a tile times that of the light, as far as it goes
    into pixels. Which are large depends on the light: for one that is known,
    a quarter of the coefficients serves nearly as well as all.
    """

    def __init__(self, transport: PackedTransport, n_looked_at: int = 32_768, seed: int = 0) -> None:
        rows = [lobe.rows for lobe in transport.lobes]
        begin = np.concatenate([[0], np.cumsum([len(of_lobe.index) for of_lobe in rows])])
        self.n_terms = int(begin[-1])  #: of all lobes
        sample = np.arange(self.n_terms)
        if self.n_terms > n_looked_at:
            sample = np.sort(np.random.default_rng(seed).integers(self.n_terms, size=n_looked_at))
        parts = [
            (of_lobe, sample[(sample >= first) & (sample < last)] - first)
            for of_lobe, first, last in zip(rows, begin[:-1], begin[1:], strict=True)
        ]
        index = np.concatenate([of_lobe.index[some] for of_lobe, some in parts])
        worth = np.concatenate([of_lobe.worth[some] for of_lobe, some in parts])
        self._index, self._worth = index[index != 0], worth[index != 0]
        self._n_roots = len(index) - len(self._index)  # which stay, whatever the light

    def least(self, size: F32, max_bytes: int) -> float:
        """Least ``worth * size`` of terms, so that larger ones take about `max_bytes`; roots always stay.

        Parameters
        ----------
        size : (n_leaves,) float32
            Largest size of each Haar coefficient of the light.
        """
        # No error is small enough: bytes alone decide.
        return self.least_of_error(size, -1.0, max_bytes)

    def least_of_error(self, size: F32, squared_error: float, max_bytes: int, share: float = 1.0) -> float:
        """The same, so that squares of smaller ones sum up to `squared_error` over all pixels, or as `least` has it.

        They sum up to no more than `share` of all squares but the roots'.
        """
        of_sample = max(len(self._index) + self._n_roots, 1) / max(self.n_terms, 1)
        n_most = round(max_bytes * of_sample / _BYTES_OF_TERM) - self._n_roots
        return float(least_term(self._index, self._worth, size, n_most, squared_error * of_sample, share))
