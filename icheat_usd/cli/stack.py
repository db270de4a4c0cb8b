"""Make edit stacks, or list those of a stage."""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, add_layer, add_stage, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)

    create = verbs.add_parser("create", help="make a stack", description="Make an edit stack and save the layer.")
    add_stage(create)
    create.add_argument("path", metavar="PRIM", nargs="?", help="where, below the default prim; default Edits")
    create.add_argument("--camera", metavar="PRIM", help="camera that the stack is for; default any")
    add_layer(create)
    add_json(create)
    create.set_defaults(command=create_command)

    listing = verbs.add_parser("list", help="list the stacks", description="List a stage's edit stacks.")
    add_stage(listing)
    add_json(listing)
    listing.set_defaults(command=list_command)


def create_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import open_for_writing
    from icheat_usd.session import authoring

    stage, layer = open_for_writing(options)
    path = authoring.create_stack(stage, options.path, layer=layer, camera=options.camera)
    if options.json:
        print_json({"stack": path, "layer": layer})
    else:
        print(path)
    return 0


def list_command(options: argparse.Namespace) -> int:
    from icheat_usd.session import inspection

    stacks = inspection.describe_stacks(inspection.open_stage(options.stage))
    if options.json:
        rows = [
            {
                "path": stack.path,
                "enabled": stack.enabled,
                "cameras": list(stack.cameras),
                "edits": [edit.path for edit in stack.edits],
            }
            for stack in stacks
        ]
        print_json({"stage": options.stage, "stacks": rows})
        return 0
    for stack in stacks:
        notes = [f"{len(stack.edits)} edit{'s' * (len(stack.edits) != 1)}"]
        notes += [f"for {', '.join(stack.cameras)}"] if stack.cameras else []
        notes += [] if stack.enabled else ["off"]
        print(f"{stack.path}  ({', '.join(notes)})")
    return 0
