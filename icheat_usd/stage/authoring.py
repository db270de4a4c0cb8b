"""Writing edits into one layer of a stage, so that other layers keep theirs.

Every function names the layer it writes to: identifier, path or file name of
a layer in the stage's own layer stack, the layer itself, or ``"session"``.
Nothing is saved; `save_layer` does that.

List-edited relationships are appended to: a prepended edit would land before
those of weaker layers, and an explicit list would cut them off.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pxr import Ar, Sdf, Tf, Usd

from icheat_usd.edits import operations
from icheat_usd.edits.model import Blend, Value
from icheat_usd.errors import EditError, StageError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.edit_stack import EditFinding, edit_prim, stack_prim
from icheat_usd.stage.keys import SAME_TIME, Key, KeyTrack, read_keys, strongest_opinion

#: customData of icheat:payload in a layer that copied another layer's keys: where they came from.
COPIED_FROM = "icheatCopiedFrom"

#: Layers whose file is larger than this are not compared with it before the first edit.
_MAX_COMPARED_BYTES = 8 << 20
_seen_on_disk: dict[str, str] = {}


@dataclass(frozen=True)
class Members:
    """What a collection includes and excludes: paths of prims or collections, absolute or below the default prim."""

    includes: tuple[str, ...] = ()
    excludes: tuple[str, ...] = ()


# --------------------------------------------------------------------------- layers


def find_layer(stage: Usd.Stage, layer: str | Sdf.Layer) -> Sdf.Layer:
    """The layer to write to, checked to be one that this stage can write to.

    Raises
    ------
    EditError
        It is not in the stage's own layer stack, several match, it may not be edited, or its file changed on disk
        since it was read.
    """
    layers = stage.GetLayerStack(includeSessionLayers=True)
    if isinstance(layer, Sdf.Layer):
        matches = [candidate for candidate in layers if candidate == layer]
    elif layer == "session":
        matches = [stage.GetSessionLayer()] if stage.GetSessionLayer() else []
    else:
        exact = {layer, os.path.realpath(layer)}
        matches = [candidate for candidate in layers if {candidate.identifier, candidate.realPath} & exact]
        matches = matches or [candidate for candidate in layers if _file_name(candidate) == layer]
    name = layer.identifier if isinstance(layer, Sdf.Layer) else layer
    if len(matches) != 1:
        known = ", ".join(candidate.identifier for candidate in layers)
        count = "is not" if not matches else f"matches {len(matches)} layers"
        raise EditError(
            f"layer '{name}' {count} in the layer stack of {stage.GetRootLayer().identifier}, which has {known}; "
            f"name one of them or 'session'"
        )
    if not matches[0].permissionToEdit:
        raise EditError(f"layer '{matches[0].identifier}' may not be edited; name another layer")
    remember_layer(matches[0])
    return matches[0]


def _file_name(layer: Sdf.Layer) -> str:
    return os.path.basename(layer.realPath or layer.identifier)


def remember_layer(layer: Sdf.Layer) -> None:
    """Note what a layer's file looks like now, so that `save_layer` can tell whether someone else wrote it.

    Call it when a stage has just been opened; the functions here call it before they first write to a layer.

    Raises
    ------
    EditError
        The layer has no unsaved changes, and its file says something else than it does.
    """
    on_disk = _on_disk(layer)
    if not on_disk or (layer.dirty and layer.identifier in _seen_on_disk):
        return
    if not layer.dirty and _seen_on_disk.get(layer.identifier) != on_disk and not _says_what_its_file_says(layer):
        raise _changed(layer)
    _seen_on_disk[layer.identifier] = on_disk


def _on_disk(layer: Sdf.Layer) -> str:
    try:
        state = os.stat(layer.realPath)
    except OSError:
        return ""
    return f"{state.st_ino}:{state.st_size}:{state.st_mtime_ns}"


def _says_what_its_file_says(layer: Sdf.Layer) -> bool:
    if os.path.getsize(layer.realPath) > _MAX_COMPARED_BYTES:
        return True
    fresh = Sdf.Layer.OpenAsAnonymous(layer.realPath)
    return bool(fresh) and fresh.ExportToString() == layer.ExportToString()


def _changed(layer: Sdf.Layer) -> EditError:
    return EditError(
        f"{layer.realPath} changed on disk since it was read, so saving would lose that change; reload it first"
    )


def save_layer(layer: Sdf.Layer) -> None:
    """Save a layer, unless someone else wrote its file since it was read.

    Raises
    ------
    EditError
        The layer has no file, its file changed on disk, or may not be written.
    """
    if layer.anonymous:
        raise EditError(f"layer '{layer.identifier}' has no file; export it or author in a layer that has one")
    known = _seen_on_disk.get(layer.identifier)
    if known is not None and _on_disk(layer) not in ("", known):
        raise _changed(layer)
    try:
        saved = layer.Save()
    except Tf.ErrorException as error:
        raise EditError(f"{layer.realPath} cannot be saved ({_first_line(error)}); check its permissions") from error
    if not saved:
        raise EditError(f"{layer.realPath} cannot be saved; check its permissions")
    _seen_on_disk[layer.identifier] = _on_disk(layer)


def _first_line(error: Tf.ErrorException) -> str:
    line = next((line.strip() for line in str(error).splitlines() if line.strip()), "unknown reason")
    return line.partition(" : ")[2].strip("'") or line


@contextmanager
def writing(stage: Usd.Stage, layer: str | Sdf.Layer, path: str | Sdf.Path) -> Iterator[Sdf.Layer]:
    """Write opinions at or below `path` to a layer, times mapped into it.

    USD's refusals become errors; after any error the layer says what it said before.
    """
    schema.require_registered()
    target = find_layer(stage, layer)
    path = Sdf.Path(path)
    before = Sdf.Layer.CreateAnonymous()
    existed = bool(target.GetPrimAtPath(path))
    if existed:
        Sdf.CreatePrimInLayer(before, path)
        Sdf.CopySpec(target, path, before, path)
    first_new = next((prefix for prefix in path.GetPrefixes() if not target.GetPrimAtPath(prefix)), path)
    try:
        with Usd.EditContext(stage, stage.GetEditTargetForLocalLayer(target)):
            yield target
    except BaseException as error:
        if existed:
            Sdf.CopySpec(before, path, target, path)
        elif target.GetPrimAtPath(first_new):
            siblings = target.GetPrimAtPath(first_new.GetParentPath()).nameChildren
            del siblings[first_new.name]
        if isinstance(error, Tf.ErrorException):
            raise EditError(f"{target.identifier}: USD refused the edit ({_first_line(error)})") from error
        raise


# --------------------------------------------------------------------------- stacks


def create_stack(stage: Usd.Stage, path: str, *, layer: str | Sdf.Layer, camera: str | None = None) -> str:
    """Make a prim a stack of edits.

    Parameters
    ----------
    path
        Where: absolute or below the default prim. A new prim is a `Scope`; an existing `Scope`, `RenderSettings`
        or `RenderPass` is used as it is. Ancestors below the default prim that do not exist become scopes.
    layer
        Layer to write to.
    camera
        The camera the stack is for.

    Returns
    -------
    str
        Path of the stack.

    Raises
    ------
    EditError
        The place is outside the default prim or inside an instance, is a stack already, or has another type.
    """
    default = stage.GetDefaultPrim()
    if not default:
        raise EditError(
            f"{stage.GetRootLayer().identifier} has no default prim, so that references would lose the stack; "
            f"set defaultPrim first"
        )
    if not Sdf.Path.IsValidPathString(path):
        raise EditError(f"'{path}' is not a prim path; give one such as {default.GetPath()}/indirect")
    stack_path = Sdf.Path(path).MakeAbsolutePath(default.GetPath())
    if not stack_path.IsPrimPath() or not stack_path.HasPrefix(default.GetPath()) or stack_path == default.GetPath():
        raise EditError(
            f"a stack at {path} is lost when {stage.GetRootLayer().identifier} is referenced; place it below the "
            f"default prim, such as {default.GetPath()}/indirect"
        )
    _refuse_instances(stage, stack_path)
    existing = stage.GetPrimAtPath(stack_path)
    if schema.has_schema(existing, schema.STACK_API):
        raise EditError(f"{stack_path} is a stack already; add edits to it or choose another path")
    cameras = collections.find_prims(stage, [camera], "camera") if camera is not None else ()
    with writing(stage, layer, stack_path):
        for ancestor in stack_path.GetPrefixes()[:-1]:
            if not stage.GetPrimAtPath(ancestor) or not stage.GetPrimAtPath(ancestor).IsDefined():
                stage.DefinePrim(ancestor, "Scope")
        prim = existing if existing and existing.IsDefined() else stage.DefinePrim(stack_path, "Scope")
        _apply(prim, schema.STACK_API)
        for target in cameras:
            _relationship(prim, schema.CAMERA).SetTargets([target])
    return str(stack_path)


def add_edit(
    stage: Usd.Stage,
    stack: str,
    name: str,
    *,
    layer: str | Sdf.Layer,
    operation: str = "scale",
    parameters: Mapping[str, Value] | None = None,
    receivers: Members | Sequence[str] = (),
    casters: Members | Sequence[str] = (),
    amount: float = 1.0,
    blend: Blend | str = Blend.COMPOSE,
    anchor: str | None = None,
    occluders: Sequence[str] = (),
    payload: tuple[str | Path, str] | None = None,
    time: float | None = None,
    before: str | None = None,
    after: str | None = None,
) -> str:
    """Add an edit to a stack, after those it has unless `before` or `after` says otherwise.

    Parameters
    ----------
    name
        Name of the new prim below the stack.
    operation, parameters
        What the edit does; without a payload the operation must be a known one.
    receivers, casters
        Paths to include, or `Members` with exclusions. A path that the stage lacks is an error.
    anchor
        Prim that surface paths inside payloads are relative to; the stage's default prim if not given.
    payload
        (file, digest) of painted or baked data; written relative to the layer's own file.
    time
        Stage time of the values and of the payload's key; None authors defaults.

    Returns
    -------
    str
        Path of the edit.

    Raises
    ------
    EditError
        Something named does not exist or does not fit; the layer is then as before.
    """
    prim = stack_prim(stage, stack)
    if not Sdf.Path.IsValidIdentifier(name):
        raise EditError(f"'{name}' cannot name an edit; use letters, digits and underscores")
    path = prim.GetPath().AppendChild(name)
    if stage.GetPrimAtPath(path):
        raise EditError(f"{path} exists already; choose another name or set its values")
    _refuse_instances(stage, path)
    with writing(stage, layer, prim.GetPath()) as target:
        edit = stage.DefinePrim(path, "Scope")
        _apply(edit, schema.EDIT_API)
        _set_operation(edit, operation, parameters or {}, time, has_payload=payload is not None)
        if amount != schema.fallback(schema.AMOUNT):
            _set_amount(edit, amount, time)
        if _checked_blend(blend) != schema.fallback(schema.BLEND):
            _set(edit, schema.BLEND, _checked_blend(blend))
        for collection, members in ((schema.RECEIVERS, receivers), (schema.CASTERS, casters)):
            # Always authored, so that a host without our schemas selects the same.
            Usd.CollectionAPI(edit, collection).CreateIncludeRootAttr().Set(False)
            Usd.CollectionAPI(edit, collection).CreateExpansionRuleAttr().Set(Usd.Tokens.expandPrims)
            _set_members(edit, collection, members)
        for occluder in collections.find_prims(stage, occluders, f"{path} occluders"):
            _append(_relationship(edit, schema.OCCLUDERS), occluder)
        anchors = (
            collections.find_prims(stage, [anchor], f"{path} anchor")
            if anchor is not None
            else tuple(p.GetPath() for p in [stage.GetDefaultPrim()] if p)
        )
        if anchors:
            _relationship(edit, schema.ANCHOR).SetTargets([*anchors])
        if payload is not None:
            _write_key(edit, target, time, _asset_path(target, os.fspath(payload[0])), payload[1])
        _append(_relationship(prim, schema.EDITS), path)
        if before is not None or after is not None:
            _move(prim, path, target, before=before, after=after)
    return str(path)


def move_edit(
    stage: Usd.Stage,
    stack: str,
    edit: str,
    *,
    layer: str | Sdf.Layer,
    before: str | None = None,
    after: str | None = None,
) -> None:
    """Move an edit before or after another one; to the end, the strongest place, if neither is given.

    The layer re-appends the moved edit and those that follow it. An edit that
    a weaker layer adds later therefore still takes part, before these.

    Raises
    ------
    EditError
        An edit is not in the stack, or a stronger layer decides the order.
    """
    prim = stack_prim(stage, stack)
    with writing(stage, layer, prim.GetPath()) as target:
        _move(prim, _listed(prim, edit), target, before=before, after=after)


def remove_edit(stage: Usd.Stage, stack: str, edit: str, *, layer: str | Sdf.Layer) -> None:
    """Take an edit out of a stack, and drop what the layer says about it.

    What weaker layers say about the edit stays; they are not written to.

    Raises
    ------
    EditError
        The edit is not in the stack, or a stronger layer lists it.
    """
    prim = stack_prim(stage, stack)
    path = _listed(prim, edit)
    with writing(stage, layer, prim.GetPath()) as target:
        relationship = _relationship(prim, schema.EDITS)
        relationship.RemoveTarget(path)
        if path in relationship.GetTargets():
            stronger = [
                spec.layer.identifier
                for spec in relationship.GetPropertyStack()
                if spec.layer != target and path in spec.targetPathList.GetAddedOrExplicitItems()
            ]
            raise EditError(f"{path} is listed by {', '.join(stronger)}, which is stronger; remove it there")
        items = target.GetRelationshipAtPath(relationship.GetPath()).targetPathList
        if not items.isExplicit:
            items.deletedItems.remove(path)
            if path in relationship.GetTargets():  # A weaker layer lists it, so that the deletion is needed.
                items.deletedItems.append(path)
        if target.GetPrimAtPath(path):
            stage.RemovePrim(path)


def _listed(stack: Usd.Prim, edit: str) -> Sdf.Path:
    targets = _relationship(stack, schema.EDITS).GetTargets()
    found = [path for path in targets if str(path) == edit] or [path for path in targets if path.name == edit]
    if len(found) != 1:
        known = ", ".join(str(path) for path in targets) or "no edits"
        raise EditError(f"{stack.GetPath()} has no edit '{edit}'; it has {known}")
    return found[0]


def _move(stack: Usd.Prim, path: Sdf.Path, layer: Sdf.Layer, *, before: str | None, after: str | None) -> None:
    if before is not None and after is not None:
        raise EditError(f"{path}: moving needs one of before and after, not both")
    relationship = _relationship(stack, schema.EDITS)
    composed = relationship.GetTargets()
    wanted = [other for other in composed if other != path]
    if before is not None or after is not None:
        other = _listed(stack, before if before is not None else str(after))
        if other == path:
            return
        index = wanted.index(other) + (after is not None)
    else:
        index = len(wanted)
    wanted.insert(index, path)
    if wanted == composed:
        return
    first = next(i for i, (a, b) in enumerate(zip(wanted, composed, strict=True)) if a != b)
    spec = layer.GetRelationshipAtPath(relationship.GetPath())
    if spec is None:
        _append(relationship, path)
        spec = layer.GetRelationshipAtPath(relationship.GetPath())
    items = spec.targetPathList
    if items.isExplicit:
        own = list(items.explicitItems)
        items.explicitItems = [p for p in wanted if p in own]
    else:
        tail = wanted[first:]
        items.prependedItems = [p for p in items.prependedItems if p not in tail]
        items.deletedItems = [p for p in items.deletedItems if p not in tail]
        items.appendedItems = [p for p in items.appendedItems if p not in tail] + tail
    if list(relationship.GetTargets()) != wanted:
        raise EditError(f"{stack.GetPath()}: a layer stronger than {layer.identifier} decides the order; move it there")


# --------------------------------------------------------------------------- values


def set_edit(
    stage: Usd.Stage,
    edit: str,
    *,
    layer: str | Sdf.Layer,
    operation: str | None = None,
    parameters: Mapping[str, Value] | None = None,
    amount: float | None = None,
    blend: Blend | str | None = None,
    enabled: bool | None = None,
    receivers: Members | Sequence[str] | None = None,
    casters: Members | Sequence[str] | None = None,
    time: float | None = None,
) -> tuple[EditFinding, ...]:
    """Author values of an edit; what is None stays as it is.

    A selection is authored as the difference from the composed one, so that
    later additions of weaker layers still join it.

    Returns
    -------
    tuple of EditFinding
        Values that were authored and have no effect, because a stronger layer decides them.

    Raises
    ------
    EditError
        Something named does not exist or does not fit; the layer is then as before.
    """
    prim = _writable_edit(stage, edit)
    written: list[str] = []
    selections: list[EditFinding] = []
    with writing(stage, layer, prim.GetPath()) as target:
        if operation is not None or parameters:
            token = operation or str(schema.read_attribute(prim, schema.OPERATION, time))
            has_payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD)) is not None
            written += _set_operation(
                prim, token, parameters or {}, time, has_payload=has_payload, write_token=operation is not None
            )
        if amount is not None:
            _set_amount(prim, amount, time)
            written.append(schema.AMOUNT)
        if blend is not None:
            _set(prim, schema.BLEND, _checked_blend(blend))
            written.append(schema.BLEND)
        if enabled is not None:
            _set(prim, schema.ENABLED, bool(enabled))
            written.append(schema.ENABLED)
        for collection, members in ((schema.RECEIVERS, receivers), (schema.CASTERS, casters)):
            if members is not None and not _set_members(prim, collection, members):
                message = f"authored in {target.identifier}, but a stronger layer changes the selection"
                selections.append(EditFinding(str(prim.GetPath()), collection, message))
    return (*_overridden(prim, target, written, time), *selections)


def mute_edit(stage: Usd.Stage, edit: str, *, layer: str | Sdf.Layer, muted: bool = True) -> tuple[EditFinding, ...]:
    """Mute or unmute an edit; see `set_edit`."""
    return set_edit(stage, edit, layer=layer, enabled=not muted)


def _overridden(prim: Usd.Prim, layer: Sdf.Layer, names: Iterable[str], time: float | None) -> tuple[EditFinding, ...]:
    findings = []
    for name in names:
        opinion = strongest_opinion(prim.GetAttribute(name), time)
        if opinion is not None and opinion.layer != layer:
            message = f"authored in {layer.identifier}, but {opinion.layer.identifier} is stronger and decides"
            findings.append(EditFinding(str(prim.GetPath()), name, message))
        elif opinion is not None and opinion.source != "default" and time is None:
            message = f"authored without a time in {layer.identifier}, where time samples or a spline decide"
            findings.append(EditFinding(str(prim.GetPath()), name, message))
    return tuple(findings)


def _writable_edit(stage: Usd.Stage, edit: str) -> Usd.Prim:
    prim = edit_prim(stage, edit)
    _refuse_instances(stage, prim.GetPath())
    return prim


def _refuse_instances(stage: Usd.Stage, path: Sdf.Path) -> None:
    for ancestor in path.GetPrefixes():
        prim = stage.GetPrimAtPath(ancestor)
        if prim and (prim.IsInstance() or prim.IsInstanceProxy() or prim.IsInPrototype()):
            raise EditError(f"{path} lies in the instance {ancestor}, whose contents are shared; place it outside")


def _apply(prim: Usd.Prim, name: str) -> None:
    allowed = prim.CanApplyAPI(name)
    if not allowed:
        raise EditError(f"{prim.GetPath()} ({prim.GetTypeName() or 'untyped'}) cannot take {name}: {allowed.whyNot}")
    if not schema.has_schema(prim, name):
        prim.ApplyAPI(name)


def _relationship(prim: Usd.Prim, name: str) -> Usd.Relationship:
    # Built-in: creating it says nothing that the schema does not.
    return prim.GetRelationship(name) or prim.CreateRelationship(name, custom=False)


def _append(relationship: Usd.Relationship, path: Sdf.Path) -> None:
    relationship.AddTarget(path, Usd.ListPositionBackOfAppendList)


def _set(prim: Usd.Prim, name: str, value: Any, time: float | None = None) -> None:
    attribute = prim.GetAttribute(name)
    attribute.Set(value, Usd.TimeCode.Default() if time is None else Usd.TimeCode(time))


def _set_amount(prim: Usd.Prim, amount: float, time: float | None) -> None:
    if isinstance(amount, bool) or not isinstance(amount, (int, float)) or not math.isfinite(amount):
        raise EditError(f"{prim.GetPath()}: amount is {amount!r}, expected a finite number")
    _set(prim, schema.AMOUNT, float(amount), time)


def _checked_blend(blend: Blend | str) -> str:
    if blend not in list(Blend):
        raise EditError(f"no blend is called '{blend}'; there are {', '.join(b.value for b in Blend)}")
    return Blend(blend).value


def _set_operation(
    prim: Usd.Prim,
    operation: str,
    parameters: Mapping[str, Value],
    time: float | None,
    *,
    has_payload: bool,
    write_token: bool = True,
) -> list[str]:
    known = schema.operations()
    found = known.get(operation)
    if found is None and (parameters or not has_payload):
        raise EditError(
            f"{prim.GetPath()}: no operation is called '{operation}'; there are {', '.join(sorted(known))} "
            f"(another one needs its schema on PXR_PLUGINPATH_NAME, or a baked payload and no parameters)"
        )
    written = [schema.OPERATION] if write_token else []
    if write_token:
        _set(prim, schema.OPERATION, operation)
    if found is None:
        return written
    _apply(prim, found.api_schema)
    implementation = operations.find(operation)
    for name, value in parameters.items():
        parameter = found.parameters.get(name)
        if parameter is None:
            listed = ", ".join(sorted(found.parameters))
            raise EditError(f"{prim.GetPath()}: operation '{operation}' has no parameter '{name}'; it has {listed}")
        checked = _checked_value(prim, parameter, value)
        given = schema.to_value(checked)
        if implementation is not None and given is not None:  # It may know bounds that no schema can state.
            implementation.complete({name: given}, str(prim.GetPath()))
        _set(prim, parameter.name, checked, time)
        written.append(parameter.name)
    return written


def _checked_value(prim: Usd.Prim, parameter: schema.PropertySchema, value: Value) -> Any:
    """The value in the form that USD takes for the parameter's type."""
    expected = parameter.fallback
    assert parameter.type_name is not None
    size = len(expected) if not isinstance(expected, str) and hasattr(expected, "__len__") else 0
    error = EditError(
        f"{prim.GetPath()}: {parameter.name} is {value!r}, expected {parameter.type_name} such as {expected}"
    )
    if isinstance(expected, (bool, str)):
        if not isinstance(value, type(expected)):
            raise error
        return value
    if not size and not isinstance(expected, (int, float)):
        return value  # A third party's type: USD says whether it fits.
    numbers = tuple(value) if isinstance(value, (tuple, list)) else (value,)
    if any(isinstance(n, (bool, str)) or not isinstance(n, (int, float)) or not math.isfinite(n) for n in numbers):
        raise error
    if len(numbers) != max(size, 1) or bool(size) != isinstance(value, (tuple, list)):
        raise error
    return type(expected)(*numbers)


