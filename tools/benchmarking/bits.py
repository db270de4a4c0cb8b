"""Suite `bits`: same bits for any number of threads, and the slow evaluator's image where nothing is compressed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits.binding import bind
from icheat_usd.edits.model import EMPTY_STACK, EditStack
from icheat_usd.relight import Relighter
from icheat_usd.relight.live import LiveRelighter
from tools.benchmarking.build import run_once
from tools.benchmarking.errors import error_edits
from tools.benchmarking.made_up_edits import many_edits
from tools.benchmarking.parts import Effort, Parts

_SMALL = Effort(96, 72, 2048)
_TINY = Effort(24, 18, 256)


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """Every stage, small."""
    return [{"stage": stage} for stage in stages]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """Digests of a whole build by threads, and the largest difference to the slow evaluator."""
    small = _TINY if quick else _SMALL
    digests = {}
    with tempfile.TemporaryDirectory() as scratch:
        for threads in ("1", "2"):
            environment = os.environ | {"NUMBA_NUM_THREADS": threads, "ICHEAT_CACHE_SIZE": "0"}
            digests[threads] = run_once(case["stage"], small, environment, Path(scratch) / "out.json")["digest"]
    differences = _against_slow(Parts(case["stage"], small), 4 if quick else 16)
    print(
        f"  same bits: {digests['1'] == digests['2']}; largest difference {max(differences.values()):.1e}", flush=True
    )
    return {"digests": digests, "same_bits": digests["1"] == digests["2"], "differences": differences}


def _against_slow(parts: Parts, n_edits: int) -> dict[str, float]:
    """Largest difference at a view sample over the root mean square light, by stack."""
    transport = parts.transport
    parts.refine_lights()
    live = LiveRelighter(parts.snapshot, parts.view, parts.gather, transport, parts.lights)
    slow = Relighter(parts.view, parts.gather, transport, parts.lights.view_direct, parts.lights.cell_light())
    stacks = {"no edit": EMPTY_STACK, f"{n_edits} edits": many_edits(parts, n_edits, n_edits // 4)}
    stacks |= {name: EditStack("/edit", (edit,)) for name, edit in error_edits(parts).items()}
    found = {}
    for name, stack in stacks.items():
        live.set_stack(stack)
        fast = live.relit().indirect_edited
        exact = slow.relight(bind(stack, parts.snapshot)).indirect_edited
        scale = max(float(np.sqrt((exact.astype(np.float64) ** 2).mean())), 1e-20)
        found[name] = float(np.abs(fast.astype(np.float64) - exact).max()) / scale
    return found


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """Table for README."""
    lines = [
        "| stage | same bits for one thread and two | largest difference to the slow evaluator, uncompressed |",
        "| --- | --- | ---: |",
    ]
    for one in results:
        if "result" in one:
            found = one["result"]
            worst = max(found["differences"].values())
            lines.append(f"| {one['case']['name']} | {'yes' if found['same_bits'] else 'NO'} | {worst:.1e} |")
    return lines
