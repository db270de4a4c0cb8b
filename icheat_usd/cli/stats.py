"""Count edits, keys and payloads of a stage, and say how large they are.

All edits count, whether a stack lists them or not. Payloads that this stage
does not use may be used by other shots; `icheat gc` finds those that nobody uses.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import Any

from icheat_usd.cli.options import add_frame, add_json, add_stage, aligned, file_size, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    add_stage(parser)
    add_frame(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import inspection
    from icheat_usd.session.statistics import statistics

    found = statistics(inspection.open_stage(options.stage), options.frame)
    if options.json:
        print_json({"stage": options.stage, **_as_json(found)})
    else:
        print("\n".join(_lines(found)))
    return 1 if found.problems else 0


def _as_json(found: Any) -> dict[str, Any]:
    def camel(name: str) -> str:
        first, *rest = name.split("_")
        return first + "".join(word.title() for word in rest)

    content = {camel(name): value for name, value in asdict(found).items()}
    return content | {"sidecars": [{camel(k): v for k, v in sidecar.items()} for sidecar in content["sidecars"]]}


def _lines(found: Any) -> list[str]:
    operations = ", ".join(f"{n} {name}" for name, n in found.operations.items())
    notes = ", ".join(f"{n} {what}" for n, what in ((found.muted, "muted"), (found.unlisted, "in no stack")) if n)
    rows = [
        ["stacks", str(found.stacks)],
        ["edits", f"{found.edits}" + (f"  ({operations})" if operations else "") + (f"  {notes}" if notes else "")],
        ["keys", str(found.keys)],
        ["payloads", f"{found.payloads}  ({file_size(sum(s.payload_bytes for s in found.sidecars))} stored)"],
    ]
    if found.painted_surfaces:
        share = 100.0 * found.painted_texels / max(found.texels, 1)
        surfaces = f"{found.painted_surfaces} surface{'s' * (found.painted_surfaces != 1)}"
        rows.append(["painted", f"{surfaces}, {found.texels:,} texels, {share:.0f} % above 0"])
    if found.rows:
        rows.append(["sampled rows", f"{found.rows:,}"])
    lines = aligned(rows)
    for sidecar in found.sidecars:
        unused = sidecar.payloads - sidecar.used
        about = f"{sidecar.used} payload{'s' * (sidecar.used != 1)}"
        about = f"{sidecar.used} of {sidecar.payloads} payloads used here" if unused else about
        lines.append(f"{sidecar.file}  {file_size(sidecar.file_bytes)}, {about}")
    return [*lines, *(f"problem: {problem}" for problem in found.problems)]
