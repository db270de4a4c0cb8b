"""Playing frames that are resident in memory, each with a light that has just changed, so that no image is kept."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from icheat_usd.session.document import Session
from icheat_usd.session.live import LiveSession
from tools.benchmarking.meter import repeat, summary
from tools.benchmarking.parts import Effort

_FRAMES = 4  # built in full, which is what takes long


def frames_of(stage: str) -> list[float]:
    """Some frames of a stage that is animated, else none."""
    opened = Session.open(stage).stage
    start, end = opened.GetStartTimeCode(), opened.GetEndTimeCode()
    if end <= start:
        return []
    return [start + i for i in range(min(_FRAMES, int(end - start) + 1))]


def measure_play(stage: str, effort: Effort, quick: bool) -> dict[str, Any]:
    """Frames per second of scrubbing with a new light at each frame, and memory of each."""
    frames = frames_of(stage)
    level = "preview" if quick else "full"
    size = {"width": effort.width, "height": effort.height}
    with LiveSession.open(stage, **size, quality=effort.settings()) as live:
        start = time.perf_counter()
        bytes_of = {}
        for frame in frames:
            live.scrub(frame)
            if not live.wait(level, timeout=3600):
                raise TimeoutError(f"frame {frame} of {Path(stage).name} was not at level {level} within an hour")
            bytes_of[frame] = live.memory()["total"]
        built = time.perf_counter() - start
        light = next(iter(live.lights))

        def step(i: int) -> Any:
            live.scrub(frames[i % len(frames)])
            live.set_light(light, gain=1 + 0.1 * (i % 7))
            return live.frame()

        limits = {"least": 2, "most": 2} if quick else {"least": 11, "most": 101}
        samples = repeat(step, seconds=2.0, **limits)
        counts = list(bytes_of.values())
        return {
            "frames": len(frames),
            "level": level,
            "build_seconds": built,
            "bytes_of_first": counts[0],
            "bytes_of_each_more": (counts[-1] - counts[0]) / max(len(counts) - 1, 1),
            "limit": live.memory()["limit"],
            "seconds": summary(samples) | {"samples": samples},
            "fps": 1 / summary(samples)["median"],
        }
