"""Times, peak memory, and what they were measured on."""

from __future__ import annotations

import gc
import os
import platform
import statistics
import sys
import threading
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

_PACKAGES = ("icheat-usd", "usd-core", "numpy", "numba", "llvmlite", "scipy", "mkl", "sparse_dot_mkl", "embreex")


class PeakMemory:
    """Largest resident set of this process while it is open, sampled every 10 ms."""

    def __init__(self) -> None:
        import psutil

        self._process = psutil.Process()
        self.begin = self._peak = self._process.memory_info().rss
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._done.wait(0.01):
            self._peak = max(self._peak, self._process.memory_info().rss)

    def stop(self) -> float:
        """MiB."""
        self._done.set()
        self._thread.join()
        return float(max(self._peak, self._process.memory_info().rss) / 2**20)


class Meter:
    """Wall time and peak resident memory of named steps."""

    def __init__(self) -> None:
        self.steps: list[dict[str, Any]] = []

    def measure(self, name: str, work: Callable[[], Any], repeat: int = 1) -> Any:
        """Run `work`, `repeat` times; record the median time, the spread and the peak memory."""
        peak = PeakMemory()
        times = []
        for _ in range(repeat):
            start = time.perf_counter()
            result = work()
            times.append(time.perf_counter() - start)
        found = {
            "step": name,
            "seconds": statistics.median(times),
            "min": min(times),
            "max": max(times),
            "repeat": repeat,
            "peak_mib": peak.stop(),
        }
        self.steps.append(found)
        print(f"  {name:<28} {found['seconds']:9.3f} s  peak {found['peak_mib']:7.0f} MiB", flush=True)
        return result


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        models = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = models[0] if models else model
    found: dict[str, Any] = {
        "cpu": model,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "system": platform.system(),
        "versions": _versions(),
    }
    try:
        import psutil

        found["memory_gib"] = round(psutil.virtual_memory().total / 2**30, 1)
        found["load_average"] = round(psutil.getloadavg()[0], 2)
    except ImportError:
        pass
    return found


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def summary(seconds: Sequence[float]) -> dict[str, Any]:
    """Median, quartiles and extremes of repeated times; seconds."""
    times = np.asarray(seconds, np.float64)
    quartiles = np.percentile(times, (25, 50, 75))
    return {
        "n": len(times),
        "median": float(quartiles[1]),
        "quartile_1": float(quartiles[0]),
        "quartile_3": float(quartiles[2]),
        "min": float(times.min()),
        "max": float(times.max()),
    }


def repeat(work: Callable[[int], object], *, least: int = 11, most: int = 201, seconds: float = 2.0) -> list[float]:
    """Times of `work(i)` for i = 0, 1, ...: at least `least`, then until `seconds` have passed or `most` are taken.

    The first two runs fill caches and are left out. Garbage is collected before, not during.
    """
    for i in range(2):
        work(i)
    gc.collect()
    gc.disable()
    times: list[float] = []
    try:
        begin = time.perf_counter()
        while len(times) < least or (len(times) < most and time.perf_counter() - begin < seconds):
            start = time.perf_counter()
            work(len(times) + 2)
            times.append(time.perf_counter() - start)
    finally:
        gc.enable()
    return times


class Threads:
    """Runs a block on fewer threads than the machine has: ``with Threads(1): ...``."""

    def __init__(self, n: int) -> None:
        self._n = n

    def __enter__(self) -> None:
        import numba

        self._before = numba.get_num_threads()
        numba.set_num_threads(min(self._n, numba.config.NUMBA_NUM_THREADS))

    def __exit__(self, *_: object) -> None:
        import numba

        numba.set_num_threads(self._before)


def command() -> str:
    """The command line of this run, as one types it."""
    return " ".join(["tools/benchmark", *sys.argv[1:]])