def _set_members(prim: Usd.Prim, name: str, members: Members | Sequence[str]) -> bool:
    """Make a collection include and exclude just `members`; False if stronger layers keep it otherwise."""
    if isinstance(members, str):
        raise EditError(f"{prim.GetPath()} {name}: expected a list of paths, got the text '{members}'")
    wanted = members if isinstance(members, Members) else Members(tuple(members))
    collection = Usd.CollectionAPI(prim, name)
    where = f"{prim.GetPath()} {name}"
    includes = _author_difference(
        collection.GetIncludesRel(), collections.find_prims(prim.GetStage(), wanted.includes, where)
    )
    excludes = _author_difference(
        collection.GetExcludesRel(), collections.find_prims(prim.GetStage(), wanted.excludes, where)
    )
    return includes and excludes


def _author_difference(relationship: Usd.Relationship, wanted: tuple[Sdf.Path, ...]) -> bool:
    """Make the composed targets `wanted`; False if stronger layers keep them otherwise."""
    composed = relationship.GetTargets()
    for path in composed:
        if path not in wanted:
            relationship.RemoveTarget(path)
    for path in wanted:
        if path not in composed:
            _append(relationship, path)
    return set(relationship.GetTargets()) == set(wanted)


# --------------------------------------------------------------------------- keys


