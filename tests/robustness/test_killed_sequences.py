"""A sequence that is killed at any moment goes on where it was, and ends as the bytes of one that never was."""

from __future__ import annotations

import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.cli.sequence_stage import QUICK, STAGE, make_stage

ROOT = Path(__file__).parents[2]
N_FRAMES = 6


def render(folder: Path) -> list[str]:
    outs = ["-o", str(folder / "f.####.exr"), "-o", str(folder / "f.####.png")]
    words = ["render", str(folder / "shot.usda"), "--frames", f"1:{N_FRAMES}", *outs, *QUICK]
    return [sys.executable, "-m", "icheat_usd", *words, "--aov", "beauty", "--aov", "crypto_object"]


def files(folder: Path) -> set[str]:
    """Images, and what is on its way to be one."""
    return {path.name for path in folder.iterdir() if path.name.startswith(("f.", ".f."))}


def finished(folder: Path) -> set[str]:
    return {name for name in files(folder) if not name.endswith(".tmp")}


@pytest.mark.slow
def test_a_sequence_killed_at_random_ends_as_if_nothing_had_happened(tmp_path: Path) -> None:
    # Images say which stage they are of, so that it must lie in the same place.
    work, expected = tmp_path / "work", tmp_path / "expected"
    work.mkdir()
    expected.mkdir()
    make_stage(work, STAGE.replace("(16, 12)", "(64, 48)"))
    subprocess.run(render(work), cwd=ROOT, check=True, capture_output=True)
    for name in files(work):
        shutil.move(work / name, expected / name)
    assert len(files(expected)) == 2 * N_FRAMES

    moments = random.Random(5)
    partial = 0
    for awaited in (".tmp", ".exr", "", ".tmp"):
        before = files(work)
        process = subprocess.Popen(render(work), cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while awaited and process.poll() is None and not any(n.endswith(awaited) for n in files(work) - before):
            time.sleep(0.001)
        time.sleep(moments.uniform(0, 0.02 if awaited else 1.0))
        process.send_signal(signal.SIGKILL)
        process.wait(timeout=60)
        there = finished(work)
        partial += 0 < len(there) < 2 * N_FRAMES
        for name in there:
            assert (work / name).read_bytes() == (expected / name).read_bytes(), name
    assert partial >= 2
    time.sleep(1.1)  # what was left in the last second might still be in use
    kept = {name: (work / name).stat().st_mtime_ns for name in finished(work)}
    subprocess.run(render(work), cwd=ROOT, check=True, capture_output=True)
    assert files(work) == files(expected)
    assert all((work / name).read_bytes() == (expected / name).read_bytes() for name in files(expected))
    assert all((work / name).stat().st_mtime_ns == moment for name, moment in kept.items())
