"""How fast the machine is in the hour of a measurement: others may use it, too.

A figure by itself says little where the same code runs at half the speed an hour later. Beside a table stands what a
fixed piece of arithmetic and of reading took while its figures were measured, so that two tables can be compared.
"""

from __future__ import annotations

import time
from typing import Any

import numba
import numpy as np
from numba import prange

from icheat_usd.kernels.simd import address_of, multiply_add, spread, store, zeros
from tools.benchmarking.kernels import Work, reading
from tools.benchmarking.meter import Threads

_PARTS = 32
_STEPS = 1 << 14  # of 8 multiply-adds of 16 lanes
_READ_BYTES = 64 << 20  # more than fits a core's cache
_LOOKS = 3


@numba.njit(nogil=True)
def _turn(n):  # type: ignore[no-untyped-def]
    a = b = c = d = e = f = g = h = zeros()
    factor, one = spread(np.float32(0.999)), spread(np.float32(1.0))
    for _ in range(n):
        a, b = multiply_add(a, factor, one), multiply_add(b, factor, one)
        c, d = multiply_add(c, factor, one), multiply_add(d, factor, one)
        e, f = multiply_add(e, factor, one), multiply_add(f, factor, one)
        g, h = multiply_add(g, factor, one), multiply_add(h, factor, one)
    a, b, c, d = multiply_add(a, one, b), multiply_add(c, one, d), multiply_add(e, one, f), multiply_add(g, one, h)
    return multiply_add(multiply_add(a, one, b), one, multiply_add(c, one, d))


@numba.njit(nogil=True, parallel=True)
def multiply_adds(out):  # type: ignore[no-untyped-def]
    """A fixed number of multiply-adds in registers; sums go to `out` (32, 16)."""
    for part in prange(_PARTS):
        store(address_of(out) + 64 * part, _turn(_STEPS))


class Pace:
    """Speed of arithmetic and of reading with one thread and two, from looks taken between what is measured."""

    def __init__(self) -> None:
        out = np.empty((_PARTS, 16), np.float32)
        #: Work, and how much of its unit it is
        self._works: dict[str, tuple[Work, float]] = {
            "GFLOP/s": (lambda: multiply_adds(out), 2e-9 * _PARTS * _STEPS * 8 * 16),
            "GB/s": (reading(_READ_BYTES), 1e-9 * _READ_BYTES),
        }
        self._found: dict[str, dict[str, list[float]]] = {
            threads: {unit: [] for unit in self._works} for threads in ("2", "1")
        }
        for work, _ in self._works.values():
            work()

    def look(self) -> None:
        """Measure once more; takes some tens of milliseconds."""
        for threads, found in self._found.items():
            with Threads(int(threads)):
                for unit, (work, amount) in self._works.items():
                    for _ in range(_LOOKS):
                        start = time.perf_counter()
                        work()
                        found[unit].append(amount / (time.perf_counter() - start))

    def as_dict(self) -> dict[str, dict[str, float]]:
        """Medians by threads and unit."""
        return {
            threads: {unit: float(np.median(speeds)) for unit, speeds in found.items() if speeds}
            for threads, found in self._found.items()
        }


def said(pace: dict[str, Any] | None, unit: str) -> str:
    """A cell of a table: with two threads / with one."""
    if not pace or unit not in pace["2"]:
        return ""
    return f"{pace['2'][unit]:.3g} / {pace['1'][unit]:.3g}"
