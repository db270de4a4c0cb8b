"""What edits make of the light of cache records, for each set of edits that a receiver may be in.

A receiver's masks are no part of a record: a hard edge within its reach would be smeared (50 % wrong around the
edge of a painted mask, measured). Pair functions are linear in each receiver mask, so that a record needs the
change of its light for masks of 0 and 1 alone; what lies between is mixed at the camera sample.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icheat_usd.edits.mask_stack import is_of_masks
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup, RecordValues
from icheat_usd.final_gather.kept_changes import KeptChanges
from icheat_usd.final_gather.masked_records import MaskedRecords
from icheat_usd.final_gather.pair_tables import PairStack, PairSums, batches
from icheat_usd.final_gather.receiver_sets import Mixtures, Touched, mixtures_of
from icheat_usd.final_gather.record_pairs import RecordPairs
from icheat_usd.final_gather.record_rays import take_rays
from icheat_usd.final_gather.row_records import RowRecords
from icheat_usd.final_gather.row_stack import is_of_rows
from icheat_usd.final_gather.same_stack import same_but_amounts, same_values
from icheat_usd.kernels import record_mixtures as kernels
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I32, I64, Bool, SurfacePoints

_MOST_KEPT = 2  #: stacks whose light is kept for others


def edited_records(
    gatherer: Gatherer, cache: IrradianceCache, hemispheres: Hemispheres
) -> MaskedRecords | RowRecords | EditedRecords:
    """Changes that a gatherer's stack makes of the light of a cache's records."""
    if is_of_masks(gatherer.field):
        return MaskedRecords(gatherer, cache, hemispheres)
    if is_of_rows(gatherer.field):
        return RowRecords(gatherer, cache, hemispheres)
    for one in hemispheres.of_pairs:
        if one.take_amounts(gatherer):
            return one
    found = EditedRecords(gatherer, cache, hemispheres)
    if hemispheres.is_kept:
        hemispheres.of_pairs[:] = [*hemispheres.of_pairs[1 - _MOST_KEPT :], found]
    return found


class EditedRecords:
    """Changes of records' irradiance, found when a camera sample first asks for them.

    Where one edit acts alone they are those of its full amount, which others are in proportion to.

    Parameters
    ----------
    hemispheres : Hemispheres
        Rays of the cache's records.
    """

    #: Mixtures are of no more than `MOST_SOFT` masks.
    takes_soft_masks = False

    def __init__(self, gatherer: Gatherer, cache: IrradianceCache, hemispheres: Hemispheres) -> None:
        assert gatherer.solution is not None
        self._gatherer, self._cache, self._hemispheres = gatherer, cache, hemispheres
        self._stack = PairStack(gatherer.field)
        self._slots: dict[bytes, I32] = {}
        self._values = _no_values(0)
        self._changes = KeptChanges()

    def take_amounts(self, gatherer: Gatherer) -> bool:
        """Go on with another stack, if it differs in amounts alone."""
        own, other = self._gatherer.solution, gatherer.solution
        assert own is not None and other is not None
        if gatherer.is_part != self._gatherer.is_part or not same_but_amounts(self._gatherer.field, gatherer.field):
            return False
        if not np.array_equal(own.b, other.b) or not same_values(own.sent, other.sent):
            return False
        self._gatherer, self._stack = gatherer, PairStack(gatherer.field)
        known = {name: np.frombuffer(name, np.bool_) for name in self._slots}
        self._slots = {name: self._slots[name] for name, is_in in known.items() if self._stack.alone(is_in) >= 0}
        return True

    def change(self, found: Lookup, points: SurfacePoints, receivers: Touched) -> F32:
        """Change of irradiance at m receivers with records.

        Parameters
        ----------
        found : of all points
        receivers : Touched
            No more than `MOST_SOFT` masks of each lie between 0 and 1.

        Returns
        -------
        (m, 3) float32
        """
        mixed = mixtures_of(receivers)
        alone = np.array([self._stack.alone(is_in) for is_in in mixed.is_in], np.int64)
        amount = np.append(self._stack.amounts, np.float32(1))[alone]
        if (alone < 0).any():
            weighed = mixed._replace(weight=mixed.weight * amount[mixed.entry])
            return self._mix(found, points, receivers, weighed)
        asked = (receivers.where, receivers.which, *mixed[1:], np.stack(mixed.is_in))
        change = self._changes.find(found, asked)
        if change is None:
            change = self._mix(found, points, receivers, mixed)
            if self._hemispheres.is_kept:
                self._changes.keep(found, asked, change)
        return change * amount[mixed.entry[mixed.begin[receivers.which]]][:, None]

    def _mix(self, found: Lookup, points: SurfacePoints, receivers: Touched, mixed: Mixtures) -> F32:
        cache, where, which = self._cache, receivers.where, receivers.which
        needed = np.zeros((len(mixed.is_in), cache.n), np.uint8)
        kernels.mark_records(found.number, found.record, where, which, mixed.begin, mixed.entry, needed)
        self._prepare(mixed, needed.view(np.bool_))
        slots = [self._slots[is_in.tobytes()] for is_in in mixed.is_in]
        out = np.empty((len(where), 3), np.float32)
        kernels.mix_records(
            cache.table.position,
            cache.table.normal,
            *self._values,
            np.stack(slots) if slots else np.zeros((0, cache.n), np.int32),
            points.position,
            points.shading_normal,
            *found[:3],
            where,
            which,
            *mixed[1:],
            out,
        )
        return out

    def change_alone(self, points: SurfacePoints, rays: Hemispheres, row: I64, receivers: Touched) -> F32:
        """The same at m receivers without records, from hemispheres of their own; `row` (m,) is that of each."""
        own = rays.parts[0].rays
        pairs = RecordPairs(self._gatherer, take_rays(own, row), take_points(points, receivers.where))
        return np.asarray(np.pi * pairs.change(np.arange(len(row)), receivers.ends().masks).mean(axis=1))

    def _prepare(self, mixed: Mixtures, wanted: Bool) -> None:
        """Changes of records in some sets of edits; `wanted` is (n_sets, n_records)."""
        n = len(self._values.irradiance)
        parts, missing = [self._values], []
        for is_in, asked in zip(mixed.is_in, wanted, strict=True):
            slots = self._slots.setdefault(is_in.tobytes(), np.full(self._cache.n, -1, np.int32))
            needed = asked & (slots < 0)
            count = int(needed.sum())
            if count == 0:
                continue
            slots[needed] = n + np.arange(count, dtype=np.int32)
            n += count
            parts.append(_no_values(count))
            missing.append((is_in, needed, parts[-1]))
        if missing:
            if self._gatherer.field.uses_incident:
                self._by_pairs(missing)
            else:
                self._by_tables(missing)
        if len(parts) > 1:
            self._values = RecordValues(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _by_tables(self, missing: list[tuple[Bool, Bool, RecordValues]]) -> None:
        """Changes of records: sets of edits, the records (n_records,) wanted in each, and their values."""
        cache, hemispheres, stack = self._cache, self._hemispheres, self._stack
        is_in = np.stack([one for one, _, _ in missing])
        wanted = np.stack([needed for _, needed, _ in missing])
        amounts = np.tile(stack.amounts, (len(missing), 1))
        amounts[[stack.alone(one) >= 0 for one in is_in]] = 1
        acts = np.ascontiguousarray(is_in[:, stack.rows], np.uint8)
        share = hemispheres.shares()
        for part in batches(hemispheres, np.asarray(wanted.any(axis=0), np.bool_)):
            owner = part.owner
            reach, shrink = cache.table.reach[owner], hemispheres.shrink[owner]
            asked = np.asarray(is_in.T @ wanted[:, owner], np.bool_)
            sums = PairSums(self._gatherer, stack, part, reach, share[owner], shrink, asked)
            for one, (_, needed, values) in enumerate(missing):
                rows = np.flatnonzero(needed[owner])
                if len(rows) == 0:
                    continue
                found = sums.values(rows, np.full(len(rows), one), acts, amounts)
                place = (np.cumsum(needed) - 1)[owner[rows]]
                for column, own in zip(values, found, strict=True):
                    # One hemisphere after another, whichever batch it is in.
                    np.add.at(column, place, own)

    def _by_pairs(self, missing: list[tuple[Bool, Bool, RecordValues]]) -> None:
        """`_by_tables` where edits look at light: ray by ray."""
        cache, hemispheres = self._cache, self._hemispheres
        every = np.zeros(cache.n, np.bool_)
        for _, needed, _ in missing:
            every |= needed
        share = hemispheres.shares()
        for rays, points, owner in hemispheres.chunks():
            some = np.flatnonzero(every[owner])
            if len(some) == 0:
                continue
            owner = owner[some]
            rays, points = take_rays(rays, some), take_points(points, some)
            pairs: dict[bool, RecordPairs] = {}
            for is_in, needed, values in missing:
                rows = np.flatnonzero(needed[owner])
                if len(rows) == 0:
                    continue
                is_alone = self._stack.alone(is_in) >= 0
                if is_alone not in pairs:
                    pairs[is_alone] = RecordPairs(self._at_full_amounts() if is_alone else self._gatherer, rays, points)
                found = pairs[is_alone].values(rows, owner[rows], is_in, cache)
                place = (np.cumsum(needed) - 1)[owner[rows]]
                for column, part in zip(values, found, strict=True):
                    part *= share[owner[rows]].reshape(-1, *(1,) * (part.ndim - 1))
                    # One hemisphere after another, whichever chunk it is in.
                    np.add.at(column, place, part)

    def _at_full_amounts(self) -> Gatherer:
        field = self._gatherer.field
        return replace(self._gatherer, field=replace(field, edits=tuple(bound.at_full_amount for bound in field.edits)))


def _no_values(n: int) -> RecordValues:
    return RecordValues(np.zeros((n, 3), np.float32), *(np.zeros((n, 3, 3), np.float32) for _ in range(2)))