def set_payload_key(
    stage: Usd.Stage,
    edit: str,
    *,
    layer: str | Sdf.Layer,
    time: float | None,
    payload: tuple[str | Path, str] | None,
    interpolation: str | None = None,
) -> tuple[EditFinding, ...]:
    """Author the payload of one keyframe.

    USD does not merge time samples of two layers. If another layer decides the
    keys, all of them are therefore copied to `layer` first, and the layer
    notes where they came from; `check` reports when the source has moved on. A
    payload that held for all times is not a key, and the first key hides it.

    Parameters
    ----------
    time
        Stage time of the key; None authors one payload for all times, in place of all keys.
    payload
        (file, digest), or None for the identity.
    interpolation
        ``"linear"`` or ``"held"``; None leaves it.

    Raises
    ------
    EditError
        There is no such edit, or its composed keys cannot be copied.
    """
    if interpolation not in (None, "linear", "held"):
        raise EditError(f"{edit}: no key interpolation is called '{interpolation}'; there are linear, held")
    prim = _writable_edit(stage, edit)
    with writing(stage, layer, prim.GetPath()) as target:
        if time is None:
            _clear_keys(prim, target)
        else:
            _own_keys(prim, target)
        asset = _asset_path(target, os.fspath(payload[0])) if payload is not None else None
        _write_key(prim, target, time, asset, payload[1] if payload is not None else "")
        if interpolation is not None:
            _set(prim, schema.KEY_INTERPOLATION, interpolation)
    return _overridden(prim, target, (schema.PAYLOAD, schema.FILE_PATH), time)


