"""Make regions of space that narrow an edit: boxes and spheres with soft borders.

icheat region add shot.usda Edits/window --box 0,1.5,-2,1,2,0.5 --softness 0.3
icheat edit set shot.usda warmFace --receiver-limit Edits/window
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, add_layer, add_stage, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    add = verbs.add_parser(
        "add", help="make a region", description="Make a guide Cube or Sphere, not rendered, and save the layer."
    )
    add_stage(add)
    add.add_argument("path", metavar="PRIM", help="where, below the default prim")
    shape = add.add_mutually_exclusive_group(required=True)
    shape.add_argument("--box", type=Numbers(6), metavar="X,Y,Z,SX,SY,SZ", help="centre and edges; metres, stage axes")
    shape.add_argument("--sphere", type=Numbers(4), metavar="X,Y,Z,R", help="centre and radius; metres, stage axes")
    add.add_argument(
        "--softness",
        type=float,
        default=0.0,
        metavar="S",
        help="share of the way from centre to border over which it fades: 0 (default) to 1",
    )
    add_layer(add)
    add_json(add)
    add.set_defaults(command=add_command)


class Numbers:
    """Type of an option: so many numbers with commas between."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __call__(self, text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(part) for part in text.split(","))
        except ValueError:
            found = ()
        if len(found) != self.count:
            raise argparse.ArgumentTypeError(f"'{text}' is not {self.count} numbers with commas between")
        return found


def add_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import open_for_writing
    from icheat_usd.session import authoring

    stage, layer = open_for_writing(options)
    given = options.box or options.sphere
    path = authoring.add_region(
        stage,
        options.path,
        layer=layer,
        shape="box" if options.box else "sphere",
        centre=given[:3],
        size=given[3:],
        softness=options.softness,
    )
    if options.json:
        print_json({"region": path, "layer": layer})
    else:
        print(path)
    return 0
