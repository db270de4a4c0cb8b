"""What is wrong with the edits on a stage: one class per rule.

Rules ask the composed stage and the specs behind it; none needs the schemas
to be registered, and none stops at the first finding.
"""

from __future__ import annotations

import difflib
import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any, ClassVar

from pxr import Sdf, Usd

from icheat_usd.edits.model import Blend
from icheat_usd.errors import EditError, IcheatError
from icheat_usd.resources import resource_path
from icheat_usd.stage import collections, key_authoring, schema
from icheat_usd.stage.edit_stack import PayloadReader, anchor_path, open_asset
from icheat_usd.stage.keys import SAME_TIME, read_keys, strongest_opinion
from icheat_usd.stage.opening import quiet_usd
from icheat_usd.stage.stacks import EditFinding, Severity, listed_edits


@dataclass(frozen=True)
class Context:
    """What rules look at."""

    stage: Usd.Stage
    time: float | None
    stacks: tuple[Usd.Prim, ...]
    edits: tuple[Usd.Prim, ...]  #: active ones, listed or not
    read_payload: PayloadReader | None = None
    listed: frozenset[str] = field(default=frozenset())  #: paths of edits that some stack lists


Found = Iterator[tuple[Usd.Prim, str, str]]  #: prim, property or "", message


class Rule(ABC):
    """One thing that can be wrong."""

    doc: ClassVar[str]
    severity: ClassVar[Severity] = Severity.ERROR

    @abstractmethod
    def find(self, context: Context) -> Found:
        """Yield prim, property name ("" for the prim itself) and message of everything that breaks the rule."""


