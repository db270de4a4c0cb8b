"""The terms of all groups of view samples as arrays, one table for each step of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icheat_usd.kernels import versions as kernels
from icheat_usd.relight.compiled import CompiledStack, Way
from icheat_usd.relight.groups import GroupTerms, SampleGroups, Term, TermTable
from icheat_usd.relight.products import Products
from icheat_usd.relight.versions import VersionKey, Versions
from icheat_usd.scene import F32, I64, Bool


class TermTables:
    """Steps are: for each aggregate the light that it sees and its reach, and the light at the end."""

    def __init__(self, compiled: CompiledStack, groups: SampleGroups, versions: Versions) -> None:
        self._compiled, self._groups, self._versions = compiled, groups, versions
        self.aggregates = np.flatnonzero(compiled.way == Way.AGGREGATE)  #: rows of the stack
        self.light = _EMPTY
        self.seen: list[TermTable] = []  #: by aggregate
        self.reach: list[TermTable] = []  #: by aggregate
        self.alone: Bool = np.zeros(0, np.bool_)  #: (n_groups,) evaluated pair by pair
        self.shared: Bool = np.zeros(0, np.bool_)  #: (n_groups,) the same for all samples, but for the interpolation

    @property
    def steps(self) -> list[TermTable]:
        return [*self.seen, *self.reach, self.light]

    def arrange(self) -> None:
        """Make the tables for the groups that there are now."""
        groups = self._groups.terms
        self.alone = np.array([terms.alone for terms in groups], np.bool_)
        offsets = self._compiled.field.has_offset
        self.shared = np.array([not offsets and _is_shared(terms) for terms in groups], np.bool_)
        self.light = self._table([terms.light for terms in groups])
        seen: list[dict[int, tuple[Term, ...]]] = [dict(terms.seen) for terms in groups]
        self.seen = [self._table([terms.get(int(row), ()) for terms in seen]) for row in self.aggregates]
        self.reach = []
        for row in self.aggregates:
            term = Term(VersionKey((), (), int(row), True), ())
            self.reach.append(self._table([(term,) if terms.get(int(row)) else () for terms in seen]))

    def add(
        self, table: TermTable, samples: I64, masks: F32, own: F32, products: Products, albedo: F32, out: F32
    ) -> None:
        """Add the terms of some samples to `out`; see `kernels.versions.add_terms`."""
        if not len(table.term_version) or not len(samples):
            return
        spread, versions = products.interpolation, self._versions
        kernels.add_terms(
            samples,
            self._groups.of_sample,
            table.term_begin,
            table.term_version,
            table.factor_begin,
            table.factor,
            masks,
            len(masks),
            own,
            products.is_sparse,
            spread.indptr,
            spread.indices,
            spread.weights,
            versions.pair_of,
            versions.values,
            products.tints,
            albedo,
            versions.offsets,
            out,
        )

    def _table(self, terms: Sequence[tuple[Term, ...]]) -> TermTable:
        flat = [term for group in terms for term in group]
        factors = [[self._factor(member) for member in term.factors] for term in flat]
        return TermTable(
            np.concatenate([[0], np.cumsum([len(group) for group in terms])]).astype(np.int64),
            np.array([self._versions.number(term.version) for term in flat], np.int32),
            np.concatenate([[0], np.cumsum([len(some) for some in factors])]).astype(np.int64),
            np.array([member for some in factors for member in some], np.int32),
        )

    def _factor(self, member: int) -> int:
        """Where `add_terms` finds the factor of a member: in the masks, or among what aggregates came to."""
        n_rows = self._compiled.n_rows
        if member >= n_rows:
            return n_rows + 2 * (member - n_rows) + 1
        if self._compiled.way[member] == Way.AGGREGATE:
            return n_rows + 2 * int(np.searchsorted(self.aggregates, member))
        return member


def _is_shared(terms: GroupTerms) -> bool:
    return not (terms.alone or terms.view or terms.seen or any(term.factors for term in terms.light))


_EMPTY = TermTable(np.zeros(2, np.int64), np.zeros(0, np.int32), np.zeros(1, np.int64), np.zeros(0, np.int32))
