"""Time and memory of each step from a stage to its images."""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from tools.benchmarking.meter import Meter, command, machine

ROOT = Path(__file__).resolve().parents[2]


def measure_help() -> dict[str, Any]:
    """Time of `icheat --help` as a process, median of 11."""
    command = [sys.executable, "-m", "icheat_usd", "--help"]
    times = []
    for _ in range(11):
        start = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
        times.append(time.perf_counter() - start)
    print(
        f"  icheat --help                {statistics.median(times):9.3f} s (min {min(times):.3f}, max {max(times):.3f})"
    )
    return {"step": "icheat --help", "seconds": statistics.median(times), "min": min(times), "max": max(times)}


def measure_stage(arguments: argparse.Namespace) -> dict[str, Any]:
    """Run every step on one stage in this process."""
    from icheat_usd.edits.binding import bind
    from icheat_usd.edits.model import Edit, EditStack, Selection
    from icheat_usd.final_gather import GatherSettings
    from icheat_usd.session import DRAFT, Quality, Session

    size = {"width": arguments.width, "height": arguments.height}
    stage_path = arguments.stages[0]
    warm = Session.open(stage_path, width=64, height=48, quality=DRAFT)
    warm.relight()
    warm.render(GatherSettings(samples_per_pixel=1, gather_rays=4))

    meter = Meter()
    quality = Quality(n_gather=arguments.gather)
    session = Session.open(stage_path, quality=quality, **size)
    started = time.perf_counter()
    snapshot = meter.measure("load", lambda: session.snapshot)
    meter.measure("build the ray tracer", lambda: session.tracer)
    meter.measure("view samples", lambda: session.view)
    meter.measure("gather samples", lambda: session.gather)
    meter.measure("transport", lambda: session.transport)
    relighter = meter.measure("light and bounces", lambda: session.relighter)
    meter.measure("first preview image", session.relight)
    meter.steps.append({"step": "stage to first preview", "seconds": time.perf_counter() - started})
    print(f"  {'stage to first preview':<28} {meter.steps[-1]['seconds']:9.3f} s", flush=True)

    paths = sorted({surface.path for surface in snapshot.surfaces})
    everything = Selection(frozenset(paths))
    half = Selection(frozenset(paths[::2]))
    stacks = {
        "relight, no edit": (),
        "relight, scale on all": (Edit("/scale", "scale", {"color": (1.5, 1.0, 0.7)}, everything, everything),),
        "relight, scale and hsv": (
            Edit("/scale", "scale", {"color": (1.5, 1.0, 0.7)}, everything, half),
            Edit("/hsv", "hsv", {"hue": 40.0, "saturation": 1.5}, half, everything),
        ),
    }
    for name, edits in stacks.items():
        field = bind(EditStack("/stack", edits), snapshot)
        receivers = relighter.receivers(field)
        meter.measure(name, lambda f=field, r=receivers: relighter.relight(f, receivers=r), repeat=5)
    settings = GatherSettings(samples_per_pixel=arguments.spp, gather_rays=arguments.rays)
    meter.measure(f"final frame, {arguments.spp} spp x {arguments.rays}", lambda: session.render(settings))
    geometry = snapshot.geometry
    return {
        "stage": Path(stage_path).name,
        "width": session.view.width,
        "height": session.view.height,
        "triangles": int(len(geometry.face)),
        "gather_samples": int(len(session.gather.area)),
        "matrix_entries": int(sum(len(lobe.rows.indices) for lobe in session.transport.lobes)),
        "steps": meter.steps,
    }


def run_pipeline(arguments: argparse.Namespace) -> dict[str, Any]:
    """Every stage in a fresh process, so that peaks do not add up."""
    if arguments.worker:
        return measure_stage(arguments)
    report: dict[str, Any] = {"version": 1, "machine": machine(), "command": command(), "stages": []}
    report["help"] = measure_help()
    for stage in arguments.stages:
        print(stage, flush=True)
        worker = [
            sys.executable,
            str(ROOT / "tools" / "benchmark"),
            "pipeline",
            stage,
            "--worker",
            "--width",
            str(arguments.width),
        ]
        worker += ["--height", str(arguments.height), "--gather", str(arguments.gather)]
        worker += ["--spp", str(arguments.spp), "--rays", str(arguments.rays)]
        output = ROOT / ".benchmark-worker.json"
        try:
            subprocess.run([*worker, "--json", str(output)], check=True)
            report["stages"].append(json.loads(output.read_text()))
        finally:
            output.unlink(missing_ok=True)
    return report


def markdown(report: dict[str, Any]) -> str:
    """The report as a table for README."""
    stages = report["stages"]
    names = [step["step"] for step in stages[0]["steps"]]
    lines = ["| step | " + " | ".join(stage["stage"] for stage in stages) + " |"]
    lines.append("| --- |" + " ---: |" * len(stages))
    for index, name in enumerate(names):
        cells = []
        for stage in stages:
            step = stage["steps"][index]
            memory = f", {step['peak_mib'] / 1024:.1f} GiB" if "peak_mib" in step else ""
            cells.append(f"{step['seconds']:.2f} s{memory}")
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)
