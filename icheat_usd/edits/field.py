"""A stack bound to a scene: the composed pair functions S, E and O, and what aggregates and views add to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from icheat_usd.edits.bound import Aggregate, BoundEdit, Ends, StackCoefficients
from icheat_usd.edits.composing import ONE, State, lay, pair_weights
from icheat_usd.edits.mask_sheets import EntrySheets, sheets_of_many
from icheat_usd.edits.mask_table import mask_table, weights_of
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level, PairCoefficients, PairEnd
from icheat_usd.edits.operations.division import divide
from icheat_usd.kernels.mask_table import MaskTable
from icheat_usd.scene import F32, I64, Finding, SurfacePoints


@dataclass(frozen=True, eq=False)
class EditField:
    """The active edits of a stack on one scene, weakest first.

    Use: `receivers` and `casters` once for all points, `Ends.take` to form
    pairs, `evaluate` on these. Where `aggregates` has entries, each is resolved
    in turn from the light of its casters under the edits before its `upto`;
    what it came to is then given to `evaluate`. `finish` applies what acts on views.
    """

    edits: tuple[BoundEdit, ...]
    light_group: I64  #: (n_lights,) group of each light; edits tell groups apart, never lights within one
    n_groups: int = 1
    findings: tuple[Finding, ...] = ()

    # What a renderer has to provide

    @property
    def is_identity(self) -> bool:
        return not self.edits

    @property
    def acts_on_views_alone(self) -> bool:
        """True if a renderer needs to know nothing of pairs."""
        return all(bound.level is Level.VIEW for bound in self.edits)

    @property
    def uses_incident(self) -> bool:
        """True if S depends on the colour of the light, so that a renderer must supply it."""
        return any(
            bound.level is Level.AGGREGATE or (bound.operation is not None and bound.operation.uses_incident)
            for bound in self.edits
        )

    @property
    def uses_receiver(self) -> bool:
        """True if coefficients depend on the receiver by more than its masks, so that receivers cannot share them."""
        return any(
            any(rows is not None for rows in bound.rows) if bound.operation is None else bound.operation.uses_receiver
            for bound in self.edits
        )

    @property
    def uses_caster(self) -> bool:
        """True if coefficients depend on the caster by more than its masks and light."""
        return any(bound.operation is not None and bound.operation.uses_caster for bound in self.edits)

    @property
    def has_offset(self) -> bool:
        """True if an edit may give offsets, which reach receivers through occluders."""
        return any(
            _bakes_offset(bound) if bound.operation is None else bound.operation.has_offset for bound in self.edits
        )

    @property
    def throughs(self) -> tuple[int, ...]:
        """Edits whose occluders let light through."""
        return tuple(
            i for i, bound in enumerate(self.edits) if bound.operation is not None and bound.operation.has_through
        )

    @property
    def aggregates(self) -> tuple[Aggregate, ...]:
        """Keys at level AGGREGATE in the order in which they must be resolved."""
        found, row = [], 0
        for index, bound in enumerate(self.edits):
            if bound.level is Level.AGGREGATE:
                # As pairs: an edit that is not composed with the weaker ones does not look at what they leave.
                upto = index if bound.edit.blend is Blend.COMPOSE else 0
                found += [Aggregate(index, key, row + key, upto) for key in range(bound.n_keys)]
            row += bound.n_keys
        return tuple(found)

    @property
    def n_rows(self) -> int:
        return sum(bound.n_keys for bound in self.edits)

    def rows_of(self, edit: int) -> slice:
        """Rows of the masks that belong to an edit."""
        first = sum(bound.n_keys for bound in self.edits[:edit])
        return slice(first, first + self.edits[edit].n_keys)

    # Points

    def receivers(self, points: SurfacePoints) -> Ends:
        """The points as receivers."""
        masks, located = [], []
        for bound in self.edits:
            for selection, rows in zip(bound.receivers, bound.rows, strict=True):
                masks.append(selection.at(points))
                if rows is not None:
                    located.append(rows.locate_receivers(points))
                    # Where no row holds nothing is edited, to the bit.
                    masks[-1] *= (located[-1].rows >= 0).any(axis=1)
        return _ends(masks, located, points, self._is_asked_for_places())

    def casters(self, points: SurfacePoints) -> Ends:
        """The points as casters."""
        masks, located = [], []
        for bound in self.edits:
            for selection, rows in zip(bound.casters, bound.rows, strict=True):
                masks.append(selection.at(points))
                if rows is not None:
                    located.append(rows.locate_casters(points))
                    masks[-1] *= located[-1] >= 0
        return _ends(masks, located, points, self._is_asked_for_places() or self.uses_caster)

    def _is_asked_for_places(self) -> bool:
        return any(bound.operation is not None and bound.operation.uses_receiver for bound in self.edits)

    def receiver_masks(self, points: SurfacePoints) -> F32:
        """Soft receiver masks u alone, (n_rows, n)."""
        if self.uses_receiver or self._receiver_table is None:
            return self.receivers(points).masks
        return weights_of(*self._receiver_table, self.n_rows, points).T

    @cached_property
    def _receiver_table(self) -> tuple[MaskTable, EntrySheets] | None:
        selections = [receivers for bound in self.edits for receivers in bound.receivers]
        table = mask_table(selections, len(selections[0].on_instances)) if selections else None
        return None if table is None else (table, sheets_of_many(table))

    # Pairs

    def evaluate(
        self,
        b: F32,
        receivers: Ends,
        casters: Ends,
        resolved: Sequence[PairCoefficients] = (),
        upto: int | None = None,
    ) -> StackCoefficients:
        """Compose the stack at n pairs (DESIGN, Semantics).

        Parameters
        ----------
        b : (G, n, 3) float32, radiance, scene-linear
            Unedited light that the casters send, by group of lights.
        receivers : Ends of n points, or of 1 that all pairs share
        casters : Ends of n points
        resolved : sequence of PairCoefficients
            Those of each resolved aggregate at the pairs' receivers, in the order of `aggregates`.
        upto : int, optional
            Compose only the edits before this one.

        Returns
        -------
        StackCoefficients
        """
        n_groups, n = b.shape[:2]
        state = State(
            scale=np.ones((n_groups, n, 3), np.float32),
            emission=np.zeros((n, 3), np.float32),
            offsets=[None, None, *(None for _ in self.throughs)],
        )
        throughs = {edit: 2 + slot for slot, edit in enumerate(self.throughs)}
        row = located = n_resolved = 0
        for index, bound in enumerate(self.edits[:upto]):
            rows = range(row, row + bound.n_keys)
            row += bound.n_keys
            first_located = located
            located += sum(rows_of_key is not None for rows_of_key in bound.rows)
            if bound.level is Level.VIEW:
                continue
            found: Sequence[PairCoefficients] = ()
            if bound.level is Level.AGGREGATE:
                found = resolved[n_resolved : n_resolved + bound.n_keys]
                n_resolved += bound.n_keys
            weights = pair_weights(bound, rows, receivers, casters, first_located)
            touched = np.flatnonzero(np.any([w != 0 for w in weights], axis=0))
            if len(touched) == 0:
                continue
            lay(state, bound, b, receivers, casters, weights, touched, found, first_located, throughs.get(index))
        return StackCoefficients(
            state.scale, state.emission, state.offsets[0], state.offsets[1], tuple(state.offsets[2:])
        )

    # Receivers

    def resolve(self, aggregate: Aggregate, light: F32) -> tuple[F32, F32]:
        """What an aggregate makes of the light of its casters.

        Parameters
        ----------
        light : (n, 3) float32, radiance
            All that n receivers get from the casters, weighted by the casters' masks, under the edits before
            `aggregate.upto`.

        Returns
        -------
        scale, added : (n, 3) float32
            The light becomes ``scale light + added``; `added` is what no bounded scale can reach: see `sent_anew`.
        """
        bound = self.edits[aggregate.edit]
        assert bound.operation is not None
        light = np.maximum(light, np.float32(0))
        wanted = bound.operation.evaluate_aggregate(bound.parameters[aggregate.key], light)
        coefficients = divide(light, wanted)
        assert coefficients.emission is not None
        return coefficients.scale, coefficients.emission

    def aggregate_share(self, aggregate: Aggregate, casters: Ends) -> F32:
        """How much of the light of each group and caster the aggregate looks at, (G, n, 1).

        Emission and whatever else has no group belongs to it only where it acts on all groups.
        """
        bound = self.edits[aggregate.edit]
        mask = casters.masks[aggregate.row]
        return (bound.groups[:, None].astype(np.float32) * mask[None, :])[:, :, None]

    def finish(self, light: F32, receivers: Ends, *, is_part: bool = False) -> F32:
        """Apply what acts on views to (n, 3) edited indirect light, then clamp it at zero.

        Light of some lights alone, `is_part`, is scaled and no more: what is added is of no light, and only the sum
        of all lights is clamped.
        """
        lines = self.view_lines(receivers.masks)
        return self.seen(light, lines, is_part=is_part)

    def view_lines(self, masks: F32) -> tuple[F32, F32] | None:
        """Scale and offset, (n, 3) each, of all that acts on views, at masks (n_rows, n) of receivers; None if none."""
        row = 0
        shape = (masks.shape[1], 3)
        scale: F32 | None = None
        offset: F32 = np.zeros(shape, np.float32)
        for bound in self.edits:
            rows = range(row, row + bound.n_keys)
            row += bound.n_keys
            if bound.level is not Level.VIEW:
                continue
            scale = np.ones(shape, np.float32) if scale is None else scale
            delta, added = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
            kept = np.zeros((len(delta), 1), np.float32)
            for key, mask_row in enumerate(rows):
                weight = (np.float32(bound.edit.amount * bound.key_weights[key]) * masks[mask_row])[:, None]
                s, o = bound.view(key)
                kept, delta, added = kept + weight, delta + weight * (s - ONE), added + weight * o
            carries = {Blend.COMPOSE: ONE + delta, Blend.OVER: ONE - kept, Blend.ADD: np.ones_like(kept)}
            carried = carries[bound.edit.blend]
            scale = carried * scale
            if bound.edit.blend is not Blend.COMPOSE:
                scale = scale + (kept * (bound.edit.blend is Blend.OVER) + delta)
            offset = carried * offset + added
        return None if scale is None else (scale, offset)

    @staticmethod
    def seen(light: F32, lines: tuple[F32, F32] | None, *, is_part: bool = False) -> F32:
        """`finish` where `view_lines` of the receivers are known."""
        if is_part:
            return light if lines is None else lines[0] * light
        # Once, at the end: a weaker edit's negative light may be lifted by a stronger one.
        return np.maximum(light if lines is None else lines[0] * light + lines[1], np.float32(0))


def _ends(masks: list[F32], located: list[Any], points: SurfacePoints, with_place: bool) -> Ends:
    n = len(points.instance)
    place = PairEnd(points.position, points.shading_normal, points.albedo) if with_place else None
    return Ends(np.stack(masks) if masks else np.zeros((0, n), np.float32), place, tuple(located))


def _bakes_offset(bound: BoundEdit) -> bool:
    constants = any(baked is not None and baked.offset is not None for baked in bound.baked)
    return constants or any(rows is not None and rows.has_offset for rows in bound.rows)
