"""Author edits: add, set, list, mute, move and remove.

icheat edit add shot.usda warmFace --receivers Geometry/Person --casters Geometry/Room --set color=1.3,1.05,0.8
icheat edit set shot.usda warmFace --amount 0.6
icheat edit mute shot.usda warmFace
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import Any

from icheat_usd.cli.options import (
    add_frame,
    add_json,
    add_layer,
    add_stack,
    add_stage,
    add_variant,
    add_why,
    aligned,
    assignment,
    finding_as_json,
    finding_as_text,
    print_json,
    why,
)


def setup_parser(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)

    add = _verb(verbs, "add", "add an edit to the stack", add_command, writes=True)
    add.add_argument("name", metavar="NAME", help="name of the new edit")
    _add_values(add)
    add.add_argument(
        "--sidecar", metavar="FILE", help="folder or .icheat.h5 file for the payload; default by the layer"
    )
    add_why(add)
    for side in ("receiver", "caster"):
        add.add_argument(
            f"--{side}-sphere",
            type=sphere,
            metavar="X,Y,Z,INNER,OUTER",
            help=f"paint the {side}s: full within INNER of the point, none beyond OUTER; metres, stage axes",
        )
    _add_place(add)

    change = _verb(verbs, "set", "change values of an edit", set_command, edit=True, writes=True)
    _add_values(change)

    _verb(verbs, "list", "list the edits of the stack in the order in which they apply", list_command)

    mute = _verb(
        verbs, "mute", "mute an edit, so that the image is as without it", mute_command, edit=True, writes=True
    )
    mute.add_argument("--off", action="store_true", help="unmute it")

    move = _verb(verbs, "move", "move an edit; without --before or --after to the end", move_command, True, True)
    _add_place(move)

    _verb(verbs, "remove", "take an edit out of the stack", remove_command, edit=True, writes=True)


def _verb(
    verbs: Any,
    name: str,
    doc: str,
    command: Callable[[argparse.Namespace], int],
    edit: bool = False,
    writes: bool = False,
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(name, help=doc, description=doc[0].upper() + doc[1:] + ".")
    add_stage(parser)
    if edit:
        parser.add_argument("edit", metavar="EDIT", help="its name or prim path")
    add_stack(parser)
    parser.add_argument("--camera", metavar="PRIM", help="camera whose stack is meant")
    if writes:
        add_layer(parser)
    add_variant(parser, "write into" if writes else "look at")
    if name == "list":
        add_frame(parser)
    elif name in ("add", "set"):
        key = ", and the payload a key there" if name == "add" else "; a key with masks of its own is 'icheat key set'"
        add_frame(parser, f"let the values be time samples at this time{key}; default: values for all times")
    add_json(parser)
    parser.set_defaults(command=command)
    return parser


def _add_values(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--operation", metavar="NAME", help="scale, hsv, …; a new edit scales")
    parser.add_argument(
        "--set",
        action="append",
        type=assignment,
        metavar="NAME=VALUE",
        help="parameter of the operation, such as gain=0.5 or color=1.2,1,0.8; may be given several times",
    )
    parser.add_argument("--amount", type=float, metavar="A", help="0 is no edit, 1 all of it")
    parser.add_argument("--blend", choices=("compose", "over", "add"), help="how it meets the weaker edits")
    for side, verb in (("receivers", "get"), ("casters", "send")):
        parser.add_argument(f"--{side}", nargs="+", metavar="PRIM", help=f"prims that {verb} the edited light")
        parser.add_argument(
            f"--exclude-{side}", nargs="+", metavar="PRIM", default=[], help="prims below those to leave out"
        )
        parser.add_argument(
            f"--{side}-expression",
            metavar="EXPR",
            help=f"membership expression in place of --{side}, such as '//{{isa:Mesh}} - //Props//*'",
        )
        parser.add_argument(
            f"--{side[:-1]}-limit",
            nargs="*",
            metavar="PRIM",
            help=f"only {side} that are in all of these: materials, regions, selections, collections, prims",
        )
    parser.add_argument("--light", nargs="*", metavar="PRIM", help="only light that first left these; default all")
    parser.add_argument("--occluder", nargs="*", metavar="PRIM", help="prims that the operation lets light pass")
    parser.add_argument("--target", metavar="PRIM", help="prim that the operation aims at; '' for none")


def _add_place(parser: argparse.ArgumentParser) -> None:
    place = parser.add_mutually_exclusive_group()
    place.add_argument("--before", metavar="EDIT")
    place.add_argument("--after", metavar="EDIT")


def sphere(text: str) -> tuple[float, ...]:
    """Centre, inner and outer radius."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 5 or not 0 <= numbers[3] < numbers[4]:
        raise argparse.ArgumentTypeError(f"'{text}' is no X,Y,Z,INNER,OUTER with INNER below OUTER")
    return numbers


