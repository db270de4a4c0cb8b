"""Runs suites, every case in a process of its own, and reports.

A suite is a module with `cases`, `measure` and `markdown`.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tools.benchmarking.stage_names import short_name

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Benchmark:
    """One of the commands of `tools/benchmark`."""

    name: str
    suites: dict[str, str]  #: name to module
    plotter: str  #: module with a `plot(report, folder)`
    left_out: tuple[str, ...] = field(default=())  #: suites that run only when asked for


def add_common_arguments(parser: argparse.ArgumentParser, benchmark: Benchmark) -> None:
    """What every such command takes."""
    usual = "all" if not benchmark.left_out else f"all but {','.join(benchmark.left_out)}"
    parser.add_argument("--only", metavar="SUITE,...", help=f"some of {','.join(benchmark.suites)}; default {usual}")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, to see that everything runs")
    parser.add_argument("--output", default="benchmark_output", help="folder for report.json, report.md, plots, images")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=480)
    parser.add_argument("--worker", help=argparse.SUPPRESS)


def run_benchmark(
    benchmark: Benchmark,
    arguments: argparse.Namespace,
    stages: list[str],
    effort: dict[str, Any],
    options: dict[str, Any],
) -> int:
    """Every chosen suite; the exit status is 1 where a case failed, 2 where a suite is unknown.

    Parameters
    ----------
    effort
        Of `parts.Effort`.
    options
        Put into every case, and not named in tables.
    """
    default = [name for name in benchmark.suites if name not in benchmark.left_out]
    chosen = default if arguments.only is None else arguments.only.split(",")
    unknown = [name for name in chosen if name not in benchmark.suites]
    if unknown:
        print(f"no suite {', '.join(unknown)}; there are {', '.join(benchmark.suites)}", file=sys.stderr)
        return 2
    from tools.benchmarking.meter import command, machine

    folder = Path(arguments.output)
    folder.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {
        "version": 1,
        "command": command(),
        "machine": machine(),
        "effort": effort,
        "quick": arguments.quick,
        "options": options,
        "suites": {},
    }
    failed = 0
    for name in chosen:
        suite = _module(benchmark, name)
        results: list[dict[str, Any]] = []
        wanted = effort.get("quality")  # of suites with cases of several
        cases = suite.cases(stages, arguments.quick)
        for case in [case for case in cases if wanted is None or case.get("quality", wanted) == wanted]:
            case = {"name": short_name(case["stage"]), **options, **case}
            print(f"{name}: {_described(case, options)}", flush=True)
            task = {"suite": name, "case": case, "effort": effort, "quick": arguments.quick}
            results.append(_run_case(benchmark, task | {"folder": str(folder / "images")}))
            failed += "error" in results[-1]
            _save(report | {"suites": report["suites"] | {name: results}}, folder)
        report["suites"][name] = results
    text = markdown(benchmark, report)
    (folder / "report.md").write_text(text)
    print(text)
    _plot(benchmark, report, folder)
    print(f"{folder / 'report.json'}, {folder / 'report.md'}")
    return 1 if failed else 0


def work(benchmark: Benchmark, task: dict[str, Any]) -> int:
    """One case, in this process."""
    from tools.benchmarking.meter import PeakMemory
    from tools.benchmarking.parts import Effort

    suite = _module(benchmark, task["suite"])
    peak = PeakMemory()
    try:
        found = {"result": suite.measure(task["case"], Effort(**task["effort"]), task["quick"], Path(task["folder"]))}
    except Exception as error:  # the other cases go on, and the report says what failed
        traceback.print_exc()
        found = {"error": f"{type(error).__name__}: {error}"}
    Path(task["json"]).write_text(json.dumps({**found, "peak_mib": peak.stop()}, default=_plain))
    return 0


def markdown(benchmark: Benchmark, report: dict[str, Any]) -> str:
    """Tables for README of every suite that was run."""
    lines = [f"`{report['command']}` on {report['machine']['cpu']}, {report['machine']['cores']} cores.", ""]
    if report["quick"]:
        lines += ["Of tiny images at the least effort, whatever tables say: to see that everything runs.", ""]
    for name, results in report["suites"].items():
        lines += [f"### {name}", "", *_module(benchmark, name).markdown(results), ""]
        lines += [
            f"{_described(result['case'], report['options'])} failed: {result['error']}"
            for result in results
            if "error" in result
        ]
    return "\n".join(lines) + "\n"


def _module(benchmark: Benchmark, suite: str) -> Any:
    return importlib.import_module(f"tools.benchmarking.{benchmark.suites[suite]}")


def _described(case: dict[str, Any], options: dict[str, Any]) -> str:
    extras = [f"{key} {value}" for key, value in case.items() if key not in ("name", "stage") and key not in options]
    return ", ".join([case["name"], *extras])


def _run_case(benchmark: Benchmark, task: dict[str, Any]) -> dict[str, Any]:
    """In a process of its own, so that none finds what another left in memory, and peaks do not add up.

    A quick run has no figures worth that, and saves the start of each.
    """
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        written = Path(scratch) / "result.json"
        task = task | {"json": str(written)}
        if task["quick"]:
            status = work(benchmark, task)
        else:
            worker = [sys.executable, str(ROOT / "tools" / "benchmark"), benchmark.name, "--worker", json.dumps(task)]
            status = subprocess.run(worker, check=False).returncode
        found = json.loads(written.read_text()) if written.exists() else {"error": f"the process ended with {status}"}
    return {"case": task["case"], "wall_seconds": time.perf_counter() - start, **found}


def _plain(value: Any) -> Any:
    """What JSON does not know: numbers and arrays of NumPy."""
    return value.tolist()


def _save(report: dict[str, Any], folder: Path) -> None:
    (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n")


def _plot(benchmark: Benchmark, report: dict[str, Any], folder: Path) -> None:
    try:
        plots = importlib.import_module(f"tools.benchmarking.{benchmark.plotter}")
    except ModuleNotFoundError as error:
        if error.name != "matplotlib":
            raise
        print("no plots: matplotlib is not installed")
        return
    for path in plots.plot(report, folder):
        print(path)
