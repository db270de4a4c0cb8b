"""Masks of receivers that the light of cache records is found for, and which places these serve.

All of it follows from where receivers lie in masks and from how far a mask may change light: stacks that differ in
amounts alone share it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import Lookup
from icheat_usd.final_gather.receiver_sets import Touched
from icheat_usd.final_gather.same_stack import same_receivers
from icheat_usd.kernels import record_slots as kernels
from icheat_usd.kernels import terms
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.scene import F32, I32, I64, Bool

#: Relative change of light between a place and the masks that a record's light was found for, and what it misses:
#: masks that change together bend it.
MOST_CHANGE, MOST_BEND = 0.25, 0.01
#: Stacks whose choices are kept for others.
_MOST_KEPT = 4
#: Share of pairs that own slots of records may leave, so that all records that are likely to be asked get one.
_FEW_LEFT = 0.01
_TURNS = 64  #: more than there are threads


class Slots(NamedTuple):
    """Masks of receivers that light of records is wanted for, those of one call of `SlotChoices.serve` by record."""

    record: I64  #: (n,)
    masks: F32  #: (n, n_rows)
    pattern: I32  #: (n,)
    derived: I64  #: (n + 1,) derivatives of each
    is_own: Bool  #: (n,) whether the masks are those of the record's own place


class _Step(NamedTuple):
    """What was asked for and found by one call."""

    found: Lookup
    receivers: Touched
    slots: Slots  #: all up to then
    slot: I64


def slot_choices(field: EditField, bend: F32, of: Hemispheres) -> SlotChoices:
    """Choices for a stack on records with these hemispheres: those of a stack before, if nothing sets them apart."""
    for one in of.choices:
        if one.is_of(field, bend):
            return one.again()
    choices = SlotChoices(field, bend, of)
    if of.is_kept:
        of.choices[:] = [*of.choices[1 - _MOST_KEPT :], choices]
    return choices


class SlotChoices:
    """Slots of n records, new ones for whatever asks for them.

    Parameters
    ----------
    bend : (n_rows,)
        Largest relative change of light by the mask of each row.
    """

    def __init__(self, field: EditField, bend: F32, of: Hemispheres) -> None:
        self._field, self._all_bend, self._of = field, bend, of
        is_soft = _vary(field) & (bend > 0)
        self._bend = np.where(is_soft, bend, np.float32(0))
        self.patterns = Patterns(is_soft, bend > 0)
        self._own: tuple[F32, I32] | None = None
        self._likely: Bool | None = None
        self._steps: list[_Step] = []
        self._before: list[_Step] = []
        n_rows = field.n_rows
        self.slots = Slots(
            np.empty(0, np.int64),
            np.empty((0, n_rows), np.float32),
            np.empty(0, np.int32),
            np.zeros(1, np.int64),
            np.empty(0, np.bool_),
        )

    def is_of(self, field: EditField, bend: F32) -> bool:
        """Whether a stack leaves no choice that this one has not."""
        return np.array_equal(self._all_bend, bend) and same_receivers(self._field, field)

    def again(self) -> SlotChoices:
        """From the start, with what was found for the same calls before."""
        found = SlotChoices(self._field, self._all_bend, self._of)
        found._before = self._steps or self._before
        found.patterns, found._own, found._likely = self.patterns, self._own, self._likely
        self._of.choices[:] = [found if one is self else one for one in self._of.choices]
        return found

    def serve(self, found: Lookup, receivers: Touched, masks: F32, first: I64) -> I64:
        """Slot of every pair of a receiver and one of its records, new ones where there are none.

        Parameters
        ----------
        found : of all points
        masks : (k, n_rows)
            Columns of the receivers.
        first : (m,)
            First pair of each.
        """
        step = len(self._steps)
        if step < len(self._before) and _is_same(self._before[step], found, receivers):
            self._steps.append(self._before[step])
            self.slots = self._before[step].slots
            return self._before[step].slot
        self._before = []
        if self._bend.any():
            slot = self._choose(found, receivers.where, receivers.which, masks, first)
        else:
            slot = self._choose_by_pattern(found, receivers.where, receivers.which, masks, first)
        if self._of.is_kept:
            self._steps.append(_Step(found, receivers, self.slots, slot))
        return slot

    def _choose(self, found: Lookup, where: I64, which: I64, masks: F32, first: I64) -> I64:
        """`serve` where masks vary from place to place."""
        slots, n_records, pattern = self.slots, self._of.n, self.patterns.of(masks)
        own_masks, own_pattern = self._own_masks()
        near = (self._bend, MOST_CHANGE, MOST_BEND)
        slot = np.empty(int(np.take(found.number, where).sum()), np.int64)
        used = np.zeros(n_records, np.uint8)
        kernels.served_by_own(
            found.number,
            found.record,
            where,
            which,
            masks,
            pattern,
            own_masks,
            own_pattern,
            *near,
            first,
            slot,
            used,
        )
        own_slot = np.full(n_records, -1, np.int64)
        own_slot[slots.record[slots.is_own]] = np.flatnonzero(slots.is_own)
        is_left = slot == -2
        n_left = int(is_left.sum())
        if len(slots.record) == 0 and n_left < _FEW_LEFT * len(slot):
            # Other bands of the image will ask for the rest: rays of all are looked through once.
            used |= self.likely().view(np.uint8)
        own = np.flatnonzero(used.view(np.bool_) & (own_slot < 0))
        # The few others, by record.
        begin, pair, place = np.zeros(n_records + 1, np.int64), np.empty(n_left, np.int64), np.empty(n_left, np.int64)
        if n_left:
            kernels.list_pairs(found.number, found.record, where, is_left, begin, pair, place)
        number_left, column = np.diff(begin), which[place]
        record, numbers = np.repeat(np.arange(n_records), number_left), np.arange(n_records + 1)
        known, centre = np.argsort(slots.record, kind="stable"), np.empty(len(pair), np.int64)
        kernels.choose_slots(
            in_turn(np.flatnonzero(number_left)),
            begin,
            column,
            masks,
            pattern,
            np.searchsorted(slots.record[known], numbers),
            known,
            slots.masks,
            slots.pattern,
            *near,
            centre,
        )
        new = np.flatnonzero(centre == np.arange(len(pair)))
        of_new = np.concatenate([own, record[new]])
        order = np.argsort(of_new, kind="stable")
        number = np.empty(len(of_new), np.int64)
        number[order] = len(slots.record) + np.arange(len(of_new))
        own_slot[own] = number[: len(own)]
        of_pair = np.zeros(len(pair), np.int64)
        of_pair[new] = number[len(own) :]
        slot[pair] = np.where(centre < 0, -1 - centre, of_pair[np.maximum(centre, 0)])
        kernels.take_own(found.number, found.record, where, own_slot, first, slot)
        self._add(
            of_new[order],
            np.concatenate([own_masks[own], masks[column[new]]])[order],
            np.concatenate([own_pattern[own], pattern[column[new]]])[order],
            order < len(own),
        )
        return slot

    def _choose_by_pattern(self, found: Lookup, where: I64, which: I64, masks: F32, first: I64) -> I64:
        """`serve` where masks are the same all over a pattern."""
        n_records = self._of.n
        pattern = self.patterns.of(masks)
        at_places = np.take(pattern, which)
        needed = np.zeros((n_records, int(pattern.max(initial=0)) + 1), np.uint8)
        kernels.mark_records(found.number, found.record, where, at_places, needed)
        most = max(needed.shape[1], int(self.slots.pattern.max(initial=0)) + 1)
        known = np.full((n_records, most), -1, np.int64)
        known[self.slots.record, self.slots.pattern] = np.arange(len(self.slots.record))
        record, new = np.nonzero(needed.view(np.bool_) & (known[:, : needed.shape[1]] < 0))
        if len(record):
            known[record, new] = len(self.slots.record) + np.arange(len(record))
            column = np.zeros(needed.shape[1], np.int64)
            column[pattern] = np.arange(len(pattern))
            self._add(record, masks[column[new]], new.astype(np.int32), np.zeros(len(record), np.bool_))
        slot = np.empty(int(found.number[where].sum()), np.int64)
        kernels.slots_of_pairs(found.number, found.record, where, at_places, known, first, slot)
        return slot

    def likely(self) -> Bool:
        """(n_records,) records that a receiver in an edit may well ask for: they lie in one themselves."""
        if self._likely is None:
            masks, _ = self._own_masks()
            self._likely = np.asarray((masks[:, self.patterns.acts] > 0).any(axis=1))
        return self._likely

    def _own_masks(self) -> tuple[F32, I32]:
        """Masks at the records' own places, and their patterns."""
        if self._own is None:
            parts = self._of.parts
            owner = np.concatenate([part.owner for part in parts])
            _, first = np.unique(owner, return_index=True)
            points = take_points(concatenate_points(*(part.points for part in parts)), first)
            masks = np.ascontiguousarray(self._field.receiver_masks(points).T)
            self._own = masks, self.patterns.of(masks)
        return self._own

    def _add(self, record: I64, masks: F32, pattern: I32, is_own: Bool) -> None:
        """New slots, of ascending records."""
        if len(record) == 0:
            return
        number = (self.patterns.places() >= 0).sum(axis=1)[pattern]
        old = self.slots
        self.slots = Slots(
            np.concatenate([old.record, record]),
            np.concatenate([old.masks, masks]),
            np.concatenate([old.pattern, pattern]),
            np.concatenate([old.derived, old.derived[-1] + np.cumsum(number, dtype=np.int64)]),
            np.concatenate([old.is_own, is_own]),
        )


