"""The applied schemas: names, fallbacks, and reading that does not depend on registration.

A host that composed a stage before our plug-in was announced never learns
about it: applied schemas are invisible and fallbacks are missing there.
Everything here reads authored opinions and the packaged generatedSchema.usda
instead, so that such a host sees the same edits; it only cannot author them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Any

from pxr import Sdf, Tf, Usd

from icheat_usd.edits.model import Value
from icheat_usd.errors import EditError
from icheat_usd.resources import resource_path

EDIT_API = "IcheatEditAPI"
STACK_API = "IcheatStackAPI"
SELECTION_API = "IcheatSelectionAPI"
REGION_API = "IcheatRegionAPI"

ENABLED = "icheat:enabled"
AMOUNT = "icheat:amount"
OPERATION = "icheat:operation"
BLEND = "icheat:blend"
OCCLUDERS = "icheat:occluders"
LIGHTS = "icheat:lights"
TARGET = "icheat:target"
RECEIVER_LIMITS = "icheat:receiverLimits"
CASTER_LIMITS = "icheat:casterLimits"
ANCHOR = "icheat:anchor"
FILE_PATH = "icheat:filePath"
PAYLOAD = "icheat:payload"
KEY_INTERPOLATION = "icheat:keyInterpolation"
RECEIVERS = "icheatReceivers"
CASTERS = "icheatCasters"

RULE = "icheat:rule"
PARTS = "icheat:parts"
SOFTNESS = "icheat:softness"

STACK_ENABLED = "icheat:stackEnabled"
EDITS = "icheat:edits"
CAMERA = "icheat:camera"

_PREFIX = "icheat:"


@dataclass(frozen=True)
class PropertySchema:
    """One property as a schema declares it."""

    name: str
    type_name: Sdf.ValueTypeName | None  #: None for a relationship
    fallback: Any = None
    doc: str = ""


@dataclass(frozen=True)
class OperationSchema:
    """The applied schema that holds an operation's parameters."""

    name: str
    api_schema: str
    parameters: MappingProxyType[str, PropertySchema]  #: by parameter name


def time_code(time: float | None) -> Usd.TimeCode:
    """The time code to read at: without a time the earliest, as an attribute may have time samples alone."""
    return Usd.TimeCode.EarliestTime() if time is None else Usd.TimeCode(time)


def time_to_write(time: float | None) -> Usd.TimeCode:
    """The time code to author at, without a time the default.

    Raises
    ------
    EditError
        It is not finite: USD would author the default for "nan", which nobody meant.
    """
    if time is not None and not math.isfinite(time):
        raise EditError(f"{time} is no time to author at; give a number such as 24 or 12.5")
    return Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)


def default_time(stage: Usd.Stage, time: float | None) -> float | None:
    """`time`, else the stage's authored start, as for snapshots; None where it has neither."""
    if time is None and stage.HasAuthoredMetadata("startTimeCode"):
        return float(stage.GetStartTimeCode())
    return time


@cache
def packaged_schemas() -> MappingProxyType[str, MappingProxyType[str, PropertySchema]]:
    """Properties of each schema in generatedSchema.usda, read as data: schema name to property name."""
    path = str(resource_path("schemas/usd/generatedSchema.usda"))
    layer = Sdf.Layer.FindOrOpen(path)
    if not layer:
        raise EditError(f"{path} cannot be read; reinstall icheat-usd")
    schemas = {}
    for prim in layer.rootPrims:
        properties = {}
        for spec in prim.properties:
            is_attribute = isinstance(spec, Sdf.AttributeSpec)
            properties[spec.name] = PropertySchema(
                spec.name,
                spec.typeName if is_attribute else None,
                spec.default if is_attribute else None,
                spec.customData.get("userDocBrief", ""),
            )
        schemas[prim.name] = MappingProxyType(properties)
    return MappingProxyType(schemas)