def _clear_keys(prim: Usd.Prim, layer: Sdf.Layer) -> None:
    for name in (schema.PAYLOAD, schema.FILE_PATH):
        spec = layer.GetAttributeAtPath(prim.GetPath().AppendProperty(name))
        if spec:
            for time in layer.ListTimeSamplesForPath(spec.path):
                layer.EraseTimeSample(spec.path, time)
            spec.ClearDefaultValue()
            spec.SetInfo("customData", {k: v for k, v in spec.customData.items() if k != COPIED_FROM})


def _own_keys(prim: Usd.Prim, layer: Sdf.Layer) -> None:
    """Make `layer` the one that decides the keys, by copying all composed ones."""
    track = read_keys(prim)
    opinion = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
    if track is None or opinion is None or opinion.layer == layer or not track.times:
        return
    for key in track.keys:
        _write_key(prim, layer, key.time, _asset_path(layer, key.anchored) if key.digest else None, key.digest)
    spec = layer.GetAttributeAtPath(prim.GetPath().AppendProperty(schema.PAYLOAD))
    source = opinion.layer.realPath or opinion.layer.identifier
    if spec:
        spec.customData[COPIED_FROM] = {"layer": _asset_path(layer, source), "keys": track.digest}


def copied_keys_are_current(prim: Usd.Prim) -> tuple[str, bool] | None:
    """Whether keys that a layer copied still equal their source.

    Returns
    -------
    (str, bool) or None
        Identifier of the source layer and whether it still says the same; None where nothing was copied.
    """
    opinion = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
    if opinion is None:
        return None
    note = opinion.layer.GetAttributeAtPath(opinion.path).customData.get(COPIED_FROM)
    if not note:
        return None
    identifier = Sdf.ComputeAssetPathRelativeToLayer(opinion.layer, str(note.get("layer", "")))
    for spec, offset in prim.GetAttribute(schema.PAYLOAD).GetPropertyStackWithLayerOffsets(schema.time_code(None)):
        if (
            identifier in (spec.layer.identifier, spec.layer.realPath)
            and spec.layer.GetNumTimeSamplesForPath(spec.path) > 0
        ):
            samples = [
                (t, spec.layer.QueryTimeSample(spec.path, t)) for t in spec.layer.ListTimeSamplesForPath(spec.path)
            ]
            keys = tuple(
                Key(offset * t, "" if isinstance(value, Sdf.ValueBlock) else str(value)) for t, value in samples
            )
            held = schema.read_attribute(prim, schema.KEY_INTERPOLATION, None) == "held"
            track = KeyTrack(keys, held, identifier)
            return identifier, note.get("keys") == track.digest
    return identifier, False


