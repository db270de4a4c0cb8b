"""Rules about stacks and what they list."""

from __future__ import annotations

from pxr import Usd

from icheat_usd.stage import schema
from icheat_usd.stage.check.rule import Context, Found, Rule
from icheat_usd.stage.list_edits import dropped_targets, listings
from icheat_usd.stage.stacks import Severity, listed_edits


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
        for prim in dict.fromkeys((*context.stacks, *context.edits, *context.selections)):
            for name in [r.GetName() for r in prim.GetRelationships() if "icheat" in r.GetName()]:
                for target, layer in dropped_targets(prim, name):
                    where = f"{target} in {layer}"
                    yield prim, name, f"{where} lies outside what is referenced and is dropped; move it in"


def _taken_out(stacks: tuple[Usd.Prim, ...]) -> frozenset[str]:
    """Edits that some layer takes out of a stack."""
    return frozenset(listing.path for stack in stacks for listing in listings(stack) if listing.removed_by)
