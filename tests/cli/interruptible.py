"""Processes that can be interrupted, whatever the tests were started by."""

from __future__ import annotations

import signal
import subprocess
from functools import partial


def start(command: list[str]) -> subprocess.Popen[str]:
    """A process with its output in pipes: shells let what they start in the background ignore interrupts."""
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed)
