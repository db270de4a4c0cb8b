"""Merge sidecars, or all that layers name, into one new file.

Nothing that exists is changed, unless --layer names a layer: then all that
this layer names is merged into the next version beside it, and the layer
names the new file from then on.
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, add_why, print_json, why


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("inputs", nargs="*", metavar="FILE", help="sidecars; or layers, for what each of them names")
    parser.add_argument("-o", "--out", metavar="FILE", help="the .icheat.h5 to make; else the next version beside")
    parser.add_argument("--layer", metavar="LAYER", help="layer file whose sidecars are merged and that is repointed")
    add_why(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.errors import SidecarError
    from icheat_usd.session import housekeeping

    if not options.inputs and options.layer is None:
        raise SidecarError("there is nothing to pack; name sidecars or layers, or a layer with --layer")
    packed = housekeeping.pack(options.inputs, options.out, layer=options.layer, why=why(options))
    if options.json:
        print_json(
            {
                "file": packed.file,
                "payloads": list(packed.payloads),
                "sources": list(packed.sources),
                "repointed": dict(packed.repointed),
            }
        )
        return 0
    print(f"{packed.file}: {len(packed.payloads)} payloads from {len(packed.sources)} files")
    for layer, count in packed.repointed.items():
        print(f"{layer}: {count} values name it now")
    return 0
