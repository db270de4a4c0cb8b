"""Writing edits into one layer of a stage, so that other layers keep theirs.

Every function names the layer it writes to: identifier, path or file name of
a layer in the stage's own layer stack, the layer itself, or ``"session"``.
Nothing is saved; `save_layer` does that.

List-edited relationships are appended to: a prepended edit would land before
those of weaker layers, and an explicit list would cut them off.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from pxr import Sdf, Usd, UsdGeom

from icheat_usd.edits.model import Blend, Value
from icheat_usd.errors import EditError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.key_authoring import set_payload_key as set_payload_key
from icheat_usd.stage.key_authoring import write_key
from icheat_usd.stage.keys import strongest_opinion
from icheat_usd.stage.layers import asset_path, overridden_opinions, refuse_instances, spec_path, writable_edit
from icheat_usd.stage.layers import find_layer as find_layer
from icheat_usd.stage.layers import reload_layer as reload_layer
from icheat_usd.stage.layers import remember_layer as remember_layer
from icheat_usd.stage.layers import save_layer as save_layer
from icheat_usd.stage.layers import writing as writing
from icheat_usd.stage.parameter_authoring import checked_blend, set_amount, set_operation, set_value
from icheat_usd.stage.parameter_authoring import unknown_operation as unknown_operation
from icheat_usd.stage.selection_authoring import Members as Members
from icheat_usd.stage.selection_authoring import add_region as add_region
from icheat_usd.stage.selection_authoring import add_selection as add_selection
from icheat_usd.stage.selection_authoring import (
    apply_schema,
    define_ancestors,
    path_below_default,
    set_members,
    set_targets,
)
from icheat_usd.stage.stacks import EditFinding, stack_prim

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
    stack_path = path_below_default(stage, path, "stack")
    existing = stage.GetPrimAtPath(stack_path)
    if schema.has_schema(existing, schema.STACK_API):
        raise EditError(f"{stack_path} is a stack already; add edits to it or choose another path")
    cameras = collections.find_prims(stage, [camera], "camera") if camera is not None else ()
    for target in cameras:
        if not stage.GetPrimAtPath(target).IsA(UsdGeom.Camera):
            raise EditError(f"{stack_path}: {target} is no camera; name one")
    with writing(stage, layer, stack_path):
        define_ancestors(stage, stack_path)
        prim = existing if existing and existing.IsDefined() else stage.DefinePrim(stack_path, "Scope")
        apply_schema(prim, schema.STACK_API)
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
    receiver_limits: Sequence[str] = (),
    caster_limits: Sequence[str] = (),
    occluders: Sequence[str] = (),
    lights: Sequence[str] = (),
    target: str | None = None,
    payload: tuple[str | Path, str] | None = None,
    time: float | None = None,
    before: str | None = None,
    after: str | None = None,
    variant: tuple[str, str] | None = None,
) -> str:
    """Add an edit to a stack, after those it has unless `before` or `after` says otherwise.

    Parameters
    ----------
    name
        Name of the new prim below the stack.
    operation, parameters
        What the edit does; without a payload the operation must be a known one.
    receivers, casters
        Paths to include, or `Members` with exclusions or an expression. A path that the stage lacks is an error.
    receiver_limits, caster_limits
        Materials, regions, selections, collections or prims that narrow the two sides.
    occluders, lights
        Prims that the operation lets light pass, and lights that it acts on, where it has a use for them.
    target
        Prim that the operation aims at.
    anchor
        Prim that surface paths inside payloads are relative to; the stage's default prim if not given.
    payload
        (file, digest) of painted or baked data; written relative to the layer's own file.
    time
        Stage time of the values and of the payload's key; None authors defaults.
    variant
        (set, variant) of the stack's prim, or of one above it, to write into; another one may be selected.

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
    if {before, after} & {name, str(path)}:
        raise EditError(f"{path} cannot lie before or after itself; name another edit")
    refuse_instances(stage, path)
    with writing(stage, layer, prim.GetPath(), variant) as written_to:
        if stage.GetPrimAtPath(path):
            is_listed = path in prim.GetRelationship(schema.EDITS).GetTargets()
            choice = "or set its values" if is_listed else "as the stack does not list it: a layer took it out"
            raise EditError(f"{path} exists already; choose another name {choice}")
        edit = stage.DefinePrim(path, "Scope")
        apply_schema(edit, schema.EDIT_API)
        set_operation(edit, operation, parameters or {}, time, has_payload=payload is not None)
        if amount != schema.fallback(schema.AMOUNT):
            set_amount(edit, amount, time)
        if checked_blend(blend) != schema.fallback(schema.BLEND):
            set_value(edit, schema.BLEND, checked_blend(blend))
        for collection, members in ((schema.RECEIVERS, receivers), (schema.CASTERS, casters)):
            # Always authored, so that a host without our schemas selects the same.
            Usd.CollectionAPI(edit, collection).CreateIncludeRootAttr().Set(False)
            Usd.CollectionAPI(edit, collection).CreateExpansionRuleAttr().Set(Usd.Tokens.expandPrims)
            set_members(edit, collection, members)
        related = _related(receiver_limits, caster_limits, occluders, lights, target)
        set_targets(edit, {relationship: names for relationship, names in related.items() if names})
        anchors = (
            collections.find_prims(stage, [anchor], f"{path} anchor")
            if anchor is not None
            else tuple(p.GetPath() for p in [stage.GetDefaultPrim()] if p)
        )
        if anchors:
            _relationship(edit, schema.ANCHOR).SetTargets([*anchors])
        if payload is not None:
            write_key(edit, written_to, time, asset_path(written_to, os.fspath(payload[0])), payload[1])
        _append(_relationship(prim, schema.EDITS), path)
        if before is not None or after is not None:
            _move(prim, path, written_to, before=before, after=after)
    return str(path)


