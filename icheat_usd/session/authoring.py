"""Edits written for good: a new sidecar for the payload, opinions in one layer, and the layer saved.

The order is what keeps a crash harmless: the sidecar first, which no one
refers to yet, then the layer that names it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from icheat_usd.edits import operations
from icheat_usd.edits.model import Blend, Payload, Rule, SurfaceMask, Value
from icheat_usd.edits.operations.base import plain_values
from icheat_usd.edits.operations.constants import BakedConstants, baked_constants
from icheat_usd.errors import EditError
from icheat_usd.scene import Finding
from icheat_usd.session.key_values import hidden_keys
from icheat_usd.session.origin import history_entry
from icheat_usd.sidecar import read_payload as read_sidecar
from icheat_usd.sidecar import write_payloads
from icheat_usd.stage import authoring, collections, schema
from icheat_usd.stage.authoring import Members
from icheat_usd.stage.layers import saving
from icheat_usd.stage.variants import selected_variant


def read_payload(file: str, source: str | bytes, digest: str, anchor: str) -> Payload:
    """Read one payload for `stage.edit_stack.read_edit_stack`."""
    return read_sidecar(source, digest, anchor=anchor, name=file)


def create_stack(stage: Any, path: str | None, *, layer: str, camera: str | None = None) -> str:
    """Make an edit stack and save the layer; without a path it is ``<default prim>/Edits``.

    Raises
    ------
    EditError
        The stage has no default prim to put it under, or the layer refuses.
    """
    with saving(stage, layer):
        return authoring.create_stack(stage, path or _default_stack(stage), layer=layer, camera=camera)


def _default_stack(stage: Any) -> str:
    default = stage.GetDefaultPrim()
    if not default:
        name = stage.GetRootLayer().identifier
        raise EditError(f"{name} has no default prim to hold the edit stack; set defaultPrim, or name the stack")
    return f"{default.GetPath()}/Edits"


def add_edit(
    stage: Any,
    stack: str | None,
    name: str,
    *,
    layer: str,
    operation: str = "scale",
    parameters: Mapping[str, Value] | None = None,
    receivers: Members | Sequence[str] = (),
    casters: Members | Sequence[str] = (),
    receiver_limits: Sequence[str] = (),
    caster_limits: Sequence[str] = (),
    occluders: Sequence[str] = (),
    lights: Sequence[str] = (),
    target: str | None = None,
    amount: float = 1.0,
    blend: Blend | str = Blend.COMPOSE,
    receiver_mask: SurfaceMask | None = None,
    caster_mask: SurfaceMask | None = None,
    made_against: Mapping[str, str | float | int] | None = None,
    frame: float | None = None,
    before: str | None = None,
    after: str | None = None,
    variant: tuple[str, str] | None = None,
    sidecar: str | Path | None = None,
    why: str = "",
) -> str:
    """Add an edit with its payload to a stack and save the layer.

    Parameters
    ----------
    stack : str or None
        None makes one, ``<default prim>/Edits``.
    receivers, casters, receiver_limits, caster_limits, occluders, lights, target
        What the edit is about; see `stage.authoring.add_edit`.
    variant : (str, str), optional
        Variant set and variant to write into, such as ("grade", "dusk") of the stack's prim.
    sidecar : path, optional
        Folder or file for the payload; beside the layer's file by default. Needed for layers without a file.
    why : str
        Kept with the payload's history, beside who and when.

    Raises
    ------
    EditError, SidecarError
        Something named does not exist or cannot be written. The layer is then
        as before, and no sidecar is left behind.
    """
    parameters = plain_values(parameters)
    written_to = authoring.find_layer(stage, layer)
    stack_path = stack or _default_stack(stage)
    if not _is_known(operation):
        raise authoring.unknown_operation(f"{stack_path}/{name}", operation)
    payload = Payload(
        operation=operation,
        parameters=dict(parameters),
        receiver_mask=receiver_mask,
        caster_mask=caster_mask,
        made_against=made_against or {},
        **_baked(operation, parameters, f"{stack_path}/{name}"),
    )
    beside = sidecar or written_to.realPath
    written: tuple[Path, str] | None = None
    if beside:
        file, digests = write_payloads(
            beside, [payload], anchor=anchor_of(stage), history=history_entry(why, f"{stack_path}/{name}")
        )
        written = (file, digests[0])
    elif receiver_mask is not None or caster_mask is not None:
        raise EditError(f"layer '{layer}' has no file to put a sidecar beside; name one with --sidecar")
    try:
        with saving(stage, written_to):
            if stack is None:
                authoring.create_stack(stage, stack_path, layer=written_to)
            path = authoring.add_edit(
                stage,
                stack_path,
                name,
                layer=written_to,
                operation=operation,
                parameters=parameters,
                receivers=receivers,
                casters=casters,
                receiver_limits=receiver_limits,
                caster_limits=caster_limits,
                occluders=occluders,
                lights=lights,
                target=target,
                amount=amount,
                blend=blend,
                payload=written,
                time=frame,
                before=before,
                after=after,
                variant=variant,
            )
    except Exception:
        # Not after an interruption: the layer may have been saved already, and then names this file.
        if written is not None:
            written[0].unlink(missing_ok=True)
        raise
    return path


def set_edit(stage: Any, edit: str, *, layer: str, **values: Any) -> tuple[Finding, ...]:
    """Change values of an edit in one layer and save it; see `stage.authoring.set_edit`.

    Returns
    -------
    tuple of Finding
        What was authored without effect, and what hides different values of the edit's keys from now on.
    """
    if values.get("parameters"):
        values["parameters"] = plain_values(values["parameters"])
    operation = values.get("operation")
    if operation is not None and operation != operations.BAKED and not _is_known(operation):
        # A baked payload would go on acting as before, under a name that somebody misspelt.
        raise authoring.unknown_operation(edit, operation)
    with saving(stage, layer):
        findings = authoring.set_edit(stage, edit, layer=layer, **values)
    with selected_variant(stage, edit, values.get("variant")):
        return (*findings, *hidden_keys(stage, edit, values.get("parameters") or ()))


def mute_edit(
    stage: Any, edit: str, *, layer: str, muted: bool = True, variant: tuple[str, str] | None = None
) -> tuple[Finding, ...]:
    """Mute or unmute an edit in one layer and save it."""
    return set_edit(stage, edit, layer=layer, enabled=not muted, variant=variant)


def move_edit(stage: Any, stack: str, edit: str, *, layer: str, **place: Any) -> None:
    """Move an edit within its stack and save the layer; see `stage.authoring.move_edit`."""
    with saving(stage, layer):
        authoring.move_edit(stage, stack, edit, layer=layer, **place)


def remove_edit(stage: Any, stack: str, edit: str, *, layer: str, variant: tuple[str, str] | None = None) -> None:
    """Take an edit out of a stack and save the layer; see `stage.authoring.remove_edit`."""
    with saving(stage, layer):
        authoring.remove_edit(stage, stack, edit, layer=layer, variant=variant)


def add_region(stage: Any, path: str, *, layer: str, **values: Any) -> str:
    """Make a region that limits can name and save the layer; see `stage.authoring.add_region`."""
    with saving(stage, layer):
        return authoring.add_region(stage, path, layer=layer, **values)


def add_selection(stage: Any, path: str, parts: Sequence[str], *, layer: str, rule: Rule | str) -> str:
    """Make a selection of others that limits can name and save the layer; see `stage.authoring.add_selection`."""
    with saving(stage, layer):
        return authoring.add_selection(stage, path, parts, layer=layer, rule=rule)


def surfaces_below(stage: Any, members: Members, paths: Iterable[str]) -> list[str]:
    """Those of the surface paths that members select."""
    if members.expression:
        return collections.surfaces_matching(stage, members.expression, paths)
    return collections.surfaces_below(stage, members.includes, members.excludes, paths)


def _is_known(operation: str) -> bool:
    """Known here, or declared by a schema, for a host that can evaluate it."""
    return operations.find(operation) is not None or operation in schema.operations()


def _baked(operation: str, parameters: Mapping[str, Value], where: str) -> BakedConstants:
    known = operations.find(operation)
    return baked_constants(known, known.complete(parameters, where)) if known else {}


def is_kept(stage: Any, layer: str) -> bool:
    """Whether what is written to a layer outlives the stage: the session layer has no file."""
    return not authoring.find_layer(stage, layer).anonymous


def anchor_of(stage: Any) -> str:
    """Scene path that surface paths in new payloads are relative to: the default prim's."""
    default = stage.GetDefaultPrim()
    return str(default.GetPath()) if default else "/"
