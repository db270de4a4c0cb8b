"""Author keyframes of an edit: set, list, copy and remove.

icheat key set shot.usda warmFace --frame 10 --set gain=2 --interpolation smooth
icheat key copy shot.usda warmFace --from 10 --frame 30
icheat key list shot.usda warmFace
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from icheat_usd.cli.edit import sphere
from icheat_usd.cli.options import (
    add_json,
    add_layer,
    add_stack,
    add_stage,
    add_variant,
    add_why,
    assignment,
    finding_as_json,
    finding_as_text,
    print_json,
    time_code,
    why,
)


def setup_parser(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)

    make = _verb(verbs, "set", "set a key: what is not given is as it is at that frame", set_command, "time of the key")
    make.add_argument(
        "--set",
        action="append",
        type=assignment,
        metavar="NAME=VALUE",
        help="value of a parameter at this key, such as gain=0.5 or color=1.2,1,0.8; may be given several times",
    )
    for side in ("receiver", "caster"):
        make.add_argument(
            f"--{side}-sphere",
            type=sphere,
            metavar="X,Y,Z,INNER,OUTER",
            help=f"paint the {side}s anew: full within INNER of the point, none beyond OUTER; metres, stage axes",
        )
    make.add_argument("--always", action="store_true", help="one payload for all times, in place of every key")
    make.add_argument("--identity", action="store_true", help="let the edit do nothing at this key")
    make.add_argument(
        "--interpolation",
        choices=("linear", "smooth", "held"),
        help="between all keys of the edit; without --frame only this is set",
    )
    make.add_argument(
        "--sidecar", metavar="FILE", help="folder or .icheat.h5 file for the payload; default by the layer"
    )
    add_why(make)

    copy = _verb(verbs, "copy", "let a key's payload hold at another frame too", copy_command, "time of the new key")
    copy.add_argument(
        "--from", dest="source", type=time_code, required=True, metavar="T", help="time of the key to copy"
    )

    _verb(verbs, "remove", "take a key out; the only key stays", remove_command, "time of the key")
    _verb(verbs, "list", "list the keys, and which layer decides them", list_command)


def _verb(
    verbs: Any, name: str, doc: str, command: Callable[[argparse.Namespace], int], frame: str = ""
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=doc, description=doc[0].upper() + doc[1:] + ".")
    add_stage(parser)
    parser.add_argument("edit", metavar="EDIT", help="its name or prim path")
    add_stack(parser)
    parser.add_argument("--camera", metavar="PRIM", help="camera whose stack is meant")
    if frame:
        add_layer(parser)
    add_variant(parser, "write into" if frame else "look at")
    if frame:
        parser.add_argument("--frame", type=time_code, required=name != "set", metavar="T", help=frame)
    add_json(parser)
    parser.set_defaults(command=command)
    return parser


def set_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.errors import EditError
    from icheat_usd.session import keys

    stage, layer = open_for_writing(options)
    _, edit = named_edit(stage, options)
    spheres = {side: getattr(options, f"{side}_sphere") for side in ("receiver", "caster")}
    if options.always and options.frame is not None:
        raise EditError("--always is for all times and --frame for one; give one of them")
    if options.frame is None and not options.always:
        if options.set or options.identity or any(spheres.values()) or options.interpolation is None:
            raise EditError("a key needs its time: give --frame, or --always; or --interpolation alone")
        findings = keys.set_interpolation(
            stage, edit, layer=layer, interpolation=options.interpolation, variant=options.variant
        )
        return _report(options, edit, layer, findings)
    values: dict[str, Any] = {"layer": layer, "frame": options.frame, "parameters": dict(options.set or ())}
    values |= {"identity": options.identity, "interpolation": options.interpolation}
    values |= {"sidecar": options.sidecar, "why": why(options), "variant": options.variant}
    if any(spheres.values()):
        # Painting needs the scene as it is at the key's frame; other keys work in a host without the kernels.
        from icheat_usd.cli.edit import brush
        from icheat_usd.session import Session

        session = Session.open(stage, camera=options.camera, frame=options.frame, stack=options.stack)
        values |= {f"{side}_brush": brush(session, numbers) for side, numbers in spheres.items() if numbers}
        return _report(options, edit, layer, session.set_key(edit, **values))
    return _report(options, edit, layer, keys.set_key(stage, edit, **values))


def copy_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.session import keys

    stage, layer = open_for_writing(options)
    _, edit = named_edit(stage, options)
    place: dict[str, Any] = {"layer": layer, "variant": options.variant}
    findings = keys.copy_key(stage, edit, frame=options.source, to=options.frame, **place)
    return _report(options, edit, layer, findings)


def remove_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.session import keys

    stage, layer = open_for_writing(options)
    _, edit = named_edit(stage, options)
    findings = keys.remove_key(stage, edit, layer=layer, frame=options.frame, variant=options.variant)
    return _report(options, edit, layer, findings)


def list_command(options: argparse.Namespace) -> int:
    """Exit with 1 where a file is missing or the layer that keys were copied from has moved on."""
    from icheat_usd.cli.authoring import named_edit
    from icheat_usd.session import inspection, keys
    from icheat_usd.stage.variants import selected_variant

    stage = inspection.open_stage(options.stage)
    _, edit = named_edit(stage, options)
    with selected_variant(stage, edit, options.variant):
        listed = keys.list_keys(stage, edit)
    if options.json:
        print_json(asdict(listed))
    else:
        print(as_text(listed))
    return 0 if listed.is_current and all(key.is_found or not key.payload for key in listed.keys) else 1


def as_text(listed: Any) -> str:
    """The keys of an edit for people: one line each, after one about all of them."""
    from icheat_usd.edits.staleness import value_text

    if not listed.keys:
        return f"{listed.edit} has no keys"
    lines = [f"{listed.edit}  {listed.interpolation}  decided by {listed.layer}"]
    if listed.copied_from:
        state = "as they still are there" if listed.is_current else "which has other keys by now"
        lines.append(f"  copied from {listed.copied_from}, {state}")
    for key in listed.keys:
        time = "always" if key.time is None else f"{key.time:g}"
        what = f"{key.payload[:12]}  {key.file}{'' if key.is_found else '  (missing)'}" if key.payload else ""
        said = " ".join(f"{name}={value_text(value)}" for name, value in key.parameters.items())
        lines.append("  ".join(filter(None, (f"  {time:>8}", said if key.payload else "identity", what))))
    return "\n".join(lines)


def _report(options: argparse.Namespace, edit: str, layer: str, findings: tuple[Any, ...]) -> int:
    """Say what was written; opinions that a stronger layer hides are findings."""
    if options.json:
        rows = [finding_as_json(finding) for finding in findings]
        print_json({"edit": edit, "layer": layer, "frame": options.frame, "findings": rows})
    else:
        print(edit)
        for finding in findings:
            print(finding_as_text(finding), file=sys.stderr)
    return 1 if findings else 0
