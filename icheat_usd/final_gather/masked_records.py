"""What edits that know nothing but masks make of the light of cache records.

A receiver's masks are no part of a record: a hard edge within its reach would be smeared. A record's change is found
for the masks at its own place, with its derivatives by them, and again where places that ask for it differ by more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.edits.mask_stack import bends, mask_stack
from icheat_usd.edits.mask_table import mask_table
from icheat_usd.edits.operations import Level
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.final_gather.caster_light import light_by_caster, ray_table, sent_by_group
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup
from icheat_usd.final_gather.painted_light import bits, is_of_few, light_by_masks
from icheat_usd.final_gather.receiver_sets import Touched, patterns
from icheat_usd.kernels import painted_sums, stack_sums
from icheat_usd.kernels import record_slots as kernels
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.scene import F32, I32, I64, Bool, SurfacePoints

#: Relative change of light between a place and the masks that a record's light was found for, and what it misses:
#: masks that change together bend it.
MOST_CHANGE, MOST_BEND = 0.25, 0.01


class _Slots(NamedTuple):
    """Changes of records' light for receivers of given masks."""

    record: I64  #: (n,)
    masks: F32  #: (n, n_rows)
    pattern: I32  #: (n,)
    derived: I64  #: (n + 1,) derivatives of each
    values: F32  #: (n, N_VALUES, 4)
    derivative: F32  #: (n_derivatives, N_VALUES, 4)


