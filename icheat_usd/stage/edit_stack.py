"""Composed USD opinions as an edit stack, and where they come from."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from types import MappingProxyType
from typing import Protocol

from pxr import Ar, Sdf, Usd

from icheat_usd.edits.model import Blend, Edit, EditStack, KeyedPayload, Payload, Selection, Value
from icheat_usd.errors import EditError, SidecarError
from icheat_usd.scene import Finding
from icheat_usd.stage import collections, schema
from icheat_usd.stage.keys import Key, KeyTrack, read_keys, strongest_opinion


class Severity(StrEnum):
    """How bad a finding is."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True)
class EditFinding(Finding):
    """Something about an edit or a stack that its author should know."""

    severity: Severity = Severity.WARNING
    rule: str = ""  #: class in `icheat_usd.stage.check` that found it, "" where reading did


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


# --------------------------------------------------------------------------- which stack


def stack_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Every active stack on the stage, in order of traversal, those in instances by their proxies."""
    everything = Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
    return [prim for prim in everything if schema.has_schema(prim, schema.STACK_API)]


def find_stack(stage: Usd.Stage, stack: str | None = None, camera: str | None = None) -> str | None:
    """Path of the stack to use: the named one, else that of the render settings, else the camera's only one.

    Parameters
    ----------
    stack
        Path of the stack, absolute or relative to the default prim; or the name of a stack, if only one has it.
    camera
        Path of the camera that is rendered; anything that is no path counts as no camera. A stack that names no
        camera is for any camera, after those that do.

    Returns
    -------
    str or None
        None if the stage has no stack at all.

    Raises
    ------
    EditError
        The named stack does not exist, or several could be meant.
    """
    if stack is not None:
        return _named_stack(stage, stack)
    settings = stage.GetMetadata("renderSettingsPrimPath")
    if settings and schema.has_schema(stage.GetPrimAtPath(settings), schema.STACK_API):
        return str(settings)
    targets = {str(prim.GetPath()): _targets(prim, schema.CAMERA) for prim in stack_prims(stage)}
    if not targets:
        return None
    if camera is not None and not camera.startswith("/"):
        camera = None
    candidates = [path for path, cameras in targets.items() if camera is not None and camera in cameras]
    candidates = candidates or [path for path, cameras in targets.items() if camera is None or not cameras]
    if len(candidates) == 1:
        return candidates[0]
    whose = f" for camera {camera}" if camera is not None else ""
    raise EditError(
        f"{stage.GetRootLayer().identifier}: {len(candidates) or 'none'} of the stacks {', '.join(targets)} can be "
        f"meant{whose}; name one with --stack"
    )


def _named_stack(stage: Usd.Stage, stack: str) -> str:
    if Sdf.Path.IsValidPathString(stack):
        default = stage.GetDefaultPrim()
        path = Sdf.Path(stack).MakeAbsolutePath(default.GetPath() if default else Sdf.Path.absoluteRootPath)
        if schema.has_schema(stage.GetPrimAtPath(path), schema.STACK_API):
            return str(path)
    paths = [str(prim.GetPath()) for prim in stack_prims(stage)]
    found = [path for path in paths if path.rpartition("/")[2] == stack]
    if len(found) != 1:
        known = f"it has {', '.join(paths)}" if paths else "make one with `icheat stack create`"
        raise EditError(f"{stage.GetRootLayer().identifier}: no stack '{stack}'; {known}")
    return found[0]


def _targets(prim: Usd.Prim, relationship: str) -> tuple[str, ...]:
    rel = prim.GetRelationship(relationship)
    return tuple(str(path) for path in rel.GetTargets()) if rel else ()


def stack_prim(stage: Usd.Stage, path: str) -> Usd.Prim:
    """The prim of a stack.

    Raises
    ------
    EditError
        There is no stack at `path`.
    """
    prim = stage.GetPrimAtPath(path)
    if not schema.has_schema(prim, schema.STACK_API):
        known = ", ".join(str(p.GetPath()) for p in stack_prims(stage)) or "none"
        raise EditError(f"{stage.GetRootLayer().identifier}: {path} is no stack; the stage's stacks: {known}")
    return prim


def edit_prim(stage: Usd.Stage, path: str) -> Usd.Prim:
    """The prim of an edit.

    Raises
    ------
    EditError
        There is no edit at `path`.
    """
    prim = stage.GetPrimAtPath(path)
    if not schema.has_schema(prim, schema.EDIT_API):
        listed = [target for stack in stack_prims(stage) for target in _targets(stack, schema.EDITS)]
        raise EditError(
            f"{stage.GetRootLayer().identifier}: {path} is no edit; the stage's edits: {', '.join(listed) or 'none'}"
        )
    return prim


def listed_edits(stack: Usd.Prim) -> tuple[list[Usd.Prim], list[EditFinding]]:
    """The edits that a stack applies, weakest first, and what is wrong with its other targets."""
    prims, findings, seen = [], [], set()
    path = str(stack.GetPath())
    for target in _targets(stack, schema.EDITS):
        prim = stack.GetStage().GetPrimAtPath(target)
        if not prim:
            findings.append(EditFinding(path, schema.EDITS, f"{target} does not exist; remove it from the stack"))
        elif not prim.IsActive() or target in seen:
            continue
        elif not schema.has_schema(prim, schema.EDIT_API):
            message = f"{target} has no {schema.EDIT_API}; apply it or remove the target from the stack"
            findings.append(EditFinding(path, schema.EDITS, message))
        else:
            prims.append(prim)
        seen.add(target)
    return prims, findings


# --------------------------------------------------------------------------- reading


def read_edit_stack(
    stage: Usd.Stage,
    stack_path: str,
    time: float | None,
    surface_paths: Iterable[str],
    read_payload: PayloadReader | None = None,
) -> tuple[EditStack, tuple[EditFinding, ...]]:
    """Everything the stage says about a stack at one time code.

    Parameters
    ----------
    time
        Time code; None reads at the stage's authored start, else at the earliest time.
    surface_paths
        Scene paths of all surfaces, which the edits' collections select from.
    read_payload
        Called for each payload that takes part at `time`. Muted edits and those of amount 0 read none.

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
    edits = []
    for edit in prims:
        read, more = _read_edit(edit, time, paths, read_payload)
        edits.append(read)
        findings += more
    enabled = bool(schema.read_attribute(prim, schema.STACK_ENABLED, time))
    stack = EditStack(path=stack_path, edits=tuple(edits), enabled=enabled)
    anchors = {str(edit.GetPath()): anchor_path(edit) for edit in prims}
    return replace(stack, digest=stack_digest(stack, anchors)), tuple(findings)


