"""A stack bound to a scene: the composed pair functions S, E and O, and what aggregates and views add to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.edits.encodings.rows import BoundRows
from icheat_usd.edits.model import Blend, Edit, Value
from icheat_usd.edits.operations import Level, Operation, PairCoefficients, PairEnd, Pairs
from icheat_usd.edits.operations.division import divide
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.scene import F32, I64, Bool, Finding, SurfacePoints

ONE = np.float32(1)
_NOWHERE = PairEnd(*(np.zeros((1, 3), np.float32),) * 3)


class Ends(NamedTuple):
    """n points as the edits see them: receivers, or casters."""

    masks: F32  #: (n_rows, n) weights: one row per edit and key, in the order of the edits
    place: PairEnd | None  #: (n, 3) each; None where no edit asks
    located: tuple[Any, ...]  #: for every key that is baked as rows: where its samples are looked up

    def take(self, which: I64) -> Ends:
        """Some of the points, in the order of `which`."""
        place = None if self.place is None else PairEnd(*(np.take(column, which, axis=0) for column in self.place))
        return Ends(np.take(self.masks, which, axis=1), place, tuple(_taken(entry, which) for entry in self.located))


def _taken(entry: Any, which: I64) -> Any:
    if isinstance(entry, tuple):
        return type(entry)(*(np.take(column, which, axis=0) for column in entry))
    return np.take(entry, which, axis=0)


class StackCoefficients(NamedTuple):
    """The composed pair functions at n pairs, for G groups of lights.

    A pair's light is ``t (sum_g scale_g b_g + emission) + A sum_g offset_g b_g``.
    `through` holds, for each edit of `EditField.throughs`, the factor on light
    that its occluders hold back; None is 0 everywhere.
    """

    scale: F32  #: (G, n, 3)
    emission: F32  #: (n, 3)
    offset_diffuse: F32 | None  #: (G, n, 3) to be multiplied by the receiver's albedo; None is 0
    offset_paint: F32 | None  #: (G, n, 3) not to be; None is 0
    through: tuple[F32 | None, ...]  #: (G, n, 3) each

    def light(self, b: F32) -> F32:
        """What the casters send to the receivers in sight, per unit of transport: (n, 3) from (G, n, 3)."""
        return weighted(self.scale, b) + self.emission


def weighted(factor: F32, b: F32) -> F32:
    """Sum over groups of lights of factor x b: (n, 3) from two (G, n, 3)."""
    total = factor[0] * b[0]
    for group in range(1, len(b)):
        total += factor[group] * b[group]
    return total


class Aggregate(NamedTuple):
    """One key of an edit that acts on all light from its casters: `resolve` it before evaluating beyond its edit."""

    edit: int
    key: int
    row: int  #: of the masks
    upto: int  #: edits before this one have acted on the light that it sees; none where it replaces or adds to them


@dataclass(frozen=True, eq=False)
class BoundEdit:
    """An edit that knows the scene; tuples have one entry per key."""

    edit: Edit
    operation: Operation | None  #: None: unknown here, what is baked is used
    parameters: tuple[Mapping[str, Value], ...]
    baked: tuple[PairCoefficients | None, ...]  #: used where the operation is unknown and there are no rows
    rows: tuple[BoundRows | None, ...]  #: used where the operation is unknown
    receivers: tuple[BoundSelection, ...]
    casters: tuple[BoundSelection, ...]
    key_weights: tuple[float, ...]
    groups: Bool  #: (G,) groups of lights that the scale acts on
    occluders: Bool  #: (n_instances,) what light passes through

    @property
    def level(self) -> Level:
        return Level.PAIR if self.operation is None else self.operation.level

    @property
    def n_keys(self) -> int:
        return len(self.key_weights)

    @property
    def offset_is_paint(self) -> bool:
        return self.operation is None or not self.operation.offset_times_albedo

    def evaluate(self, key: int, pairs: Pairs, receivers: Any, casters: Any) -> PairCoefficients:
        """Pair coefficients at full amount and masks, as of one key.

        `receivers` and `casters` are the key's entries of `Ends.located`, if it is baked as rows.
        """
        if self.operation is not None:
            return self.operation.evaluate(self.parameters[key], pairs)
        rows = self.rows[key]
        if rows is not None:
            return rows.evaluate(receivers, casters)
        baked = self.baked[key]
        assert baked is not None
        return baked

    def view(self, key: int) -> tuple[F32, F32]:
        """Scale and offset of an edit at level VIEW, (3,) each."""
        assert self.operation is not None
        return self.operation.evaluate_view(self.parameters[key])


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
        return _ends(masks, located, points, self.uses_receiver)

    def casters(self, points: SurfacePoints) -> Ends:
        """The points as casters."""
        masks, located = [], []
        for bound in self.edits:
            for selection, rows in zip(bound.casters, bound.rows, strict=True):
                masks.append(selection.at(points))
                if rows is not None:
                    located.append(rows.locate_casters(points))
                    masks[-1] *= located[-1] >= 0
        return _ends(masks, located, points, self.uses_receiver or self.uses_caster)

    def receiver_masks(self, points: SurfacePoints) -> F32:
        """Soft receiver masks u alone, (n_rows, n)."""
        return self.receivers(points).masks

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
        state = _State(
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
            weights = _pair_weights(bound, rows, receivers, casters, first_located)
            touched = np.flatnonzero(np.any([w != 0 for w in weights], axis=0))
            if len(touched) == 0:
                continue
            self._apply(
                state, bound, b, receivers, casters, weights, touched, found, first_located, throughs.get(index)
            )
        return StackCoefficients(
            state.scale, state.emission, state.offsets[0], state.offsets[1], tuple(state.offsets[2:])
        )

    def _apply(
        self,
        state: _State,
        bound: BoundEdit,
        b: F32,
        receivers: Ends,
        casters: Ends,
        weights: list[F32],
        touched: I64,
        resolved: Sequence[PairCoefficients],
        first_located: int,
        through_slot: int | None,
    ) -> None:
        """Lay one edit over the state, at the touched pairs."""
        n = b.shape[1]
        which: Any = slice(None) if len(touched) == n else touched
        groups = np.flatnonzero(bound.groups)
        seen = _seen(state, bound, b, groups, which)
        pairs = Pairs(seen, _end(receivers.place, which, n), _end(casters.place, which, n))
        delta, added = np.zeros_like(seen), np.zeros_like(seen)
        extra: dict[int, F32] = {}
        kept = np.zeros((len(seen), 1), np.float32)
        located = first_located
        for key in range(bound.n_keys):
            weight = weights[key][which, None]
            if bound.level is Level.AGGREGATE:
                coefficients = resolved[key]
                if len(coefficients.scale) > 1:
                    coefficients = of_receivers(coefficients, which)
            else:
                at = (None, None)
                if bound.rows[key] is not None:
                    at = (_pick(receivers.located[located], which, n), _pick(casters.located[located], which, n))
                    located += 1
                coefficients = bound.evaluate(key, pairs, *at)
            kept += weight
            delta += weight * (coefficients.scale - ONE)
            if coefficients.emission is not None:
                added += weight * coefficients.emission
            for slot, value in (
                (int(bound.offset_is_paint), coefficients.offset),
                (through_slot, coefficients.through),
            ):
                if value is not None and slot is not None:
                    extra[slot] = weight * value + extra.get(slot, np.float32(0))
        all_groups = len(groups) == len(b)
        carried = {Blend.COMPOSE: ONE + delta, Blend.OVER: ONE - kept, Blend.ADD: np.ones_like(kept)}[bound.edit.blend]
        for group in groups:
            before = state.scale[group, which]
            if bound.edit.blend is Blend.COMPOSE:
                state.scale[group, which] = carried * before
            else:
                state.scale[group, which] = carried * before + (kept * (bound.edit.blend is Blend.OVER) + delta)
        if all_groups:
            state.emission[which] = carried * state.emission[which] + added
        else:
            state.emission[which] += added
        for slot, value in enumerate(state.offsets):
            if value is not None:
                for group in groups:
                    value[group, which] *= carried
            if slot in extra:
                if value is None:
                    value = state.offsets[slot] = np.zeros((len(b), n, 3), np.float32)
                for group in groups:
                    value[group, which] += extra[slot]

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

    def finish(self, light: F32, receivers: Ends) -> F32:
        """Apply what acts on views to (n, 3) edited indirect light, then clamp it at zero."""
        row = 0
        scale: F32 | None = None
        offset: F32 = np.zeros_like(light)
        for bound in self.edits:
            rows = range(row, row + bound.n_keys)
            row += bound.n_keys
            if bound.level is not Level.VIEW:
                continue
            scale = np.ones_like(light) if scale is None else scale
            delta, added = np.zeros_like(light), np.zeros_like(light)
            kept = np.zeros((len(light), 1), np.float32)
            for key, mask_row in enumerate(rows):
                weight = (np.float32(bound.edit.amount * bound.key_weights[key]) * receivers.masks[mask_row])[:, None]
                s, o = bound.view(key)
                kept, delta, added = kept + weight, delta + weight * (s - ONE), added + weight * o
            carries = {Blend.COMPOSE: ONE + delta, Blend.OVER: ONE - kept, Blend.ADD: np.ones_like(kept)}
            carried = carries[bound.edit.blend]
            scale = carried * scale
            if bound.edit.blend is not Blend.COMPOSE:
                scale = scale + (kept * (bound.edit.blend is Blend.OVER) + delta)
            offset = carried * offset + added
        # Once, at the end: a weaker edit's negative light may be lifted by a stronger one.
        return np.maximum(light if scale is None else scale * light + offset, np.float32(0))


def sent_anew(scale: F32, added: F32, reach: F32) -> PairCoefficients:
    """What pairs need so that the light of an aggregate's casters becomes ``scale light + added``.

    What is added is light that the casters send, all of them the same radiance, so that stronger edits find it. From
    casters that do not reach a receiver, or that it does not reflect, none can come.

    Parameters
    ----------
    scale, added : (n, 3) float32
        From `EditField.resolve`.
    reach : (n, 3) float32
        Transport from the casters, weighted by their masks.
    """
    reached = reach > 0
    emission = np.divide(added, reach, out=np.zeros_like(added), where=reached)
    return PairCoefficients(scale, np.minimum(emission, np.float32(1e30)))


def of_receivers(coefficients: PairCoefficients, which: Any) -> PairCoefficients:
    """A resolved aggregate at some receivers."""
    emission = coefficients.emission
    return PairCoefficients(coefficients.scale[which], None if emission is None else emission[which])


@dataclass(eq=False)
class _State:
    """What the edits so far have made of the pairs."""

    scale: F32
    emission: F32
    offsets: list[F32 | None]  #: diffuse, paint, then one for each edit that lets light through


def _ends(masks: list[F32], located: list[Any], points: SurfacePoints, with_place: bool) -> Ends:
    n = len(points.instance)
    place = PairEnd(points.position, points.shading_normal, points.albedo) if with_place else None
    return Ends(np.stack(masks) if masks else np.zeros((0, n), np.float32), place, tuple(located))


def _end(place: PairEnd | None, which: Any, n: int) -> PairEnd:
    if place is None:
        return _NOWHERE
    return place if len(place.position) != n else PairEnd(*(column[which] for column in place))


def _pick(entry: Any, which: Any, n: int) -> Any:
    if isinstance(which, slice):
        return entry
    shared = len(entry[0] if isinstance(entry, tuple) else entry) != n
    return entry if shared else _taken(entry, which)


def _pair_weights(bound: BoundEdit, rows: range, receivers: Ends, casters: Ends, first_located: int) -> list[F32]:
    """Amount x key weight x u x w of each key, (n,) each."""
    shares: list[Any] = [np.float32(bound.edit.amount * weight) for weight in bound.key_weights]
    if bound.n_keys > 1 and all(key_rows is not None for key_rows in bound.rows):
        # Where one key has no samples, the other speaks alone: disocclusion is no reason to fade.
        confidence = [receivers.located[first_located + k].confidence for k in range(bound.n_keys)]
        total = sum(w * c for w, c in zip(bound.key_weights, confidence, strict=True))
        safe = np.where(total > 0, total, ONE)
        shares = [share * (c / safe).astype(np.float32) for share, c in zip(shares, confidence, strict=True)]
    return [share * receivers.masks[row] * casters.masks[row] for share, row in zip(shares, rows, strict=True)]


def _seen(state: _State, bound: BoundEdit, b: F32, groups: I64, which: Any) -> F32:
    """The light that an edit looks at: as the weaker edits left it where it composes, else unedited."""
    if bound.edit.blend is not Blend.COMPOSE:
        return np.asarray(sum(b[group, which] for group in groups), np.float32)
    seen: Any = sum(state.scale[group, which] * b[group, which] for group in groups)
    if len(groups) == len(b):
        seen = seen + state.emission[which]
    return np.asarray(seen, np.float32)


def _bakes_offset(bound: BoundEdit) -> bool:
    constants = any(baked is not None and baked.offset is not None for baked in bound.baked)
    return constants or any(rows is not None and rows.has_offset for rows in bound.rows)
