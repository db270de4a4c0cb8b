"""Show the composed stack: every edit in order, its values, and which layer says so."""

from __future__ import annotations

import argparse
import os
from typing import Any

from icheat_usd.cli.options import add_frame, add_json, add_stack, add_stage, print_json
from icheat_usd.errors import EditError


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    add_stack(parser)
    parser.add_argument("--camera", metavar="PRIM", help="camera whose stack is meant")
    add_frame(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import inspection

    stage = inspection.open_stage(options.stage)
    path = inspection.find_stack(stage, options.stack, options.camera)
    if path is None:
        raise EditError(f"{options.stage} has no edit stack; make one with `icheat stack create`")
    stack = inspection.describe_stack(stage, path, options.frame)
    if options.json:
        content = {"stage": options.stage, "stack": stack.path, "enabled": stack.enabled}
        edits = [edit_as_json(edit) for edit in stack.edits]
        removed = [{"path": r.path, "listedBy": r.layer, "removedBy": r.removed_by} for r in stack.removed]
        content |= {"cameras": list(stack.cameras), "edits": edits, "missing": list(stack.missing)}
        print_json(content | {"removed": removed})
        return 0
    notes = [*(f"for {camera}" for camera in stack.cameras), *([] if stack.enabled else ["off"])]
    print(stack.path + (f"  ({', '.join(notes)})" if notes else ""))
    blocks = [_block(edit) for edit in stack.edits] + [[f"{name}  (missing)"] for name in stack.missing]
    blocks += [[f"{r.path.rpartition('/')[2]}  (removed by {os.path.basename(r.removed_by)})"] for r in stack.removed]
    for index, lines in enumerate(blocks):
        last = index == len(blocks) - 1
        print(("└─ " if last else "├─ ") + lines[0])
        for line in lines[1:]:
            print(("      " if last else "│     ") + line)
    return 0


def edit_summary(edit: Any) -> str:
    """One line: name, operation, parameters, amount, and what keeps it from acting."""
    parts = [edit.path.rpartition("/")[2], str(edit.operation.value)]
    parts += [f"{name}={_text(value.value)}" for name, value in sorted(edit.parameters.items()) if value.layer]
    if edit.amount.value != 1.0:
        parts.append(f"amount={_text(edit.amount.value)}")
    if edit.blend.value != "compose":
        parts.append(f"blend={edit.blend.value}")
    if edit.enabled.value is False:
        parts.append("(muted)")
    if not edit.is_active:
        parts.append("(inactive)")
    return "  ".join(parts)


def _block(edit: Any) -> list[str]:
    lines = [edit_summary(edit)]
    for side in ("receivers", "casters"):
        members = [*getattr(edit, side), getattr(edit, f"{side}_expression")]
        excluded = getattr(edit, f"{side}_excluded")
        shown = " ".join(filter(None, members)) or "nothing"
        lines.append(f"{side}: {shown}" + (f"  without {' '.join(excluded)}" if excluded else ""))
    opinions = {"operation": edit.operation, "amount": edit.amount, "blend": edit.blend, "enabled": edit.enabled}
    said = [(name, value) for name, value in (opinions | dict(edit.parameters)).items() if value.layer]
    for layer in edit.layers:
        names = [f"{name}={_text(value.value)}" for name, value in said if value.layer == layer]
        lines.append(f"{os.path.basename(layer)}: {', '.join(names) or 'no deciding values'}")
    if edit.key_times:
        lines.append("keys: " + " ".join(f"{time:g}" for time in edit.key_times))
    if edit.payload_digest:
        lines.append(f"payload: {edit.payload_digest[:12]} in {os.path.basename(edit.file)}")
    if edit.problem:
        lines.append(f"problem: {edit.problem}")
    return lines


def edit_as_json(edit: Any) -> dict[str, Any]:
    def described(value: Any) -> dict[str, Any]:
        return {"value": value.value, "layer": value.layer, "source": value.source}

    return {
        "path": edit.path,
        "active": edit.is_active,
        "enabled": described(edit.enabled),
        "operation": described(edit.operation),
        "amount": described(edit.amount),
        "blend": described(edit.blend),
        "parameters": {name: described(value) for name, value in edit.parameters.items()},
        "receivers": {
            "includes": list(edit.receivers),
            "excludes": list(edit.receivers_excluded),
            "expression": edit.receivers_expression,
        },
        "casters": {
            "includes": list(edit.casters),
            "excludes": list(edit.casters_excluded),
            "expression": edit.casters_expression,
        },
        "receiverLimits": list(edit.receiver_limits),
        "casterLimits": list(edit.caster_limits),
        "occluders": list(edit.occluders),
        "lights": list(edit.lights),
        "target": edit.target,
        "anchor": edit.anchor,
        "keyTimes": list(edit.key_times),
        "file": edit.file,
        "payload": edit.payload_digest,
        "listedBy": edit.listed_by,
        "layers": list(edit.layers),
        "problem": edit.problem,
    }


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return "(" + ", ".join(f"{number:g}" for number in value) + ")"
    return f"{value:g}" if isinstance(value, float) else str(value)
