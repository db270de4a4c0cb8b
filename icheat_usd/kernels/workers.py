"""Numba's workers."""

from __future__ import annotations

import numba


def start_workers() -> None:
    """Start them before a parallel kernel does, so that it is known from the first one on whether kernels overlap."""
    numba.get_num_threads()
