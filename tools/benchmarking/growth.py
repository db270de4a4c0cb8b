"""Suite `growth`: how time and memory grow with each size.

Builds have few rays, as it is what follows from a size that is measured. What grows without a new transport (lights,
edits) is measured in the process that built it; every other size has a process of its own.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits.model import EMPTY_STACK, EditStack
from icheat_usd.scene import LightKind
from tools.benchmarking.frames import Scene, lights_as_they_are, make_scene
from tools.benchmarking.generated import write_room
from tools.benchmarking.made_up_edits import many_edits
from tools.benchmarking.meter import PeakMemory, repeat, summary
from tools.benchmarking.parts import Effort, Parts, with_movable_lights
from tools.benchmarking.test_lights import TestLight, add_lights

_RAYS = {"record_rays": 512, "rays_per_bounce_row": 32, "light_samples": 4, "dome_samples": 4}
_LIGHTS, _EDITS = (1, 8, 32), (0, 16, 64)
_TRIANGLES = (10_000, 100_000, 1_000_000)
_QUICK_LIGHTS, _QUICK_EDITS, _QUICK_TRIANGLES = (1, 3), (0, 4), (100, 400)


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Of the last stage, and of generated ones for triangles."""
    found = [{"what": "lights and edits"}, {"what": "view samples", "size": 4}, {"what": "gather samples", "size": 4}]
    found = found[:1] if quick else found
    found += [{"what": "triangles", "size": size} for size in (_QUICK_TRIANGLES if quick else _TRIANGLES)]
    return [{"stage": stages[-1], **case} for case in found]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Points, each with its size, seconds to build and of frames, and peak memory."""
    what, size, stage = case["what"], case.get("size", 1), case["stage"]
    effort = _effort(replace(effort, changes=tuple(_RAYS.items())), what, size)
    with tempfile.TemporaryDirectory() as scratch:
        if what == "triangles":
            stage = str(write_room(Path(scratch) / "room.usda", size))
        _warm(stage)
        peak, start = PeakMemory(), time.perf_counter()
        parts, _ = with_movable_lights(Parts(stage, effort))
        _ = parts.packed
        seconds = time.perf_counter() - start
    scene = make_scene(parts)
    sizes = {
        "view samples": parts.view.n,
        "gather samples": parts.gather.n,
        "triangles": len(parts.snapshot.geometry.face),
    }
    first = _point(scene, scene.stack, quick, peak) | {"transport_seconds": seconds}
    if what in sizes:
        return {"rays": _RAYS, "points": [first | {"what": what, "size": sizes[what]}]}
    points = [first | {"what": name, "size": sizes[name]} for name in ("view samples", "gather samples")]
    return {"rays": _RAYS, "points": [*points, *_of_edits(scene, quick), *_of_lights(parts, quick)]}


def _point(scene: Scene, stack: EditStack, quick: bool, peak: PeakMemory) -> dict[str, Any]:
    """Times of frames with a stack, and memory since `peak` was begun."""
    limits = {"least": 2, "most": 2} if quick else {"least": 7, "most": 101}
    start = time.perf_counter()
    scene.parts.refine_lights()
    scene.parts.live.set_stack(stack)
    scene.parts.live.frame()
    first_frame = time.perf_counter() - start
    times = {name: summary(repeat(step, seconds=1.0, **limits)) for name, step in _steps(scene).items()}
    return {
        "first_frame_seconds": first_frame,
        "frame_seconds": times["light colour"]["median"],
        "times": times,
        "transport_bytes": getattr(scene.parts.packed, "n_bytes", None),
        "peak_mib": peak.stop(),
    }


def _of_edits(scene: Scene, quick: bool) -> Iterator[dict[str, Any]]:
    for size in _QUICK_EDITS if quick else _EDITS:
        stack = EMPTY_STACK if size == 0 else many_edits(scene.parts, size, size // 4)
        yield _point(scene, stack, quick, PeakMemory()) | {"what": "edits", "size": size}


def _of_lights(parts: Parts, quick: bool) -> Iterator[dict[str, Any]]:
    for size in _QUICK_LIGHTS if quick else _LIGHTS:
        peak = PeakMemory()
        scene = make_scene(_with_lights(parts, size))
        yield _point(scene, scene.stack, quick, peak) | {"what": "lights", "size": size}


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
    return parts.under(
        add_lights(replace(parts.snapshot, lights=empty, light_paths=(), light_controls=()), [*balls, dark])
    )


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


def points_of(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """All points, by what grows and by size."""
    found = [point for one in results if "result" in one for point in one["result"]["points"]]
    order = list(dict.fromkeys(point["what"] for point in found))
    return sorted(found, key=lambda point: (order.index(point["what"]), point["size"]))


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README."""
    rays = next((one["result"]["rays"] for one in results if "result" in one), {})
    said = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in rays.items())
    lines = [
        f"Built with {said}; what has no build time goes on with the transport of the first row.",
        "",
        "| size | transport | first frame | light colour | light move | amount | peak memory |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for point in points_of(results):
        frames = " | ".join(
            f"{1000 * point['times'][name]['median']:.1f} ms" for name in ("light colour", "light move", "amount")
        )
        built = f"{point['transport_seconds']:.1f} s" if "transport_seconds" in point else ""
        lines.append(
            f"| {point['size']:,} {point['what']} | {built} | {point['first_frame_seconds']:.1f} s |"
            f" {frames} | {point['peak_mib'] / 1024:.1f} GiB |"
        )
    return lines
