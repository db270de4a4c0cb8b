"""Compile every kernel now, so that no first use has to wait for it.

Run it after installing, or when an image is built that others start from; a
minute or two on two cores, seconds if there is nothing to do. Compiled code
lies in the user's cache folder, or under $ICHEAT_CACHE_DIR, by the contents of
its sources, the versions of its libraries and the processor.
"""

from __future__ import annotations

import argparse
import time

from icheat_usd.cli.options import add_json, positive, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--jobs", type=positive, metavar="N", help="processes at once; default one per core")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.kernels._jit import cache_directory
    from icheat_usd.session.warming import warm

    seconds: dict[str, float] = {}

    def say(name: str, took: float) -> None:
        seconds[name] = round(took, 1)
        if not options.json:
            print(f"{name}: {took:.1f} s", flush=True)

    began = time.monotonic()
    warm(options.jobs, say)
    if options.json:
        print_json({"folder": str(cache_directory()), "seconds": seconds, "total": round(time.monotonic() - began, 1)})
    else:
        print(f"kernels are compiled in {cache_directory()}; {time.monotonic() - began:.1f} s")
    return 0
