"""The terms of all groups of view samples as arrays, one table for each step of an evaluation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icheat_usd.kernels import terms as kernels
from icheat_usd.kernels.soft_terms import SoftTable
from icheat_usd.relight.compiled import Way
from icheat_usd.relight.groups import GroupTerms, SampleGroups, Term, TermTable, reach_of
from icheat_usd.relight.live_stack import LiveStack
from icheat_usd.relight.products import Products
from icheat_usd.relight.soft_samples import SoftSamples
from icheat_usd.relight.versions import Versions
from icheat_usd.scene import F32, I64, Bool


class TermTables:
    """Steps are: for each aggregate the light that it sees and its reach, and the light at the end."""

    def __init__(self, stack: LiveStack, groups: SampleGroups, versions: Versions) -> None:
        self._groups, self._versions = groups, versions
        compiled = stack.compiled
        self.aggregates = np.flatnonzero(compiled.way == Way.AGGREGATE)  #: rows of the stack
        self.light = _EMPTY
        self.alike = _EMPTY  #: of those, what all samples of a group receive alike; nothing of groups that are mixed
        self.soft = _EMPTY  #: what is left of groups whose other terms have no factors but masks
        self._soft_samples = SoftSamples()
        self.is_soft: Bool = np.zeros(0, np.bool_)  #: (n_groups,) whether something is
        self.seen: list[TermTable] = [_EMPTY] * len(self.aggregates)  #: by aggregate
        self.reach: list[TermTable] = [_EMPTY] * len(self.aggregates)  #: by aggregate
        self.alone: Bool = np.zeros(0, np.bool_)  #: (n_groups,) evaluated pair by pair
        self.shared: Bool = np.zeros(0, np.bool_)  #: (n_groups,) the same for all samples, but for the interpolation
        self.restructured(stack)

    def restructured(self, stack: LiveStack) -> None:
        """Go on with another stack; only one without aggregates may have other rows."""
        self._compiled, self._mask_rows, self._n_masks = stack.compiled, stack.mask_rows, len(stack.receiver_masks)

    @property
    def steps(self) -> list[TermTable]:
        return [*self.seen, *self.reach, self.light]

    def arrange(self) -> None:
        """Make the tables for the groups that are new."""
        groups = self._groups.terms[len(self.shared) :]
        if not groups:
            return
        self.alone = np.append(self.alone, [terms.alone for terms in groups]).astype(np.bool_)
        shared = [self._is_shared(terms) for terms in groups]
        self.shared = np.append(self.shared, shared).astype(np.bool_)
        is_soft = [self._is_soft(terms) for terms in groups]
        self.is_soft = np.append(self.is_soft, is_soft).astype(np.bool_)
        self.light = self._more(self.light, [terms.light for terms in groups])
        alike, soft = [], []
        for terms, *either in zip(groups, shared, is_soft, strict=True):
            some = terms.light if any(either) else ()
            alike.append(tuple(term for term in some if not term.factors))
            soft.append(tuple(term for term in some if term.factors))
        self.alike, self.soft = self._more(self.alike, alike), self._more(self.soft, soft)
        seen: list[dict[int, tuple[Term, ...]]] = [dict(terms.seen) for terms in groups]
        for k, row in enumerate(self.aggregates.tolist()):
            self.seen[k] = self._more(self.seen[k], [terms.get(row, ()) for terms in seen])
            reach = Term(reach_of(row), ())
            self.reach[k] = self._more(self.reach[k], [(reach,) if terms.get(row) else () for terms in seen])

    def versions(self, groups: I64) -> set[int]:
        """Numbers of the versions that some groups need."""
        found: set[int] = set()
        for table in self.steps:
            for group in groups:
                found.update(table.term_version[table.term_begin[group] : table.term_begin[group + 1]].tolist())
        return found

    def add(
        self, table: TermTable, samples: I64, masks: F32, own: F32, products: Products, albedo: F32, out: F32
    ) -> None:
        """Add the terms of some samples to `out`; see `kernels.terms.add_terms`."""
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

    def add_soft(self, samples: I64, masks: F32, products: Products, out: F32, values: F32 | None = None) -> None:
        """Light of samples of groups that are soft, besides what they share; see `relight.soft_samples`.

        Parameters
        ----------
        values
            Products of the versions with other light.
        """
        table = SoftTable(*self.soft, masks)
        values = self._versions.values if values is None else values
        self._soft_samples.light(samples, self._groups.of_sample, table, self._versions.pair_of, values, products, out)

    def _more(self, table: TermTable, terms: Sequence[tuple[Term, ...]]) -> TermTable:
        """A table with more groups at the end."""
        flat = [term for group in terms for term in group]
        factors = [[self._factor(member) for member in term.factors] for term in flat]
        ends = table.term_begin[-1] + np.cumsum([len(group) for group in terms])
        factor_ends = table.factor_begin[-1] + np.cumsum([len(some) for some in factors])
        return TermTable(
            np.append(table.term_begin, ends).astype(np.int64),
            np.append(table.term_version, [self._versions.number(term.version) for term in flat]).astype(np.int32),
            np.append(table.factor_begin, factor_ends).astype(np.int64),
            np.append(table.factor, [member for some in factors for member in some]).astype(np.int32),
        )

    def _is_shared(self, terms: GroupTerms) -> bool:
        return self._is_by_products(terms) and not any(term.factors for term in terms.light)

    def _is_soft(self, terms: GroupTerms) -> bool:
        factors = {member for term in terms.light for member in term.factors}
        aggregates = set(self.aggregates.tolist())
        of_masks = all(member < self._compiled.n_rows and member not in aggregates for member in factors)
        return bool(factors) and of_masks and self._is_by_products(terms)

    def _is_by_products(self, terms: GroupTerms) -> bool:
        """Whether all light comes by products."""
        if terms.alone or terms.view or terms.seen:
            return False
        rows = [row for term in terms.light for row in (*term.version.whole, *term.factors)]
        return not self._compiled.gives_offset[[row for row in rows if row < self._compiled.n_rows]].any()

    def _factor(self, member: int) -> int:
        """Where `add_terms` finds the factor of a member: in the masks, or among what aggregates came to."""
        n_rows = self._compiled.n_rows
        if member >= n_rows:
            return self._n_masks + 2 * (member - n_rows) + 1
        if self._compiled.way[member] == Way.AGGREGATE:
            return self._n_masks + 2 * int(np.searchsorted(self.aggregates, member))
        return int(self._mask_rows[member])


_EMPTY = TermTable(np.zeros(1, np.int64), np.zeros(0, np.int32), np.zeros(1, np.int64), np.zeros(0, np.int32))