def move_edit(
    stage: Usd.Stage,
    stack: str,
    edit: str,
    *,
    layer: str | Sdf.Layer,
    before: str | None = None,
    after: str | None = None,
    variant: tuple[str, str] | None = None,
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
    with writing(stage, layer, prim.GetPath(), variant) as target:
        _move(prim, _listed(prim, edit), target, before=before, after=after)


def remove_edit(
    stage: Usd.Stage, stack: str, edit: str, *, layer: str | Sdf.Layer, variant: tuple[str, str] | None = None
) -> None:
    """Take an edit out of a stack, and drop what the layer says about it.

    What weaker layers say about the edit stays; they are not written to.

    Raises
    ------
    EditError
        The edit is not in the stack, or a stronger layer lists it.
    """
    prim = stack_prim(stage, stack)
    with writing(stage, layer, prim.GetPath(), variant) as target:
        path = _listed(prim, edit)
        relationship = _relationship(prim, schema.EDITS)
        relationship.RemoveTarget(path)
        own = spec_path(stage, relationship.GetPath())
        if path in relationship.GetTargets():
            stronger = [
                spec.layer.identifier + ("" if spec.layer != target else f" at {spec.path}")
                for spec in relationship.GetPropertyStack()
                if (spec.layer, spec.path) != (target, own) and path in spec.targetPathList.GetAddedOrExplicitItems()
            ]
            raise EditError(f"{path} is listed by {', '.join(stronger)}, which is stronger; remove it there")
        items = target.GetRelationshipAtPath(own).targetPathList
        if not items.isExplicit:
            items.deletedItems.remove(path)
            if path in relationship.GetTargets():  # A weaker layer lists it, so that the deletion is needed.
                items.deletedItems.append(path)
        if target.GetPrimAtPath(spec_path(stage, path)):
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
    place = spec_path(stack.GetStage(), relationship.GetPath())
    if layer.GetRelationshipAtPath(place) is None:
        _append(relationship, path)
    spec = layer.GetRelationshipAtPath(place)
    items = spec.targetPathList
    if items.isExplicit:
        own = list(items.explicitItems)
        items.explicitItems = [p for p in wanted if p in own]
    else:
        tail = wanted[first:]
        items.prependedItems = [p for p in items.prependedItems if p not in tail]
        items.deletedItems = [p for p in items.deletedItems if p not in tail]
        items.appendedItems = [p for p in items.appendedItems if p not in tail] + tail
        if items.orderedItems:  # A reorder statement, which other tools write, acts after all else.
            items.orderedItems = wanted
    if list(relationship.GetTargets()) != wanted:
        in_variant = place.ContainsPrimVariantSelection()
        stronger = "what a layer says beside the variant" if in_variant else f"a layer stronger than {layer.identifier}"
        raise EditError(f"{stack.GetPath()}: {stronger} decides the order; move it there")


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
    receiver_limits: Sequence[str] | None = None,
    caster_limits: Sequence[str] | None = None,
    occluders: Sequence[str] | None = None,
    lights: Sequence[str] | None = None,
    target: str | None = None,
    time: float | None = None,
    variant: tuple[str, str] | None = None,
) -> tuple[EditFinding, ...]:
    """Author values of an edit; what is None stays as it is, an empty list or target takes away.

    A selection is authored as the difference from the composed one, so that
    later additions of weaker layers still join it. A variant (set, variant) is
    that of the edit's prim or of one above it, such as the stack's; what layers
    say beside it is stronger than what they say in it.

    Returns
    -------
    tuple of EditFinding
        Values that were authored and have no effect, because a stronger layer decides them.

    Raises
    ------
    EditError
        Something named does not exist or does not fit; the layer is then as before.
    """
    path = edit if variant is not None else writable_edit(stage, edit).GetPath()
    written: list[str] = []
    selections: list[EditFinding] = []
    with writing(stage, layer, path, variant) as written_to:
        prim = writable_edit(stage, edit)
        if operation is not None or parameters:
            token = operation or str(schema.read_attribute(prim, schema.OPERATION, time))
            has_payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD)) is not None
            written += set_operation(
                prim, token, parameters or {}, time, has_payload=has_payload, write_token=operation is not None
            )
        if amount is not None:
            set_amount(prim, amount, time)
            written.append(schema.AMOUNT)
        if blend is not None:
            set_value(prim, schema.BLEND, checked_blend(blend))
            written.append(schema.BLEND)
        if enabled is not None:
            set_value(prim, schema.ENABLED, bool(enabled))
            written.append(schema.ENABLED)
        for collection, members in ((schema.RECEIVERS, receivers), (schema.CASTERS, casters)):
            if members is not None and not set_members(prim, collection, members):
                message = f"authored in {written_to.identifier}, but a stronger layer changes the selection"
                selections.append(EditFinding(str(prim.GetPath()), collection, message))
        for name in set_targets(prim, _related(receiver_limits, caster_limits, occluders, lights, target)):
            message = f"authored in {written_to.identifier}, but a stronger layer changes the targets"
            selections.append(EditFinding(str(prim.GetPath()), name, message))
        return (*overridden_opinions(prim, written_to, written, time), *selections)


