"""Memory that a renderer has freed is there for what comes next."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

_CHURN = """
import resource, sys
import numpy as np
from icheat_usd.cli.memory import keep_freed_memory

if sys.argv[1] == "keep":
    keep_freed_memory()

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for size in (1, 2, 20, 60):
        np.empty(size << 20, np.uint8).fill(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

faults()
print(faults())
"""


def faults(how: str) -> int:
    """Pages that the system cleared for arrays that had been there before, in a process of its own."""
    command = [sys.executable, "-c", _CHURN, how]
    environment = {"PATH": "", "NUMPY_MADVISE_HUGEPAGE": "0"}
    return int(subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_memory_that_was_freed_is_taken_again():
    assert faults("leave") > 1000
    assert faults("keep") < 100
