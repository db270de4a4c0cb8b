"""Suite `killed`: a sequence whose process is killed at random and started again has the frames of one left alone."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.errors import IcheatError
from icheat_usd.image.exr import read_exr
from tools.benchmarking.parts import Effort
from tools.benchmarking.render_sequence import STAGE
from tools.benchmarking.runner import ROOT

_FRAMES, _QUICK_FRAMES = 12, 2
_KILLS, _QUICK_KILLS = 10, 1
_SIZE, _QUICK_SIZE = (320, 240), (12, 9)


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """The animated sample stage, whatever stages are named."""
    return [{"stage": str(ROOT / STAGE)}]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """What was on disk after each kill, and whether all frames are those of the undisturbed run in the end."""
    with tempfile.TemporaryDirectory() as scratch:
        alone, killed = Path(scratch) / "alone", Path(scratch) / "killed"
        alone.mkdir()
        killed.mkdir()
        start = time.perf_counter()
        _run(case["stage"], alone, quick).wait()
        whole = time.perf_counter() - start
        kills = [_kill_one(case["stage"], killed, quick, i, whole) for i in range(_QUICK_KILLS if quick else _KILLS)]
        start = time.perf_counter()
        status = _run(case["stage"], killed, quick).wait()
        frames = {name: _pixels(killed / name) == _pixels(alone / name) for name in _names(quick)}
        files = {name: _bytes(killed / name) == _bytes(alone / name) for name in _names(quick)}
        return {
            "frames": len(frames),
            "seconds_alone": whole,
            "seconds_last": time.perf_counter() - start,
            "status": status,
            "kills": kills,
            "half_written": sum(len(kill["unreadable"]) for kill in kills),
            "done_again": sum(len(kill["done_again"]) for kill in kills),
            "same_pixels": sum(frames.values()),
            "same_files": sum(files.values()),
            "left_behind": sorted(p.name for p in killed.iterdir() if p.name not in frames),
        }


def _names(quick: bool) -> list[str]:
    return [f"frame.{i:04d}.exr" for i in range(1, 1 + (_QUICK_FRAMES if quick else _FRAMES))]


def _run(stage: str, folder: Path, quick: bool) -> subprocess.Popen[bytes]:
    width, height = _QUICK_SIZE if quick else _SIZE
    command = [sys.executable, "-m", "icheat_usd", "render", stage, "--frames", f"1:{len(_names(quick))}"]
    command += ["--width", str(width), "--height", str(height), "--method", "brute", "--samples", "1"]
    command += ["--rays", "16", "-o", str(folder / "frame.####.exr")]
    output = subprocess.DEVNULL
    return subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output, start_new_session=True)


def _kill_one(stage: str, folder: Path, quick: bool, number: int, whole: float) -> dict[str, Any]:
    """Start, kill after a random part of what a whole run takes, and look at what is there."""
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("frame.*.exr")}
    rng = np.random.default_rng([number, 0x51])
    # Beyond a third nothing would be left for the last of ten.
    delay = float(rng.uniform(0.05, 0.35)) * whole
    process = _run(stage, folder, quick)
    try:
        process.wait(delay)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    there = sorted(folder.glob("frame.*.exr"))
    return {
        "after_seconds": delay,
        "status": process.returncode,
        "there": len(there),
        "unreadable": [path.name for path in there if _pixels(path) is None],
        "done_again": [name for name, written in before.items() if (folder / name).stat().st_mtime_ns != written],
    }


def _pixels(path: Path) -> str | None:
    """Digest of all layers; None where the file is missing or cannot be read."""
    try:
        film = read_exr(path)
    except (IcheatError, OSError):
        return None
    digest = hashlib.sha256()
    for name in sorted(film.layers):
        digest.update(name.encode() + film.layers[name].tobytes())
    return digest.hexdigest()


def _bytes(path: Path) -> str | None:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.exists() else None


def markdown(results: list[dict[str, Any]]) -> list[str]:
    """A sentence for README."""
    lines = []
    for found in (one["result"] for one in results if "result" in one):
        n_killed = sum(kill["status"] < 0 for kill in found["kills"])
        lines.append(
            f"Killed {n_killed} times of {len(found['kills'])} starts (the others had ended); afterwards"
            f" {found['same_pixels']} of {found['frames']} frames have the pixels of an undisturbed run"
            f" ({found['same_files']} the same files), {found['half_written']} half-written frames were seen,"
            f" {found['done_again']} finished ones were rendered again, left behind:"
            f" {', '.join(found['left_behind']) or 'nothing'}. Alone {found['seconds_alone']:.1f} s, the last start"
            f" {found['seconds_last']:.1f} s."
        )
    return lines