class MaskedRecords:
    """Changes of records' irradiance under a stack that `is_of_masks`, found when a camera sample first asks for them.

    Parameters
    ----------
    hemispheres : Hemispheres
        Rays of the cache's records.
    """

    #: Receivers may lie in any number of soft masks.
    takes_soft_masks = True

    def __init__(self, gatherer: Gatherer, cache: IrradianceCache, hemispheres: Hemispheres) -> None:
        assert gatherer.solution is not None
        self._field, self._cache, self._hemispheres = gatherer.field, cache, hemispheres
        self._geometry = gatherer.snapshot.geometry
        self._stack = mask_stack(self._field, with_emission=gatherer.solution.sent is None)
        bend = bends(self._stack)
        with_transport = len(self._stack.start) > self._field.n_groups
        self._sent = sent_by_group(gatherer.solution, with_transport=with_transport)
        table = mask_table(_acting(self._field), gatherer.snapshot.n_instances)
        assert table is not None
        self._casters = table
        self._is_painted = bool((table.mask >= 0).any())
        self._by_rays = not is_of_few(table)
        is_soft = _vary(self._field) & (bend > 0)
        self._bend = np.where(is_soft, bend, np.float32(0))
        self._patterns = _Patterns(is_soft, bend > 0)
        self._own: tuple[F32, I32] | None = None
        n_rows = self._field.n_rows
        self._slots = _Slots(
            np.empty(0, np.int64),
            np.empty((0, n_rows), np.float32),
            np.empty(0, np.int32),
            np.zeros(1, np.int64),
            np.empty((0, stack_sums.N_VALUES, 4), np.float32),
            np.empty((0, stack_sums.N_VALUES, 4), np.float32),
        )

    def change(self, found: Lookup, points: SurfacePoints, receivers: Touched) -> F32:
        """Change of irradiance at m receivers with records.

        Parameters
        ----------
        found : of all points

        Returns
        -------
        (m, 3) float32
        """
        cache, where, which = self._cache, receivers.where, receivers.which
        out = np.zeros((len(where), 3), np.float32)
        if not self._patterns.acts.any():
            return out
        masks = np.ascontiguousarray(receivers.columns.T)
        number = np.take(found.number, where).astype(np.int64)
        first = np.cumsum(number) - number
        if self._bend.any():
            slot = self._choose(found, where, which, masks)
        else:
            slot = self._choose_by_pattern(found, where, which, masks, first)
        slots, soft_begin, soft_row = self._slots, *self._patterns.soft_rows()
        kernels.mix_slots(
            cache.table.position,
            cache.table.normal,
            slots.values,
            slots.derivative,
            slots.derived,
            slots.masks,
            slots.pattern,
            soft_begin,
            soft_row,
            slot,
            points.position,
            points.shading_normal,
            *found[:3],
            where,
            which,
            masks,
            first,
            out,
        )
        return out

    def change_alone(self, points: SurfacePoints, rays: Hemispheres, row: I64, receivers: Touched) -> F32:
        """The same at m receivers without records, from hemispheres of their own; `row` (m,), ascending."""
        masks = np.take(np.ascontiguousarray(receivers.columns.T), receivers.which, axis=0)
        n = len(row)
        nowhere = np.full((1, self._field.n_rows), -1, np.int16)
        begin = np.searchsorted(row, np.arange(rays.n + 1))
        slots = stack_sums.SlotTable(begin, masks, np.zeros(n, np.int32), nowhere, np.zeros(n + 1, np.int64))
        values, _ = self._evaluate(rays, row, slots)
        return np.ascontiguousarray(values[:, 0, :3])

    def _choose(self, found: Lookup, where: I64, which: I64, masks: F32) -> I64:
        """Slot of every pair of a place and one of its records, new ones where there are none."""
        slots, n_records = self._slots, self._cache.n
        pattern = self._patterns.of(masks)
        own_masks, own_pattern = self._own_masks()
        n_pairs = int(np.take(found.number, where).sum())
        begin = np.empty(n_records + 1, np.int64)
        pair, place = np.empty(n_pairs, np.int64), np.empty(n_pairs, np.int64)
        kernels.list_pairs(found.number, found.record, where, begin, pair, place)
        known = np.argsort(slots.record, kind="stable")
        known_begin = np.searchsorted(slots.record[known], np.arange(n_records + 1))
        centre, is_own = np.empty(n_pairs, np.int64), np.empty(n_pairs, np.uint8)
        kernels.choose_slots(
            begin,
            place,
            which,
            masks,
            pattern,
            own_masks,
            own_pattern,
            known_begin,
            known,
            slots.masks,
            slots.pattern,
            self._bend,
            MOST_CHANGE,
            MOST_BEND,
            centre,
            is_own,
        )
        new = np.flatnonzero(centre == np.arange(n_pairs))
        number = np.empty(n_pairs, np.int64)
        number[new] = len(slots.record) + np.arange(len(new))
        slot = np.empty(n_pairs, np.int64)
        slot[pair] = np.where(centre < 0, -1 - centre, np.take(number, np.maximum(centre, 0)))
        if len(new):
            record = np.searchsorted(begin, new, side="right") - 1
            column = which[place[new]]
            self._add(record, np.where(is_own[new, None], own_masks[record], masks[column]), pattern[column])
        return slot

    def _choose_by_pattern(self, found: Lookup, where: I64, which: I64, masks: F32, first: I64) -> I64:
        """`_choose` where masks are the same all over a pattern."""
        pattern = self._patterns.of(masks)
        at_places = np.take(pattern, which)
        needed = np.zeros((self._cache.n, int(pattern.max(initial=0)) + 1), np.uint8)
        kernels.mark_records(found.number, found.record, where, at_places, needed)
        known = np.full(
            (self._cache.n, max(needed.shape[1], int(self._slots.pattern.max(initial=0)) + 1)), -1, np.int64
        )
        known[self._slots.record, self._slots.pattern] = np.arange(len(self._slots.record))
        record, new = np.nonzero(needed.view(np.bool_) & (known[:, : needed.shape[1]] < 0))
        if len(record):
            known[record, new] = len(self._slots.record) + np.arange(len(record))
            column = np.zeros(needed.shape[1], np.int64)
            column[pattern] = np.arange(len(pattern))
            self._add(record, masks[column[new]], new.astype(np.int32))
        slot = np.empty(int(found.number[where].sum()), np.int64)
        kernels.slots_of_pairs(found.number, found.record, where, at_places, known, first, slot)
        return slot

    def _own_masks(self) -> tuple[F32, I32]:
        """Masks at the records' own places, and their patterns."""
        if self._own is None:
            parts = self._hemispheres.parts
            owner = np.concatenate([part.owner for part in parts])
            _, first = np.unique(owner, return_index=True)
            points = take_points(concatenate_points(*(part.points for part in parts)), first)
            masks = np.ascontiguousarray(self._field.receiver_masks(points).T)
            self._own = masks, self._patterns.of(masks)
        return self._own

    def _add(self, record: I64, masks: F32, pattern: I32) -> None:
        """New slots, of ascending records."""
        place = self._patterns.places()
        number = (place >= 0).sum(axis=1)[pattern]
        derived = np.concatenate([[0], np.cumsum(number, dtype=np.int64)])
        begin = np.searchsorted(record, np.arange(self._cache.n + 1))
        table = stack_sums.SlotTable(begin, masks, pattern, place, derived)
        values, derivative = self._evaluate(self._hemispheres, record, table)
        old = self._slots
        self._slots = _Slots(
            np.concatenate([old.record, record]),
            np.concatenate([old.masks, masks]),
            np.concatenate([old.pattern, pattern]),
            np.concatenate([old.derived, old.derived[-1] + derived[1:]]),
            np.concatenate([old.values, values]),
            np.concatenate([old.derivative, derivative]),
        )

    def _evaluate(self, of: Hemispheres, record: I64, slots: stack_sums.SlotTable) -> tuple[F32, F32]:
        """Changes of light, (n_slots, N_VALUES, 4), and derivatives, (n_derivatives, N_VALUES, 4)."""
        values = np.zeros((len(record), stack_sums.N_VALUES, 4), np.float32)
        derivative = np.zeros((int(slots.derived[-1]), stack_sums.N_VALUES, 4), np.float32)
        needed = np.diff(slots.begin) > 0
        if self._by_rays:
            self._ray_by_ray(of, needed, slots, values, derivative)
        elif self._is_painted:
            known = light_by_masks(of, self._sent, self._casters)
            known.find(of, self._geometry, needed)
            painted_sums.stack_of_painted(
                known.begin,
                *known.entries[1:],
                bits(self._casters),
                self._casters,
                self._stack,
                slots,
                np.flatnonzero(needed),
                values,
                derivative,
            )
        else:
            light = light_by_caster(of, self._sent, np.diff(self._casters.begin) > 0)
            light.find(of, needed)
            stack_sums.stack_of_casters(
                light.begin,
                light.caster,
                light.values,
                self._casters,
                self._stack,
                slots,
                np.flatnonzero(needed),
                values,
                derivative,
            )
        shrink = np.take(of.shrink, record)
        values[:, 4:] *= shrink[:, None, None]
        derivative[:, 4:] *= np.repeat(shrink, np.diff(slots.derived))[:, None, None]
        return values, derivative

    def _ray_by_ray(
        self, of: Hemispheres, needed: Bool, slots: stack_sums.SlotTable, values: F32, derivative: F32
    ) -> None:
        share = of.shares()
        for rays, _, owner in of.parts:
            order = np.flatnonzero(needed[owner])
            if len(order) == 0:
                continue
            order = order[np.argsort(owner[order], kind="stable")]
            mine = owner[order]
            first = np.flatnonzero(np.append(True, mine[1:] != mine[:-1]))
            stack_sums.stack_of_rays(
                ray_table(rays),
                self._geometry.face,
                self._geometry.face_uv,
                self._sent,
                order,
                np.append(first, len(mine)),
                mine[first],
                share,
                self._casters,
                self._stack,
                slots,
                rays.seed,
                rays.n_theta,
                rays.n_phi,
                values,
                derivative,
            )


