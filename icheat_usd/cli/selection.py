"""Combine selections by set algebra: unions, intersections and differences.

icheat selection add shot.usda Edits/woodByWindow --rule intersection Looks/oak Edits/window
icheat edit set shot.usda warmFace --caster-limit Edits/woodByWindow
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, add_layer, add_stage, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    verbs = parser.add_subparsers(title="verbs", metavar="VERB", required=True)
    add = verbs.add_parser(
        "add", help="make a selection of others", description="Make a selection of others and save the layer."
    )
    add_stage(add)
    add.add_argument("path", metavar="PRIM", help="where, below the default prim")
    add.add_argument(
        "parts", metavar="PART", nargs="+", help="material, region, selection, collection or prim; order counts"
    )
    add.add_argument(
        "--rule",
        choices=("intersection", "union", "difference"),
        default="intersection",
        help="what is in all parts (default), in any, or in the first but no other",
    )
    add_layer(add)
    add_json(add)
    add.set_defaults(command=add_command)


def add_command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.authoring import open_for_writing
    from icheat_usd.session import authoring

    stage, layer = open_for_writing(options)
    path = authoring.add_selection(stage, options.path, options.parts, layer=layer, rule=options.rule)
    if options.json:
        print_json({"selection": path, "layer": layer})
    else:
        print(path)
    return 0
