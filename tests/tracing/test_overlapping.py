"""Rays traced by several threads at once."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

CHILD = """
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from icheat_usd.kernels._jit import kernels_may_overlap
from icheat_usd.tracing import build_tracer
from tests.scenes import cornell
tracer = build_tracer(cornell(8, 8))
rng = np.random.default_rng(0)
origins, directions = rng.normal(size=(2, 768, 3)).astype(np.float32)
expected = tracer.occluded(origins, directions, 0.9)
if kernels_may_overlap():
    with ThreadPoolExecutor(2) as threads:
        for found in threads.map(lambda _: tracer.occluded(origins, directions, 0.9), range(10_000)):
            assert np.array_equal(found, expected)
print("whole")
"""


def test_shadow_rays_leave_the_memory_of_other_threads_alone() -> None:
    """Where Embree writes behind a packet that is too short, this dies of its heap, or never ends."""
    root = Path(__file__).parents[2]
    child = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, cwd=root, timeout=120)
    assert child.returncode == 0, child.stderr
    assert child.stdout == "whole\n"
