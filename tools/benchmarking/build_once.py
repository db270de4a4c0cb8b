"""One process that opens a stage and waits for its preview: ``python -m tools.benchmarking.build_once TASK``.

TASK is JSON: stage, width, height, quality, gather, output, and started, the clock when the process was asked for.
"""

from __future__ import annotations

import hashlib
import json
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np


def main(task: dict[str, Any]) -> None:
    """Times and peak memory up to each level of the preview."""
    import icheat_usd.session.quality as qualities
    from icheat_usd.session.live import LiveSession

    quality = getattr(qualities, task["quality"])
    if task["n_gather"]:
        quality = replace(quality, n_gather=task["n_gather"])
    opened = time.time()
    steps: dict[str, list[float]] = {}

    def heard(event: Any) -> None:
        if event.kind == "progress":
            now = time.time() - opened
            begin, _ = steps.setdefault(f"{event.step}", [now, now])
            steps[event.step] = [begin, now]

    found: dict[str, Any] = {"imports": opened - task["started"]}
    with LiveSession.open(task["stage"], width=task["width"], height=task["height"], quality=quality) as live:
        live.listen(heard)
        for level in ("preview", "full", "rest"):
            if not live.wait(level, timeout=3600):
                raise TimeoutError(f"{task['stage']} was not at level {level} within an hour")
            image = live.frame()
            found[level] = {"seconds": time.time() - opened, "peak_mib": _peak()}
    found["digest"] = hashlib.sha256(np.ascontiguousarray(image).tobytes()).hexdigest()
    found["steps"] = {name: {"from": begin, "to": end} for name, (begin, end) in steps.items()}
    Path(task["output"]).write_text(json.dumps(found))


def _peak() -> float:
    """MiB; the largest resident set so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
