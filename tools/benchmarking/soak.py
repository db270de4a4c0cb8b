"""Suite `soak`: random commands at a live session for a long time; memory stays flat and the end is right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from icheat_usd.session.live import LiveSession
from tools.benchmarking.parts import Effort
from tools.benchmarking.play import frames_of
from tools.soaking import soak


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """The first stage, which by default is animated; small, so that an hour holds many commands."""
    return [{"stage": stages[0]}]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Commands by kind, memory over time, and whether a fresh session shows the same bits."""
    effort = Effort(32, 24, 512) if quick else Effort(160, 120, 4096)
    quality = replace(effort.settings(), record_rays=512)
    frames = frames_of(case["stage"])
    seconds = 3.0 if quick else 60 * case["minutes"]

    def start() -> LiveSession:
        size = {"width": effort.width, "height": effort.height}
        return LiveSession.open(case["stage"], frame=frames[0] if frames else None, **size, quality=quality)

    with start() as live:
        live.wait("rest")
        every = max(0.5, seconds / 240)
        found = soak(live, start, seconds=seconds, frames=frames, every=every, say=lambda line: print(line, flush=True))
    return {
        "seconds": found.seconds,
        "commands": dict(found.commands.most_common()),
        "refused": dict(found.refused.most_common(20)),
        "memory": found.memory,
        "growth": found.growth,
        "slowdown": found.slowdown,
        "same_bits_as_fresh": found.is_equal,
        "differences": found.differences,
    }


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """One line per stage."""
    lines = []
    for one in results:
        if "result" in one:
            found = one["result"]
            count, minutes = sum(found["commands"].values()), found["seconds"] / 60
            end = (
                f"the same bits as a fresh session in {len(found['differences'])} states"
                if found["same_bits_as_fresh"]
                else f"off by {max(found['differences']):.2g}"
            )
            lines.append(
                f"{one['case']['name']}: {count:,} commands in {minutes:.0f} min;"
                f" memory {100 * found['growth']:+.1f} % from the second quarter to the last; at the end"
                f" {end}."
            )
    return lines
