"""Two processes write at once: both edits are kept, or one writer is told; none is lost in silence."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.robustness.writer import edits, make_stage, verify_sidecars

ROOT = Path(__file__).parents[2]

N_EDITS = 25


@pytest.mark.parametrize("layers", [("shot.usda", "shot.usda"), ("shot.usda", "scene.usda")])
def test_two_writers_at_once_lose_nothing_in_silence(layers: tuple[str, str], tmp_path: Path) -> None:
    stage = make_stage(tmp_path)
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "tests.robustness.writer", "loop", str(N_EDITS), str(stage), layer, name],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for layer, name in zip(layers, ("ann", "bob"), strict=True)
    ]
    for process in processes:  # both have imported everything and wait
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("go\n")
        process.stdin.flush()
    said = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
    lines = [line for out, _ in said for line in out.splitlines()]
    kept = {line.split()[1] for line in lines if line.startswith("kept ")}
    told = [line for line in lines if line.startswith("told ")]
    assert len(kept) + len(told) == 2 * N_EDITS
    assert all("changed on disk since it was read" in line for line in told), told
    # What a writer was told it kept is there; what it was told it lost is not.
    assert set(edits(stage)) == kept and kept
    assert verify_sidecars(tmp_path) >= len(kept)
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
