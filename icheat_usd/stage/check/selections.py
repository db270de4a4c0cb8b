"""Rules about what edits select and aim at."""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Sdf, Usd, UsdGeom, UsdLux

from icheat_usd.edits import operations
from icheat_usd.errors import EditError
from icheat_usd.stage import collections, schema
from icheat_usd.stage.check.rule import Context, Found, Rule
from icheat_usd.stage.selections import read_region
from icheat_usd.stage.stacks import Severity, targets

_LIMITS = (schema.RECEIVER_LIMITS, schema.CASTER_LIMITS)


class EmptySelection(Rule):
    doc = "Receivers and casters include something."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for name in (schema.RECEIVERS, schema.CASTERS):
                selected = collections.collection(prim, name)
                if selected.HasNoIncludedPaths():
                    yield prim, name, "selects nothing, so the edit does nothing; include prims"
                    continue
                expression = collections.authored(prim, name)[2]
                if expression and not _matches_anything(prim, name):
                    yield prim, name, f"no prim matches '{expression}', so the edit does nothing; change the expression"


def _matches_anything(edit: Usd.Prim, name: str) -> bool:
    everything = Usd.PrimRange(edit.GetStage().GetPseudoRoot(), Usd.TraverseInstanceProxies())
    try:
        return bool(collections.select(edit, name, (str(prim.GetPath()) for prim in everything)).paths)
    except EditError:
        return True  # What USD cannot evaluate is named where the edits are read.


class SelectedPrimMissing(Rule):
    doc = "What a selection, limit, anchor, light, target or occluder names exists."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in (*context.edits, *context.selections):
            for relationship in prim.GetRelationships():
                if "icheat" not in relationship.GetName():
                    continue
                for path in relationship.GetTargets():
                    if not context.stage.GetObjectAtPath(path) and not context.stage.GetPrimAtPath(path.GetPrimPath()):
                        yield prim, relationship.GetName(), f"{path} does not exist; rename or remove it"


class SelectionInCircle(Rule):
    doc = "No part of a selection contains the selection itself."

    def find(self, context: Context) -> Found:
        for prim in context.selections:
            circle = _circle(context.stage, prim.GetPath())
            if circle:
                names = " -> ".join(map(str, circle))
                yield prim, schema.PARTS, f"leads in a circle: {names}; take one of these out"


class RegionIsRendered(Rule):
    doc = "A shape that an edit uses as a region is not rendered itself."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in _regions(context):
            imageable = UsdGeom.Imageable(prim)
            hidden = imageable.ComputeVisibility(schema.time_code(context.time)) == UsdGeom.Tokens.invisible
            if not hidden and imageable.ComputePurpose() in (UsdGeom.Tokens.default_, UsdGeom.Tokens.render):
                yield prim, "purpose", "edits use it as a region, and it shows in renders; set its purpose to guide"


class RegionWithoutSpace(Rule):
    doc = "A region has a volume, and a softness from 0 to 1."

    def find(self, context: Context) -> Found:
        for prim in _regions(context):
            try:
                read_region(prim, context.time)
            except EditError as error:
                yield prim, "", str(error).partition(": ")[2]


class UnshadowWithoutOccluders(Rule):
    doc = "An edit that lets light pass through prims names these."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            name = schema.read_attribute(prim, schema.OPERATION, context.time)
            operation = operations.find(name)
            if operation is not None and operation.has_through and not targets(prim, schema.OCCLUDERS):
                yield (
                    prim,
                    schema.OCCLUDERS,
                    f"'{name}' lets light pass its occluders, and has none; name some",
                )


class LightsWithoutEffect(Rule):
    doc = "Lights narrow an edit whose operation can tell them apart."
    severity = Severity.WARNING

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            name = schema.read_attribute(prim, schema.OPERATION, context.time)
            operation = operations.find(name)
            if operation is not None and operation.level is operations.Level.VIEW and targets(prim, schema.LIGHTS):
                message = f"'{name}' acts on all light of its receivers, whichever lights it is from; remove the lights"
                yield prim, schema.LIGHTS, message


class SeveralTargets(Rule):
    doc = "An edit aims at one prim at most."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            found = targets(prim, schema.TARGET)
            if len(found) > 1:
                yield prim, schema.TARGET, f"has {len(found)} targets, expected one: {', '.join(found)}"


class LightIsNoLight(Rule):
    doc = "What an edit names as a light is one, or can be one."

    def find(self, context: Context) -> Found:
        for prim in context.edits:
            for path in targets(prim, schema.LIGHTS):
                target = context.stage.GetPrimAtPath(path)
                below = Usd.PrimRange(target, Usd.TraverseInstanceProxies()) if target else ()
                if target and not any(p.HasAPI(UsdLux.LightAPI) or p.IsA(UsdGeom.Gprim) for p in below):
                    yield prim, schema.LIGHTS, f"{path} is no light, so the edit cannot be rendered; name lights"


def _limit_targets(context: Context) -> Iterator[Sdf.Path]:
    for prim in context.edits:
        for name in _LIMITS:
            yield from map(Sdf.Path, targets(prim, name))
    for prim in context.selections:
        yield from map(Sdf.Path, targets(prim, schema.PARTS))


def _regions(context: Context) -> list[Usd.Prim]:
    """Cubes and spheres that edits select the space of."""
    paths = dict.fromkeys(path for path in _limit_targets(context) if path.IsPrimPath())
    prims = [context.stage.GetPrimAtPath(path) for path in paths]
    shapes = (UsdGeom.Cube, UsdGeom.Sphere)
    return [prim for prim in prims if prim and prim.IsActive() and any(prim.IsA(shape) for shape in shapes)]


def _circle(stage: Usd.Stage, start: Sdf.Path) -> tuple[Sdf.Path, ...]:
    """A way over parts from a selection back to itself, () if there is none."""
    seen: set[Sdf.Path] = set()
    waiting: list[tuple[Sdf.Path, ...]] = [(start,)]
    while waiting:
        way = waiting.pop()
        for part in map(Sdf.Path, targets(stage.GetPrimAtPath(way[-1]), schema.PARTS)):
            if part == start:
                return (*way, part)
            if (
                part not in seen
                and part.IsPrimPath()
                and schema.has_schema(stage.GetPrimAtPath(part), schema.SELECTION_API)
            ):
                seen.add(part)
                waiting.append((*way, part))
    return ()
