"""Runs the suites of `tools/benchmark relight`, every case in a process of its own, and reports."""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from tools.benchmarking.meter import PeakMemory, command, machine
from tools.benchmarking.stage_names import default_stages, short_name
from tools.benchmarking.test_lights import SETS

ROOT = Path(__file__).resolve().parents[2]

#: A suite is a module with `cases`, `measure` and `markdown`.
SUITES = {
    "frames": "frames",
    "peers": "peers",
    "errors": "error_suite",
    "growth": "growth",
    "build": "build",
    "bits": "bits",
    "soak": "soak",
}
_QUICK_STAGE = "sample_stages/cornell_box/shot.usda"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("stages", nargs="*", help="stage files; default two sample stages")
    parser.add_argument("--only", metavar="SUITE,...", help=f"some of {','.join(SUITES)}; default all but soak")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that everything runs")
    parser.add_argument("--output", default="benchmark_output", help="folder for report.json, report.md, plots, images")
    parser.add_argument("--minutes", type=float, default=60.0, help="soak: how long")
    parser.add_argument(
        "--lights", choices=sorted(SETS), default="first", help="errors: which test lights; second is for reports alone"
    )
    parser.add_argument(
        "--mixed", action="store_true", help="frames: also 64 edits of which some turn hues; takes minutes"
    )
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--gather", type=int, help="gather samples; default the preview's own")
    parser.add_argument("--worker", help=argparse.SUPPRESS)


def run(arguments: argparse.Namespace) -> int:
    """The whole benchmark, or one case of it in a worker; the exit status is 1 where a case failed."""
    if arguments.worker:
        return _work(json.loads(arguments.worker))
    chosen = [name for name in SUITES if name != "soak"] if arguments.only is None else arguments.only.split(",")
    unknown = [name for name in chosen if name not in SUITES]
    if unknown:
        print(f"no suite {', '.join(unknown)}; there are {', '.join(SUITES)}", file=sys.stderr)
        return 2
    stages = arguments.stages or ([str(ROOT / _QUICK_STAGE)] if arguments.quick else default_stages(ROOT))
    effort = {"width": arguments.width, "height": arguments.height, "n_gather": arguments.gather}
    if arguments.quick:
        effort = {"width": 32, "height": 24, "n_gather": 512}
    folder = Path(arguments.output)
    folder.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {
        "version": 1,
        "command": command(),
        "machine": machine(),
        "effort": effort,
        "quick": arguments.quick,
        "suites": {},
    }
    failed = 0
    for name in chosen:
        suite = importlib.import_module(f"tools.benchmarking.{SUITES[name]}")
        results = []
        for case in suite.cases(stages, arguments.quick):
            options = {"minutes": arguments.minutes, "lights": arguments.lights, "mixed": arguments.mixed}
            case = {"name": short_name(case["stage"]), **options, **case}
            print(f"{name}: {_described(case)}", flush=True)
            task = {"suite": name, "case": case, "effort": effort, "quick": arguments.quick}
            results.append(_run_case(task | {"folder": str(folder / "images")}))
            failed += "error" in results[-1]
            _save(report | {"suites": report["suites"] | {name: results}}, folder)
        report["suites"][name] = results
    text = markdown(report)
    (folder / "report.md").write_text(text)
    print(text)
    _plot(report, folder)
    print(f"{folder / 'report.json'}, {folder / 'report.md'}")
    return 1 if failed else 0


def markdown(report: dict[str, Any]) -> str:
    """Tables for README of every suite that was run."""
    lines = [f"`{report['command']}` on {report['machine']['cpu']}, {report['machine']['cores']} cores.", ""]
    for name, results in report["suites"].items():
        suite = importlib.import_module(f"tools.benchmarking.{SUITES[name]}")
        lines += [f"### {name}", "", *suite.markdown(results), ""]
        lines += [f"{_described(result['case'])} failed: {result['error']}" for result in results if "error" in result]
    return "\n".join(lines) + "\n"


def _described(case: dict[str, Any]) -> str:
    extras = [
        f"{key} {value}" for key, value in case.items() if key not in ("name", "stage", "minutes", "lights", "mixed")
    ]
    return ", ".join([case["name"], *extras])


def _run_case(task: dict[str, Any]) -> dict[str, Any]:
    """In a process of its own, so that none finds what another left in memory, and peaks do not add up.

    A quick run has no figures worth that, and saves the start of each.
    """
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        written = Path(scratch) / "result.json"
        task = task | {"json": str(written)}
        if task["quick"]:
            status = _work(task)
        else:
            worker = [sys.executable, str(ROOT / "tools" / "benchmark"), "relight", "--worker", json.dumps(task)]
            status = subprocess.run(worker, check=False).returncode
        found = json.loads(written.read_text()) if written.exists() else {"error": f"the process ended with {status}"}
    return {"case": task["case"], "wall_seconds": time.perf_counter() - start, **found}


def _work(task: dict[str, Any]) -> int:
    """One case, in this process."""
    from tools.benchmarking.parts import Effort

    suite = importlib.import_module(f"tools.benchmarking.{SUITES[task['suite']]}")
    peak = PeakMemory()
    try:
        found = {"result": suite.measure(task["case"], Effort(**task["effort"]), task["quick"], Path(task["folder"]))}
    except Exception as error:  # the other cases go on, and the report says what failed
        traceback.print_exc()
        found = {"error": f"{type(error).__name__}: {error}"}
    Path(task["json"]).write_text(json.dumps({**found, "peak_mib": peak.stop()}, default=_plain))
    return 0


def _plain(value: Any) -> Any:
    """What JSON does not know: numbers and arrays of NumPy."""
    return value.tolist()


def _save(report: dict[str, Any], folder: Path) -> None:
    (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n")


def _plot(report: dict[str, Any], folder: Path) -> None:
    try:
        from tools.benchmarking.plots import plot
    except ImportError:
        print("no plots: matplotlib is not installed")
        return
    for path in plot(report, folder):
        print(path)
