"""Store payloads anew in the newest version of the sidecar format.

The result is a new file, in which payloads are also found under the digests
that they had: stages that name the old file need only name the new one.
"""

from __future__ import annotations

import argparse

from icheat_usd.cli.options import add_json, add_why, print_json, why


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("files", nargs="+", metavar="FILE", help="sidecars; they stay as they are")
    parser.add_argument("-o", "--out", metavar="FILE", help="the .icheat.h5 to make; else the next version beside")
    add_why(parser)
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.session import housekeeping

    file, renamed = housekeeping.upgrade(options.files, options.out, why=why(options))
    if options.json:
        print_json({"file": file, "payloads": dict(renamed)})
        return 0
    changed = sum(old != new for old, new in renamed.items())
    print(f"{file}: {len(renamed)} payloads, {changed} of them in newer versions and still found by their old digests")
    return 0