def mute_edit(
    stage: Usd.Stage,
    edit: str,
    *,
    layer: str | Sdf.Layer,
    muted: bool = True,
    variant: tuple[str, str] | None = None,
) -> tuple[EditFinding, ...]:
    """Mute or unmute an edit; see `set_edit`."""
    return set_edit(stage, edit, layer=layer, enabled=not muted, variant=variant)


def _related(
    receiver_limits: Sequence[str] | None,
    caster_limits: Sequence[str] | None,
    occluders: Sequence[str] | None,
    lights: Sequence[str] | None,
    target: str | None,
) -> dict[str, Sequence[str] | None]:
    """Targets by relationship; None leaves one as it is, an empty target is none."""
    return {
        schema.RECEIVER_LIMITS: receiver_limits,
        schema.CASTER_LIMITS: caster_limits,
        schema.OCCLUDERS: occluders,
        schema.LIGHTS: lights,
        schema.TARGET: None if target is None else [target] if target else [],
    }


def _relationship(prim: Usd.Prim, name: str) -> Usd.Relationship:
    # Built-in: creating it says nothing that the schema does not.
    return prim.GetRelationship(name) or prim.CreateRelationship(name, custom=False)


def _append(relationship: Usd.Relationship, path: Sdf.Path) -> None:
    relationship.AddTarget(path, Usd.ListPositionBackOfAppendList)
