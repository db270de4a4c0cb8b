"""A stack on one view while it is being changed: bound, compiled, and its masks at all samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.binding import bind, rebind
from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import EMPTY_STACK, Edit, EditStack, KeyedPayload, SurfaceMask, Value
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.errors import EditError
from icheat_usd.relight.compiled import CompiledStack, Way, compile_stack, numbers_of
from icheat_usd.relight.painted import PaintedPoints
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, F64, I64, SceneSnapshot, SurfacePoints

#: Sides of an edit: fields of a payload.
RECEIVERS, CASTERS = "receiver_mask", "caster_mask"


class Change(NamedTuple):
    """What a command has changed in a stack of the same structure."""

    rows: list[int]  #: whose casters send otherwise
    samples: I64  #: ascending, whose receiver masks are others
    painted: list[int]  #: rows whose caster masks are others


class _Exchange(NamedTuple):
    """An edit in the place of another one."""

    edit: int
    bound: BoundEdit
    numbers: list[tuple[int, F64]]  #: row and slots
    receivers: list[tuple[int, I64, F32]]  #: row, view samples and weights
    casters: list[tuple[int, I64, F32]]  #: row, gather samples and weights
    sends_otherwise: bool


class LiveStack:
    """What a `LiveRelighter` knows about its stack.

    Edits that are muted or have an amount of 0 are no part of what is bound, so
    that the light is bit for bit the same as without them; muting one changes
    the structure.
    """

    def __init__(self, snapshot: SceneSnapshot, view: ViewSamples, gather: GatherSamples, at_records: bool) -> None:
        self._snapshot, self._view, self._gather = snapshot, view, gather
        self._at_records = at_records
        self.light_paths = snapshot.light_paths
        self._show(EMPTY_STACK, self._bind(EMPTY_STACK, self.light_paths), self.light_paths)

    stack: EditStack
    field: EditField
    compiled: CompiledStack
    receiver_masks: F32  #: (n_rows, n_view)
    caster_masks: F32  #: (n_rows, n_gather)
    light_paths: tuple[str, ...]

    def set_stack(self, stack: EditStack, light_paths: tuple[str, ...]) -> Change | None:
        """Take another stack; what changed, or None if the structure is another one."""
        changed = None if light_paths != self.light_paths else self._changed_edits(stack)
        if changed is None:
            self._show(stack, self._bind(stack, light_paths), light_paths)
            return None
        change = self._exchange(changed)
        if change is None:
            self._show(stack, self._bind(stack, light_paths), light_paths)
        self.stack = stack
        return change

    def set_amount(self, edit_path: str, amount: float) -> Change | None:
        """Change one amount; as `set_stack`."""
        if not np.isfinite(amount):
            raise EditError(f"{edit_path}: the amount is {amount!r}, expected a finite number")
        return self.set_edit(replace(self.edit(edit_path), amount=float(amount)))

    def edit(self, edit_path: str) -> Edit:
        """The edit at a path.

        Raises
        ------
        EditError
            There is none.
        """
        for edit in self.stack.edits:
            if edit.path == edit_path:
                return edit
        listed = ", ".join(edit.path for edit in self.stack.edits) or "no edits"
        raise EditError(f"there is no edit {edit_path} in the stack {self.stack.path}, which has {listed}")

    def set_edit(self, now: Edit) -> Change | None:
        """Put an edit in the place of the one of its path; as `set_stack`."""
        edits = tuple(now if edit.path == now.path else edit for edit in self.stack.edits)
        return self.set_stack(replace(self.stack, edits=edits, digest=""), self.light_paths)

    def set_at_records(self, at_records: bool) -> None:
        """Say whether edits that look at receivers may look at the records of the transport instead."""
        if at_records != self._at_records:
            self._at_records = at_records
            self._show(self.stack, self.field, self.light_paths)

    # Binding ----------------------------------------------------------------------------------------------------------

    def _bind(self, stack: EditStack, light_paths: tuple[str, ...]) -> EditField:
        return bind(stack, replace(self._snapshot, light_paths=light_paths))

    def _show(self, stack: EditStack, field: EditField, light_paths: tuple[str, ...]) -> None:
        receivers = field.receivers(self._view.points).masks
        casters = field.casters(self._gather.points).masks
        compiled = compile_stack(field, self._gather, casters, self._at_records)
        self.stack, self.field, self.light_paths, self.compiled = stack, field, light_paths, compiled
        self.receiver_masks = np.ascontiguousarray(receivers)
        self.caster_masks = np.ascontiguousarray(casters)
        self._painted: dict[tuple[int, str], PaintedPoints] = {}

    def _changed_edits(self, stack: EditStack) -> list[tuple[int, Edit]] | None:
        """Edits of the field that are set differently in `stack`; None if its structure is another one."""
        if len(stack.edits) != len(self.stack.edits):
            return None
        place = {bound.edit.path: k for k, bound in enumerate(self.field.edits)}
        changed = []
        for before, now in zip(self.stack.edits, stack.edits, strict=True):
            was_active, is_active = self.stack.enabled and before.is_active, stack.enabled and now.is_active
            if before is now and was_active == is_active or not (was_active or is_active):
                continue
            if was_active != is_active or not _same_structure(before, now) or now.path not in place:
                return None
            if any(selection.findings for selection in _selections(self.field.edits[place[now.path]])):
                return None
            changed.append((place[now.path], now))
        return changed

    def _exchange(self, changed: list[tuple[int, Edit]]) -> Change | None:
        """Put edits in the place of others of the same structure; None if their numbers do not fit after all."""
        exchanges = [self._exchanged(edit, now) for edit, now in changed]
        compiled = self.compiled
        if any(len(new) != len(compiled.slots_of(row)) for found in exchanges for row, new in found.numbers):
            return None
        edits, samples = list(self.field.edits), [np.empty(0, np.int64)]
        for found in exchanges:
            edits[found.edit] = found.bound
            for row, new in found.numbers:
                compiled.slots_of(row)[:] = new
            for row, points, weights in found.receivers:
                self.receiver_masks[row, points] = weights
                samples.append(points)
            for row, points, weights in found.casters:
                self.caster_masks[row, points] = weights
                compiled.set_weights(row, points, weights)
            for key, row in enumerate(self._rows(found.edit)):
                compiled.row_amount[row] = found.bound.edit.amount * found.bound.key_weights[key]
        self.field = replace(self.field, edits=tuple(edits))
        self.compiled = replace(compiled, field=self.field)
        rows = [row for found in exchanges if found.sends_otherwise for row in self._rows(found.edit)]
        # Points of one mask are ascending already.
        painted = [row for found in exchanges for row, _, _ in found.casters]
        return Change(rows, samples[-1] if len(samples) < 3 else np.unique(np.concatenate(samples)), painted)

    def _exchanged(self, edit: int, now: Edit) -> _Exchange:
        before = self.field.edits[edit]
        bound = replace(before, edit=now)
        sides: list[list[tuple[int, I64, F32]]] = []
        for side, points in ((RECEIVERS, self._view.points), (CASTERS, self._gather.points)):
            sides.append([])
            for key, row in enumerate(self._rows(edit)):
                mask = _mask(now, key, side)
                if mask is not None and mask is not _mask(before.edit, key, side):
                    bound, found, weights = self._repainted(bound, key, side, row, mask, points)
                    sides[-1].append((row, found, weights))
        recipe_stays = now.parameters == before.edit.parameters and _recipes(now) == _recipes(before.edit)
        if not recipe_stays or (any(sides) and bound.is_prepared):
            bound = rebind(bound, now, self._snapshot)
        weights_stay = _key_weights(now) == before.key_weights and now.amount == before.edit.amount
        bound = replace(bound, key_weights=_key_weights(now))
        numbers = []
        if bound.parameters is not before.parameters:
            for key, row in enumerate(self._rows(edit)):
                if self.compiled.way[row] == Way.VERSION:
                    cells = np.flatnonzero(self.compiled.support[row])
                    numbers.append((row, numbers_of(bound, key, self._gather, cells)))
        sends_otherwise = bound.parameters is not before.parameters or not weights_stay or bool(sides[1])
        return _Exchange(edit, bound, numbers, sides[0], sides[1], sends_otherwise)

    def _repainted(
        self, bound: BoundEdit, key: int, side: str, row: int, mask: SurfaceMask, points: SurfacePoints
    ) -> tuple[BoundEdit, I64, F32]:
        """The edit with another mask on the same surfaces; points whose weight may have changed and their weights."""
        selections = list(bound.receivers if side == RECEIVERS else bound.casters)
        selection = selections[key]
        assert selection.mask is not None
        if (row, side) not in self._painted:
            self._painted[row, side] = PaintedPoints(selection, points)
        painted = self._painted[row, side]
        places = painted.touched(mask.texels != selection.mask.texels)
        found, weights = painted.weights(places, mask.texels)
        selections[key] = replace(selection, mask=replace(selection.mask, texels=mask.texels))
        if side == RECEIVERS:
            return replace(bound, receivers=tuple(selections)), found, weights
        return replace(bound, casters=tuple(selections)), found, weights

    def _rows(self, edit: int) -> range:
        return self.compiled.rows_of(edit)


def _same_structure(a: Edit, b: Edit) -> bool:
    """Whether two edits differ in amount, parameters, weights of keys and texels of masks alone."""
    return (
        (a.path, a.operation, a.blend, a.occluders, a.lights) == (b.path, b.operation, b.blend, b.occluders, b.lights)
        and a.receivers == b.receivers
        and a.casters == b.casters
        and len(a.keys) == len(b.keys)
        and all(_same_payload(x, y) for x, y in zip(a.keys, b.keys, strict=True))
    )


def _same_payload(a: KeyedPayload, b: KeyedPayload) -> bool:
    if a.payload is b.payload:
        return True
    if a.payload is None or b.payload is None:
        return False
    names = ("rows", "scale_delta", "emission", "offset")
    same = all(getattr(a.payload, name) is getattr(b.payload, name) for name in names)
    return same and all(
        _same_surfaces(getattr(a.payload, side), getattr(b.payload, side)) for side in (RECEIVERS, CASTERS)
    )


def _same_surfaces(a: SurfaceMask | None, b: SurfaceMask | None) -> bool:
    if a is None or b is None:
        return a is b
    same = a.surfaces is b.surfaces or a.surfaces == b.surfaces
    return a is b or (same and a.texels.shape == b.texels.shape and a.rest is b.rest)


def _selections(bound: BoundEdit) -> tuple[BoundSelection, ...]:
    return (*bound.receivers, *bound.casters)


def _mask(edit: Edit, key: int, side: str) -> SurfaceMask | None:
    if not edit.keys:
        return None
    payload = [keyed.payload for keyed in edit.keys if keyed.payload is not None][key]
    found: SurfaceMask | None = getattr(payload, side)
    return found


def _recipes(edit: Edit) -> list[Mapping[str, Value]]:
    return [keyed.payload.parameters for keyed in edit.keys if keyed.payload is not None]


def _key_weights(edit: Edit) -> tuple[float, ...]:
    return tuple(keyed.weight for keyed in edit.keys if keyed.payload is not None) if edit.keys else (1.0,)
