"""Compile every kernel now, so that no first use has to wait for it.

Run it after installing, or when an image is built that others start from; some
minutes on two cores, less on more, seconds if there is nothing to do.
Commands that compute do the same when they are first run, for what most stages
need: what few need, each compiles when it is called, unless this has been run.
Compiled code lies in the user's cache folder, or under $ICHEAT_CACHE_DIR, by
the contents of its sources, the versions of its libraries and the processor.
"""

from __future__ import annotations

import argparse
import time

from icheat_usd.cli.options import add_json, positive, print_json


def setup_parser(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--jobs", type=positive, metavar="N", help="processes at once; default one per core")
    add_json(parser)


def command(options: argparse.Namespace) -> int:
    from icheat_usd.cli.progress import ProgressLine
    from icheat_usd.kernels._jit import cache_directory
    from icheat_usd.session.warming import EVERYTHING, compile_ahead

    began = time.monotonic()
    with ProgressLine() as progress:
        n = compile_ahead(EVERYTHING, options.jobs, progress)
    seconds = time.monotonic() - began
    if options.json:
        print_json({"folder": str(cache_directory()), "kernels": n, "seconds": round(seconds, 1)})
    else:
        done = f"{n} kernels are compiled" if n else "all kernels had been compiled"
        print(f"{done} in {cache_directory()}; {seconds:.1f} s")
    return 0