def add_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import open_for_writing
    from icheat_usd.session import authoring, inspection
    from icheat_usd.stage.authoring import Members

    stage, layer = open_for_writing(options)
    values: dict[str, Any] = {name: value for name, value in _related(options).items() if value is not None}
    for side in ("receivers", "casters"):
        values[side] = _members(options, side) or Members()
    for name in ("operation", "amount", "blend"):
        if getattr(options, name) is not None:
            values[name] = getattr(options, name)
    if options.sidecar is not None:
        values["sidecar"] = options.sidecar
    values |= {"layer": layer, "parameters": dict(options.set or ()), "frame": options.frame}
    values |= {"before": options.before, "after": options.after, "why": why(options), "variant": options.variant}
    spheres = {side: getattr(options, f"{side}_sphere") for side in ("receiver", "caster")}
    if any(spheres.values()):
        # Painting needs the scene; an edit between whole prims does not, and works in a host without the kernels.
        from icheat_usd.session import Session

        session = Session.open(stage, camera=options.camera, frame=options.frame, stack=options.stack)
        values |= {f"{side}_brush": brush(session, numbers) for side, numbers in spheres.items() if numbers}
        path = session.add_edit(options.name, **values)
    else:
        stack = inspection.find_stack(stage, options.stack, options.camera)
        path = authoring.add_edit(stage, stack, options.name, **values)
    return _report(options, path, layer, inspection.idle_edit(stage, path, options.variant))


def _included(stage: Any, edit: str, options: argparse.Namespace, side: str) -> tuple[str, ...]:
    """What an edit includes already, where the options only exclude: an exclusion alone takes nothing else away.

    Raises
    ------
    EditError
        It selects by an expression, which knows no exclusions.
    """
    from icheat_usd.errors import EditError
    from icheat_usd.session import inspection

    if not getattr(options, f"exclude_{side}") or getattr(options, side):
        return ()
    included, expression = inspection.included(stage, edit, side, options.variant)
    if expression and not getattr(options, f"{side}_expression"):
        raise EditError(f"{edit}: its {side} are '{expression}'; exclude with --{side}-expression '… - //NAME//'")
    return included


def _members(options: argparse.Namespace, side: str, already: tuple[str, ...] = ()) -> Any:
    """What the options select on one side, None where they say nothing."""
    from icheat_usd.stage.authoring import Members

    included, excluded = getattr(options, side), getattr(options, f"exclude_{side}")
    expression = getattr(options, f"{side}_expression")
    if not (included or excluded or expression):
        return None
    return Members(tuple(included or already), tuple(excluded), expression or "")


def _related(options: argparse.Namespace) -> dict[str, Any]:
    return {
        "receiver_limits": options.receiver_limit,
        "caster_limits": options.caster_limit,
        "lights": options.light,
        "occluders": options.occluder,
        "target": options.target,
    }


def brush(session: Any, numbers: tuple[float, ...]) -> Any:
    """A soft sphere from metres in stage axes."""
    from icheat_usd.session import soft_sphere

    x, y, z = (float(value) - float(c) for value, c in zip(numbers[:3], session.snapshot.centre, strict=True))
    return soft_sphere((x, y, z), inner=numbers[3], outer=numbers[4])


def set_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.errors import EditError
    from icheat_usd.session import authoring, inspection

    stage, layer = open_for_writing(options)
    _, edit = named_edit(stage, options)
    values: dict[str, Any] = {"operation": options.operation, "amount": options.amount, "blend": options.blend}
    values |= {"parameters": dict(options.set) if options.set else None, "time": options.frame}
    values["variant"] = options.variant
    values |= _related(options)
    for side in ("receivers", "casters"):
        values[side] = _members(options, side, _included(stage, edit, options, side))
    if all(value is None for name, value in values.items() if name not in ("time", "variant")):
        raise EditError(f"there is nothing to set on {edit}; give --set, --amount or another value")
    findings = authoring.set_edit(stage, edit, layer=layer, **values)
    if any(values[name] is not None for name in ("operation", "receivers", "casters", "occluders")):
        findings += inspection.idle_edit(stage, edit, options.variant)
    return _report(options, edit, layer, findings)


def mute_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.session import authoring

    stage, layer = open_for_writing(options)
    _, edit = named_edit(stage, options)
    findings = authoring.mute_edit(stage, edit, layer=layer, muted=not options.off, variant=options.variant)
    return _report(options, edit, layer, findings)


def move_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.session import authoring

    stage, layer = open_for_writing(options)
    stack, edit = named_edit(stage, options)
    place = {"before": options.before, "after": options.after, "variant": options.variant}
    authoring.move_edit(stage, stack, edit, layer=layer, **place)
    return _report(options, edit, layer, ())


def remove_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import named_edit, open_for_writing
    from icheat_usd.session import authoring

    stage, layer = open_for_writing(options)
    stack, edit = named_edit(stage, options)
    authoring.remove_edit(stage, stack, edit, layer=layer, variant=options.variant)
    return _report(options, edit, layer, ())


def list_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.tree import edit_as_json, edit_summary
    from icheat_usd.session import inspection
    from icheat_usd.stage.variants import selected_variant

    stage = inspection.open_stage(options.stage)
    path = inspection.find_stack(stage, options.stack, options.camera)
    edits: tuple[Any, ...] = ()
    if path is not None:
        with selected_variant(stage, path, options.variant):
            edits = inspection.describe_stack(stage, path, options.frame).edits
    if options.json:
        print_json({"stage": options.stage, "stack": path, "edits": [edit_as_json(edit) for edit in edits]})
        return 0
    for line in aligned([edit_summary(edit) for edit in edits]):
        print(line)
    if path is None:
        print(f"{options.stage} has no edit stack", file=sys.stderr)
    return 0


def _report(options: argparse.Namespace, edit: str, layer: str, findings: tuple[Any, ...]) -> int:
    """Say what was written; opinions that a stronger layer hides, and what an edit still lacks, are findings."""
    if options.json:
        rows = [finding_as_json(finding) for finding in findings]
        print_json({"edit": edit, "layer": layer, "findings": rows})
    else:
        print(edit)
        for finding in findings:
            print(finding_as_text(finding), file=sys.stderr)
    return 1 if findings else 0
