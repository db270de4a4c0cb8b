"""Dense rows to sparse Haar rows: under a bound on the error, or with a fixed number of coefficients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import row_coding
from icheat_usd.samples.tree import ClusterTree
from icheat_usd.scene import F32, F64, I32, I64

#: Largest coefficient in 8 and 16 bits.
BYTE, WORD = 127, 32767

#: Rounding of a decoded value, relative to the largest one; in the stated bounds. float32 has 2^-24, and the weights
#: of leaves that are merged later are sums of rounded ones.
_ROUNDING = 2.0**-20


class CodedRows(NamedTuple):
    """Rows that share patterns of coefficients; see `SampledRows`."""

    row_pattern: I32  #: (n_rows,) -1: the row is the identity within the tolerance
    row_step: F32  #: (n_rows, k)
    indptr: I64
    indices: I32
    numbers: NDArray[np.int8] | NDArray[np.int16]
    error: F64  #: (n_rows, k) largest difference at any leaf, quantisation and rounding included


class ColumnsDiffer(Exception):
    """Columns that were said to be alike are not."""


class RowCoder:
    """Codes rows as they come; equal patterns are kept once.

    Parameters
    ----------
    tree
        Of the leaves.
    tolerance : (k,) float64
        Largest difference allowed in each column; 0 where the column must be as exact as 16 bits make it.
    n_coefficients : int, optional
        Keep this many in each row instead, whatever the error.
    alike : (k,) int, optional
        An equal column of each, possibly itself, or -1 where it is 0 throughout: coded once, and checked.
    """

    def __init__(
        self, tree: ClusterTree, tolerance: F64, n_coefficients: int | None = None, alike: I64 | None = None
    ) -> None:
        self._tree = tree
        self._alike = np.arange(len(tolerance)) if alike is None else alike
        self._distinct = np.unique(np.append(self._alike[self._alike >= 0], self._alike.max(initial=-1).clip(0)))
        self._tolerance = np.asarray(tolerance, np.float64)[self._distinct]
        self._n_kept = -1 if n_coefficients is None else min(n_coefficients, tree.n_leaves)
        self._known: dict[bytes, int] = {}
        self._patterns: list[tuple[I32, NDArray[np.int16]]] = []
        self._rows: list[tuple[I32, F32, F64]] = []
        # Fine steps until coarse ones have been seen to do.
        self._largest = BYTE

    def add(self, values: F32) -> None:
        """Code rows (n, n_leaves, k) float32.

        Raises
        ------
        ColumnsDiffer
            Columns are not alike after all.
        """
        for column, like in enumerate(self._alike):
            equal = (
                not values[..., column].any() if like < 0 else np.array_equal(values[..., column], values[..., like])
            )
            if like != column and not equal:
                raise ColumnsDiffer
        values = np.ascontiguousarray(values[..., self._distinct], np.float32)
        coded = self._encode(values, self._largest)
        if self._largest == BYTE and not self._is_fine(coded[4]):
            self._largest = WORD
            coded = self._encode(values, WORD)
        count, index, number, step, error = coded
        pattern = np.full(len(values), -1, np.int32)
        for r, n in enumerate(count.tolist()):
            if n == 0:
                step[r] = 0
                continue
            entry = (index[r, :n].copy(), number[r, :n].copy())
            key = entry[0].tobytes() + entry[1].tobytes()
            pattern[r] = self._known.setdefault(key, len(self._patterns))
            if pattern[r] == len(self._patterns):
                self._patterns.append(entry)
        largest = np.abs(values).max(axis=1, initial=0.0).astype(np.float64)
        self._rows.append((pattern, step, error + _ROUNDING * (largest + error)))

    def _is_fine(self, error: F64) -> bool:
        if self._n_kept < 0:
            return bool((error <= self._tolerance).all())
        return False  # what was left out hides what rounding adds: rounding shall not add to it

    def _encode(self, values: F32, largest: int) -> tuple[I64, I32, NDArray[np.int16], F32, F64]:
        tree = self._tree
        n, n_leaves, k = values.shape
        width = n_leaves if self._n_kept < 0 else max(self._n_kept, 1)
        count = np.empty(n, np.int64)
        # One more than can be kept: a coefficient that rounds to nothing is written before it is dropped.
        index = np.empty((n, width + 1), np.int32)
        number = np.empty((n, width + 1, k), np.int16)
        step, error = np.empty((n, k), np.float32), np.empty((n, k), np.float64)
        row_coding.encode_rows(
            tree.lo,
            tree.hi,
            tree.left,
            tree.right,
            tree.weight,
            tree.node_weight,
            tree.depth,
            values,
            self._tolerance,
            self._n_kept,
            largest,
            count,
            index,
            number,
            step,
            error,
        )
        return count, index, number, step, error

    def finish(self) -> CodedRows:
        """All rows that were added, in order."""
        k = len(self._tolerance)
        place, zero = np.searchsorted(self._distinct, np.maximum(self._alike, 0)), self._alike < 0
        patterns, steps, errors = zip(*self._rows, strict=True) if self._rows else ((), (), ())
        lengths = [len(index) for index, _ in self._patterns]
        numbers = np.concatenate([np.zeros((0, k), np.int16), *(number for _, number in self._patterns)])
        if np.abs(numbers).max(initial=0) <= BYTE:
            numbers = numbers.astype(np.int8)
        step = np.concatenate([np.zeros((0, k), np.float32), *steps])[:, place]
        error = np.concatenate([np.zeros((0, k), np.float64), *errors])[:, place]
        step[:, zero], error[:, zero] = 0, 0
        return CodedRows(
            np.concatenate([np.zeros(0, np.int32), *patterns]),
            step,
            np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            np.concatenate([np.zeros(0, np.int32), *(index for index, _ in self._patterns)]),
            np.ascontiguousarray(numbers[:, place]),
            error,
        )