class _Patterns:
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
        is_in = (masks > 0) & self.acts
        first, which = patterns(np.packbits(is_in, axis=1).T)
        numbers = []
        for row in first.tolist():
            own = is_in[row]
            number = self._number.setdefault(own.tobytes(), len(self._is_in))
            if number == len(self._is_in):
                self._is_in.append(own.copy())
            numbers.append(number)
        return np.take(np.array(numbers, np.int32), which)

    def places(self) -> np.ndarray[tuple[int, int], np.dtype[np.int16]]:
        """Place of the derivative by each row among those of a slot of each pattern, (n_patterns, n_rows)."""
        derived = np.stack(self._is_in) & self._is_soft
        return np.where(derived, np.cumsum(derived, axis=1) - 1, -1).astype(np.int16)

    def soft_rows(self) -> tuple[I64, I64]:
        """Rows that slots of each pattern have derivatives by: their ranges, (n_patterns + 1,), and they themselves."""
        pattern, row = np.nonzero(np.stack(self._is_in) & self._is_soft)
        return np.searchsorted(pattern, np.arange(len(self._is_in) + 1)), row


def _acting(field: EditField) -> list[BoundSelection]:
    """Casters of every row; none of rows that act on views."""
    return [
        BoundSelection(np.zeros_like(casters.on_instances)) if bound.level is Level.VIEW else casters
        for bound in field.edits
        for casters in bound.casters
    ]


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
