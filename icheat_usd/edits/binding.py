"""Binding a stack to a scene: operations found, selections placed, parameters prepared, lights put in groups."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from icheat_usd.edits import operations
from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.encodings.rows import bind_rows
from icheat_usd.edits.field import EditField
from icheat_usd.edits.measures import Measures
from icheat_usd.edits.model import Edit, EditStack, Payload, Selection, Value
from icheat_usd.edits.operations import Measure, Operation, PairCoefficients
from icheat_usd.edits.selection import BoundSelection, bind_selection
from icheat_usd.errors import EditError
from icheat_usd.scene import F32, I64, Bool, Finding, SceneSnapshot


def bind(stack: EditStack, snapshot: SceneSnapshot, known: Mapping[str, BoundEdit] | None = None) -> EditField:
    """Bind the active edits of `stack` to a scene.

    Parameters
    ----------
    known : mapping, optional
        Edits by path that were bound to this scene before: what binding them anew would find is taken from there.

    Raises
    ------
    EditError
        An operation is unknown and no payload holds it baked, a parameter is
        wrong, an occluder does not exist, or a painted mask cannot
        be placed on the scene.
    """
    group, members = _light_groups(stack, snapshot)
    bound = [
        _bound_as(known.get(edit.path) if known else None, edit, members.get(edit.path))
        or _bind_edit(edit, snapshot, members.get(edit.path))
        for edit in stack.active
    ]
    n_groups = int(group.max(initial=0)) + 1
    # An edit that is blocked at this time has no key left, and one whose lights are all out nothing to scale.
    edits = tuple(edit for edit in bound if edit.n_keys and (edit.groups.any() or not len(edit.groups)))
    edits = tuple(_with_groups(edit, n_groups) for edit in edits)
    return EditField(edits, group, n_groups, _findings(edits))


def _bound_as(known: BoundEdit | None, edit: Edit, groups: Bool | None) -> BoundEdit | None:
    """An edit that may differ from a bound one in amount, blend and lights; None if it differs in more."""
    if known is None or not _is_placed_as(known.edit, edit):
        return None
    weights = tuple(weight for _, weight in _payloads(edit))
    return replace(known, edit=edit, key_weights=weights, groups=np.zeros(0, np.bool_) if groups is None else groups)


def _is_placed_as(a: Edit, b: Edit) -> bool:
    """Whether two edits select the same and do the same."""
    return a is b or (
        (a.path, a.operation, a.occluders, a.target) == (b.path, b.operation, b.occluders, b.target)
        and (a.parameters is b.parameters or dict(a.parameters) == dict(b.parameters))
        and (a.receivers is b.receivers or a.receivers == b.receivers)
        and (a.casters is b.casters or a.casters == b.casters)
        and len(a.keys) == len(b.keys)
        and all(x.payload is y.payload for x, y in zip(a.keys, b.keys, strict=True))
    )


def rebind(bound: BoundEdit, edit: Edit, snapshot: SceneSnapshot) -> BoundEdit:
    """Bind an edit that differs from a bound one in amount, parameters and weights of keys alone.

    Raises
    ------
    EditError
        A parameter is wrong.
    """
    payloads = _payloads(edit)
    parameters = tuple(
        _prepared(bound.operation, edit, payload, snapshot, receivers, casters)
        for (payload, _), receivers, casters in zip(payloads, bound.receivers, bound.casters, strict=True)
    )
    return replace(bound, edit=edit, parameters=parameters, key_weights=tuple(weight for _, weight in payloads))


def _payloads(edit: Edit) -> list[tuple[Payload | None, float]]:
    if not edit.keys:
        return [(None, 1.0)]
    return [(key.payload, key.weight) for key in edit.keys if key.payload is not None]


def _light_groups(stack: EditStack, snapshot: SceneSnapshot) -> tuple[I64, dict[str, Bool]]:
    """Lights that no edit tells apart form a group; which groups each edit with lights of its own acts on."""
    named = {edit.path: _named_lights(edit, snapshot) for edit in stack.active if edit.lights}
    if not named:
        return np.zeros(len(snapshot.light_paths), np.int64), {}
    table = np.stack(list(named.values()), axis=1)
    signatures, group = np.unique(table, axis=0, return_inverse=True)
    return group.reshape(-1).astype(np.int64), {path: signatures[:, i] for i, path in enumerate(named)}


def _named_lights(edit: Edit, snapshot: SceneSnapshot) -> Bool:
    """Which lights are at or below the edit's; none, if what it names is hidden or sends nothing at this time."""
    below = tuple(path.rstrip("/") + "/" for path in edit.lights)
    return np.array([path in edit.lights or path.startswith(below) for path in snapshot.light_paths], np.bool_)


