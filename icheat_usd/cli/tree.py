"""Show the composed stack: every edit in order, what it does to what, how, and which layer says so.

One line says name, operation, amount at the frame, encoding, size of the
payloads, and what keeps the edit from acting or makes it stale. The scene
itself is read only where a baked payload depends on it.
"""

from __future__ import annotations

import argparse
import os
from typing import Any

from icheat_usd.cli.options import (
    add_frame,
    add_json,
    add_stack,
    add_stage,
    add_variant,
    aligned,
    file_size,
    print_json,
)
from icheat_usd.errors import EditError


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    add_stack(parser)
    parser.add_argument("--camera", metavar="PRIM", help="camera whose stack is meant")
    add_variant(parser, "look at")
    add_frame(parser)
    parser.add_argument("--quick", action="store_true", help="do not compare baked payloads with the scene")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import inspection
    from icheat_usd.session.payload_states import encoding, payload_states
    from icheat_usd.stage.variants import selected_variant

    stage = inspection.open_stage(options.stage)
    path = inspection.find_stack(stage, options.stack, options.camera)
    if path is None:
        raise EditError(f"{options.stage} has no edit stack; make one with `icheat stack create`")
    with selected_variant(stage, path, options.variant):
        stack = inspection.describe_stack(stage, path, options.frame)
        states = payload_states(stage, list(stack.edits), options.frame, scene=not options.quick)
    encodings = {edit.path: encoding(edit, states[edit.path]) for edit in stack.edits}
    if options.json:
        edits = [
            edit_as_json(edit) | _payloads_as_json(encodings[edit.path], states[edit.path]) for edit in stack.edits
        ]
        removed = [{"path": r.path, "listedBy": r.layer, "removedBy": r.removed_by} for r in stack.removed]
        content = {"stage": options.stage, "stack": stack.path, "enabled": stack.enabled}
        content |= {"cameras": list(stack.cameras), "edits": edits, "missing": list(stack.missing)}
        print_json(content | {"removed": removed})
        return 0
    notes = [*(f"for {camera}" for camera in stack.cameras), *([] if stack.enabled else ["off"])]
    print(stack.path + (f"  ({', '.join(notes)})" if notes else ""))
    heads = aligned([_head(edit, encodings[edit.path], states[edit.path]) for edit in stack.edits])
    blocks = [[head, *_details(edit, states[edit.path])] for head, edit in zip(heads, stack.edits, strict=True)]
    blocks += [[f"{name}  (missing)"] for name in stack.missing]
    blocks += [[f"{r.path.rpartition('/')[2]}  (removed by {os.path.basename(r.removed_by)})"] for r in stack.removed]
    for index, lines in enumerate(blocks):
        last = index == len(blocks) - 1
        print(("└─ " if last else "├─ ") + lines[0])
        for line in lines[1:]:
            print(("      " if last else "│     ") + line)
    return 0


def _head(edit: Any, how: str, states: Any) -> list[str]:
    size = sum(state.stored_bytes for state in {state.digest: state for state in states}.values())
    notes = [*_notes(edit), *(["STALE"] if any(state.stale for state in states) else [])]
    name, operation = edit.path.rpartition("/")[2], str(edit.operation.value)
    amount = f"amount {_text(edit.amount.value)}"
    return [name, operation, amount, how, file_size(size) if size else "-", " ".join(notes)]


def _payloads_as_json(how: str, states: Any) -> dict[str, Any]:
    payloads = [
        {
            "time": state.time,
            "digest": state.digest,
            "file": state.file,
            "parameters": dict(state.parameters),
            "elements": list(state.elements),
            "storedBytes": state.stored_bytes,
            "stale": list(state.stale),
            "notes": list(state.notes),
            "problem": state.problem,
        }
        for state in states
    ]
    return {"encoding": how, "stale": any(state.stale for state in states), "payloads": payloads}


def edit_summary(edit: Any) -> tuple[str, str, str]:
    """Cells of one line: name; operation; parameters, amount, and what keeps it from acting."""
    parts = [f"{name}={_text(value.value)}" for name, value in sorted(edit.parameters.items()) if value.layer]
    if edit.amount.value != 1.0:
        parts.append(f"amount={_text(edit.amount.value)}")
    return edit.path.rpartition("/")[2], str(edit.operation.value), "  ".join([*parts, *_notes(edit)])


def _notes(edit: Any) -> list[str]:
    notes = [f"blend={edit.blend.value}"] if edit.blend.value != "compose" else []
    notes += ["(muted)"] if edit.enabled.value is False else []
    return notes + (["(inactive)"] if not edit.is_active else [])


def _details(edit: Any, states: Any) -> list[str]:
    lines = []
    for side in ("receivers", "casters"):
        members = [*getattr(edit, side), getattr(edit, f"{side}_expression")]
        excluded = getattr(edit, f"{side}_excluded")
        shown = " ".join(filter(None, members)) or "nothing"
        limits = getattr(edit, f"{side[:-1]}_limits")
        without = f"  without {' '.join(excluded)}" if excluded else ""
        lines.append(f"{side}: {shown}{without}" + (f"  within {' '.join(limits)}" if limits else ""))
    for name, paths in (("lights", edit.lights), ("target", [edit.target]), ("occluders", edit.occluders)):
        lines += [f"{name}: {' '.join(paths)}"] if any(paths) else []
    opinions = {"operation": edit.operation, "amount": edit.amount, "blend": edit.blend, "enabled": edit.enabled}
    said = [(name, value) for name, value in (opinions | dict(edit.parameters)).items() if value.layer]
    for layer in edit.layers:
        names = [f"{name}={_text(value.value)}" for name, value in said if value.layer == layer]
        lines.append(f"{os.path.basename(layer)}: {', '.join(names) or 'no deciding values'}")
    for state in states:
        at = "always" if state.time is None else f"at {state.time:g}"
        if not state.digest:
            lines.append(f"payload {at}: none, the identity")
        else:
            held = f"  ({', '.join(state.elements)})" if state.elements else ""
            values = "".join(f"{name}={_text(value)}, " for name, value in state.parameters.items())
            lines.append(f"payload {at}: {values}{state.digest[:12]} in {os.path.basename(state.file)}{held}")
        lines += [f"  stale: {reason}" for reason in state.stale]
        lines += [f"  note: {note}" for note in state.notes]
        lines += [f"  problem: {state.problem}"] if state.problem else []
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