def _read_edit(
    prim: Usd.Prim, time: float | None, surface_paths: frozenset[str], read_payload: PayloadReader | None
) -> tuple[Edit, list[EditFinding]]:
    path = str(prim.GetPath())
    track = read_keys(prim)
    operation = str(schema.read_attribute(prim, schema.OPERATION, time))
    edit = Edit(
        path=path,
        operation=operation,
        parameters=read_parameters(prim, operation, time),
        receivers=collections.select(prim, schema.RECEIVERS, surface_paths),
        casters=collections.select(prim, schema.CASTERS, surface_paths),
        amount=_finite(prim, schema.AMOUNT, time),
        blend=_blend(prim, time),
        enabled=bool(schema.read_attribute(prim, schema.ENABLED, time)),
        occluders=_targets(prim, schema.OCCLUDERS),
    )
    findings = [
        EditFinding(path, name, f"selects no surface, so the edit does nothing; include prims in {name}")
        for name, selection in ((schema.RECEIVERS, edit.receivers), (schema.CASTERS, edit.casters))
        if edit.is_active and not selection.paths
    ]
    if track is None or not edit.is_active:
        return edit, findings
    keys = tuple(_read_key(prim, key, weight, read_payload) for key, weight in track.at(time))
    return _with_recipes(prim, replace(edit, keys=keys), time), findings


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
    """Lay authored parameters over each payload's recipe, and the recipes under the edit's own parameters."""
    operation = edit.operation
    recipes = [key.payload for key in edit.keys if key.payload is not None]
    if recipes and strongest_opinion(prim.GetAttribute(schema.OPERATION)) is None:
        operation = recipes[0].operation
    authored = authored_parameters(prim, operation, time)
    fallbacks = _fallback_parameters(operation)
    keys = []
    for key in edit.keys:
        payload = key.payload
        if payload is not None and payload.operation == operation:
            complete = {**fallbacks, **payload.parameters, **authored}
            payload = replace(payload, parameters=MappingProxyType(complete))
        keys.append(replace(key, payload=payload))
    complete_keys = [(k.payload.parameters, k.weight) for k in keys if k.payload and k.payload.operation == operation]
    mixed = _mix(complete_keys) if complete_keys else {**fallbacks, **authored}
    return replace(edit, operation=operation, keys=tuple(keys), parameters=MappingProxyType(mixed))


