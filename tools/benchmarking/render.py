"""`tools/benchmark render`: which suites there are, and what they take."""

from __future__ import annotations

import argparse
import json
import sys

from icheat_usd.freed_memory import keep_freed_memory
from tools.benchmarking.runner import ROOT, Benchmark, add_common_arguments, run_benchmark, work

BENCHMARK = Benchmark(
    "render",
    {
        "rivals": "rivals",
        "edits": "render_edits",
        "properties": "render_properties",
        "scale": "render_scale",
        "sequence": "render_sequence",
        "killed": "render_killed",
    },
    plotter="render_plots",
)
_STAGES = ("sample_stages/cornell_box/scene.usda", "sample_stages/furnished_room/scene.usda")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stages", nargs="*", help="stage files of rivals and edits; default two sample stages")
    add_common_arguments(parser, BENCHMARK)
    parser.add_argument(
        "--references", metavar="FOLDER", help="rivals: where references are kept; default in the user's cache folder"
    )
    parser.add_argument(
        "--reference-minutes", type=float, default=0.0, metavar="N",
        help="rivals: render more of each stage's reference for so long; without one on disk a little in any case",
    )  # fmt: skip
    parser.add_argument(
        "--seconds", type=float, default=75.0, help="rivals: how long path tracers are followed; default %(default)s"
    )
    parser.add_argument(
        "--renderers", metavar="NAME,...", help="rivals: some of ours,llvm,scalar,luxcore; default all of them"
    )
    parser.add_argument(
        "--efforts", metavar="NAME,...", help="rivals: some of ours, as 'cached 0,cached 3'; default all of them"
    )


def run(arguments: argparse.Namespace) -> int:
    """The whole benchmark, or one case of it in a worker."""
    if arguments.worker:
        keep_freed_memory()  # as `icheat render` does; Mitsuba has an allocator of its own
        return work(BENCHMARK, json.loads(arguments.worker))
    unknown = _unknown(arguments)
    if unknown:
        print(unknown, file=sys.stderr)
        return 2
    stages = arguments.stages or [str(ROOT / name) for name in _STAGES[: 1 if arguments.quick else None]]
    effort = {"width": arguments.width, "height": arguments.height}
    if arguments.quick:
        effort = {"width": 32, "height": 24}
    options = {
        "references": arguments.references,
        "reference_minutes": arguments.reference_minutes,
        "seconds": 0.2 if arguments.quick else arguments.seconds,
        "renderers": arguments.renderers,
        "efforts": arguments.efforts,
    }
    return run_benchmark(BENCHMARK, arguments, stages, effort, options)


def _unknown(arguments: argparse.Namespace) -> str | None:
    """What is wrong with the names of renderers and efforts."""
    from tools.benchmarking.render_efforts import efforts
    from tools.benchmarking.rivals import RENDERERS

    known = {"renderers": RENDERERS, "efforts": tuple(efforts(arguments.quick))}
    for option, names in known.items():
        wrong = [name for name in (getattr(arguments, option) or names[0]).split(",") if name not in names]
        if wrong:
            return f"--{option}: there is no {', '.join(wrong)}; there are {', '.join(names)}"
    return None
