"""How the process that renders takes memory from the system.

The C library gives large arrays back as soon as they are freed, and the next one is new memory, which the system
clears page by page: of a frame with 64 painted edits that was a tenth of the time.
"""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _MMAP_MAX = -1, -4  # numbers of `mallopt` in glibc's malloc.h
_MOST_FREE = 1 << 29  # bytes at the end of the heap that are kept for what comes next


def keep_freed_memory() -> None:
    """Take what was freed before for new arrays; does nothing where the C library is not glibc.

    For programs of our own: a process that others share has an allocator of theirs.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # musl and macOS have none, and Windows no library without a name
        return
    mallopt(_MMAP_MAX, 0)  # mappings of their own are given back one by one
    mallopt(_TRIM_THRESHOLD, _MOST_FREE)