def _with_groups(bound: BoundEdit, n_groups: int) -> BoundEdit:
    if len(bound.groups):
        return bound
    return replace(bound, groups=np.ones(n_groups, np.bool_))


def _findings(edits: tuple[BoundEdit, ...]) -> tuple[Finding, ...]:
    sources = [source for bound in edits for source in (*bound.receivers, *bound.casters, *bound.rows) if source]
    return tuple(dict.fromkeys(finding for source in sources for finding in getattr(source, "findings", ())))


def _bind_edit(edit: Edit, snapshot: SceneSnapshot, groups: Bool | None) -> BoundEdit:
    operation = operations.find(edit.operation)
    payloads = _payloads(edit)
    rows, baked = [], []
    for payload, _ in payloads:
        sampled = None if operation is not None or payload is None else payload.rows
        rows.append(None if sampled is None else bind_rows(sampled, snapshot, edit.path))
        baked.append(_constants(payload) if operation is None and rows[-1] is None else None)
        if operation is None and rows[-1] is None and baked[-1] is None:
            raise EditError(
                f"{edit.path}: operation '{edit.operation}' is unknown and no payload holds it baked;"
                f" known are {', '.join(operations.names())}; install the package that brings it, or mute the edit"
            )
    # Rows have all soft weights multiplied in; what the collections say still holds.
    masks = [(None, None) if r is not None else _masks(p) for r, (p, _) in zip(rows, payloads, strict=True)]
    sides = [
        tuple(
            bind_selection(
                Selection(selection.paths) if key_rows is not None else selection, pair[side], snapshot, edit.path
            )
            for key_rows, pair in zip(rows, masks, strict=True)
        )
        for side, selection in enumerate((edit.receivers, edit.casters))
    ]
    return BoundEdit(
        edit,
        operation,
        parameters=tuple(
            _prepared(operation, edit, payload, snapshot, receivers, casters)
            for (payload, _), receivers, casters in zip(payloads, *sides, strict=True)
        ),
        baked=tuple(baked),
        rows=tuple(rows),
        receivers=sides[0],
        casters=sides[1],
        key_weights=tuple(weight for _, weight in payloads),
        groups=np.zeros(0, np.bool_) if groups is None else groups,
        occluders=_occluders(operation, edit, snapshot),
    )


def _masks(payload: Payload | None) -> tuple[Any, Any]:
    return (None, None) if payload is None else (payload.receiver_mask, payload.caster_mask)


def _constants(payload: Payload | None) -> PairCoefficients | None:
    if payload is None or (payload.scale_delta, payload.emission, payload.offset) == (None, None, None):
        return None

    def rgb(value: tuple[float, float, float] | None) -> F32 | None:
        return None if value is None else np.asarray(value, np.float32)[None, :]

    delta = rgb(payload.scale_delta or (0.0, 0.0, 0.0))
    assert delta is not None
    return PairCoefficients(np.float32(1) + delta, rgb(payload.emission), rgb(payload.offset))


def _prepared(
    operation: Operation | None,
    edit: Edit,
    payload: Payload | None,
    snapshot: SceneSnapshot,
    receivers: BoundSelection,
    casters: BoundSelection,
) -> Mapping[str, Value]:
    if operation is None:
        return {}
    given = dict(edit.parameters if payload is None else payload.parameters)
    parameters = operation.complete(given, edit.path)
    for parameter in operation.parameters:
        value = parameters[parameter.name]
        if parameter.measure is Measure.POINT and isinstance(value, tuple):
            parameters[parameter.name] = tuple(float(x - c) for x, c in zip(value, snapshot.centre, strict=True))
    return operation.prepare(parameters, Measures(snapshot, receivers, casters))


def _occluders(operation: Operation | None, edit: Edit, snapshot: SceneSnapshot) -> Bool:
    """Instances that the edit lets light through."""
    below = tuple(path.rstrip("/") + "/" for path in edit.occluders)
    named = [s.path in edit.occluders or s.path.startswith(below) for s in snapshot.surfaces]
    surfaces = np.array(named, np.bool_)
    if operation is not None and operation.has_through and not surfaces.any():
        raise EditError(
            f"{edit.path}: operation '{operation.name}' has no occluders in this scene; name the prims that light"
            " should pass through with rel icheat:occluders, or mute the edit"
        )
    return surfaces[snapshot.geometry.instance_surface] if len(surfaces) else np.zeros(0, np.bool_)
