"""A stack on one view while it is being changed: bound, compiled, and its masks at all samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.binding import bind, rebind
from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.masks import bind_mask
from icheat_usd.edits.model import EMPTY_STACK, Edit, EditStack, Payload, SurfaceMask, Value
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.errors import EditError
from icheat_usd.materials import take_points
from icheat_usd.relight.compiled import CompiledStack, Way, compile_stack, numbers_of
from icheat_usd.relight.painted import PaintedPoints, PointsByInstance
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, F64, I64, SceneSnapshot

#: Sides of an edit: fields of a payload.
RECEIVERS, CASTERS = "receiver_mask", "caster_mask"


class Change(NamedTuple):
    """What a command has changed in a stack."""

    rows: list[int]  #: whose casters send otherwise
    samples: I64  #: ascending, whose receiver masks are others
    painted: list[int]  #: rows whose caster masks are others
    before: I64 | None = None  #: (n_rows,) row that each row was, -1 for new ones; None: rows are the same
    n_before: int = 0  #: rows that there were then
    amount_of: str = ""  #: path of the edit whose amount has changed, if nothing else has
    gone: tuple[int, ...] = ()  #: rows of `LiveStack.receiver_masks` that were given up, or given to new rows

    @property
    def is_none(self) -> bool:
        """Whether the image stays as it is: the same stack was set again."""
        return self.before is None and not (self.rows or len(self.samples) or self.painted)


class _Exchange(NamedTuple):
    """An edit in the place of another one."""

    edit: int
    bound: BoundEdit
    numbers: list[tuple[int, F64]]  #: row and slots
    receivers: list[tuple[int, I64, F32]]  #: key, view samples and weights
    casters: list[tuple[int, I64, F32]]  #: key, gather samples and weights
    sends_otherwise: bool
    amount_alone: bool  #: nothing but the amount differs


class _Weights(NamedTuple):
    """What a selection says about the points that lie on its surfaces."""

    selection: BoundSelection
    points: I64  #: ascending
    weights: F32


class LiveStack:
    """What a `LiveRelighter` knows about its stack.

    Edits that are muted or have an amount of 0 are no part of what is bound, so
    that the light is bit for bit the same as without them; muting one changes
    the structure.
    """

    def __init__(self, snapshot: SceneSnapshot, view: ViewSamples, gather: GatherSamples, at_records: bool) -> None:
        self._snapshot, self._gather = snapshot, gather
        self._points = {RECEIVERS: PointsByInstance(view.points), CASTERS: PointsByInstance(gather.points)}
        self._at_records = at_records
        self._known: dict[str, BoundEdit] = {}  # muted ones too
        self._weights: dict[tuple[str, int, str], _Weights] = {}  # by edit, key and side
        self._painted: dict[tuple[str, int, str], tuple[I64, PaintedPoints]] = {}
        self._show_anew(EMPTY_STACK, self._bind(EMPTY_STACK, snapshot.light_paths), snapshot.light_paths)

    stack: EditStack
    field: EditField
    compiled: CompiledStack
    light_paths: tuple[str, ...]
    receiver_masks: F32  #: (n, n_view) at least one for each row of the stack; what none uses is 0
    mask_rows: I64  #: (n_rows,) where in `receiver_masks` that of each row is; it stays there while the row stays

    def receiver_mask(self, row: int | np.integer) -> F32:
        """Weights of a row at all view samples, (n_view,)."""
        mask: F32 = self.receiver_masks[self.mask_rows[row]]
        return mask

    def set_stack(self, stack: EditStack, light_paths: tuple[str, ...]) -> Change | None:
        """Take another stack; what changed, or None if that is everything.

        Raises
        ------
        EditError
            It cannot be bound; all is as before.
        """
        if light_paths == self.light_paths:
            changed = self._changed_edits(stack)
            change = None if changed is None else self._exchange(changed)
            if change is not None:
                self.stack = stack
                return change
        return self._show(stack, self._bind(stack, light_paths), light_paths)

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
            self._show_anew(self.stack, self.field, self.light_paths)

    # Binding ----------------------------------------------------------------------------------------------------------

    def _bind(self, stack: EditStack, light_paths: tuple[str, ...]) -> EditField:
        same = light_paths == self._snapshot.light_paths
        snapshot = self._snapshot if same else replace(self._snapshot, light_paths=light_paths, light_controls=())
        return bind(stack, snapshot, self._known)

    def _show(self, stack: EditStack, field: EditField, light_paths: tuple[str, ...]) -> Change | None:
        """Take a stack of another structure; edits that stay keep their masks and their rows of `receiver_masks`."""
        compiled = self._compiled(field)
        before = self._rows_before(field, compiled) if light_paths == self.light_paths else None
        if before is None or len(before) > len(self.receiver_masks):
            self._show_anew(stack, field, light_paths)
            return None
        stays = before >= 0
        gone = np.setdiff1d(self.mask_rows, self.mask_rows[before[stays]])
        masks, changed = self.receiver_masks, [np.empty(0, np.int64)]
        bounds = {bound.edit.path: bound for bound in self.field.edits}
        for path, key, row in _keys(self.field):
            if self.mask_rows[row] in gone:
                points = self._weights_of(bounds[path], key, RECEIVERS).points
                masks[self.mask_rows[row], points] = 0
                changed.append(points)
        mask_rows = np.full(len(before), -1, np.int64)
        mask_rows[stays] = self.mask_rows[before[stays]]
        mask_rows[~stays] = np.setdiff1d(np.arange(len(masks)), mask_rows)[: np.count_nonzero(~stays)]
        for _, key, row in _keys(field):
            if not stays[row]:
                found = self._weights_of(field.edits[compiled.row_table[row, 0]], key, RECEIVERS)
                masks[mask_rows[row], found.points] = found.weights
                changed.append(found.points)
        n_before, self.mask_rows = len(self.mask_rows), mask_rows
        self._take(stack, field, compiled, light_paths)
        given_up = tuple(np.concatenate([gone, mask_rows[~stays]]).tolist())
        return Change([], _flagged(changed, masks.shape[1]), [], before, n_before, gone=given_up)

    def _show_anew(self, stack: EditStack, field: EditField, light_paths: tuple[str, ...]) -> None:
        compiled = self._compiled(field)
        # Some more, for edits to come: memory that is not touched costs nothing.
        n = compiled.n_rows + max(2, compiled.n_rows // 8)
        masks = np.zeros((n, len(self._points[RECEIVERS].points.instance)), np.float32)
        for _, key, row in _keys(field):
            found = self._weights_of(field.edits[compiled.row_table[row, 0]], key, RECEIVERS)
            masks[row, found.points] = found.weights
        self.receiver_masks, self.mask_rows = masks, np.arange(compiled.n_rows)
        self._take(stack, field, compiled, light_paths)

    def _take(self, stack: EditStack, field: EditField, compiled: CompiledStack, light_paths: tuple[str, ...]) -> None:
        self.stack, self.field, self.light_paths, self.compiled = stack, field, light_paths, compiled
        paths = {edit.path for edit in stack.edits}
        self._known = {path: bound for path, bound in self._known.items() if path in paths}
        self._known |= {bound.edit.path: bound for bound in field.edits}
        self._weights = {name: found for name, found in self._weights.items() if name[0] in paths}
        self._painted = {name: found for name, found in self._painted.items() if name[0] in paths}

    def _compiled(self, field: EditField) -> CompiledStack:
        found = [self._weights_of(bound, key, CASTERS) for bound in field.edits for key in range(bound.n_keys)]
        return compile_stack(field, self._gather, [(one.points, one.weights) for one in found], self._at_records)

    def _weights_of(self, bound: BoundEdit, key: int, side: str) -> _Weights:
        """Weights of one side of an edit, found once."""
        selection, name = _side(bound, side)[key], (bound.edit.path, key, side)
        known = self._weights.get(name)
        if known is not None and known.selection is selection:
            return known
        of = self._points[side]
        points = of.on(selection.on_instances)
        weights = selection.at_some(of.points, points)
        rows = bound.rows[key]
        if rows is not None and len(points):
            # Where no row holds nothing is edited, to the bit.
            there = take_points(of.points, points)
            if side == RECEIVERS:
                weights = weights * (rows.locate_receivers(there).rows >= 0).any(axis=1)
            else:
                weights = weights * (rows.locate_casters(there) >= 0)
        self._weights[name] = _Weights(selection, points, weights)
        return self._weights[name]

    def _rows_before(self, field: EditField, compiled: CompiledStack) -> I64 | None:
        """Which row each row of a field was before, -1 if none was alike; None if no row can stay.

        Where edits look at receivers, or at all light of theirs, it is not enough to know which rows are others.
        """
        by_version = (Way.VERSION, Way.VIEW)
        if not (np.isin(compiled.way, by_version).all() and np.isin(self.compiled.way, by_version).all()):
            return None
        same_lights = np.array_equal(field.light_group, self.field.light_group)
        if not same_lights or field.n_groups != self.field.n_groups or not compiled.n_rows:
            return None
        places = {(path, key): row for path, key, row in _keys(self.field)}
        bounds = {bound.edit.path: bound for bound in self.field.edits}
        found = [
            places[path, key] if path in bounds and _acts_as(bounds[path], bound) else -1
            for bound in field.edits
            for path, key in ((bound.edit.path, key) for key in range(bound.n_keys))
        ]
        return np.array(found, np.int64)

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
            if was_active != is_active or now.path not in place:
                return None
            bound = self.field.edits[place[now.path]]
            if not _same_structure(before, now, bound) or any(one.findings for one in _selections(bound)):
                return None
            changed.append((place[now.path], now))
        # Their order, and which are there.
        if any(a.path != b.path for a, b in zip(self.stack.edits, stack.edits, strict=True)):
            return None
        return changed

    def _exchange(self, changed: list[tuple[int, Edit]]) -> Change | None:
        """Put edits in the place of others of the same structure; None if their numbers do not fit after all."""
        exchanges = [self._exchanged(edit, now) for edit, now in changed]
        amount_of = exchanges[0].bound.edit.path if len(exchanges) == 1 and exchanges[0].amount_alone else ""
        compiled = self.compiled
        if any(len(new) != len(compiled.slots_of(row)) for found in exchanges for row, new in found.numbers):
            return None
        edits, samples = list(self.field.edits), [np.empty(0, np.int64)]
        for found in exchanges:
            edits[found.edit] = found.bound
            for row, new in found.numbers:
                compiled.slots_of(row)[:] = new
            first = self._rows(found.edit).start
            for key, points, weights in found.receivers:
                self.receiver_masks[self.mask_rows[first + key], points] = weights
                samples.append(points)
                self._remember(found, key, RECEIVERS, points, weights)
            for key, points, weights in found.casters:
                compiled.set_weights(first + key, points, weights)
                self._remember(found, key, CASTERS, points, weights)
            for key, row in enumerate(self._rows(found.edit)):
                compiled.row_amount[row] = found.bound.edit.amount * found.bound.key_weights[key]
            self._known[found.bound.edit.path] = found.bound
        self.field = replace(self.field, edits=tuple(edits))
        self.compiled = replace(compiled, field=self.field)
        rows = [row for found in exchanges if found.sends_otherwise for row in self._rows(found.edit)]
        # Points of one mask are ascending already.
        painted = [self._rows(found.edit).start + key for found in exchanges for key, _, _ in found.casters]
        some = samples[-1] if len(samples) < 3 else np.unique(np.concatenate(samples))
        return Change(rows, some, painted, amount_of=amount_of)

    def _exchanged(self, edit: int, now: Edit) -> _Exchange:
        before = self.field.edits[edit]
        bound = replace(before, edit=now)
        sides: list[list[tuple[int, I64, F32]]] = []
        for side in (RECEIVERS, CASTERS):
            sides.append([])
            for key in range(before.n_keys):
                was, mask = _mask(before.edit, key, side), _mask(now, key, side)
                if mask is not was:
                    bound, found, weights = self._repainted(bound, key, side, was, mask)
                    sides[-1].append((key, found, weights))
        recipe_stays = _recipes(now) == _recipes(before.edit)
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
        amount_alone = recipe_stays and not any(sides) and bound.key_weights == before.key_weights
        return _Exchange(edit, bound, numbers, sides[0], sides[1], sends_otherwise, amount_alone)

    def _repainted(
        self, bound: BoundEdit, key: int, side: str, was: SurfaceMask | None, mask: SurfaceMask | None
    ) -> tuple[BoundEdit, I64, F32]:
        """The edit with another mask on one side; points whose weight may have changed, ascending, and their weights.

        Raises
        ------
        EditError
            The mask does not fit the scene.
        """
        selections = list(_side(bound, side))
        selection, name = selections[key], (bound.edit.path, key, side)
        of = self._points[side].points
        if mask is not None and was is not None and _same_surfaces(was, mask):
            assert selection.mask is not None
            known = self._painted.get(name)
            if known is None or known[0] is not selection.mask.first_face:
                known = selection.mask.first_face, PaintedPoints(selection, of)
                self._painted[name] = known
            found, weights = known[1].repainted(selection.mask.texels, mask.texels)
            selections[key] = replace(selection, mask=replace(selection.mask, texels=mask.texels))
        else:
            now = None if mask is None else bind_mask(mask, self._snapshot, bound.edit.path)
            selections[key] = replace(selection, mask=now)
            found, before = self._weights_of(bound, key, side)[1:]
            weights = selections[key].at_some(of, found)
            found, weights = found[weights != before], weights[weights != before]
        if side == RECEIVERS:
            return replace(bound, receivers=tuple(selections)), found, weights
        return replace(bound, casters=tuple(selections)), found, weights

    def _remember(self, found: _Exchange, key: int, side: str, points: I64, weights: F32) -> None:
        """Have `_weights_of` know weights that were painted over."""
        name = (found.bound.edit.path, key, side)
        known = self._weights.pop(name, None)
        if known is not None and known.selection is _side(self.field.edits[found.edit], side)[key]:
            known.weights[np.searchsorted(known.points, points)] = weights
            self._weights[name] = known._replace(selection=_side(found.bound, side)[key])

    def _rows(self, edit: int) -> range:
        return self.compiled.rows_of(edit)


def _same_structure(a: Edit, b: Edit, bound: BoundEdit) -> bool:
    """Whether two edits differ in amount, parameters, weights of keys and painted masks alone."""
    return (
        (a.path, a.operation, a.blend, a.occluders, a.lights) == (b.path, b.operation, b.blend, b.occluders, b.lights)
        and (a.receivers is b.receivers or a.receivers == b.receivers)
        and (a.casters is b.casters or a.casters == b.casters)
        and len(_payloads(a)) == len(_payloads(b))
        and (bound.operation is not None or _same_baked(a, b))
    )


def _same_baked(a: Edit, b: Edit) -> bool:
    """Whether two edits of an unknown operation have the same rows and numbers; rows know their masks."""

    def same(x: Payload | None, y: Payload | None) -> bool:
        if x is None or y is None:
            return x is y
        names = ["rows", "scale_delta", "emission", "offset"] + ["receiver_mask", "caster_mask"] * (x.rows is not None)
        return all(getattr(x, name) is getattr(y, name) for name in names)

    return all(same(x, y) for x, y in zip(_payloads(a), _payloads(b), strict=True))


def _acts_as(before: BoundEdit, now: BoundEdit) -> bool:
    """Whether two edits of one path act alike, wherever in the stack they are."""
    return before is now or (
        before.edit.amount == now.edit.amount
        and before.edit.blend is now.edit.blend
        and before.key_weights == now.key_weights
        and before.operation is now.operation
        and before.parameters is now.parameters
        and before.baked is now.baked
        and before.receivers is now.receivers
        and before.casters is now.casters
        and np.array_equal(before.groups, now.groups)
    )


def _keys(field: EditField) -> Iterator[tuple[str, int, int]]:
    """Path, key and row of every row."""
    names = ((bound.edit.path, key) for bound in field.edits for key in range(bound.n_keys))
    return ((path, key, row) for row, (path, key) in enumerate(names))


def _side(bound: BoundEdit, side: str) -> tuple[BoundSelection, ...]:
    return bound.receivers if side == RECEIVERS else bound.casters


def _flagged(parts: Sequence[I64], n: int) -> I64:
    """The union of some sets of points of `n`, ascending."""
    flags = np.zeros(n, np.bool_)
    for part in parts:
        flags[part] = True
    return np.flatnonzero(flags)


def _same_surfaces(a: SurfaceMask, b: SurfaceMask) -> bool:
    """Whether two masks have their texels at the same places; where their faces lay once tells no more than that."""
    return a.texels.shape == b.texels.shape and (a.surfaces is b.surfaces or a.surfaces == b.surfaces)


def _selections(bound: BoundEdit) -> tuple[BoundSelection, ...]:
    return (*bound.receivers, *bound.casters)


def _payloads(edit: Edit) -> list[Payload | None]:
    """One for each key that is bound."""
    return [keyed.payload for keyed in edit.keys if keyed.payload is not None] if edit.keys else [None]


def _mask(edit: Edit, key: int, side: str) -> SurfaceMask | None:
    payload = _payloads(edit)[key]
    found: SurfaceMask | None = None if payload is None else getattr(payload, side)
    return found


def _recipes(edit: Edit) -> list[dict[str, Value]]:
    return [dict(edit.parameters if payload is None else payload.parameters) for payload in _payloads(edit)]


def _key_weights(edit: Edit) -> tuple[float, ...]:
    return tuple(keyed.weight for keyed in edit.keys if keyed.payload is not None) if edit.keys else (1.0,)
