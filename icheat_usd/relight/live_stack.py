"""A stack on one view while it is being changed: bound, compiled, and its masks at all samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icheat_usd.edits.binding import bind, rebind
from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import EMPTY_STACK, Edit, EditStack, KeyedPayload
from icheat_usd.errors import EditError
from icheat_usd.relight.compiled import CompiledStack, Way, compile_stack, numbers_of
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, SceneSnapshot


class LiveStack:
    """What a `LiveRelighter` knows about its stack.

    Edits that are muted keep their place with an amount of 0, so that turning
    them on and off changes numbers and no structure.
    """

    def __init__(self, snapshot: SceneSnapshot, view: ViewSamples, gather: GatherSamples) -> None:
        self._snapshot, self._view, self._gather = snapshot, view, gather
        self.light_paths = snapshot.light_paths
        self._show(EMPTY_STACK, self._bind(EMPTY_STACK, self.light_paths), self.light_paths)

    stack: EditStack
    field: EditField
    compiled: CompiledStack
    receiver_masks: F32  #: (n_rows, n_view)
    caster_masks: F32  #: (n_rows, n_gather)
    light_paths: tuple[str, ...]

    @property
    def active_rows(self) -> list[int]:
        """Rows of the edits that are not muted."""
        return [
            row for edit, bound in enumerate(self.field.edits) if bound.edit.amount != 0 for row in self._rows(edit)
        ]

    def set_stack(self, stack: EditStack, light_paths: tuple[str, ...]) -> list[int] | None:
        """Take another stack; rows that act differently now, or None if the structure is another one."""
        changed = None if light_paths != self.light_paths else self._changed_edits(stack)
        if changed is None:
            self._show(stack, self._bind(stack, light_paths), light_paths)
            return None
        bound = {edit: self._rebound(self.field.edits[edit], now) for edit, now in changed}
        rows = self._exchange(bound)
        self.stack = stack
        return rows if rows is not None else self.set_stack_anew()

    def set_stack_anew(self) -> None:
        """Bind and compile the stack again."""
        self._show(self.stack, self._bind(self.stack, self.light_paths), self.light_paths)

    def set_amount(self, edit_path: str, amount: float) -> list[int] | None:
        """Change one amount; as `set_stack`."""
        if not np.isfinite(amount):
            raise EditError(f"{edit_path}: the amount is {amount!r}, expected a finite number")
        edits = self.stack.edits
        found = [k for k, edit in enumerate(edits) if edit.path == edit_path]
        if not found:
            raise EditError(f"there is no edit {edit_path} in the stack; it has {', '.join(e.path for e in edits)}")
        changed = replace(edits[found[0]], amount=float(amount))
        stack = replace(self.stack, edits=(*edits[: found[0]], changed, *edits[found[0] + 1 :]))
        return self.set_stack(stack, self.light_paths)

    # Binding ----------------------------------------------------------------------------------------------------------

    def _bind(self, stack: EditStack, light_paths: tuple[str, ...]) -> EditField:
        snapshot = replace(self._snapshot, light_paths=light_paths)
        shown = tuple(_shown(edit) for edit in stack.edits)
        try:
            field = bind(EditStack(stack.path, shown), snapshot)
        except EditError:
            # A muted edit may be one that cannot be shown: that is what muting it is for.
            shown = tuple(
                _shown(edit) for edit in stack.edits if _is_active(stack, edit) or _can_be_bound(edit, snapshot)
            )
            field = bind(EditStack(stack.path, shown), snapshot)
        now = {edit.path: _weighed(stack, edit) for edit in stack.edits}
        return replace(field, edits=tuple(replace(bound, edit=now[bound.edit.path]) for bound in field.edits))

    def _rebound(self, bound: BoundEdit, now: Edit) -> BoundEdit:
        before = bound.edit
        if before.parameters == now.parameters and before.keys == now.keys:
            return replace(bound, edit=now)
        return rebind(bound, now, self._snapshot)

    def _show(self, stack: EditStack, field: EditField, light_paths: tuple[str, ...]) -> None:
        receivers = field.receivers(self._view.points).masks
        casters = field.casters(self._gather.points).masks
        compiled = compile_stack(field, self._gather, casters)
        self.stack, self.field, self.light_paths, self.compiled = stack, field, light_paths, compiled
        self.receiver_masks = np.ascontiguousarray(receivers)
        self.caster_masks = np.ascontiguousarray(casters)

    def _changed_edits(self, stack: EditStack) -> list[tuple[int, Edit]] | None:
        """Edits of the field that are set differently in `stack`; None if its structure is another one."""
        if len(stack.edits) != len(self.stack.edits):
            return None
        place = {bound.edit.path: k for k, bound in enumerate(self.field.edits)}
        changed = []
        for before, now in zip(self.stack.edits, stack.edits, strict=True):
            if before is now and stack.enabled == self.stack.enabled:
                continue
            if not _same_structure(before, now):
                return None
            if now.path in place:
                changed.append((place[now.path], _weighed(stack, now)))
            elif _is_active(stack, now) or before.keys != now.keys:
                return None
        return changed

    def _exchange(self, bound: dict[int, BoundEdit]) -> list[int] | None:
        """Put edits in the place of others of the same structure: rows, or None if their numbers do not fit."""
        compiled, numbers = self.compiled, {}
        for edit, now in bound.items():
            for key, row in enumerate(self._rows(edit)):
                if compiled.way[row] == Way.VERSION:
                    numbers[row] = numbers_of(now, key, self._gather, np.flatnonzero(compiled.support[row]))
                    if len(numbers[row]) != compiled.slot_begin[row + 1] - compiled.slot_begin[row]:
                        return None
        for row, values in numbers.items():
            compiled.slots[compiled.slot_begin[row] : compiled.slot_begin[row + 1]] = values
        edits = list(self.field.edits)
        rows = []
        for edit, now in bound.items():
            edits[edit] = now
            for key, row in enumerate(self._rows(edit)):
                compiled.row_amount[row] = now.edit.amount * now.key_weights[key]
                rows.append(row)
        self.field = replace(self.field, edits=tuple(edits))
        self.compiled = replace(compiled, field=self.field)
        return rows

    def _rows(self, edit: int) -> range:
        rows = self.field.rows_of(edit)
        return range(rows.start, rows.stop)


def _is_active(stack: EditStack, edit: Edit) -> bool:
    return stack.enabled and edit.is_active


def _shown(edit: Edit) -> Edit:
    return edit if edit.is_active else replace(edit, enabled=True, amount=1.0)


def _weighed(stack: EditStack, edit: Edit) -> Edit:
    """The edit with what it counts now: a muted one is not multiplied by anything but 0."""
    return edit if _is_active(stack, edit) else replace(edit, amount=0.0)


def _can_be_bound(edit: Edit, snapshot: SceneSnapshot) -> bool:
    try:
        bind(EditStack("", (_shown(edit),)), snapshot)
    except EditError:
        return False
    return True


def _same_structure(a: Edit, b: Edit) -> bool:
    """Whether two edits differ in amount, parameters and weights of keys alone."""
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
    names = ("receiver_mask", "caster_mask", "rows", "scale_delta", "emission", "offset")
    return all(getattr(a.payload, name) is getattr(b.payload, name) for name in names)
