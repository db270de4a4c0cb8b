"""Runs cases in child processes and adds up how they went."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass
class Tally:
    """How the cases went; everything but `refused` and `accepted` is a fault."""

    kind: str
    refused: int = 0
    accepted: int = 0
    faults: dict[int, str] = field(default_factory=dict)  #: by case number
    memory_bytes: int = 0  #: the most that reading one case added to a process's peak
    seconds: float = 0.0

    @property
    def n_cases(self) -> int:
        return self.refused + self.accepted + len(self.faults)

    def __str__(self) -> str:
        grouped = Counter(fault.split(" (")[0][:120] for fault in self.faults.values())
        lines = [
            f"{self.n_cases} mutated {self.kind}s in {self.seconds:.1f} s: {self.refused} refused, {self.accepted} "
            f"accepted, {len(self.faults)} faults; the most memory one added: {self.memory_bytes / 2**20:.1f} MiB"
        ]
        lines += [f"  {count} x {fault}" for fault, count in grouped.most_common()]
        lines += [f"  case {number}: {fault}" for number, fault in sorted(self.faults.items())[:40]]
        return "\n".join(lines)


def run(kind: str, begin: int, end: int, folder: Path, *, seconds: float = 600.0) -> Tally:
    """Read the cases from `begin` up to `end`; a child that dies is replaced, and goes on after what killed it."""
    started = time.monotonic()
    tally = Tally(kind)
    folder.mkdir(parents=True, exist_ok=True)
    outcomes = folder / "outcomes"
    outcomes.unlink(missing_ok=True)
    number = begin
    while number < end:
        command = [sys.executable, "-m", "tools.fuzzing.child", kind, str(number), str(end), str(folder)]
        left = max(1.0, seconds - (time.monotonic() - started))
        try:
            child = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=left, check=False)
            died = _death(child.returncode)
            said = child.stderr.decode(errors="replace").strip().splitlines()[-1:] if died else []
        except subprocess.TimeoutExpired:
            died, said = "out of time", []
        done = [json.loads(line) for line in outcomes.read_text().splitlines()] if outcomes.exists() else []
        number = done[-1][0] + 1 if done and done[-1][0] >= number else number
        if died and number < end:
            tally.faults[number] = " ".join([died, *said])
            with outcomes.open("a") as file:
                file.write(json.dumps([number, "", 0]) + "\n")
            number += 1
            if died == "out of time":
                break
    for case, outcome, added in [json.loads(line) for line in outcomes.read_text().splitlines()]:
        tally.memory_bytes = max(tally.memory_bytes, added)
        if outcome == "refused":
            tally.refused += 1
        elif outcome == "accepted":
            tally.accepted += 1
        elif outcome:
            tally.faults[case] = outcome
    tally.seconds = time.monotonic() - started
    return tally


def _death(returncode: int) -> str:
    if returncode == 0:
        return ""
    if returncode == -signal.SIGALRM:
        return "hang"
    return f"crash: {signal.Signals(-returncode).name}" if returncode < 0 else f"crash: exit {returncode}"
