"""A writer that is killed at any step loses nothing that was committed, and leaves nothing half-made in its way."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="writers are forked")
@pytest.mark.parametrize(
    ("verb", "stride", "outcomes"),
    [
        # Killed before anything had a name, with a sidecar that no layer names yet, and after the layer was saved.
        ("add", 1, {"early 0", "early 1", "late 0"}),
        # Every step takes minutes on a busy machine; all were seen to pass.
        ("publish", 3, {"as before 1", "as before 2", "repointed 2"}),
    ],
)
def test_a_writer_killed_at_any_step_leaves_every_stage_and_payload_whole(
    verb: str, stride: int, outcomes: set[str], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "tests.robustness.writer", "sweep", str(tmp_path), verb, str(stride)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    states = Counter(done.stdout.splitlines())
    assert set(states) == outcomes
    assert sum(states.values()) >= 60 // stride