def is_registered() -> bool:
    """Whether this process's schema registry knows our schemas. Builds the registry; never call it on import."""
    return Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(EDIT_API) is not None


def require_registered() -> None:
    """Check that schemas can be applied.

    Raises
    ------
    EditError
        The host composed a stage before the plug-in was announced.
    """
    if not is_registered():
        raise EditError(
            "edits cannot be authored here, because USD started before it could find icheat's schemas: add the "
            "output of `icheat plugin-path` to PXR_PLUGINPATH_NAME and restart the application (reading works)"
        )


def has_schema(prim: Usd.Prim, name: str) -> bool:
    """Whether the schema is applied to `prim`, registered or not."""
    if not prim:
        return False
    authored = prim.GetPrimTypeInfo().GetAppliedAPISchemas()
    # The second list also has what other schemas bring along; most prims have neither, and it is slower to get.
    return name in authored or (bool(authored) and name in prim.GetAppliedSchemas())


def fallback(property_name: str) -> Any:
    """The packaged fallback of one of our properties, None where it has none."""
    for properties in packaged_schemas().values():
        if property_name in properties:
            return properties[property_name].fallback
    return None


def read_attribute(prim: Usd.Prim, name: str, time: float | None) -> Any:
    """The composed value, else the packaged fallback; a blocked value falls back too."""
    attribute = prim.GetAttribute(name)
    value = attribute.Get(time_code(time)) if attribute else None
    return fallback(name) if value is None else value


def operations() -> dict[str, OperationSchema]:
    """Every operation whose schema is known, by name: the packaged ones and those of registered plug-ins.

    A schema belongs to operation ``x`` when all of its ``icheat:`` attributes are called ``icheat:x:<parameter>``.
    """
    found = dict(_packaged_operations())
    for name, operation in _registry_operations().items():
        found.setdefault(name, operation)
    return found


@cache
def _packaged_operations() -> MappingProxyType[str, OperationSchema]:
    found = (_as_operation(schema, properties.values()) for schema, properties in packaged_schemas().items())
    return MappingProxyType({operation.name: operation for operation in found if operation})


@cache
def _registry_operations() -> MappingProxyType[str, OperationSchema]:
    registry = Usd.SchemaRegistry()
    found = {}
    for schema_type in Tf.Type.FindByName("UsdAPISchemaBase").GetAllDerivedTypes():
        name = registry.GetAPISchemaTypeName(schema_type)
        definition = registry.FindAppliedAPIPrimDefinition(name) if name else None
        if definition is None:
            continue
        names = [n for n in definition.GetPropertyNames() if n.startswith(_PREFIX)]
        properties = []
        for property_name in names:
            attribute = definition.GetAttributeDefinition(property_name)
            if attribute:
                # No sentence: USD drops a schema's documentation when it composes definitions.
                properties.append(PropertySchema(property_name, attribute.GetTypeName(), attribute.GetFallbackValue()))
        operation = _as_operation(name, properties)
        if operation:
            found[operation.name] = operation
    return MappingProxyType(found)


def _as_operation(schema: str, properties: Iterable[PropertySchema]) -> OperationSchema | None:
    parts = [(p.name.split(":"), p) for p in properties if p.name.startswith(_PREFIX)]
    names = {pieces[1] for pieces, _ in parts}
    if len(names) != 1 or any(len(pieces) != 3 or p.type_name is None for pieces, p in parts):
        return None
    return OperationSchema(names.pop(), schema, MappingProxyType({pieces[2]: p for pieces, p in parts}))


def to_value(value: Any) -> Value | None:
    """A USD value as the edit model keeps it; None for types that it has no form for."""
    if isinstance(value, (bool, int, float, str)):
        return float(value) if isinstance(value, int) and not isinstance(value, bool) else value
    if isinstance(value, Sdf.AssetPath):
        return str(value.resolvedPath or value.path)
    try:
        return tuple(float(component) for component in value)
    except TypeError:
        return None
