"""What edits that know nothing but masks make of the light of cache records.

A receiver's masks are no part of a record: a hard edge within its reach would be smeared. A record's change is found
for the masks at its own place, with its derivatives by them, and again where places that ask for it differ by more.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.edits.mask_stack import at_amounts, bends, full_stack, steepness
from icheat_usd.edits.mask_table import mask_table
from icheat_usd.edits.operations import Level
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup
from icheat_usd.final_gather.merged_light import groups_of, merged_light, painted_weights, sent_by_group
from icheat_usd.final_gather.painted_light import bits, is_painted, light_by_masks, with_few
from icheat_usd.final_gather.receiver_sets import Touched
from icheat_usd.final_gather.slot_choices import Slots, in_turn, slot_choices
from icheat_usd.kernels import merged_stack, painted_sums, stack_sums
from icheat_usd.kernels import record_slots as kernels
from icheat_usd.kernels.mask_table import MaskTable
from icheat_usd.kernels.record_lanes import LANES, frames_of
from icheat_usd.scene import F32, I64, Bool, SurfacePoints

#: Bands of an image ask for about as many slots each: so much more room is made for those of the first.
_GROWTH = 4


class _Values(NamedTuple):
    """Changes of records' light for the masks of slots, with room behind them for those of more."""

    light: F32  #: (n, LANES)
    derivative: F32  #: (n_derivatives, LANES)


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
        self._snapshot = gatherer.snapshot
        full = full_stack(self._field, with_emission=gatherer.solution.sent is None)
        self._stack = at_amounts(full, self._field)
        # Of other amounts the same, so that these change nothing that it takes time to find.
        bend = bends(full, self._field)
        with_transport = len(self._stack.start) > self._field.n_groups
        self._sent = sent_by_group(gatherer.solution, with_transport=with_transport)
        table = mask_table(_acting(self._field), gatherer.snapshot.n_instances)
        assert table is not None
        self._casters = table
        self._of_few, self._others = _ways(table)
        self._weights = painted_weights(table, self._others, steepness(full, self._field))
        self._choices = slot_choices(self._field, bend, hemispheres)
        self._frames = np.empty((cache.n, LANES), np.float32)
        frames_of(cache.table.position, cache.table.normal, hemispheres.shrink, self._frames)
        nothing = np.empty((0, LANES), np.float32)
        self._values, self._n_known = _Values(nothing, nothing), 0

    def change(self, found: Lookup, points: SurfacePoints, receivers: Touched) -> F32:
        """Change of irradiance at m receivers with records.

        Parameters
        ----------
        found : of all points

        Returns
        -------
        (m, 3) float32
        """
        where, which = receivers.where, receivers.which
        choices, out = self._choices, np.zeros((len(where), 3), np.float32)
        if not choices.patterns.acts.any():
            return out
        masks = np.ascontiguousarray(receivers.columns.T)
        number = np.take(found.number, where).astype(np.int64)
        first = np.cumsum(number) - number
        slot = choices.serve(found, receivers, masks, first)
        self._know(choices.slots)
        soft_begin, soft_row = choices.patterns.soft_rows()
        kernels.mix_slots(
            self._frames,
            *self._values,
            choices.slots.derived,
            choices.slots.masks,
            choices.slots.pattern,
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
        values = np.zeros((n, LANES), np.float32)
        self._evaluate(rays, slots, values, np.zeros((0, LANES), np.float32))
        return np.ascontiguousarray(values[:, 0:15:5])

    def _know(self, upto: Slots) -> None:
        """See to it that the light of some slots is known."""
        n = self._n_known
        if n == len(upto.record):
            return
        record, derived = upto.record[n:], upto.derived[n:] - upto.derived[n]
        begin = np.searchsorted(record, np.arange(self._cache.n + 1))
        places = self._choices.patterns.places()
        table = stack_sums.SlotTable(begin, upto.masks[n:], upto.pattern[n:], places, derived)
        first = int(upto.derived[n])
        light = _with_room(self._values.light, n, len(record))
        derivative = _with_room(self._values.derivative, first, int(derived[-1]))
        self._values, self._n_known = _Values(light, derivative), len(upto.record)
        self._evaluate(self._hemispheres, table, light[n:], derivative[first:])

    def _evaluate(self, of: Hemispheres, slots: stack_sums.SlotTable, values: F32, derivative: F32) -> None:
        """Add changes of light, (n_slots, LANES), and derivatives, (n_derivatives, LANES)."""
        wanted = np.diff(slots.begin) > 0
        # Rays of all are looked through once; other bands of the image will ask for the rest.
        likely = self._choices.likely() if of is self._hemispheres else wanted
        if self._of_few.any():
            known = light_by_masks(of, self._sent, self._casters, self._of_few)
            known.find(of, self._snapshot.geometry, wanted | likely)
            painted_sums.stack_of_painted(
                known.begin,
                *known.entries[1:],
                bits(self._casters),
                self._casters,
                self._stack,
                slots,
                in_turn(np.flatnonzero(wanted)),
                values,
                derivative,
            )
        if self._others.any():
            edits = stack_sums.Edits(
                self._casters, self._weights.of_entries.column, self._casters.weight, self._stack, slots
            )
            if self._weights.of_entries.width and not of.is_kept:
                self._at_once(of, wanted, edits, values, derivative)
                return
            light = merged_light(of, self._sent, self._others, self._weights)
            for table in light.tables(of, self._snapshot, wanted, likely):
                stack_sums.stack_of_casters(
                    table.begin,
                    table.entry,
                    *table.rows,
                    *edits,
                    in_turn(np.flatnonzero(wanted & table.has)),
                    values,
                    derivative,
                )

    def _at_once(self, of: Hemispheres, wanted: Bool, edits: stack_sums.Edits, values: F32, derivative: F32) -> None:
        """What other casters than those of few masks bring, where nothing of it is kept."""
        width = self._weights.of_entries.width
        for rays in self._weights.met_by(groups_of(of, wanted), self._sent, self._others, self._snapshot.geometry):
            merged_stack.stack_of_rays(*rays, width, *edits, values, derivative)


def _with_room(values: F32, known: int, more: int) -> F32:
    """Lanes with room for `more` behind those that are known, which are zero."""
    if known + more > len(values):
        known_values = values[:known]
        values = np.empty((_GROWTH * (known + more), LANES), np.float32)
        values[:known] = known_values
    values[known : known + more] = 0
    return values


def _acting(field: EditField) -> list[BoundSelection]:
    """Casters of every row; none of rows that act on views."""
    return [
        BoundSelection(np.zeros_like(casters.on_instances)) if bound.level is Level.VIEW else casters
        for bound in field.edits
        for casters in bound.casters
    ]


def _ways(casters: MaskTable) -> tuple[Bool, Bool]:
    """(n_instances,) casters whose light is found by subsets of painted masks, and others.

    Those that are not painted go along with the former, if there are any.
    """
    acts, of_few = np.diff(casters.begin) > 0, with_few(casters)
    if not of_few.any():
        return of_few, acts
    of_many = is_painted(casters) & ~of_few
    return acts & ~of_many, of_many
