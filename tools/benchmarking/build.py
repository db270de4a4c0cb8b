"""Suite `build`: from opening a stage to its first usable preview, and to the full one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tools.benchmarking.parts import Effort

_ROOT = Path(__file__).resolve().parents[2]

#: Runs of one case, one after another, with one folder for caches.
_RUNS = {
    "nothing cached": {},
    "kernels cached": {"ICHEAT_CACHE_SIZE": "0"},
    "all cached": {},
}


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Every stage."""
    return [{"stage": stage} for stage in stages]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Three processes: without any cache, without the cache of builds, and with both."""
    found = {}
    # Compiling takes minutes and does not depend on sizes: the quick run keeps the user's own kernels.
    runs = {"kernels cached": _RUNS["kernels cached"]} if quick else _RUNS
    with tempfile.TemporaryDirectory() as scratch:
        for name, extra in runs.items():
            environment = {key: value for key, value in os.environ.items() if key != "ICHEAT_CACHE_SIZE"} | extra
            if not quick:
                environment["ICHEAT_CACHE_DIR"] = str(Path(scratch) / "cache")
            found[name] = run_once(case["stage"], effort, environment, Path(scratch) / "out.json")
            print(
                f"  {name:<16} first preview {found[name]['preview']['seconds']:7.1f} s,"
                f" full {found[name]['full']['seconds']:7.1f} s, {found[name]['full']['peak_mib']:.0f} MiB",
                flush=True,
            )
    return {"runs": found}


def run_once(stage: str, effort: Effort, environment: dict[str, str], output: Path) -> dict[str, Any]:
    """Open the stage in a process of its own."""
    task = {
        "stage": stage,
        "width": effort.width,
        "height": effort.height,
        "quality": effort.quality,
        "n_gather": effort.n_gather,
        "output": str(output),
        "started": time.time(),
    }
    command = [sys.executable, "-m", "tools.benchmarking.build_once", json.dumps(task)]
    done = subprocess.run(command, env=environment, cwd=_ROOT, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"opening {stage} failed: {done.stderr.strip().splitlines()[-1:]}")
    found: dict[str, Any] = json.loads(output.read_text())
    return found


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README."""
    lines = [
        "| stage | caches | imports, apart | first usable preview | full transport | at rest | peak memory |",
        "| --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for one in results:
        for name, run in one.get("result", {}).get("runs", {}).items():
            seconds = [run["imports"], *(run[level]["seconds"] for level in ("preview", "full", "rest"))]
            times = " | ".join(f"{value:.1f} s" for value in seconds)
            lines.append(f"| {one['case']['name']} | {name} | {times} | {run['rest']['peak_mib'] / 1024:.1f} GiB |")
    return lines
