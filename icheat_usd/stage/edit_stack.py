"""Composed USD opinions as an edit stack."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Protocol

from pxr import Ar, Usd

from icheat_usd.edits.model import Blend, Edit, EditStack, KeyedPayload, Payload, Selection, Value
from icheat_usd.errors import EditError, SidecarError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.keys import Key, read_keys, strongest_opinion
from icheat_usd.stage.parameters import (
    authored_parameters,
    fallback_parameters,
    mix_parameters,
    read_flag,
    read_number,
    read_parameters,
)
from icheat_usd.stage.refusals import named_refusals
from icheat_usd.stage.selections import limit_content, with_limits
from icheat_usd.stage.spaces import in_scene_space
from icheat_usd.stage.stacks import EditFinding, listed_edits, stack_prim, targets

_NOTHING = Selection(frozenset())


class PayloadReader(Protocol):
    """Reads one payload; how is up to whoever knows the file format."""

    def __call__(self, file: str, source: str | bytes, digest: str, anchor: str) -> Payload:
        """Return the payload called `digest`.

        Parameters
        ----------
        file
            Identifier for messages.
        source
            Path of the file, or its content where it lies in a package.
        digest
            SHA-256 (hex) that names the payload.
        anchor
            Scene path that surface paths inside the payload are relative to.
        """


@named_refusals
def read_edit_stack(
    stage: Usd.Stage,
    stack_path: str,
    time: float | None,
    surface_paths: Iterable[str],
    read_payload: PayloadReader | None = None,
    *,
    with_muted: bool = False,
) -> tuple[EditStack, tuple[EditFinding, ...]]:
    """Everything the stage says about a stack at one time code.

    Parameters
    ----------
    time
        Time code; None reads at the stage's authored start, else at the earliest time.
    surface_paths
        Scene paths of all surfaces, which the edits' collections select from.
    read_payload
        Called for each payload that takes part at `time`. Muted edits, those of amount 0 and those of a stack that is
        off read none.
    with_muted
        Read muted edits and those of amount 0 like the others, for someone who will turn them on; what cannot be read
        of them is left out as if it were not asked for.

    Returns
    -------
    (EditStack, tuple of EditFinding)
        Each payload's `parameters` are complete: authored opinions over the payload's recipe over fallbacks.
        `Edit.parameters` follows the same order, recipes mixed by the weights of their keys.

    Raises
    ------
    EditError
        The stack does not exist, or an edit's values or keys cannot be used.
    SidecarError
        A payload's file is missing, or `read_payload` refuses it.
    """
    time = schema.default_time(stage, time)
    prim = stack_prim(stage, stack_path)
    prims, findings = listed_edits(prim)
    paths = frozenset(surface_paths)
    enabled = read_flag(prim, schema.STACK_ENABLED, time)
    edits = []
    for edit in prims:
        read, more = _read_edit(edit, time, paths, read_payload, is_used=enabled, with_muted=with_muted)
        edits.append(read)
        findings += more
    stack = EditStack(path=stack_path, edits=tuple(edits), enabled=enabled)
    anchors = {str(edit.GetPath()): anchor_path(edit) for edit in prims}
    return replace(stack, digest=stack_digest(stack, anchors)), tuple(findings)


def _read_edit(
    prim: Usd.Prim,
    time: float | None,
    surface_paths: frozenset[str],
    read_payload: PayloadReader | None,
    *,
    is_used: bool,
    with_muted: bool,
) -> tuple[Edit, list[EditFinding]]:
    """An edit; of one that is not used only its values, unless `with_muted` asks for what can be read."""
    if with_muted:
        try:
            edit, findings = _read_used(prim, time, surface_paths, read_payload, lambda _: True)
            return edit, findings if is_used and edit.is_active else []
        except (EditError, SidecarError):
            if is_used and _read_used(prim, time, surface_paths, None, lambda _: False)[0].is_active:
                raise
    return _read_used(prim, time, surface_paths, read_payload, lambda edit: is_used and edit.is_active)


def _read_used(
    prim: Usd.Prim,
    time: float | None,
    surface_paths: frozenset[str],
    read_payload: PayloadReader | None,
    is_read: Callable[[Edit], bool],
) -> tuple[Edit, list[EditFinding]]:
    path = str(prim.GetPath())
    track = read_keys(prim)
    operation = str(schema.read_attribute(prim, schema.OPERATION, time))
    edit = Edit(
        path=path,
        operation=operation,
        parameters=read_parameters(prim, operation, time),
        receivers=_NOTHING,
        casters=_NOTHING,
        amount=read_number(prim, schema.AMOUNT, time),
        blend=_blend(prim, time),
        enabled=read_flag(prim, schema.ENABLED, time),
        occluders=targets(prim, schema.OCCLUDERS),
    )
    is_used = is_read(edit)
    receivers, casters = (_select(prim, name, surface_paths, is_used) for name in (schema.RECEIVERS, schema.CASTERS))
    edit = replace(edit, receivers=receivers, casters=casters)
    findings = [
        EditFinding(path, name, f"selects no surface, so the edit does nothing; include prims in {name}")
        for name, selection in ((schema.RECEIVERS, edit.receivers), (schema.CASTERS, edit.casters))
        if is_used and not selection.paths
    ]
    if not is_used:
        return edit, findings
    edit, more = with_limits(prim, edit, time, surface_paths)
    if track is not None:
        keys = tuple(_read_key(prim, key, weight, read_payload) for key, weight in track.at(time))
        edit = _with_recipes(prim, replace(edit, keys=keys), time)
    edit, misplaced = in_scene_space(prim, edit, time)
    return edit, [*findings, *more, *misplaced]


def _select(prim: Usd.Prim, name: str, surface_paths: frozenset[str], is_used: bool) -> Selection:
    try:
        return collections.select(prim, name, surface_paths)
    except EditError:
        if is_used:
            raise
        return _NOTHING  # What is muted is never in the way.


def _read_key(prim: Usd.Prim, key: Key, weight: float, read_payload: PayloadReader | None) -> KeyedPayload:
    if not key.digest:
        return KeyedPayload(None, weight)
    if read_payload is None:
        raise EditError(f"{prim.GetPath()}: has a payload in {key.anchored}, and nothing was given to read it with")
    payload = read_payload(key.anchored, open_asset(prim, key), key.digest, anchor_path(prim))
    return KeyedPayload(payload, weight, key.digest, key.anchored)


def open_asset(prim: Usd.Prim, key: Key) -> str | bytes:
    """Path of a key's file, or its content where it lies in a package or behind a resolver.

    Raises
    ------
    SidecarError
        The resolver does not find the file.
    """
    if key.resolved and not Ar.IsPackageRelativePath(key.resolved) and os.path.isfile(key.resolved):
        return key.resolved
    asset = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(key.resolved)) if key.resolved else None
    if not asset:
        raise SidecarError(
            f"{key.anchored}: the sidecar file of {prim.GetPath()} was not found (authored as '{key.file}'); "
            f"restore it or mute the edit"
        )
    return bytes(asset.GetBuffer())


def _with_recipes(prim: Usd.Prim, edit: Edit, time: float | None) -> Edit:
    """Lay authored parameters over each payload's recipe, and the recipes under the edit's own parameters.

    The recipe of another operation, from before the edit was given a new one, says nothing about this one; the
    payload's masks stay.
    """
    operation = edit.operation
    recipes = [key.payload for key in edit.keys if key.payload is not None]
    if recipes and strongest_opinion(prim.GetAttribute(schema.OPERATION)) is None:
        operation = recipes[0].operation
    authored = authored_parameters(prim, operation, time)
    fallbacks = fallback_parameters(operation)
    keys = []
    for key in edit.keys:
        payload = key.payload
        if payload is not None and (payload.operation == operation or operation in schema.operations()):
            recipe = payload.parameters if payload.operation == operation else {}
            complete = MappingProxyType({**fallbacks, **recipe, **authored})
            payload = replace(payload, operation=operation, parameters=complete)
        keys.append(replace(key, payload=payload))
    complete_keys = [(k.payload.parameters, k.weight) for k in keys if k.payload and k.payload.operation == operation]
    mixed = mix_parameters(complete_keys) if complete_keys else {**fallbacks, **authored}
    return replace(edit, operation=operation, keys=tuple(keys), parameters=MappingProxyType(mixed))


def _blend(prim: Usd.Prim, time: float | None) -> Blend:
    token = schema.read_attribute(prim, schema.BLEND, time)
    try:
        return Blend(token)
    except ValueError:
        known = ", ".join(blend.value for blend in Blend)
        raise EditError(f"{prim.GetPath()}: {schema.BLEND} is '{token}', expected one of {known}") from None


def anchor_path(prim: Usd.Prim) -> str:
    """Scene path that surface paths in the edit's payloads are relative to.

    Raises
    ------
    EditError
        The anchor has several targets.
    """
    anchors = targets(prim, schema.ANCHOR)
    if len(anchors) > 1:
        raise EditError(f"{prim.GetPath()}: {schema.ANCHOR} has {len(anchors)} targets, expected one")
    return anchors[0] if anchors else "/"


def stack_digest(stack: EditStack, anchors: Mapping[str, str] = MappingProxyType({})) -> str:
    """SHA-256 (hex) of everything that decides the image; the same in every process.

    Muted edits, edits of amount 0, names of edits and places of files do not decide it.
    """

    def number(value: Value) -> object:
        if isinstance(value, tuple):
            return [float(v).hex() for v in value]
        return float(value).hex() if isinstance(value, (int, float)) and not isinstance(value, bool) else value

    def side(selection: Selection) -> object:
        return [sorted(selection.paths), [limit_content(limit) for limit in selection.limits]]

    edits = [
        {
            "operation": edit.operation,
            "parameters": {name: number(value) for name, value in edit.parameters.items()},
            "receivers": side(edit.receivers),
            "casters": side(edit.casters),
            "amount": number(edit.amount),
            "blend": edit.blend.value,
            "keys": [[key.digest, number(key.weight), _recipe(key, number)] for key in edit.keys],
            "anchor": anchors.get(edit.path, "") if any(key.digest for key in edit.keys) else "",
            "occluders": sorted(edit.occluders),
            "lights": sorted(edit.lights),
            "target": None if edit.target is None else number(edit.target),
        }
        for edit in stack.active
    ]
    text = json.dumps(edits, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _recipe(key: KeyedPayload, number: object) -> dict[str, object]:
    assert callable(number)
    return {name: number(value) for name, value in key.payload.parameters.items()} if key.payload else {}