def _write_key(prim: Usd.Prim, layer: Sdf.Layer, time: float | None, asset: str | None, digest: str) -> None:
    for name, value in ((schema.FILE_PATH, asset and Sdf.AssetPath(asset)), (schema.PAYLOAD, digest)):
        attribute = prim.GetAttribute(name)
        if time is None:
            attribute.Set(value if asset else Sdf.ValueBlock())
            continue
        stage_time = float(time)
        _erase_sample(prim, layer, name, stage_time)
        attribute.Set(value if asset else Sdf.ValueBlock(), Usd.TimeCode(stage_time))


def _erase_sample(prim: Usd.Prim, layer: Sdf.Layer, name: str, stage_time: float) -> None:
    """Drop a sample at the same stage time that rounding of the layer offset moved by a hair."""
    path = prim.GetPath().AppendProperty(name)
    target = prim.GetStage().GetEditTargetForLocalLayer(layer)
    offset = target.GetMapFunction().timeOffset
    for layer_time in layer.ListTimeSamplesForPath(path):
        if abs(offset * layer_time - stage_time) <= SAME_TIME:
            layer.EraseTimeSample(path, layer_time)


def _asset_path(layer: Sdf.Layer, file: str) -> str:
    """`file` as the layer should say it: relative to its own file where it has one."""
    if "://" in file or file.startswith("anon:"):
        return file
    absolute = os.path.abspath(file)
    if layer.anonymous or not layer.realPath or Ar.IsPackageRelativePath(file):
        return absolute
    relative = os.path.relpath(absolute, os.path.dirname(layer.realPath)).replace(os.sep, "/")
    return relative if relative.startswith("../") else f"./{relative}"


def reload_layer(layer: Sdf.Layer) -> None:
    """Read a layer's file again, dropping unsaved changes.

    Raises
    ------
    StageError
        The file cannot be read.
    """
    if not layer.Reload(force=True):
        raise StageError(f"{layer.identifier} cannot be read again; check that the file exists")
    _seen_on_disk[layer.identifier] = _on_disk(layer)
