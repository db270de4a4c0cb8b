"""Suite `growth`: how time and memory grow with each size; one process per point."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits.model import EMPTY_STACK, EditStack
from icheat_usd.scene import LightKind
from tools.benchmarking.frames import Scene, lights_as_they_are, make_scene
from tools.benchmarking.generated import write_room
from tools.benchmarking.made_up_edits import many_edits
from tools.benchmarking.meter import repeat, summary
from tools.benchmarking.parts import Effort, Parts, with_movable_lights
from tools.benchmarking.test_lights import TestLight, add_lights

_SIZES: dict[str, tuple[int, ...]] = {
    "view samples": (1, 4),
    "gather samples": (1, 4),
    "lights": (1, 8, 32),
    "edits": (0, 16, 64),
    "triangles": (10_000, 100_000, 1_000_000),
}
_QUICK: dict[str, tuple[int, ...]] = {"lights": (1, 3), "triangles": (100, 400)}


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Of the last stage, and of generated ones for triangles."""
    sizes = _QUICK if quick else _SIZES
    return [{"stage": stages[-1], "what": what, "size": size} for what, many in sizes.items() for size in many]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Seconds to build and of frames; the caller adds the peak memory of the process."""
    what, size, stage = case["what"], case["size"], case["stage"]
    with tempfile.TemporaryDirectory() as scratch:
        if what == "triangles":
            stage = str(write_room(Path(scratch) / "room.usda", size))
        _warm(stage)
        start = time.perf_counter()
        parts = Parts(stage, _effort(effort, what, size))
        parts = _with_lights(parts, size) if what == "lights" else with_movable_lights(parts)[0]
        _ = parts.packed
        transport_seconds = time.perf_counter() - start
        parts.refine_lights()
        scene = make_scene(parts)
        parts.live.set_stack(_stack(scene, what, size))
        parts.live.frame()
        build_seconds = time.perf_counter() - start
    limits = {"least": 2, "most": 2} if quick else {"least": 7, "most": 101}
    times = {name: summary(repeat(step, seconds=1.0, **limits)) for name, step in _steps(scene).items()}
    return {
        "size": {"view samples": parts.view.n, "gather samples": parts.gather.n}.get(what, size),
        "build_seconds": build_seconds,
        "transport_seconds": transport_seconds,
        "frame_seconds": times["light colour"]["median"],
        "times": times,
        "transport_bytes": getattr(parts.packed, "n_bytes", None),
        "triangles": len(parts.snapshot.geometry.face),
    }


def _effort(effort: Effort, what: str, size: int) -> Effort:
    if what == "view samples":
        side = round(size**0.5)
        return replace(effort, width=effort.width * side, height=effort.height * side)
    if what == "gather samples":
        return replace(effort, n_gather=size * effort.settings().n_gather)
    return effort


def _warm(stage: str) -> None:
    """Compile, or load, every kernel on a tiny image first."""
    parts, _ = with_movable_lights(Parts(stage, Effort(24, 16, 256)))
    scene = make_scene(parts)
    parts.live.set_stack(scene.stack)
    for step in _steps(scene).values():
        step(0)


def _with_lights(parts: Parts, n: int) -> Parts:
    """`n` small balls in place of the stage's lights, and a dome, which does not shine."""
    rng = np.random.default_rng(32)
    position = parts.view.points.position[rng.integers(0, parts.view.n, n)]
    normal = parts.view.points.normal[rng.integers(0, parts.view.n, n)]
    radius = parts.snapshot.radius
    balls = []
    for i in range(n):
        matrix = np.concatenate([np.eye(3), (position[i] + 0.1 * radius * normal[i])[:, None]], axis=1)
        balls.append(TestLight(f"ball{i}", LightKind.SPHERE, matrix, (5.0, 5.0, 5.0), (0.01 * radius, 0.0)))
    none = parts.snapshot.lights
    empty = none._replace(
        **{name: getattr(none, name)[:0] for name in ("kind", "to_world", "radiance", "size", "texture", "surface")},
        triangle_begin=np.zeros(1, np.int64),
        triangle=none.triangle[:0],
        triangle_instance=none.triangle_instance[:0],
    )
    dark = TestLight("dome", LightKind.DOME, np.eye(3, 4), (0.0, 0.0, 0.0), image=np.ones((2, 4, 3), np.float32))
    return parts.under(add_lights(replace(parts.snapshot, lights=empty, light_paths=()), [*balls, dark]))


def _stack(scene: Scene, what: str, size: int) -> EditStack:
    if what != "edits":
        return scene.stack
    return EMPTY_STACK if size == 0 else many_edits(scene.parts, size, size // 4)


def _steps(scene: Scene) -> dict[str, Callable[[int], Any]]:
    live, lights = scene.parts.live, scene.parts.lights
    start = lights_as_they_are(scene.parts)[scene.area_light]

    def colour(i: int) -> Any:
        lights.set_gain(scene.area_light, (1 + 0.1 * (i % 7), 1, 0.9))
        return live.frame()

    def move(i: int) -> Any:
        moved = start.copy()
        moved[:, 3] += 0.01 * (1 + i % 11)
        lights.change(scene.area_light, to_world=moved)
        return live.frame()

    def amount(i: int) -> Any:
        edits = live.stack.edits
        if edits:
            live.set_amount(edits[i % len(edits)].path, 0.3 + 0.05 * (i % 11))
        return live.frame()

    return {"light colour": colour, "light move": move, "amount": amount}


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README."""
    lines = [
        "| size | transport | to the first full frame | light colour | light move | amount | peak memory |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for one in results:
        if "result" not in one:
            continue
        found = one["result"]
        frames = " | ".join(
            f"{1000 * found['times'][name]['median']:.1f} ms" for name in ("light colour", "light move", "amount")
        )
        lines.append(
            f"| {found['size']:,} {one['case']['what']} | {found['transport_seconds']:.1f} s |"
            f" {found['build_seconds']:.1f} s | {frames} | {one['peak_mib'] / 1024:.1f} GiB |"
        )
    return lines
