"""What becomes of memory that a process has freed: kept for what comes next, or given back to the system.

Both are asked of the C library, and nothing happens where that is not glibc.
"""

from __future__ import annotations

import ctypes
from typing import Any

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # numbers of `mallopt` in glibc's malloc.h
_MOST_FREE = 1 << 29  # bytes at the end of the heap that are kept for what comes next


def keep_freed_memory() -> None:
    """Take what was freed before for new arrays, from now on.

    The C library gives large arrays back as soon as they are freed, and the next one is new memory, which the system
    clears page by page: of a frame with 64 painted edits that was a tenth of the time. For programs of our own: a
    process that others share has an allocator of theirs.
    """
    mallopt = _of_c_library("mallopt")
    if mallopt is not None:
        mallopt(_MMAP_MAX, 0)  # mappings of their own are given back one by one
        mallopt(_TRIM_THRESHOLD, _MOST_FREE)


def give_freed_memory_back() -> None:
    """Let the system have what was freed up to now, which takes milliseconds.

    The C library keeps what lies between arrays that live on: in an hour of commands a tenth of all memory comes
    together so.
    """
    trim = _of_c_library("malloc_trim")
    if trim is not None:
        trim(0)


def _of_c_library(name: str) -> Any:
    """A function of it, None where it has no such one."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # musl and macOS have none, and Windows no library without a name
        return None
