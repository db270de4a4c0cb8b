"""One writer at a time between looking at a layer's file and replacing it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from icheat_usd.errors import EditError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

_TIMEOUT_SECONDS = 10.0


@contextmanager
def locked(file: str) -> Iterator[None]:
    """Hold the lock of a file: ``.<name>.icheat-lock`` beside it, locked by the operating system.

    The lock dies with its process, so that none is ever stale; a lock file
    that a killed process left behind is empty, unlocked and used again. Where
    the folder or its file system knows no locks this does nothing.

    Raises
    ------
    EditError
        Another process held the lock for ten seconds.
    """
    name = os.path.join(os.path.dirname(file), f".{os.path.basename(file)}.icheat-lock")
    descriptor = _acquire(name, file) if fcntl else None
    try:
        yield
    finally:
        if descriptor is not None:
            # Removed while it is held: whoever waits for it sees that the name has gone, and makes a new one.
            with suppress(OSError):
                os.unlink(name)
            os.close(descriptor)


def _acquire(name: str, file: str) -> int | None:
    deadline = time.monotonic() + _TIMEOUT_SECONDS
    while True:
        try:
            descriptor = os.open(name, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError:
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(descriptor).st_ino == os.stat(name).st_ino:
                return descriptor
        except BlockingIOError:
            pass
        except FileNotFoundError:
            pass  # released, and removed, between opening and locking
        except OSError:
            os.close(descriptor)
            return None
        os.close(descriptor)
        if time.monotonic() > deadline:
            raise EditError(f"{file} is being saved by another process; try again in a moment")
        time.sleep(0.005)
