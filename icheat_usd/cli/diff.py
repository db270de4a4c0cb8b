"""Say what changed from A to B: two stages, two layers or two sidecars.

Stages are compared as composed: edits, their order, values with the layer that
decides them, selections, and what was repainted at which key. Exit 0 if they
are the same, 1 if they differ.

icheat diff shot.v1.usda shot.v2.usda
icheat diff --layers shot.v1.usda shot.v2.usda
icheat diff shot.v001.icheat.h5 shot.v002.icheat.h5
"""

from __future__ import annotations

import argparse
from dataclasses import asdict

from icheat_usd.cli.options import add_frame, add_json, print_json
from icheat_usd.errors import StageError


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("a", metavar="A", help="USD file or .icheat.h5 file")
    parser.add_argument("b", metavar="B", help="another one of the same kind")
    parser.add_argument("--layers", action="store_true", help="compare what the two files say themselves, not composed")
    add_frame(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import differences
    from icheat_usd.session.payload_differences import compare_sidecars

    kinds = [name.endswith((".h5", ".hdf5")) for name in (options.a, options.b)]
    if kinds[0] != kinds[1]:
        raise StageError(f"{options.a} and {options.b} are not of one kind; name two USD files or two sidecars")
    if kinds[0]:
        found = [differences.Difference(name, "payload", text) for name, text in compare_sidecars(options.a, options.b)]
    elif options.layers:
        from icheat_usd.stage.opinions import edit_opinions

        found = differences.compare_layers(edit_opinions(options.a), edit_opinions(options.b))
    else:
        from icheat_usd.session import inspection

        stages = [inspection.open_stage(name) for name in (options.a, options.b)]
        found = differences.compare_stages(stages[0], stages[1], options.frame)
    if options.json:
        print_json({"a": options.a, "b": options.b, "differences": [asdict(difference) for difference in found]})
    else:
        for difference in found:
            print(difference.text)
    return 1 if found else 0
