"""A session gives memory that it has freed back to the system, now and then."""

from __future__ import annotations

import platform
import subprocess
import sys
import threading

import pytest

from icheat_usd.session import background
from icheat_usd.session.background import Background

_CHURN = """
import os
import numpy as np
from icheat_usd.session.freed_memory import give_freed_memory_back

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE") >> 20

# Some of what was made side by side lives on.
arrays = [np.ones(16 << 10, np.uint8) for _ in range(8 << 10)]
arrays = arrays[::64]
before = resident()
give_freed_memory_back()
print(before - resident())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="malloc_trim is glibc's")
def test_memory_between_arrays_that_live_on_is_given_back():
    found = subprocess.run([sys.executable, "-c", _CHURN], capture_output=True, text=True, check=True)
    assert int(found.stdout) > 100  # MiB, of 126 that were freed


def _tidied(monkeypatch: pytest.MonkeyPatch, seconds: float) -> tuple[Background, threading.Semaphore]:
    monkeypatch.setattr(background, "_TIDY_SECONDS", seconds)
    calls = threading.Semaphore(0)
    one = Background(lambda: None, lambda error: None, tidy=calls.release)
    one.start()
    return one, calls


def test_the_background_tidies_up_once_after_the_last_command(monkeypatch: pytest.MonkeyPatch):
    one, calls = _tidied(monkeypatch, 0.1)
    try:
        assert not calls.acquire(timeout=0.3), "nothing has happened yet"
        one.wake()
        assert calls.acquire(timeout=10)
        assert not calls.acquire(timeout=0.3), "nothing has happened since"
        one.wake()
        assert calls.acquire(timeout=10)
    finally:
        one.close()


def test_the_background_tidies_up_while_commands_go_on(monkeypatch: pytest.MonkeyPatch):
    one, calls = _tidied(monkeypatch, 0.05)
    try:
        for _ in range(2000):
            one.wake()
            if calls.acquire(timeout=0.005):
                break
        else:
            pytest.fail("commands kept it from tidying up")
    finally:
        one.close()


def test_the_background_does_not_tidy_up_all_the_time(monkeypatch: pytest.MonkeyPatch):
    one, calls = _tidied(monkeypatch, 1000.0)
    try:
        for _ in range(100):
            one.wake()
        assert not calls.acquire(timeout=0.2)
    finally:
        one.close()
