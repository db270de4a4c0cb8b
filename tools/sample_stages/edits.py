"""The edits that the sequence and shot layers of a sample stage carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from icheat_usd.edits import operations
from icheat_usd.edits.model import Payload, SurfaceMask, Value
from icheat_usd.edits.operations.constants import baked_constants
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.scene import SceneSnapshot
from icheat_usd.session.authoring import surfaces_below
from icheat_usd.sidecar import write_payloads
from icheat_usd.stage import authoring, open_stage, take_snapshot
from icheat_usd.stage.authoring import Members
from icheat_usd.stage.selection_authoring import add_region

STACK = "/World/Edits"

#: Texels along a control face: cages have many small faces, flat walls one large one.
_TEXELS = {True: 4, False: 32}

Sphere = tuple[float, float, float, float, float]


@dataclass(frozen=True)
class New:
    """An edit to add. Spheres are x, y, z, inner and outer radius, in metres of the stage; paths are below /World."""

    name: str
    doc: str
    receivers: Sequence[str]
    casters: Sequence[str]
    operation: str = "scale"
    parameters: Mapping[str, Value] = field(default_factory=dict)
    amount: float = 1.0
    receiver_sphere: Sphere | None = None
    caster_sphere: Sphere | None = None
    receiver_region: Sphere | None = None  #: limits the receivers by a Sphere prim instead of paint
    keys: Mapping[float, Mapping[str, Value]] = field(default_factory=dict)  #: parameters by frame
    occluders: Sequence[str] = ()
    lights: Sequence[str] = ()
    target: str | None = None
    needs_payload: bool = True  #: False: what USD says is all there is


@dataclass(frozen=True)
class Override:
    """What a stronger layer says about a weaker layer's edit."""

    name: str
    amount: float | None = None
    parameters: Mapping[str, Value] | None = None
    enabled: bool | None = None


def author_edits(path: Path, edits: Sequence[New | Override], make_stack: bool) -> None:
    """Write edits into the layer at `path` and all their payloads into one sidecar beside it."""
    stage = open_stage(path)
    layer = stage.GetRootLayer().identifier
    if make_stack:
        authoring.create_stack(stage, STACK, layer=layer, camera="/World/Cameras/Main")
    snapshot = take_snapshot(stage, width=4, height=4)
    made = [edit for edit in edits if isinstance(edit, New)]
    recipes = {edit.name: edit.keys or {None: edit.parameters} for edit in made}
    payloads = [
        _payload(stage, snapshot, edit, {**edit.parameters, **parameters})
        for edit in made
        for parameters in recipes[edit.name].values()
        if edit.needs_payload
    ]
    file, digests = write_payloads(path, payloads, anchor="/World") if payloads else (path, [])
    remaining = iter(digests)
    for edit in edits:
        if isinstance(edit, Override):
            authoring.set_edit(
                stage,
                f"{STACK}/{edit.name}",
                layer=layer,
                amount=edit.amount,
                parameters=edit.parameters,
                enabled=edit.enabled,
            )
            continue
        keys = {time: next(remaining) for time in recipes[edit.name] if edit.needs_payload}
        first = next(iter(keys), None)
        limits = () if edit.receiver_region is None else (_region(stage, layer, edit),)
        prim = authoring.add_edit(
            stage,
            STACK,
            edit.name,
            layer=layer,
            operation=edit.operation,
            # Keyed parameters are the payloads' own: an opinion here would hide them.
            parameters={} if edit.keys else edit.parameters,
            receivers=edit.receivers,
            casters=edit.casters,
            amount=edit.amount,
            occluders=edit.occluders,
            lights=edit.lights,
            target=edit.target,
            receiver_limits=limits,
            payload=(file, keys[first]) if keys else None,
            time=first,
        )
        for time, digest in list(keys.items())[1:]:
            authoring.set_payload_key(stage, prim, layer=layer, time=time, payload=(file, digest))
        stage.GetRootLayer().GetPrimAtPath(prim).documentation = edit.doc
    authoring.save_layer(stage.GetRootLayer())


def _region(stage: object, layer: str, edit: New) -> str:
    assert edit.receiver_region is not None
    x, y, z, inner, outer = edit.receiver_region
    path = f"/World/Regions/{edit.name}"
    add_region(stage, path, layer=layer, shape="sphere", centre=(x, y, z), size=(outer,), softness=1 - inner / outer)
    return path


def _payload(stage: object, snapshot: SceneSnapshot, edit: New, parameters: Mapping[str, Value]) -> Payload:
    operation = operations.find(edit.operation)
    if operation is None:
        raise KeyError(edit.operation)
    return Payload(
        operation=edit.operation,
        parameters=dict(parameters),
        receiver_mask=_mask(stage, snapshot, edit.receivers, edit.receiver_sphere),
        caster_mask=_mask(stage, snapshot, edit.casters, edit.caster_sphere),
        **baked_constants(operation, operation.complete(parameters, edit.name)),
    )


def _mask(stage: object, snapshot: SceneSnapshot, members: Sequence[str], sphere: Sphere | None) -> SurfaceMask | None:
    if sphere is None:
        return None
    x, y, z = (value - float(centre) for value, centre in zip(sphere[:3], snapshot.centre, strict=True))
    brush = soft_sphere((x, y, z), inner=sphere[3], outer=sphere[4])
    paths = surfaces_below(stage, Members(tuple(members)), [surface.path for surface in snapshot.surfaces])
    many_faces = sum(surface.n_faces for surface in snapshot.surfaces if surface.path in set(paths)) > 100
    return paint_mask(snapshot, paths, brush, resolution=_TEXELS[many_faces])
