"""Rules about payloads: whether what is baked or painted still fits the edit and the scene."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from pxr import Usd, UsdGeom

from icheat_usd.edits import operations, staleness
from icheat_usd.edits.facts import Facts
from icheat_usd.edits.model import Payload, SurfaceMask, Value
from icheat_usd.edits.operations import Operation
from icheat_usd.edits.operations.constants import baked_constants
from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.check.rule import Context, Found, Rule
from icheat_usd.stage.keys import Key, read_keys, strongest_opinion
from icheat_usd.stage.parameters import authored_parameters
from icheat_usd.stage.stacks import Severity


class BakedWithoutPayload(Rule):
    doc = "An edit whose operation is 'baked' has a payload with a baked form."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            if schema.read_attribute(prim, schema.OPERATION, context.time) != operations.BAKED:
                continue
            try:
                track = read_keys(prim)
            except EditError:
                continue  # Other rules say why.
            if track is None:
                yield prim, schema.OPERATION, "is 'baked' and there is no payload; bake the edit, or name an operation"
            for key, payload in context.payloads(prim):
                if not has_baked_form(payload):
                    message = f"is 'baked' and payload {key.digest[:12]} holds nothing baked; bake the edit again"
                    yield prim, schema.OPERATION, message


class BakedStale(Rule):
    doc = "What a payload was baked against has not changed since."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim, key, payload in context.all_payloads():
            because = stale_because(context, prim, key, payload)
            if because:
                yield prim, schema.PAYLOAD, f"what is baked{_at(key)} is stale: {'; '.join(because)}; bake it again"


class BakedForOtherCamera(Rule):
    doc = "The camera that a payload's rows were sampled for sees what it saw."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim, key, payload in context.all_payloads():
            because = camera_changes(context, prim, key, payload)
            if because:
                message = f"rows{_at(key)} were sampled for what a camera saw, and {'; '.join(because)}"
                yield prim, schema.PAYLOAD, f"{message}; places that it did not see fade out: bake it again"


class BakedParametersChanged(Rule):
    doc = "Rows were baked with the edit's operation and parameters as they are."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim, key, payload in context.all_payloads():
            because = parameters_changed(prim, key, payload, context.time)
            if because and not is_by_product(payload):
                message = f"what is baked{_at(key)} is stale: {'; '.join(because)}; readers that do not know the"
                yield prim, schema.PAYLOAD, f"{message} operation show the old; bake it again"


class PaintedSurfaceChanged(Rule):
    doc = "Painted surfaces have the faces that they were painted on."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim, key, payload in context.all_payloads():
            time = context.time if key.time is None else key.time
            for path, how in painted_changes(context.stage, payload, time):
                advice = "weights come from the nearest place that was painted; look at it, and paint again"
                yield prim, schema.PAYLOAD, f"painted surface {path} {how}; {advice}"


# --------------------------------------------------------------------------- what has changed


def has_baked_form(payload: Payload) -> bool:
    """Whether a reader that does not know the operation can apply the payload."""
    constants = (payload.scale_delta, payload.emission, payload.offset)
    return payload.rows is not None or any(value is not None for value in constants)


def is_by_product(payload: Payload) -> bool:
    """Whether all that is baked are constants that authoring stores by itself, of an operation that is known here.

    A layer that overrides a parameter leaves them behind, as it should: that is no more than a note.
    """
    return payload.rows is None and operations.find(payload.operation) is not None


def stale_because(context: Context, prim: Usd.Prim, key: Key, payload: Payload) -> tuple[str, ...]:
    """What has changed in the scene since a payload was baked; the scene is read only if it matters."""
    now = _facts_now(context, prim, key, payload)
    return () if now is None else staleness.stale_because(payload, payload.operation, now)


def camera_changes(context: Context, prim: Usd.Prim, key: Key, payload: Payload) -> tuple[str, ...]:
    """How the camera that rows were sampled for has changed since."""
    now = _facts_now(context, prim, key, payload)
    return () if now is None else staleness.camera_changes(payload, now)


def _facts_now(context: Context, prim: Usd.Prim, key: Key, payload: Payload) -> Facts | None:
    known = operations.find(payload.operation)
    wanted = staleness.needs(known, has_rows=payload.rows is not None)
    if not (wanted.geometry or wanted.lights) or "surfaces" not in payload.made_against:
        return None
    time = key.time
    if time is None:
        made_at = payload.made_against.get("time")
        time = float(made_at) if isinstance(made_at, (int, float)) else context.time
    return context.facts_at(prim, time, payload.made_against)


def parameters_changed(prim: Usd.Prim, key: Key, payload: Payload, time: float | None) -> tuple[str, ...]:
    """What has changed in the edit since a payload was baked."""
    if not has_baked_form(payload):
        return ()
    opinion = strongest_opinion(prim.GetAttribute(schema.OPERATION))
    name = schema.read_attribute(prim, schema.OPERATION, time) if opinion else payload.operation
    if name == operations.BAKED:
        return ()
    if name != payload.operation:
        return (f"the operation is '{name}', and was '{payload.operation}' when it was baked",)
    authored = authored_parameters(prim, name, time if key.time is None else key.time)
    changed = staleness.baked_parameters(payload, authored)
    operation = operations.find(name)
    if changed and operation is not None and payload.rows is None and _same_constants(operation, payload, authored):
        return ()  # gain 2 and color 1 is color 2 and gain 1
    return changed


def painted_changes(stage: Usd.Stage, payload: Payload, time: float | None) -> Iterator[tuple[str, str]]:
    """Painted surfaces that are gone or have other faces: path, and how they changed. Meshes are asked directly."""
    from icheat_usd.stage.meshes import topology_digest  # needs kernels, which hosts may lack

    masks: list[SurfaceMask] = [mask for mask in (payload.receiver_mask, payload.caster_mask) if mask is not None]
    surfaces = [surface for mask in masks for surface in mask.surfaces]
    for path, digest, part in dict.fromkeys((s.path, s.topology_digest, s.part) for s in surfaces):
        prim = stage.GetPrimAtPath(path)
        if not prim or not prim.IsActive():
            yield path, "is gone"
        elif digest and not part and prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            counts = mesh.GetFaceVertexCountsAttr().Get(schema.time_code(time))
            indices = mesh.GetFaceVertexIndicesAttr().Get(schema.time_code(time))
            if counts is not None and indices is not None:
                now = topology_digest(np.asarray(counts), np.asarray(indices))
                if now != digest:
                    yield path, "has other faces"


def _same_constants(operation: Operation, payload: Payload, authored: Mapping[str, Value]) -> bool:
    try:
        now = baked_constants(operation, operation.complete({**payload.parameters, **authored}, operation.name))
    except EditError:
        return False

    def same(was: tuple[float, float, float] | None, is_: tuple[float, float, float] | None) -> bool:
        return bool(np.allclose(was or (0.0, 0.0, 0.0), is_ or (0.0, 0.0, 0.0), rtol=1e-5, atol=1e-6))

    return bool(now) and (
        same(payload.scale_delta, now.get("scale_delta"))
        and same(payload.emission, now.get("emission"))
        and same(payload.offset, now.get("offset"))
    )


def _at(key: Key) -> str:
    return "" if key.time is None else f" at {key.time:g}"
