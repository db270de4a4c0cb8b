"""Memory that was freed is there for what comes next, or is given back."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="asks glibc")

_KEEPING = """
import resource, sys
import numpy as np
from icheat_usd.freed_memory import keep_freed_memory

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

_GIVING = """
import os
import numpy as np
from icheat_usd.freed_memory import give_freed_memory_back

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") >> 20

# Some of what was made side by side lives on.
arrays = [np.ones(16 << 10, np.uint8) for _ in range(8 << 10)]
arrays = arrays[::64]
before = resident()
give_freed_memory_back()
print(before - resident())
"""


def faults(how: str) -> int:
    """Pages that the system cleared for arrays that had been there before, in a process of its own."""
    command = [sys.executable, "-c", _KEEPING, how]
    environment = {"PATH": "", "NUMPY_MADVISE_HUGEPAGE": "0"}
    return int(subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout)


def test_memory_that_was_freed_is_taken_again():
    assert faults("leave") > 1000
    assert faults("keep") < 100


def test_memory_between_arrays_that_live_on_is_given_back():
    found = subprocess.run([sys.executable, "-c", _GIVING], capture_output=True, text=True, check=True)
    assert int(found.stdout) > 100  # MiB, of 126 that were freed
