"""View samples grouped by which rows of a stack touch them, wholly or softly, and the terms that make their light.

Light is affine in every soft mask and in what every aggregate came to, so that

    light = base + sum over terms of (product of factors) x (transport x version)

with few terms: a difference that several edits make together is 0 unless some
caster is touched by all of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import terms as kernels
from icheat_usd.kernels.versions import COMPOSE
from icheat_usd.relight.compiled import CompiledStack, Way
from icheat_usd.relight.version_lists import VersionKey
from icheat_usd.scene import F32, I32, I64

#: More terms than this, and the samples of a group are evaluated pair by pair.
MOST_TERMS = 16
#: The same where the terms are summed for all samples of a group at once.
MOST_SHARED_TERMS = 64


class Term(NamedTuple):
    """One summand of the light of a group's samples."""

    version: VersionKey
    factors: tuple[int, ...]  #: members of the stack whose soft mask, or what they came to, multiply


class GroupTerms(NamedTuple):
    """How the light of the samples of one group is put together; `alone`: it is not, but pair by pair."""

    light: tuple[Term, ...] = ()
    seen: tuple[tuple[int, tuple[Term, ...]], ...] = ()  #: by row of each aggregate, in order: the light that it sees
    alone: bool = False
    view: bool = False  #: something acts on all their light at the end


class TermTable(NamedTuple):
    """Terms of all groups as arrays, see `kernels.terms.add_terms`."""

    term_begin: I64
    term_version: I32
    factor_begin: I64
    factor: I32


def group_terms(
    compiled: CompiledStack, whole: Sequence[int], soft: Sequence[int], divided: bool = False
) -> GroupTerms:
    """Terms of samples that some rows touch wholly and some softly.

    Parameters
    ----------
    divided
        Rows that no caster has in common go to terms of their own: more terms of fewer versions.
    """
    way = compiled.way
    touching = [row for row in (*whole, *soft) if way[row] != Way.VIEW]
    aggregates = sorted(row for row in touching if way[row] == Way.AGGREGATE)
    if any(way[row] == Way.ALONE for row in touching):
        return GroupTerms(alone=True)
    by_version = {Way.VERSION, Way.PAIRS}
    hard = tuple(sorted(row for row in whole if way[row] in by_version and _meets(compiled, (row,))))
    varying = [row for row in soft if way[row] in by_version] + aggregates
    if _looks_at_soft(compiled, touching, varying) or _changes_offset(compiled, touching):
        return GroupTerms(alone=True)
    members = sorted(varying + [int(compiled.row_table[row, 4]) for row in aggregates], key=_order(compiled))
    light = _terms(compiled, hard, members, -1)
    if divided and light and not light[0].factors:
        parts = _components(compiled, light[0].version.whole)
        light = (*(Term(VersionKey(part), ()) for part in parts), *light[1:])
    seen = []
    for row in aggregates:
        edit = compiled.edit_of[row]
        below = [member for member in members if compiled.edit_of[member] < edit]
        terms = _terms(compiled, tuple(r for r in hard if compiled.edit_of[r] < edit), below, row)
        seen.append((row, terms))
    most = MOST_TERMS if members else MOST_SHARED_TERMS
    if max([len(light), *(len(terms) for _, terms in seen)]) > most:
        return GroupTerms(alone=True)
    return GroupTerms(light, tuple(seen), view=any(way[row] == Way.VIEW for row in (*whole, *soft)))


def _components(compiled: CompiledStack, rows: tuple[int, ...]) -> list[tuple[int, ...]]:
    """The rows in sets that have no caster in common, each ascending."""
    parts: list[set[int]] = []
    for row in rows:
        near = {other for other in rows if _meets(compiled, (row, other))} | {row}
        meeting = [part for part in parts if part & near]
        parts = [part for part in parts if not part & near] + [near.union(*meeting)]
    return sorted(tuple(sorted(part)) for part in parts)


def _order(compiled: CompiledStack):  # type: ignore[no-untyped-def]
    return lambda member: (int(compiled.edit_of[member]), member)


def _meets(compiled: CompiledStack, members: Sequence[int]) -> bool:
    return bool(compiled.meet(members).any())


def _looks_at_soft(compiled: CompiledStack, touching: Sequence[int], varying: Sequence[int]) -> bool:
    """Whether an edit looks at light that a weaker one leaves in an amount of each sample's own."""
    for row in touching:
        if compiled.looks[row] and compiled.way[row] != Way.AGGREGATE and compiled.row_table[row, 2] == COMPOSE:
            for below in varying:
                if compiled.edit_of[below] < compiled.edit_of[row] and _meets(compiled, (row, below)):
                    return True
    return False


def _changes_offset(compiled: CompiledStack, touching: Sequence[int]) -> bool:
    """Whether an edit that looks at receivers lies over an offset, which does not come by rows of the transport."""
    for row in touching:
        for below in touching if compiled.way[row] == Way.PAIRS else ():
            weaker = compiled.edit_of[below] < compiled.edit_of[row]
            if weaker and compiled.gives_offset[below] and _meets(compiled, (row, below)):
                return True
    return False


