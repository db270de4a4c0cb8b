"""Suite `scale`: how time and memory of a frame grow with triangles, lights and pixels, and what named stages take.

Every size and stage has a process of its own. Loading is the stage's snapshot and the tracer, rendering all the rest.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom

from icheat_usd.scene import LightKind, SceneSnapshot
from icheat_usd.stage import open_stage, take_snapshot
from tools.benchmarking.generated import write_room
from tools.benchmarking.goals import Goal, at_most
from tools.benchmarking.meter import PeakMemory
from tools.benchmarking.parts import Effort
from tools.benchmarking.render_efforts import lesser, said_of_lesser
from tools.benchmarking.render_frame import Frame, warm
from tools.benchmarking.test_lights import TestLight, add_lights, with_lights

_TRIANGLES, _QUICK_TRIANGLES = (10_000, 100_000, 1_000_000), (100, 400)
_LIGHTS, _QUICK_LIGHTS = (1, 8, 64), (1, 3)
_WIDTHS, _QUICK_WIDTHS = (320, 640, 1280, 1920), (16, 32)

#: Where it is not what grows.
_USUAL_TRIANGLES = 100_000


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Sizes of the generated room, and every stage as it is."""
    sizes = {
        "triangles": _QUICK_TRIANGLES if quick else _TRIANGLES,
        "lights": _QUICK_LIGHTS if quick else _LIGHTS,
        "pixels": _QUICK_WIDTHS if quick else _WIDTHS,
    }
    of_room = [
        {"stage": "generated room", "what": what, "size": size} for what, values in sizes.items() for size in values
    ]
    return of_room + [{"stage": stage, "what": "stage", "size": 0} for stage in stages]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Seconds and peak memory of one size."""
    what, size = case["what"], case["size"]
    width, height = effort.width, effort.height
    if what == "pixels":
        width, height = size, _height(size)
    with tempfile.TemporaryDirectory() as scratch:
        n_triangles = size if what == "triangles" else (400 if quick else _USUAL_TRIANGLES)
        small = write_room(Path(scratch) / "small.usda", 200)
        stage = Path(case["stage"]) if what == "stage" else write_room(Path(scratch) / "room.usda", n_triangles)
        warm(_snapshot(stage if what == "stage" else small, 32, 24, case), lesser(quick))
        peak, start = PeakMemory(), time.perf_counter()
        snapshot = _snapshot(stage, width, height, case)
    frame = Frame(snapshot, lesser(quick))
    _ = frame.tracer
    load_seconds = time.perf_counter() - start
    _, seconds = frame.render(frame.field())
    found = {
        "width": effort.width,
        "height": effort.height,
        "what": what,
        "size": width * height if what == "pixels" else size,
        "named": {"pixels": f"{width}x{height} pixels", "stage": case["name"]}.get(what, f"{size:,} {what}"),
        "load_seconds": load_seconds,
        "render_seconds": seconds,
        "cell_seconds": frame.light_seconds,
        "peak_mib": peak.stop(),
    }
    print(f"  {seconds:8.2f} s, loaded in {load_seconds:.2f} s, peak {found['peak_mib']:.0f} MiB", flush=True)
    return found


def _height(width: int) -> int:
    """4:3, but for the last, which is 1920 x 1080."""
    return 1080 if width == 1920 else width * 3 // 4


def _snapshot(stage: Path, width: int, height: int, case: dict[str, Any]) -> SceneSnapshot:
    opened = open_stage(stage)
    if case["what"] == "stage":
        return _seen_and_lit(opened, width, height)
    snapshot = take_snapshot(opened, width=width, height=height)
    return _lit(snapshot, case["size"]) if case["what"] == "lights" else snapshot


def _seen_and_lit(stage: Usd.Stage, width: int, height: int) -> SceneSnapshot:
    """A stage as it is; one without a camera is framed, one without a light gets a grey sky."""
    has_camera = any(prim.IsA(UsdGeom.Camera) for prim in stage.Traverse())
    snapshot = take_snapshot(stage, camera=None if has_camera else "auto", width=width, height=height)
    if len(snapshot.lights.kind):
        return snapshot
    grey = np.ones((2, 4, 3), np.float32)
    return add_lights(snapshot, [TestLight("sky", LightKind.DOME, np.eye(3, 4), (1.0, 1.0, 1.0), image=grey)])


def _lit(snapshot: SceneSnapshot, n: int) -> SceneSnapshot:
    """`n` small balls under the ceiling in place of the stage's light, of the same power in all."""
    side = int(np.ceil(np.sqrt(n)))
    places = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[:n] + 0.5) / side
    lights = []
    for i, (x, z) in enumerate(places * 6 - 3):
        centre = np.array([x, 2.7, z]) - snapshot.centre
        matrix = np.concatenate([np.eye(3), centre[:, None]], axis=1)
        radiance = (1200.0 / n, 1150.0 / n, 1000.0 / n)
        lights.append(TestLight(f"ball{i}", LightKind.SPHERE, matrix, radiance, (0.05, 0.0)))
    return with_lights(snapshot, lights)


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README."""
    done = [one["result"] for one in results if "result" in one]
    if not done:
        return []
    lines = [said_of_lesser(done[0]["width"], done[0]["height"]), ""]
    lines += ["| size | load | render | of it light of the gather samples | peak memory |"]
    lines.append("| --- | ---: | ---: | ---: | ---: |")
    for point in done:
        lines.append(
            f"| {point['named']} | {point['load_seconds']:.2f} s | {point['render_seconds']:.2f} s |"
            f" {point['cell_seconds']:.2f} s | {point['peak_mib'] / 1024:.2f} GiB |"
        )
    peaks = [Goal(f"{one['named']}", one["peak_mib"] / 1024, 8) for one in done]
    return [*lines, "", at_most("peak memory in GiB", peaks)]
