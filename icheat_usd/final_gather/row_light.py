"""What edits held as sampled rows make of the light of cache records.

A receiver mixes the rows of the samples around it. Its weights are no part of a record: records keep the light that
each row near them would bring, with gradients, and camera samples mix these by their own weights. So one edit is as
exact as the unedited light is. Where several edits act on a receiver, their product is taken as straight in the
weights of each, about those at the record.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import Lookup
from icheat_usd.final_gather.kept_changes import KeptChanges
from icheat_usd.final_gather.receiver_sets import Touched, mixtures_of
from icheat_usd.final_gather.row_hemispheres import Collected, collect
from icheat_usd.final_gather.row_stack import RowStack
from icheat_usd.kernels import record_mixtures, record_slots, row_mixing
from icheat_usd.kernels import row_light as kernels
from icheat_usd.kernels.row_edits import Stack
from icheat_usd.kernels.row_sites import NEIGHBOURS
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.scene import F32, I32, I64, Bool, SurfacePoints

#: Decoded rows that are held at once; within the processor's caches, so that rays find their leaves fast.
_DECODED_BYTES = 24 << 20


_MOST_KEPT = 2  #: stacks whose light is kept for others


class _Asked(NamedTuple):
    """What places ask for."""

    where: I64
    which: I64
    begin: I64
    entry: I32
    share: F32
    rows: I32
    weights: F32


def row_light(gatherer: Gatherer, stack: RowStack, hemispheres: Hemispheres, position: F32, normal: F32) -> RowLight:
    """Light of records for a stack, from what is known of it under another that differs in amounts alone.

    Parameters
    ----------
    stack : RowStack of the gatherer's field
    position, normal : (n_records, 3) float32
    """
    sent = _sent(gatherer)
    for one in hemispheres.of_rows:
        if one.take_amounts(gatherer, stack, sent):
            return one
    found = RowLight(gatherer, hemispheres, position, normal, stack, sent)
    hemispheres.of_rows[:] = [*hemispheres.of_rows[1 - _MOST_KEPT :], found]
    return found


def _sent(gatherer: Gatherer) -> F32:
    assert gatherer.solution is not None
    return gatherer.solution.b if gatherer.solution.sent is None else gatherer.solution.sent


class RowLight:
    """Light of records' rows, found when a camera sample first asks for it."""

    def __init__(
        self, gatherer: Gatherer, hemispheres: Hemispheres, position: F32, normal: F32, stack: RowStack, sent: F32
    ) -> None:
        self._gatherer, self._hemispheres, self._position, self._normal = gatherer, hemispheres, position, normal
        self._stack, self._rows, self._sent = stack, stack.rows, sent
        self._changes = KeptChanges()
        self._sets: dict[bytes, int] = {}
        self._slot = np.zeros((0, self._hemispheres.n), np.int32)
        self._acts = np.zeros((0, self._stack.n_keys), np.uint8)
        n = len(self._rows)
        self._record, self._set = np.zeros(0, np.int64), np.zeros(0, np.int64)  # of each base
        self._own_row, self._own_weight = (
            np.zeros((0, n, NEIGHBOURS), np.int32),
            np.zeros((0, n, NEIGHBOURS), np.float32),
        )
        self._bases = np.zeros((0, row_mixing.LANES), np.float32)
        self._lists = row_mixing.Lists(np.zeros((0, n), np.int32), *(np.full(1 << 12, -1, np.int32) for _ in range(4)))
        self._packed: row_mixing.PackedLists | None = None
        self._n = 0
        self._sums = np.zeros((0, row_mixing.LANES), np.float32)

    def change(self, found: Lookup, points: SurfacePoints, receivers: Touched) -> F32:
        """Change of irradiance at m receivers with records, (m, 3); `found` is of all points."""
        mixed = mixtures_of(receivers)
        number = np.array([self._set_of(is_in) for is_in in mixed.is_in], np.int32)
        entry = number[mixed.entry]
        # What one edit changes is in proportion to its amount.
        alone = self._stack.alone(self._acts)
        in_proportion = bool((alone[number] >= 0).all())
        rows, weights = self._stack.mixtures(receivers.ends(), with_amounts=not in_proportion)
        asked = _Asked(receivers.where, receivers.which, mixed.begin, entry, mixed.weight, rows, weights)
        change = self._changes.find(found, asked)
        if change is None:
            self._enter(found, asked)
            change = self._mix(found, asked, points)
            if self._hemispheres.is_kept:
                self._changes.keep(found, asked, change)
        if not in_proportion:
            return change
        edit = alone[entry[mixed.begin[receivers.which]]]
        return change * self._stack.amounts[edit][:, None]

    def _mix(self, found: Lookup, asked: _Asked, points: SurfacePoints) -> F32:
        out = np.empty((len(asked.where), 3), np.float32)
        row_mixing.mix_rows(
            self._position,
            self._normal,
            points.position,
            points.shading_normal,
            *found[:3],
            *asked[:5],
            self._slot,
            self._stack.acting_payloads(self._acts),
            self._pack(),
            asked.rows,
            asked.weights,
            self._bases,
            self._sums,
            out,
        )
        return out

    def take_amounts(self, gatherer: Gatherer, stack: RowStack, sent: F32) -> bool:
        """Go on with another stack, if what is known holds under it too.

        Where several edits act, the others' amounts are in the sum of a row.
        """
        is_same = (
            gatherer.is_part == self._gatherer.is_part
            and not self._stack.has_several(self._acts).any()
            and stack.differs_in_amounts_alone(self._stack)
            and np.array_equal(sent, self._sent)
        )
        if is_same:
            self._gatherer, self._stack = gatherer, stack
        return is_same

    # What is asked for

    def _enter(self, found: Lookup, wanted: _Asked) -> None:
        """See to it that the sums that places ask for are known."""
        where, which, begin, entry, _, rows, weights = wanted
        n_records, n_pairs = self._hemispheres.n, int(np.take(found.number, where).sum())
        asked = np.zeros((len(self._slot), n_records), np.uint8)
        record_mixtures.mark_records(found.number, found.record, where, which, begin, entry, asked)
        pair_begin = np.empty(n_records + 1, np.int64)
        pair, place = np.empty(n_pairs, np.int64), np.empty(n_pairs, np.int64)
        everything = np.ones(n_pairs, np.bool_)
        record_slots.list_pairs(found.number, found.record, where, everything, pair_begin, pair, place)
        n_bases, n_sums = len(self._record), self._n
        self._add_bases(asked.view(np.bool_) & (self._slot < 0))
        active = self._stack.acting_payloads(self._acts)
        new = np.arange(n_bases, len(self._record))
        self._list(
            len(new),
            row_mixing.list_own,
            new,
            self._stack.first_row,
            active[self._set[new]],
            self._own_row[new],
            self._own_weight[new],
        )
        places = pair_begin, place, which, begin, entry, self._slot, self._stack.first_row
        self._list(n_records, row_mixing.list_sums, *places, active, rows, weights)
        self._sum(n_bases, n_sums)

    def _set_of(self, is_in: Bool) -> int:
        name = is_in.tobytes()
        if name not in self._sets:
            self._sets[name] = len(self._sets)
            self._slot = np.concatenate([self._slot, np.full((1, self._hemispheres.n), -1, np.int32)])
            self._acts = np.concatenate([self._acts, self._stack.acting(is_in)[None]])
        return self._sets[name]

    def _add_bases(self, new: Bool) -> None:
        """Bases of (n_sets, n_records)."""
        one, record = np.nonzero(new)
        n = len(record)
        self._slot[one, record] = len(self._record) + np.arange(n, dtype=np.int32)
        row = np.full((n, len(self._rows), NEIGHBOURS), -1, np.int32)
        weight = np.zeros(row.shape, np.float32)
        # Light is straight in the weights of one edit alone, so that they may count from 0.
        several = self._stack.has_several(self._acts)[one]
        if several.any():
            at = take_points(self._record_points, record[several])
            row[several], weight[several] = self._stack.mixtures(self._gatherer.field.receivers(at))
            weight[several] *= self._stack.acting_payloads(self._acts[one[several]])[:, :, None]
        self._record, self._set = np.concatenate([self._record, record]), np.concatenate([self._set, one])
        self._own_row = np.concatenate([self._own_row, row])
        self._own_weight = np.concatenate([self._own_weight, weight])
        self._bases = np.concatenate([self._bases, np.zeros((n, row_mixing.LANES), np.float32)])
        head = np.concatenate([self._lists.head, np.full((n, len(self._rows)), -1, np.int32)])
        self._lists = self._lists._replace(head=head)

    @property
    def _record_points(self) -> SurfacePoints:
        """Where records stand, in their order."""
        parts, owners = [], []
        seen = np.zeros(self._hemispheres.n, np.bool_)
        for part in self._hemispheres.parts:
            first = np.flatnonzero(~seen[part.owner])
            seen[part.owner] = True
            parts.append(take_points(part.points, first))
            owners.append(part.owner[first])
        return take_points(concatenate_points(*parts), np.argsort(np.concatenate(owners), kind="stable"))

    def _list(self, n: int, enter: Any, *asked: Any) -> None:
        """Enter sums that are not there yet, by `row_mixing.list_sums` or `list_own`, of `n` records or bases."""
        done = 0
        while True:
            done, self._n = enter(done, *asked, self._lists, self._n)
            if done == n:
                break
            more = np.full(max(len(self._lists.row), 1 << 16), -1, np.int32)
            self._lists = row_mixing.Lists(
                self._lists.head, *(np.concatenate([column, more]) for column in self._lists[1:])
            )
            self._packed = None

    def _pack(self) -> row_mixing.PackedLists:
        if self._packed is None or len(self._packed.row) != self._n:
            n_lists = self._lists.head.size
            columns = (np.empty(n, np.int32) for n in (n_lists + 1, self._n, self._n))
            self._packed = row_mixing.PackedLists(*columns)
            row_mixing.pack_lists(self._lists, *self._packed)
        return self._packed

    # Sums

    def _sum(self, first_base: int, first_sum: int) -> None:
        """Sums from `first_sum` on, and light at the records of bases from `first_base` on."""
        n = self._n - first_sum
        self._sums = np.concatenate([self._sums, np.zeros((n, row_mixing.LANES), np.float32)])
        row, base_of, payload_of = (column[first_sum : self._n].astype(np.int64) for column in self._lists[2:])
        has_own = (self._own_weight != 0).any(axis=(1, 2))
        is_new = has_own | self._stack.has_constants(self._acts)[self._set]
        is_new[:first_base] = False
        bases = np.union1d(base_of, np.flatnonzero(is_new))
        if len(bases) == 0:
            return
        rays, stack = self._collect(np.unique(self._record[bases]))
        used = np.unique(payload_of << 32 | row) >> 32
        size = np.array([4 * rows.n_distinct * rows.n_cells for rows in self._rows])
        n_chunks = 1 + int(size[used].sum()) // _DECODED_BYTES
        # Neighbours share rows, and sums of one payload rays.
        along = np.argsort(_along_curve(self._position[self._record[bases]]), kind="stable")
        for some in np.array_split(bases[along], n_chunks):
            position = np.full(len(self._record), -1, np.int64)
            position[some] = np.arange(len(some))
            mine = np.flatnonzero(position[base_of] >= 0)
            mine = mine[np.lexsort((payload_of[mine], position[base_of[mine]]))]
            own = self._own_row[some].astype(np.int64)
            own[self._own_weight[some] == 0] = -1
            decoded, at, own_at = self._decode(payload_of[mine], row[mine], own)
            light = np.empty((len(some), row_mixing.LANES), np.float32)
            sums = np.empty((len(mine), row_mixing.LANES), np.float32)
            first = self._hemispheres.parts[0].rays
            kernels.row_sums(
                rays.table,
                stack,
                self._sent,
                not self._gatherer.is_part,
                first.seed,
                first.n_theta,
                first.n_phi,
                rays.order,
                rays.range_of(self._record[some]),
                self._acts[self._set[some]],
                is_new[some].astype(np.uint8),
                own_at,
                self._own_weight[some],
                np.searchsorted(position[base_of[mine]], np.arange(len(some) + 1)),
                payload_of[mine],
                at,
                decoded,
                light,
                sums,
            )
            self._sums[first_sum + mine] = sums
            self._bases[some[is_new[some]]] = light[is_new[some]]
        new = np.flatnonzero(has_own & is_new)
        row_mixing.take_own(self._lists, new, self._own_row[new], self._own_weight[new], self._sums, self._bases)

    def _decode(self, payload: I64, row: I64, own: I64) -> tuple[F32, I64, I64]:
        """Rows, one after another, and where those of sums and of records (n, n_payloads, 4) begin; -1 for none."""
        parts, begin = [np.zeros(0, np.float32)], 0
        at, own_at = np.zeros(len(row), np.int64), np.full(own.shape, -1, np.int64)
        for one, rows in enumerate(self._rows):
            mine, held = payload == one, own[:, one] >= 0
            used, which = np.unique(np.concatenate([row[mine], own[:, one][held]]), return_inverse=True)
            parts.append(rows.decode(used).reshape(-1))
            first = begin + which.reshape(-1) * (rows.n_distinct * rows.n_cells)
            at[mine] = first[: int(mine.sum())]
            own_at[:, one][held] = first[int(mine.sum()) :]
            begin += len(parts[-1])
        return np.concatenate(parts), at, own_at

    def _collect(self, records: I64) -> tuple[Collected, Stack]:
        """Hemispheres of some records, and the edits at the ends of their rays."""
        field, solution = self._gatherer.field, self._gatherer.solution
        assert solution is not None
        snapshot = self._gatherer.snapshot
        varied = self._stack.varied(snapshot.n_instances)
        rays = collect(self._hemispheres, records, snapshot, solution.gather, varied)
        casters = [self._stack.casters(solution.gather.points)]
        if rays.strangers is not None:
            casters.append(field.casters(rays.strangers))
        return rays, self._stack.table(casters)


def _along_curve(position: F32) -> I64:
    """Order along a curve that fills space, 10 bits an axis (Morton)."""
    low = position.min(axis=0)
    extent = max(float((position.max(axis=0) - low).max()), 1e-30)
    grid = ((position - low) * (1023.0 / extent)).astype(np.int64)
    code = np.zeros(len(position), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (grid[:, axis] >> bit & 1) << 3 * bit + axis
    return code