def _is_same(step: _Step, found: Lookup, receivers: Touched) -> bool:
    """Whether a call asks for what another has found."""
    own = step.receivers
    return (
        step.found.record is found.record
        and own.columns is receivers.columns
        and np.array_equal(own.where, receivers.where)
        and np.array_equal(own.which, receivers.which)
    )


def in_turn(records: I64) -> I64:
    """Numbers in an order of which any long part has some from everywhere, so that threads have as much to do."""
    return records[np.argsort(np.arange(len(records)) % _TURNS, kind="stable")]


class Patterns:
    """Sets of rows that receivers are in, numbered as they come up.

    Parameters
    ----------
    is_soft : (n_rows,)
        Rows whose masks vary from place to place.
    acts : (n_rows,)
        Rows that change light.
    """

    def __init__(self, is_soft: Bool, acts: Bool) -> None:
        self._is_soft, self.acts = is_soft, acts
        self._number: dict[bytes, int] = {}
        self._is_in: list[Bool] = []

    def of(self, masks: F32) -> I32:
        """Pattern of each of k columns of masks, (k, n_rows)."""
        n = len(masks)
        is_in = np.empty((n, -(-masks.shape[1] // 64)), np.uint64)
        kernels.rows_in(masks, self.acts, is_in)
        table = np.full(1 << (2 * n).bit_length(), -1, np.int64)
        first, which = np.empty(n, np.int64), np.empty(n, np.int64)
        n_different = terms.group_rows(is_in, table, first, which)
        numbers = np.empty(n_different, np.int32)
        for k, example in enumerate(first[:n_different].tolist()):
            own = (masks[example] > 0) & self.acts
            numbers[k] = self._number.setdefault(own.tobytes(), len(self._is_in))
            if numbers[k] == len(self._is_in):
                self._is_in.append(own)
        return np.take(numbers, which)

    def places(self) -> np.ndarray[tuple[int, int], np.dtype[np.int16]]:
        """Place of the derivative by each row among those of a slot of each pattern, (n_patterns, n_rows)."""
        derived = np.stack(self._is_in) & self._is_soft
        return np.where(derived, np.cumsum(derived, axis=1) - 1, -1).astype(np.int16)

    def soft_rows(self) -> tuple[I64, I64]:
        """Rows that slots of each pattern have derivatives by: their ranges, (n_patterns + 1,), and they themselves."""
        pattern, row = np.nonzero(np.stack(self._is_in) & self._is_soft)
        return np.searchsorted(pattern, np.arange(len(self._is_in) + 1)), row


def _vary(field: EditField) -> Bool:
    """(n_rows,) whether receivers of a row may have other masks than 0 and 1."""
    return np.array(
        [
            not receivers.constant_on_instances or not np.isin(receivers.on_instances, (0, 1)).all()
            for bound in field.edits
            for receivers in bound.receivers
        ],
        np.bool_,
    )