def _terms(compiled: CompiledStack, hard: tuple[int, ...], members: Sequence[int], restrict: int) -> tuple[Term, ...]:
    inside = () if restrict < 0 else (restrict,)
    found: list[Term] = []

    def extend(differ: tuple[int, ...], begin: int) -> None:
        if len(found) > MOST_TERMS:
            return
        together = (*differ, *inside)
        acting = tuple(row for row in hard if not together or _meets(compiled, (*together, row)))
        if together or acting:
            found.append(Term(VersionKey(acting, differ, restrict), differ))
        for k in range(begin, len(members)):
            # Keys of one edit are summed, so that together they make no difference of their own.
            same = any(compiled.edit_of[members[k]] == compiled.edit_of[other] for other in differ)
            if not same and _meets(compiled, (*together, members[k])):
                extend((*differ, members[k]), k + 1)

    if not inside or _meets(compiled, inside):
        extend((), 0)
    return tuple(found)


class SampleGroups:
    """Which group each view sample belongs to; groups are numbered as they appear, and never change.

    Parameters
    ----------
    mask_rows : (n_rows,)
        Where in the receiver masks that of each row is.
    """

    def __init__(self, compiled: CompiledStack, mask_rows: I64, n_view: int, divided: bool = False) -> None:
        self.divided = divided
        self._number: dict[bytes, int] = {}
        self._members: dict[bytes, frozenset[int]] = {}  # rows of the masks that touch each group that can grow
        self.of_sample: I32 = np.full(n_view, -1, np.int32)  #: -1: no edit touches it
        self.terms: list[GroupTerms] = []
        self.undivided: list[GroupTerms] = []  #: the same as if they were not divided; empty if they are not
        self._take(compiled, mask_rows)

    def _take(self, compiled: CompiledStack, mask_rows: I64) -> None:
        self._compiled = compiled
        self._row_of = dict(zip(mask_rows.tolist(), range(len(mask_rows)), strict=True))

    def restructured(self, compiled: CompiledStack, mask_rows: I64, before: I64, gone: Iterable[int]) -> I64:
        """Go on with another stack; samples, ascending, whose rows have changed their order and need `assign`.

        Parameters
        ----------
        before : (n_rows,) row that each row was, -1 for new ones
        gone
            Rows of the masks that now belong to another row, or none; `assign` the samples that they touched, too.
        """
        was, lost = self._row_of, frozenset(gone)
        self._take(compiled, mask_rows)
        stays = before[before >= 0]
        is_reordered = bool((np.diff(stays) < 0).any())
        regrouped = np.zeros(len(self.terms) + 1, np.bool_)
        for key, members in list(self._members.items()):
            if members & lost:
                del self._number[key], self._members[key]
            elif is_reordered:
                rows = [was[member] for member in sorted(members, key=self._row_of.__getitem__)]
                if rows != sorted(rows):
                    regrouped[self._number[key]] = True
                    del self._number[key], self._members[key]
        return np.flatnonzero(regrouped[self.of_sample]) if regrouped.any() else np.empty(0, np.int64)

    def assign(self, samples: I64, masks: F32) -> int:
        """Find the groups of some samples by their receiver masks; returns how many groups are new."""
        n_before = len(self.terms)
        words = max(1, -(-len(masks) // 64))
        keys = np.empty((len(samples), 2 * words), np.uint64)
        kernels.signatures(masks, samples, keys)
        table = np.full(1 << max(4, int(np.ceil(np.log2(max(2 * len(samples), 1))))), -1, np.int64)
        first, local = np.empty(len(samples), np.int64), np.empty(len(samples), np.int64)
        n = kernels.group_rows(keys, table, first, local)
        number = np.array([self._group(keys[k], words) for k in first[:n]], np.int32)
        self.of_sample[samples] = number[local] if n else -1
        return len(self.terms) - n_before

    def _group(self, key: np.ndarray, words: int) -> int:
        if not key.any():
            return -1
        name = key.tobytes()
        if name not in self._number:
            bits = np.unpackbits(key.view(np.uint8), bitorder="little")
            sides = [np.flatnonzero(bits[side : side + 64 * words]).tolist() for side in (0, 64 * words)]
            whole, soft = (sorted(self._row_of[member] for member in side) for side in sides)
            self._members[name] = frozenset(sides[0] + sides[1])
            self._number[name] = len(self.terms)
            self.terms.append(group_terms(self._compiled, whole, soft, self.divided))
            if self.divided:
                self.undivided.append(group_terms(self._compiled, whole, soft))
        return self._number[name]

    def live(self) -> I64:
        """Groups that some sample belongs to, ascending."""
        return np.flatnonzero(np.bincount(self.of_sample + 1, minlength=len(self.terms) + 1)[1:])


def versions_of(terms: Iterable[GroupTerms]) -> set[VersionKey]:
    """Versions that the light of some groups is made of."""
    found: set[VersionKey] = set()
    for group in terms:
        found.update(term.version for term in group.light)
        for row, seen in group.seen:
            found.update(term.version for term in seen)
            if seen:
                found.add(reach_of(row))
    return found


def reach_of(row: int) -> VersionKey:
    """The weights of the casters of an aggregate's row."""
    return VersionKey((), (), row, True)
