"""View samples under soft masks, and the products of all their terms laid side by side while these stay the same."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import soft_terms as kernels
from icheat_usd.kernels.soft_terms import SoftTable
from icheat_usd.relight.products import Products
from icheat_usd.scene import F32, I32, I64

#: Memory of the products that are laid side by side; where they would take more they stay where they are.
_MOST_BYTES = 128_000_000


class _Asked(NamedTuple):
    """Whose light was asked for."""

    samples: I64
    group: I32  #: of each
    term_begin: I64  #: of the terms of all groups

    def is_same(self, other: _Asked) -> bool:
        samples, group, term_begin = other
        is_same = np.array_equal(self.samples, samples) and np.array_equal(self.group, group)
        return is_same and np.array_equal(self.term_begin, term_begin)


@dataclass
class _Places:
    """Where the products of samples are laid."""

    group: I32  #: (n_slots,) with a record of one of its samples each
    row: I32  #: (n_slots,)
    begin: I64  #: (n_slots + 1,) of the terms of each
    first: I64  #: (n_samples,) first of the places of each sample
    place: I64  #: of every record of every sample
    gathered: F32  #: (n_lobes, begin[-1], 4)


class SoftSamples:
    """Finds light under soft masks; what it finds for the same samples again and again takes less time.

    Both ways have the same bits.
    """

    def __init__(self) -> None:
        self._asked: _Asked | None = None  # the last time
        self._places: _Places | None = None  # of these
        self._is_large = False  # they have too many

    def light(
        self, samples: I64, group: I32, table: SoftTable, pair_of: I32, values: F32, products: Products, out: F32
    ) -> None:
        """Light of `samples` into ``out[samples]``; see `kernels.soft_terms.soft_terms`."""
        spread = products.interpolation
        asked = _Asked(samples, group[samples], table.term_begin)
        if self._asked is None or not asked.is_same(self._asked):
            self._asked, self._places, self._is_large = asked._replace(samples=samples.copy()), None, False
        elif self._places is None and products.is_sparse and not self._is_large:
            self._places = _find_places(asked, products)
            self._is_large = self._places is None
        if self._places is None:
            rows = spread.indptr, spread.indices, spread.weights
            kernels.soft_terms(samples, group, table, products.is_sparse, *rows, pair_of, values, products.tints, out)
            return
        at = self._places
        kernels.gather_terms(at.group, at.row, at.begin, table, pair_of, values, at.gathered)
        kernels.gathered_terms(
            samples, group, table, at.first, at.place, spread.indptr, spread.weights, at.gathered, products.tints, out
        )


def _find_places(asked: _Asked, products: Products) -> _Places | None:
    samples, group, term_begin = asked
    spread = products.interpolation
    count = np.diff(spread.indptr)[samples]
    first = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64)
    entry = np.arange(count.sum()) + np.repeat(spread.indptr[samples] - first, count)
    key = np.repeat(group.astype(np.int64), count) * spread.n_columns + spread.indices[entry]
    slot, slot_of = np.unique(key, return_inverse=True)
    of_group, row = np.divmod(slot, spread.n_columns)
    begin = np.concatenate([[0], np.cumsum(np.diff(term_begin)[of_group])]).astype(np.int64)
    shape = len(products.tints), int(begin[-1]), 4
    if 4 * np.prod(shape, dtype=np.int64) > _MOST_BYTES:
        return None
    place = begin[slot_of]
    return _Places(of_group.astype(np.int32), row.astype(np.int32), begin, first, place, np.empty(shape, np.float32))
