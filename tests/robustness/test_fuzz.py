"""A part of what `tools/fuzz` reads: no crash, no hang, no file outside, bounded memory, always one clear error."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tools.fuzzing.runner import run

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="what is opened is seen through inotify")


def test_mutated_sidecars_are_refused_or_read(tmp_path: Path) -> None:
    tally = run("sidecar", 0, 800, tmp_path)
    assert not tally.faults, str(tally)
    assert tally.n_cases == 800 and tally.refused > 400 and tally.accepted > 60
    # Payloads here declare 8 MiB at most, so that reading may take twice that and two chunks of 1 MiB.
    assert tally.memory_bytes < 24 << 20


def test_mutated_layers_are_refused_or_read(tmp_path: Path) -> None:
    tally = run("layer", 0, 250, tmp_path)
    assert not tally.faults, str(tally)
    assert tally.n_cases == 250 and tally.refused > 60 and tally.accepted > 60


def test_a_crash_and_a_hang_would_be_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The harness itself: children that die, and files outside that are opened, are faults of their case."""
    harness = tmp_path / "harness"
    (harness / "tools" / "fuzzing").mkdir(parents=True)
    for name in ("__init__.py", "fuzzing/__init__.py"):
        (harness / "tools" / name).write_text("")
    (harness / "tools" / "fuzzing" / "child.py").write_text((ROOT / "tools" / "fuzzing" / "child.py").read_text())
    (harness / "tools" / "fuzzing" / "layers.py").write_text(
        "import ctypes, os, signal, time\n"
        "def case(number, folder):\n"
        "    (folder / 'secret' / 'x').write_text('')\n"
        "    path = folder / str(number)\n"
        "    path.write_text('')\n"
        "    return path\n"
        "def read(path):\n"
        "    number = int(path.name)\n"
        "    if number == 12: os.kill(os.getpid(), signal.SIGSEGV)\n"
        "    if number == 14: os.kill(os.getpid(), signal.SIGALRM)\n"
        "    if number == 16: (path.parent / 'secret' / 'x').read_text()\n"
        "    if number == 18: raise TypeError('of our own')\n"
        "    return 'accepted'\n"
    )
    monkeypatch.setattr("tools.fuzzing.runner.ROOT", harness)
    tally = run("layer", 10, 20, tmp_path / "cases")
    assert sorted(tally.faults) == [12, 14, 16, 18] and tally.accepted == 6
    assert tally.faults[12].startswith("crash: SIGSEGV") and tally.faults[14].startswith("hang")
    assert "outside was opened" in tally.faults[16] and "TypeError: of our own" in tally.faults[18]
