"""Read a composed stage into plain data; run here, and in a host that composed before it heard of the schemas."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd

from icheat_usd.edits.model import EditStack, Payload
from icheat_usd.sidecar import read_payload
from icheat_usd.stage import schema
from icheat_usd.stage.check import check_stage
from icheat_usd.stage.description import describe_edit
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.list_edits import listings
from icheat_usd.stage.stacks import find_stack, stack_prim


def read_sidecar(file: str, source: str | bytes, digest: str, anchor: str) -> Payload:
    return read_payload(source, digest, anchor=anchor, name=file)


def open_case(opened: dict[str, Any]) -> Usd.Stage:
    """The stage, with its session layer and muted layers."""
    root = Sdf.Layer.FindOrOpen(opened["root"])
    if opened["session"]:
        session = Sdf.Layer.CreateAnonymous("session.usda")
        session.TransferContent(Sdf.Layer.FindOrOpen(opened["session"]))
        stage = Usd.Stage.Open(root, session)
    else:
        stage = Usd.Stage.Open(root)
    for layer in opened["muted"]:
        stage.MuteLayer(layer)
    return stage


def read_stack(stage: Usd.Stage, opened: dict[str, Any]) -> EditStack:
    return read_edit_stack(stage, opened["stack"], opened["time"], opened["surfaces"], read_sidecar)[0]


def stack_values(stack: EditStack) -> list[Any]:
    """All that a stack says, muted edits too, without names of files."""
    return [
        [
            edit.name,
            edit.operation,
            dict(sorted(edit.parameters.items())),
            [sorted(edit.receivers.paths), repr(edit.receivers.limits)],
            [sorted(edit.casters.paths), repr(edit.casters.limits)],
            [edit.amount, edit.blend.value, edit.enabled],
            [[key.digest, key.weight] for key in edit.keys],
            [list(edit.occluders), list(edit.lights), edit.target],
        ]
        for edit in stack.edits
    ]


def provenance(stage: Usd.Stage, opened: dict[str, Any]) -> dict[str, dict[str, str]]:
    """File names of the layers that decide each value, list each edit, and take edits out."""

    def name(identifier: str) -> str:
        return Path(identifier.rstrip("]").rpartition("[")[2]).name.rpartition(":")[2] if identifier else ""

    found = {"removed": {}, "winners": {}}  # type: dict[str, dict[str, str]]
    for listing in listings(stack_prim(stage, opened["stack"])):
        edit = listing.path.rpartition("/")[2]
        if listing.removed_by:
            found["removed"][edit] = name(listing.removed_by)
            continue
        if not stage.GetPrimAtPath(listing.path):
            continue  # What USD flattens has no inactive prims, but still their names.
        told = describe_edit(stage, listing.path, opened["time"])
        assert told.listed_by == listing.layer
        values = {"amount": told.amount, "enabled": told.enabled, "operation": told.operation, "blend": told.blend}
        values |= dict(told.parameters)
        found["winners"] |= {f"{edit}.{key}": name(value.layer) for key, value in values.items()}
        found["winners"] |= {f"{edit}.{key}.source": value.source for key, value in values.items()}
        found["winners"][f"{edit}.listed"] = name(told.listed_by)
        found["winners"][f"{edit}.keys"] = name(told.keys.layer) if told.keys else ""
    return found


def read_case(opened: dict[str, Any]) -> dict[str, Any]:
    """Everything there is to compare, as JSON says it."""
    stage = open_case(opened)
    stack = read_stack(stage, opened)
    return {
        "registered": schema.is_registered(),
        "found": find_stack(stage),
        "digest": stack.digest,
        "enabled": stack.enabled,
        "edits": json.loads(json.dumps(stack_values(stack))),
        "checked": sorted(
            [finding.rule, finding.prim, finding.message]
            for finding in check_stage(stage, opened["time"], read_sidecar)
            if finding.rule != "SchemasNotRegistered"
        ),
        **provenance(stage, opened),
    }


def main() -> None:
    print(json.dumps([read_case(opened) for opened in json.load(sys.stdin)]))
