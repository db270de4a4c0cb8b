"""The payloads of edits: form, size, and whether they are still up to date."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from icheat_usd.edits import operations
from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Level
from icheat_usd.edits.operations.constants import baked_constants
from icheat_usd.errors import EditError, IcheatError
from icheat_usd.session.authoring import read_payload
from icheat_usd.sidecar import list_elements
from icheat_usd.stage.check import Context, baked
from icheat_usd.stage.check.rule import look_at
from icheat_usd.stage.description import EditDescription
from icheat_usd.stage.edit_stack import open_asset
from icheat_usd.stage.keys import Key
from icheat_usd.stage.opening import quiet_usd

#: Elements of a payload that are its sampled form.
_ROWS = "rows"


@dataclass(frozen=True)
class PayloadState:
    """One key of an edit."""

    time: float | None  #: stage time; None holds always
    digest: str  #: "" is the identity
    file: str
    elements: tuple[str, ...] = ()
    stored_bytes: int = 0
    stale: tuple[str, ...] = ()  #: what has changed since it was painted or baked
    notes: tuple[str, ...] = ()  #: what has changed and leaves it usable
    problem: str = ""  #: why it cannot be read
    parameters: Mapping[str, Value] = field(default_factory=dict)


def payload_states(
    stage: Any, edits: list[EditDescription], frame: float | None = None, *, scene: bool = True
) -> dict[str, tuple[PayloadState, ...]]:
    """State of every key, by path of the edit.

    Parameters
    ----------
    scene
        False looks at nothing that needs the scene to be read: whether baked rows are up to date is then not known.
        The scene is read only where a payload depends on it.
    """
    with quiet_usd():
        context = look_at(stage, frame, read_payload)
        return {edit.path: tuple(_states(context, edit, scene)) for edit in edits}


def encoding(edit: EditDescription, states: tuple[PayloadState, ...]) -> str:
    """How the edit is evaluated: vector, rank-1, recipe or rows; from a baked payload where it says so."""
    name = str(edit.operation.value)
    operation = operations.find(name)
    elements = {element for state in states for element in state.elements}
    if operation is None:
        if _ROWS in elements:
            return "baked rows"
        return "baked rank-1" if elements & {"scale-delta", "emission", "offset"} else "unknown"
    if operation.level is Level.VIEW:
        return "vector"
    try:
        complete = operation.complete({key: value.value for key, value in edit.parameters.items()}, edit.path)
    except EditError:
        return "recipe"
    return "rank-1" if baked_constants(operation, complete) else "recipe"


def _states(context: Context, edit: EditDescription, scene: bool) -> Iterator[PayloadState]:
    prim = context.stage.GetPrimAtPath(edit.path)
    for key in edit.keys.keys if edit.keys else ():
        if not key.digest:
            yield PayloadState(key.time, "", "")
            continue
        try:
            source = open_asset(prim, key)
            infos = [info for info in list_elements(source, name=key.anchored) if info.payload == key.digest]
            payload = context.payload(prim, key)
        except IcheatError as error:
            yield PayloadState(key.time, key.digest, key.anchored, problem=str(error))
            continue
        assert payload is not None
        yield PayloadState(
            key.time,
            key.digest,
            key.anchored,
            tuple(dict.fromkeys(info.element for info in infos)),
            sum(info.stored_bytes for info in infos),
            tuple(_stale(context, prim, key, payload, scene)),
            tuple(_notes(context, prim, key, payload, scene)),
            parameters=payload.parameters,
        )


def _stale(context: Context, prim: Any, key: Key, payload: Any, scene: bool) -> Iterator[str]:
    time = context.time if key.time is None else key.time
    for path, how in baked.painted_changes(context.stage, payload, time):
        yield f"painted surface {path} {how}"
    if not baked.is_by_product(payload):
        yield from baked.parameters_changed(prim, key, payload, context.time)
    if scene:
        yield from baked.stale_because(context, prim, key, payload)


def _notes(context: Context, prim: Any, key: Key, payload: Any, scene: bool) -> Iterator[str]:
    if baked.is_by_product(payload):
        for change in baked.parameters_changed(prim, key, payload, context.time):
            yield f"{change}; readers that do not know the operation show that"
    if scene:
        yield from baked.camera_changes(context, prim, key, payload)
