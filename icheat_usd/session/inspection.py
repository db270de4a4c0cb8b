"""What a stage's edits are and what is wrong with them, without rendering anything."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from icheat_usd.scene import Finding
from icheat_usd.session.authoring import read_payload
from icheat_usd.session.products import product_findings
from icheat_usd.stage import open_stage, schema
from icheat_usd.stage.camera import named_settings_findings
from icheat_usd.stage.check import RULES, Context, check_stage, findings_of
from icheat_usd.stage.check.selections import EmptySelection, UnshadowWithoutOccluders
from icheat_usd.stage.description import EditDescription, describe_edit
from icheat_usd.stage.list_edits import Listing, listings
from icheat_usd.stage.opening import composition_findings
from icheat_usd.stage.refusals import named_refusals
from icheat_usd.stage.stacks import edit_prim, find_stack, stack_prim, stack_prims
from icheat_usd.stage.variants import selected_variant


@dataclass(frozen=True)
class StackDescription:
    """A stack as composed: its edits in the order in which they apply, inactive ones included."""

    path: str
    enabled: bool
    cameras: tuple[str, ...]
    edits: tuple[EditDescription, ...]
    missing: tuple[str, ...]  #: targets that do not exist or are no edits
    removed: tuple[Listing, ...] = ()  #: what one layer lists and a stronger one takes out


@named_refusals
def describe_stacks(stage: Any, frame: float | None = None) -> tuple[StackDescription, ...]:
    """Every stack on the stage, in order of traversal."""
    return tuple(describe_stack(stage, str(prim.GetPath()), frame) for prim in stack_prims(stage))


@named_refusals
def describe_stack(stage: Any, path: str, frame: float | None = None) -> StackDescription:
    """One stack at a time.

    Raises
    ------
    EditError
        There is no stack at `path`.
    """
    prim = stack_prim(stage, path)
    edits, missing = [], []
    relationship = prim.GetRelationship(schema.EDITS)
    for target in relationship.GetTargets() if relationship else ():
        edit = stage.GetPrimAtPath(target)
        if not edit or (edit.IsActive() and not schema.has_schema(edit, schema.EDIT_API)):
            missing.append(str(target))
        else:
            edits.append(describe_edit(stage, str(target), frame, prim))
    cameras = prim.GetRelationship(schema.CAMERA)
    return StackDescription(
        path=str(prim.GetPath()),
        enabled=bool(schema.read_attribute(prim, schema.STACK_ENABLED, frame)),
        cameras=tuple(str(camera) for camera in cameras.GetTargets()) if cameras else (),
        edits=tuple(edits),
        missing=tuple(missing),
        removed=tuple(listing for listing in listings(prim) if listing.removed_by),
    )


def check(stage: Any, frame: float | None = None) -> tuple[Finding, ...]:
    """Everything wrong with a stage's composition, its edits and its render products; every payload is read."""
    settings = (*named_settings_findings(stage), *product_findings(stage, frame))
    return (*composition_findings(stage), *settings, *check_stage(stage, frame, read_payload))


def included(stage: Any, edit: str, side: str, variant: tuple[str, str] | None = None) -> tuple[tuple[str, ...], str]:
    """Paths that the "receivers" or "casters" of an edit, maybe one of a variant, include, and their expression."""
    with selected_variant(stage, edit, variant):
        described = describe_edit(stage, edit)
        return tuple(getattr(described, side)), str(getattr(described, f"{side}_expression"))


def idle_edit(stage: Any, edit: str, variant: tuple[str, str] | None = None) -> tuple[Finding, ...]:
    """What an edit, maybe one of a variant, still lacks before it can do anything; no payload is read."""
    rules = [rule for rule in RULES if isinstance(rule, (EmptySelection, UnshadowWithoutOccluders))]
    with selected_variant(stage, edit, variant):
        context = Context(stage, schema.default_time(stage, None), (), (edit_prim(stage, edit),), ())
        return tuple(finding for rule in rules for finding in findings_of(rule, context))


class RuleDescription(NamedTuple):
    """One rule of `check`."""

    name: str
    severity: str
    doc: str  #: what holds on a good stage


def check_rules() -> tuple[RuleDescription, ...]:
    """Every rule, in the order in which `check` applies them."""
    return tuple(RuleDescription(type(rule).__name__, rule.severity.value, rule.doc) for rule in RULES)


__all__ = [
    "RuleDescription",
    "check_rules",
    "StackDescription",
    "check",
    "describe_stack",
    "describe_stacks",
    "find_stack",
    "open_stage",
]