def check_stage(
    stage: Usd.Stage, time: float | None = None, read_payload: PayloadReader | None = None
) -> list[EditFinding]:
    """Everything that is wrong with the edits on a stage, in order of rule and prim.

    Parameters
    ----------
    time
        Time code at which values are read, by default the stage's start; keys and samples are all looked at.
    read_payload
        Given one, every payload is read.
    """
    time = schema.default_time(stage, time)
    with quiet_usd():  # USD warns on stderr about dropped targets, each time it composes them.
        everything = list(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
        stacks = tuple(prim for prim in everything if schema.has_schema(prim, schema.STACK_API))
        edits = tuple(prim for prim in everything if schema.has_schema(prim, schema.EDIT_API))
        listed = frozenset(str(prim.GetPath()) for stack in stacks for prim in listed_edits(stack)[0])
        context = Context(stage, time, stacks, edits, read_payload, listed)
        return [
            EditFinding(str(prim.GetPath()), name, message, rule.severity, type(rule).__name__)
            for rule in RULES
            for prim, name, message in rule.find(context)
        ]


# --------------------------------------------------------------------------- schemas


class SchemasNotRegistered(Rule):
    doc = "This process's USD knows the schemas, so that edits can be authored."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        if (context.stacks or context.edits) and not schema.is_registered():
            message = "edits can be read but not authored here: set PXR_PLUGINPATH_NAME from `icheat plugin-path`"
            yield context.stage.GetPseudoRoot(), "", message


class SchemaOnWrongType(Rule):
    doc = "Each schema is applied to a prim of a type it is made for."

    def find(self, context: Context) -> Found:
        for prim in dict.fromkeys((*context.stacks, *context.edits)):
            for name in prim.GetPrimTypeInfo().GetAppliedAPISchemas():
                allowed = _allowed_types().get(name)
                if allowed and prim.GetTypeName() not in allowed:
                    found = prim.GetTypeName() or "no type"
                    yield prim, "", f"{name} is applied to a prim of {found}, expected {' or '.join(allowed)}"


class UnknownAttribute(Rule):
    doc = "Every icheat: property is one that a schema declares."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        known = _declared()
        for prim in dict.fromkeys((*context.stacks, *context.edits)):
            operation = schema.read_attribute(prim, schema.OPERATION, context.time)
            own = f"icheat:{operation}:" if operation not in schema.operations() else "\0"
            for name in prim.GetAuthoredPropertyNames():
                ours = name.startswith(("icheat", "collection:icheat"))
                if not ours or name in known or name.startswith(own) or _is_collection_property(name):
                    continue
                close = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {close[0]}?" if close else "; remove it"
                yield prim, name, f"no schema declares this property, so it does nothing{hint}"


class WrongAttributeType(Rule):
    doc = "Every icheat: property has the declared type in every layer."

    def find(self, context: Context) -> Found:
        known = _declared()
        for prim in dict.fromkeys((*context.stacks, *context.edits)):
            for name in prim.GetAuthoredPropertyNames():
                declared = known.get(name)
                if declared is None:
                    continue
                expected = "relationship" if declared.type_name is None else str(declared.type_name)
                for spec in prim.GetProperty(name).GetPropertyStack():
                    found = str(spec.typeName) if isinstance(spec, Sdf.AttributeSpec) else "relationship"
                    if found != expected:
                        message = f"is of type {found} in {spec.layer.identifier}, expected {expected}"
                        yield prim, name, message


# --------------------------------------------------------------------------- stacks


class StackOutsideDefaultPrim(Rule):
    doc = "A stack lies below the default prim, or references to the layer lose it."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        default = context.stage.GetDefaultPrim()
        for prim in context.stacks:
            if not default:
                yield prim, "", "the stage has no default prim, so references lose the stack; set defaultPrim"
            elif not prim.GetPath().HasPrefix(default.GetPath()):
                yield (
                    prim,
                    "",
                    f"lies outside the default prim {default.GetPath()}, so references lose it; move it there",
                )


class StackInInstance(Rule):
    doc = "A stack lies outside instances, whose contents cannot be overridden."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.stacks:
            if prim.IsInstanceProxy():
                yield prim, "", "lies in an instance, so no shot can override it; move it out"


class UnusableTarget(Rule):
    doc = "A stack lists edits that exist."

    def find(self, context: Context) -> Found:
        for prim in context.stacks:
            for finding in listed_edits(prim)[1]:
                yield prim, finding.feature, finding.message


class EditListedTwice(Rule):
    doc = "A layer lists an edit once, and only one stack applies it."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        owners: dict[str, str] = {}
        for prim in context.stacks:
            relationship = prim.GetRelationship(schema.EDITS)
            for spec in relationship.GetPropertyStack() if relationship else ():
                items = spec.targetPathList
                parts = (items.explicitItems, items.prependedItems, items.appendedItems, items.addedItems)
                every = [path for part in parts for path in part]
                for path in dict.fromkeys(path for path in every if every.count(path) > 1):
                    yield prim, schema.EDITS, f"{path} is listed twice in {spec.layer.identifier}; list it once"
            for edit in listed_edits(prim)[0]:
                path = str(edit.GetPath())
                if path in owners:
                    yield prim, schema.EDITS, f"{path} is listed by {owners[path]} too; a change for one changes both"
                owners.setdefault(path, str(prim.GetPath()))


class EditInNoStack(Rule):
    doc = "Every edit is listed by a stack, unless a layer took it out on purpose."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            if str(prim.GetPath()) not in context.listed | _taken_out(context.stacks):
                yield prim, "", f"no stack lists it, so it has no effect; append it to a stack's {schema.EDITS}"


class CameraIsNoCamera(Rule):
    doc = "A stack's camera is a camera."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.stacks:
            relationship = prim.GetRelationship(schema.CAMERA)
            for path in relationship.GetTargets() if relationship else ():
                target = context.stage.GetPrimAtPath(path)
                if not target or target.GetTypeName() != "Camera":
                    yield prim, schema.CAMERA, f"{path} is no camera, so no render finds the stack by it; name a camera"


class TargetDropped(Rule):
    doc = "Targets authored in a referenced layer lie inside what is referenced; USD silently drops others."

    def find(self, context: Context) -> Found:
        for prim in dict.fromkeys((*context.stacks, *context.edits)):
            names = [r.GetName() for r in prim.GetRelationships() if "icheat" in r.GetName()]
            for node in _nodes(prim):
                for name in names:
                    path = node.path.AppendProperty(name)
                    for layer in node.layerStack.layers:
                        spec = layer.GetRelationshipAtPath(path)
                        for target in spec.targetPathList.GetAddedOrExplicitItems() if spec else ():
                            if node.mapToRoot.MapSourceToTarget(target).isEmpty:
                                where = f"{target} in {layer.identifier}"
                                yield prim, name, f"{where} lies outside what is referenced and is dropped; move it in"


# --------------------------------------------------------------------------- edits


class UnknownOperation(Rule):
    doc = "An edit's operation is known, or it has a baked payload."

    def find(self, context: Context) -> Found:
        known = schema.operations()
        for prim in context.edits:
            operation = schema.read_attribute(prim, schema.OPERATION, context.time)
            if operation in known or strongest_opinion(prim.GetAttribute(schema.PAYLOAD)) is not None:
                continue
            listed = ", ".join(sorted(known))
            yield prim, schema.OPERATION, f"'{operation}' is unknown here and there is no payload; known are {listed}"


class OperationSchemaNotApplied(Rule):
    doc = "An edit has its operation's schema, so that hosts show its parameters."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            operation = schema.operations().get(schema.read_attribute(prim, schema.OPERATION, context.time))
            has_own = operation is not None and any(prim.GetAttribute(p.name) for p in operation.parameters.values())
            if operation is not None and has_own and not schema.has_schema(prim, operation.api_schema):
                yield prim, schema.OPERATION, f"'{operation.name}' is set without {operation.api_schema}; apply it"


class UnknownToken(Rule):
    doc = "Blend and key interpolation are among the allowed tokens."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for name, allowed in (
                (schema.BLEND, [blend.value for blend in Blend]),
                (schema.KEY_INTERPOLATION, ["linear", "smooth", "held"]),
            ):
                token = schema.read_attribute(prim, name, context.time)
                if token not in allowed:
                    yield prim, name, f"'{token}' is not one of {', '.join(allowed)}"


class NotFinite(Rule):
    doc = "Numbers are finite in every default and time sample."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for attribute in prim.GetAuthoredPropertiesInNamespace("icheat"):
                if not isinstance(attribute, Usd.Attribute):
                    continue
                for spec in attribute.GetPropertyStack():
                    samples = [(None, spec.default)] if spec.HasInfo("default") else []
                    for time in spec.layer.ListTimeSamplesForPath(spec.path):
                        samples.append((time, spec.layer.QueryTimeSample(spec.path, time)))
                    bad = next(((t, v) for t, v in samples if not _is_finite(v)), None)
                    if bad is not None:
                        at = "" if bad[0] is None else f" at time {bad[0]:g}"
                        message = f"is {bad[1]} in {spec.layer.identifier}{at}, expected a finite number"
                        yield prim, attribute.GetName(), message


class EmptySelection(Rule):
    doc = "Receivers and casters include something."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for name in (schema.RECEIVERS, schema.CASTERS):
                if collections.collection(prim, name).HasNoIncludedPaths():
                    yield prim, name, "selects nothing, so the edit does nothing; include prims"


class SelectedPrimMissing(Rule):
    doc = "What a selection, anchor or occluder names exists."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for relationship in prim.GetRelationships():
                if "icheat" not in relationship.GetName():
                    continue
                for path in relationship.GetTargets():
                    if not context.stage.GetObjectAtPath(path) and not context.stage.GetPrimAtPath(path.GetPrimPath()):
                        yield prim, relationship.GetName(), f"{path} does not exist; rename or remove it"


class SeveralAnchors(Rule):
    doc = "An edit has one anchor at most."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            try:
                anchor_path(prim)
            except EditError as error:
                yield prim, schema.ANCHOR, str(error)


# --------------------------------------------------------------------------- keys


class PayloadWithoutFile(Rule):
    doc = "A payload says which file holds it."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
            if payload is None or payload.is_blocked:
                continue
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if file is None or (file.is_blocked and file.layer == payload.layer):
                where = payload.layer.identifier
                yield prim, schema.PAYLOAD, f"is authored in {where} without {schema.FILE_PATH}; author both there"


class FileWithoutPayload(Rule):
    doc = "A sidecar file comes with the payload to take from it."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if file is not None and strongest_opinion(prim.GetAttribute(schema.PAYLOAD)) is None:
                yield prim, schema.FILE_PATH, f"has no effect without {schema.PAYLOAD}; author both"


class KeysFromTwoLayers(Rule):
    doc = "File and payload are decided by the same layer."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if payload and file and not payload.is_blocked and payload.layer != file.layer:
                message = (
                    f"is decided by {payload.layer.identifier} but {schema.FILE_PATH} by {file.layer.identifier}; "
                    f"author both in the same layer"
                )
                yield prim, schema.PAYLOAD, message


class KeyTimesDiffer(Rule):
    doc = "File and payload have time samples at the same times."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            payload = strongest_opinion(prim.GetAttribute(schema.PAYLOAD))
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if not payload or not file or payload.layer != file.layer or file.source != "timeSamples":
                continue
            times = [o.layer.ListTimeSamplesForPath(o.path) for o in (payload, file)]
            same = len(times[0]) == len(times[1])
            if not same or any(abs(a - b) > SAME_TIME for a, b in zip(*times, strict=True)):
                yield prim, schema.FILE_PATH, f"has other sample times than {schema.PAYLOAD}; sample both together"


class MissingSidecar(Rule):
    doc = "Every key's file exists, and holds its payload where a reader is given."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            try:
                track = read_keys(prim)
            except EditError:
                continue  # Other rules say why.
            seen = set()
            for key in track.keys if track else ():
                if not key.digest or (key.anchored, key.digest) in seen:
                    continue
                seen.add((key.anchored, key.digest))
                try:
                    source = open_asset(prim, key)
                    if context.read_payload is not None:
                        context.read_payload(key.anchored, source, key.digest, anchor_path(prim))
                except IcheatError as error:
                    yield prim, schema.FILE_PATH, str(error)


class UnanchoredFile(Rule):
    doc = "A layer without a file names sidecar files absolutely."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            file = strongest_opinion(prim.GetAttribute(schema.FILE_PATH))
            if file is None or not file.layer.anonymous:
                continue
            asset = prim.GetAttribute(schema.FILE_PATH).Get(schema.time_code(context.time))
            if asset and asset.path and not asset.path.startswith("/") and "://" not in asset.path:
                message = f"'{asset.path}' is relative in {file.layer.identifier}, which has no place; save the layer"
                yield prim, schema.FILE_PATH, message


class CopiedKeysOutdated(Rule):
    doc = "Keys that a layer copied still equal those of the layer they came from."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            state = key_authoring.copied_keys_are_current(prim)
            if state is not None and not state[1]:
                yield prim, schema.PAYLOAD, f"keys were copied from {state[0]}, which has changed; copy them again"


RULES: tuple[Rule, ...] = (
    SchemasNotRegistered(),
    SchemaOnWrongType(),
    UnknownAttribute(),
    WrongAttributeType(),
    StackOutsideDefaultPrim(),
    StackInInstance(),
    UnusableTarget(),
    EditListedTwice(),
    EditInNoStack(),
    CameraIsNoCamera(),
    TargetDropped(),
    UnknownOperation(),
    OperationSchemaNotApplied(),
    UnknownToken(),
    NotFinite(),
    EmptySelection(),
    SelectedPrimMissing(),
    SeveralAnchors(),
    PayloadWithoutFile(),
    FileWithoutPayload(),
    KeysFromTwoLayers(),
    KeyTimesDiffer(),
    MissingSidecar(),
    UnanchoredFile(),
    CopiedKeysOutdated(),
)


def _declared() -> dict[str, schema.PropertySchema]:
    packaged = {name: p for properties in schema.packaged_schemas().values() for name, p in properties.items()}
    operations = {p.name: p for operation in schema.operations().values() for p in operation.parameters.values()}
    return {**operations, **packaged}


@cache
def _allowed_types() -> dict[str, list[str]]:
    description = json.loads(resource_path("schemas/usd/plugInfo.json").read_text())
    types = description["Plugins"][0]["Info"]["Types"]
    return {name: info["apiSchemaCanOnlyApplyTo"] for name, info in types.items()}


_COLLECTION_PROPERTIES = frozenset(["includes", "excludes", "expansionRule", "includeRoot", "membershipExpression", ""])


def _is_collection_property(name: str) -> bool:
    return any(
        name == f"collection:{collection}"
        or (name.startswith(f"collection:{collection}:") and name.rpartition(":")[2] in _COLLECTION_PROPERTIES)
        for collection in (schema.RECEIVERS, schema.CASTERS)
    )


def _taken_out(stacks: tuple[Usd.Prim, ...]) -> frozenset[str]:
    """Targets that some layer deletes from a stack."""
    relationships = [stack.GetRelationship(schema.EDITS) for stack in stacks]
    specs = [spec for relationship in relationships if relationship for spec in relationship.GetPropertyStack()]
    return frozenset(str(path) for spec in specs for path in spec.targetPathList.deletedItems)


def _nodes(prim: Usd.Prim) -> Iterator[Any]:
    index = prim.GetPrimInPrototype().GetPrimIndex() if prim.IsInstanceProxy() else prim.GetPrimIndex()
    remaining = [index.rootNode]
    while remaining:
        node = remaining.pop(0)
        if not node.isCulled and not node.isInert:
            yield node
        remaining += node.children


def _is_finite(value: Any) -> bool:
    converted = None if isinstance(value, (Sdf.ValueBlock, Sdf.AssetPath)) else schema.to_value(value)
    numbers = converted if isinstance(converted, tuple) else (converted,)
    return all(not isinstance(number, float) or math.isfinite(number) for number in numbers)