def _mix(recipes: list[tuple[Mapping[str, Value], float]]) -> dict[str, Value]:
    """Weighted mean of numbers and vectors; of anything else what the heaviest recipe says."""
    heaviest = max(recipes, key=lambda recipe: recipe[1])[0]
    total = sum(weight for _, weight in recipes)
    mixed: dict[str, Value] = {}
    for name, value in heaviest.items():
        values = [(recipe.get(name, value), weight / total) for recipe, weight in recipes]
        if isinstance(value, (bool, str)) or all(v == value for v, _ in values):
            mixed[name] = value
        elif isinstance(value, tuple):
            mixed[name] = tuple(sum(w * v[i] for v, w in values if isinstance(v, tuple)) for i in range(len(value)))
        else:
            mixed[name] = sum(w * float(v) for v, w in values if isinstance(v, (int, float)))
    return mixed


def read_parameters(prim: Usd.Prim, operation: str, time: float | None) -> Mapping[str, Value]:
    """Parameters of an operation: authored opinions over schema fallbacks."""
    complete = {**_fallback_parameters(operation), **authored_parameters(prim, operation, time)}
    return MappingProxyType(complete)


def authored_parameters(prim: Usd.Prim, operation: str, time: float | None) -> dict[str, Value]:
    """What the stage itself says about the parameters of an operation, known or not.

    Raises
    ------
    EditError
        A value is not finite.
    """
    prefix = f"icheat:{operation}"
    known = schema.operations().get(operation)
    found: dict[str, Value] = {}
    for attribute in prim.GetAuthoredPropertiesInNamespace(prefix):
        if not isinstance(attribute, Usd.Attribute) or not attribute.HasAuthoredValue():
            continue
        if known is not None and attribute.GetName()[len(prefix) + 1 :] not in known.parameters:
            continue  # Mistyped: means nothing, as anywhere in USD; `check` reports it.
        value = attribute.Get(schema.time_code(time))
        converted = None if value is None else schema.to_value(value)
        if converted is not None:
            _require_finite(prim, attribute.GetName(), converted)
            found[attribute.GetName()[len(prefix) + 1 :]] = converted
    return found


def _fallback_parameters(operation: str) -> dict[str, Value]:
    known = schema.operations().get(operation)
    if known is None:
        return {}
    values = {name: schema.to_value(parameter.fallback) for name, parameter in known.parameters.items()}
    return {name: value for name, value in values.items() if value is not None}


def _finite(prim: Usd.Prim, name: str, time: float | None) -> float:
    value = schema.read_attribute(prim, name, time)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise EditError(f"{prim.GetPath()}: {name} is {value!r}, expected a number")
    _require_finite(prim, name, float(value))
    return float(value)


def _require_finite(prim: Usd.Prim, name: str, value: Value) -> None:
    numbers = value if isinstance(value, tuple) else (value,)
    if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
        raise EditError(f"{prim.GetPath()}: {name} is {value!r}, expected a finite number; author it again")


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
    targets = _targets(prim, schema.ANCHOR)
    if len(targets) > 1:
        raise EditError(f"{prim.GetPath()}: {schema.ANCHOR} has {len(targets)} targets, expected one")
    return targets[0] if targets else "/"


