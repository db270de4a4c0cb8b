"""Rules about schemas, types and values."""

from __future__ import annotations

import difflib
import json
import math
from functools import cache
from typing import Any

from pxr import Sdf, Usd

from icheat_usd.edits.model import Blend
from icheat_usd.edits.model import Rule as SelectionRule
from icheat_usd.resources import resource_path
from icheat_usd.stage import schema
from icheat_usd.stage.check.rule import Context, Found, Rule
from icheat_usd.stage.keys import Interpolation
from icheat_usd.stage.stacks import Severity


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
        for prim in dict.fromkeys((*context.stacks, *context.edits, *context.selections)):
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
        for prim in dict.fromkeys((*context.stacks, *context.edits, *context.selections)):
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
        for prim in dict.fromkeys((*context.stacks, *context.edits, *context.selections)):
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


class UnknownToken(Rule):
    doc = "Blend, key interpolation and selection rule are among the allowed tokens."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for name, allowed in (
                (schema.BLEND, [blend.value for blend in Blend]),
                (schema.KEY_INTERPOLATION, list(Interpolation)),
            ):
                token = schema.read_attribute(prim, name, context.time)
                if token not in allowed:
                    yield prim, name, f"'{token}' is not one of {', '.join(allowed)}"
        for prim in context.selections:
            token = schema.read_attribute(prim, schema.RULE, context.time)
            if token not in list(SelectionRule):
                yield prim, schema.RULE, f"'{token}' is not one of {', '.join(SelectionRule)}"


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


def _is_finite(value: Any) -> bool:
    converted = None if isinstance(value, (Sdf.ValueBlock, Sdf.AssetPath)) else schema.to_value(value)
    numbers = converted if isinstance(converted, tuple) else (converted,)
    return all(not isinstance(number, float) or math.isfinite(number) for number in numbers)
