"""Say which payloads an edit has had: when, from whom, why, and in which file.

Also those of versions that nothing names any more, as long as their files
exist beside the layers or in the trash.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

from icheat_usd.cli.options import add_json, add_stack, add_stage, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    parser.add_argument("edit", metavar="EDIT", help="its name or prim path")
    add_stack(parser)
    parser.add_argument("--camera", metavar="PRIM", help="camera whose stack is meant")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit
    from icheat_usd.session import inspection, payload_history

    stage = inspection.open_stage(options.stage)
    _, edit = named_edit(stage, options)
    events, problems = payload_history.edit_history(stage, edit)
    if options.json:
        print_json({"edit": edit, "events": [asdict(event) for event in events], "problems": problems})
        return 1 if problems else 0
    print(as_text(events))
    for problem in problems:
        print(f"problem: {problem}")
    return 1 if problems else 0


def as_text(events: object) -> str:
    """One line per payload that was written; a star marks those that are named now."""
    lines = []
    for event in events:  # type: ignore[attr-defined]
        said = "  ".join(part for part in (event.when or "(no date)", event.who, event.edit, event.why) if part)
        keys = f"  named at {', '.join(event.keys)}" if event.keys else ""
        line = f"{'*' if event.keys else ' '} {event.payload[:12]}  {said}  {event.file}{keys}"
        lines.append("".join(c if c.isprintable() else "?" for c in line))
    return "\n".join(lines) or "no history"