def stack_digest(stack: EditStack, anchors: Mapping[str, str] = MappingProxyType({})) -> str:
    """SHA-256 (hex) of everything that decides the image; the same in every process.

    Muted edits, edits of amount 0, names of edits and places of files do not decide it.
    """

    def number(value: Value) -> object:
        if isinstance(value, tuple):
            return [float(v).hex() for v in value]
        return float(value).hex() if isinstance(value, (int, float)) and not isinstance(value, bool) else value

    def surfaces(selection: Selection) -> list[str]:
        return sorted(selection.paths)

    edits = [
        {
            "operation": edit.operation,
            "parameters": {name: number(value) for name, value in edit.parameters.items()},
            "receivers": surfaces(edit.receivers),
            "casters": surfaces(edit.casters),
            "amount": number(edit.amount),
            "blend": edit.blend.value,
            "keys": [[key.digest, number(key.weight), _recipe(key, number)] for key in edit.keys],
            "anchor": anchors.get(edit.path, "") if edit.keys else "",
            "occluders": sorted(edit.occluders),
        }
        for edit in stack.active
    ]
    text = json.dumps(edits, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _recipe(key: KeyedPayload, number: object) -> dict[str, object]:
    assert callable(number)
    return {name: number(value) for name, value in key.payload.parameters.items()} if key.payload else {}


# --------------------------------------------------------------------------- provenance


@dataclass(frozen=True)
class Described:
    """A value and the layer whose opinion it is; "" for a fallback."""

    value: Value
    layer: str


@dataclass(frozen=True)
class EditDescription:
    """What an edit says at a time, and which layer says so. Needs no payload to be readable."""

    path: str
    is_active: bool  #: the prim's `active`
    operation: Described
    amount: Described
    blend: Described
    enabled: Described
    parameters: Mapping[str, Described]
    receivers: tuple[str, ...]
    receivers_excluded: tuple[str, ...]
    receivers_expression: str
    casters: tuple[str, ...]
    casters_excluded: tuple[str, ...]
    casters_expression: str
    occluders: tuple[str, ...]
    anchor: str
    key_times: tuple[float, ...]
    keys: KeyTrack | None
    file: str  #: of the key that weighs most
    payload_digest: str
    layers: tuple[str, ...]  #: identifiers of all layers with an opinion on the prim, strongest first
    problem: str = ""  #: why keys cannot be read


def describe_edit(stage: Usd.Stage, path: str, time: float | None = None) -> EditDescription:
    """Describe an edit, also an inactive one.

    Raises
    ------
    EditError
        There is no edit at `path`.
    """
    time = schema.default_time(stage, time)
    prim = stage.GetPrimAtPath(path)
    if not prim or (prim.IsActive() and not schema.has_schema(prim, schema.EDIT_API)):
        prim = edit_prim(stage, path)
    operation = _described(prim, schema.OPERATION, time)
    known = schema.operations().get(str(operation.value))
    names = {name: parameter.name for name, parameter in known.parameters.items()} if known else {}
    for name in authored_parameters(prim, str(operation.value), time):
        names.setdefault(name, f"icheat:{operation.value}:{name}")
    problem, track = "", None
    try:
        track = read_keys(prim)
    except EditError as error:
        problem = str(error)
    key = max(track.at(time), key=lambda pair: pair[1])[0] if track else None
    receivers, receivers_excluded, receivers_expression = collections.authored(prim, schema.RECEIVERS)
    casters, casters_excluded, casters_expression = collections.authored(prim, schema.CASTERS)
    return EditDescription(
        path=str(prim.GetPath()),
        is_active=prim.IsActive(),
        operation=operation,
        amount=_described(prim, schema.AMOUNT, time),
        blend=_described(prim, schema.BLEND, time),
        enabled=_described(prim, schema.ENABLED, time),
        parameters=MappingProxyType({name: _described(prim, full, time) for name, full in names.items()}),
        receivers=receivers,
        receivers_excluded=receivers_excluded,
        receivers_expression=receivers_expression,
        casters=casters,
        casters_excluded=casters_excluded,
        casters_expression=casters_expression,
        occluders=_targets(prim, schema.OCCLUDERS),
        anchor=(_targets(prim, schema.ANCHOR) or ("",))[0],
        key_times=track.times if track else (),
        keys=track,
        file=key.anchored if key else "",
        payload_digest=key.digest if key else "",
        layers=tuple(dict.fromkeys(spec.layer.identifier for spec in prim.GetPrimStack())),
        problem=problem,
    )


def _described(prim: Usd.Prim, name: str, time: float | None) -> Described:
    opinion = strongest_opinion(prim.GetAttribute(name), time)
    value = schema.read_attribute(prim, name, time)
    if value is None:
        registered = schema.operations()
        value = next((p.fallback for o in registered.values() for p in o.parameters.values() if p.name == name), None)
    converted = schema.to_value(value) if value is not None else None
    if isinstance(value, bool):
        converted = value
    layer = opinion.layer.identifier if opinion and not opinion.is_blocked else ""
    return Described("" if converted is None else converted, layer)
