"""`tools/benchmark relight`: which suites there are, and what they take."""

from __future__ import annotations

import argparse
import json

from tools.benchmarking.runner import ROOT, Benchmark, add_common_arguments, run_benchmark, work
from tools.benchmarking.stage_names import default_stages

BENCHMARK = Benchmark(
    "relight",
    {
        "frames": "frames",
        "peers": "peers",
        "errors": "error_suite",
        "growth": "growth",
        "build": "build",
        "bits": "bits",
        "soak": "soak",
    },
    plotter="plots",
    left_out=("soak",),
)
_QUICK_STAGE = "sample_stages/cornell_box/shot.usda"

#: Sets of `test_lights`, named here too so that `--help` needs nothing else.
_LIGHT_SETS = ("first", "second")
#: Names of qualities of `icheat_usd.session`, for the same reason.
_QUALITIES = ("LIVE", "LIVE_FINE")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stages", nargs="*", help="stage files; default two sample stages")
    add_common_arguments(parser, BENCHMARK)
    parser.add_argument("--minutes", type=float, default=60.0, help="soak: how long")
    parser.add_argument(
        "--lights", choices=_LIGHT_SETS, default="first", help="errors: which test lights; second is for reports alone"
    )
    parser.add_argument("--pixels", type=int, help="errors: how many are measured, spread over the image; default 2000")
    parser.add_argument(
        "--mixed", action="store_true", help="frames: also 64 edits of which some turn hues; takes minutes"
    )
    parser.add_argument("--gather", type=int, help="gather samples; default the preview's own")
    parser.add_argument("--quality", choices=_QUALITIES, help="of the preview; default LIVE, for errors both")


def run(arguments: argparse.Namespace) -> int:
    """The whole benchmark, or one case of it in a worker."""
    if arguments.worker:
        return work(BENCHMARK, json.loads(arguments.worker))
    stages = arguments.stages or ([str(ROOT / _QUICK_STAGE)] if arguments.quick else default_stages(ROOT))
    effort = {"width": arguments.width, "height": arguments.height, "n_gather": arguments.gather}
    if arguments.quick:
        effort = {"width": 32, "height": 24, "n_gather": 512}
    if arguments.quality or arguments.quick:
        effort["quality"] = arguments.quality or _QUALITIES[0]
    options = {name: getattr(arguments, name) for name in ("minutes", "lights", "pixels", "mixed")}
    return run_benchmark(BENCHMARK, arguments, stages, effort, options)
