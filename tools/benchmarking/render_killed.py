"""Suite `killed`: a sequence whose process is killed and started again has the frames of one left alone.

Ten times it is killed at random, and then as often as given while a file is being written, which chance rarely meets.
"""

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

_FRAMES, _QUICK_FRAMES = 16, 2
_KILLS, _QUICK_KILLS = 10, 1
_WHILE_WRITING = 3
_SIZE, _QUICK_SIZE = (160, 120), (12, 9)

#: Random kills come at most so many frames after the first one is begun: later, and none would be left for the last.
_FRAMES_A_KILL = 2.0


def cases(stages: list[str], quick: bool) -> list[dict[str, Any]]:
    """The animated sample stage, whatever stages are named."""
    return [{"stage": str(ROOT / STAGE)}]


def measure(case: dict[str, Any], effort: Effort, quick: bool, folder: Path) -> dict[str, Any]:
    """What was on disk after each kill, and whether all frames are those of the undisturbed run in the end."""
    with tempfile.TemporaryDirectory() as scratch:
        alone, killed = Path(scratch) / "alone", Path(scratch) / "killed"
        alone.mkdir()
        killed.mkdir()
        # Twice, as the first one may compile.
        one = [_seconds(case["stage"], alone, quick, 1) for _ in range(2)][-1]
        whole = _seconds(case["stage"], alone, quick, len(_names(quick)))
        latest = one + (_FRAMES_A_KILL - 1) * (whole - one) / (len(_names(quick)) - 1)
        delays = np.random.default_rng(0x51).uniform(0, latest, _QUICK_KILLS if quick else _KILLS)
        kills = [_kill_one(case["stage"], killed, quick, float(delay)) for delay in delays]
        kills += [_kill_one(case["stage"], killed, quick, None) for _ in range(1 if quick else _WHILE_WRITING)]
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


def _seconds(stage: str, folder: Path, quick: bool, frames: int) -> float:
    """Of the first frames, whether they are there or not."""
    start = time.perf_counter()
    _run(stage, folder, quick, frames, "--force").wait()
    return time.perf_counter() - start


def _run(stage: str, folder: Path, quick: bool, frames: int = 0, *more: str) -> subprocess.Popen[bytes]:
    """As a user starts it, at full effort; a quick one by brute force, which has less to load."""
    width, height = _QUICK_SIZE if quick else _SIZE
    shown = f"1:{frames or len(_names(quick))}"
    command = [sys.executable, "-m", "icheat_usd", "render", stage, "--frames", shown, *more]
    command += ["--width", str(width), "--height", str(height), "-o", str(folder / "frame.####.exr")]
    command += ["--method", "brute", "--samples", "1", "--rays", "16"] if quick else ["--method", "cached"]
    output = subprocess.DEVNULL
    return subprocess.Popen(command, cwd=ROOT, stdout=output, stderr=output, start_new_session=True)


def _kill_one(stage: str, folder: Path, quick: bool, delay: float | None) -> dict[str, Any]:
    """Start, kill after so many seconds, or once a file is being written, and look at what is there."""
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("frame.*.exr")}
    others = {path.name for path in folder.iterdir()}
    start = time.perf_counter()
    process = _run(stage, folder, quick)
    while process.poll() is None:
        is_writing = any(path.name not in others for path in folder.iterdir())
        if is_writing if delay is None else time.perf_counter() - start >= delay:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        else:
            time.sleep(0.001)
    there = sorted(folder.glob("frame.*.exr"))
    return {
        "after_seconds": time.perf_counter() - start,
        "while_writing": delay is None,
        "partial": [path.name for path in folder.iterdir() if path.name not in _names(quick)],
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
        at_random = [kill for kill in found["kills"] if not kill["while_writing"]]
        n_killed, n_writing = (
            sum(kill["status"] < 0 for kill in found["kills"] if kill["while_writing"] is writing)
            for writing in (False, True)
        )
        lines.append(
            f"Killed {n_killed} times at random in {len(at_random)} starts (in the others the sequence had ended), and"
            f" {n_writing} times while a frame was being written. Afterwards {found['same_pixels']} of"
            f" {found['frames']} frames have the pixels of an undisturbed run ({found['same_files']} are the same"
            f" files). Seen on the way: {found['half_written']} frames that could not be read,"
            f" {found['done_again']} finished ones that were rendered again. Left behind:"
            f" {', '.join(found['left_behind']) or 'nothing'}. The undisturbed run took {found['seconds_alone']:.1f} s,"
            f" the last start {found['seconds_last']:.1f} s."
        )
    return lines
