"""Kernels that have not been compiled on this machine: all at once for an image, in turn for a live session."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence

from icheat_usd.errors import IcheatError
from icheat_usd.progress import Progress
from icheat_usd.session.warming import (
    LIVE_PURPOSES,
    STEP,
    are_compiled,
    compile_ahead,
    compile_in_turn,
    may_help,
)

#: From one report to the next, for who waits.
_REPORT_SECONDS = 0.1


def compile_first(purpose: str, progress: Progress, warn: Callable[[str], None] = warnings.warn) -> None:
    """Have all cores compile what one of `warming.PURPOSES` needs, where that helps.

    A failure is told, and left to whoever calls the kernel.
    """
    if not may_help():
        return
    try:
        compile_ahead((purpose,), progress=progress)
    except IcheatError as error:
        warn(f"{error}; it is compiled when it is called")


class FirstUse:
    """What a live session needs, in the order in which it needs it, while it shows what it can.

    Compiles in processes of its own, where it has not been done, until nobody wants it any more. Where that can't help,
    each kernel is compiled when it is called.
    """

    def __init__(self, purposes: Sequence[str] = LIVE_PURPOSES) -> None:
        self.users = set[int]()  #: by `id`
        self._shares = dict.fromkeys(purposes, 0.0)
        self._changed = threading.Condition()
        self._is_over = not may_help() or are_compiled(purposes)
        self._thread = threading.Thread(target=self._compile, name="icheat first use", daemon=True)
        if not self._is_over:
            self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether all is compiled, or what is not will not be here."""
        return self._is_over

    def is_done(self, purpose: str) -> bool:
        """Whether that is so for all that the purpose calls."""
        return self._is_over or self._shares[purpose] == 1.0

    def wait(self, purpose: str, progress: Progress) -> None:
        """Until it is done; what `progress` raises ends the waiting."""
        while not self.is_done(purpose):
            progress(STEP, self._shares[purpose])
            with self._changed:
                self._changed.wait(_REPORT_SECONDS)

    def close(self) -> None:
        """What has been compiled stays; the rest is compiled when it is called, or by the next session."""
        self._is_over = True
        if self._thread.is_alive():
            self._thread.join()

    def _compile(self) -> None:
        try:
            compile_in_turn(tuple(self._shares), self._report)
        except _ClosedError:
            pass
        except IcheatError as error:
            warnings.warn(f"{error}; it is compiled when it is called", stacklevel=1)
        finally:
            self._is_over = True

    def _report(self, purpose: str, share: float) -> None:
        if self._is_over:
            raise _ClosedError
        with self._changed:
            self._shares[purpose] = share
            self._changed.notify_all()


class _ClosedError(Exception):
    """Nobody needs it any more."""


_lock = threading.Lock()
_shared: list[FirstUse] = []  # one at most: sessions that are opened together would compile the same


def begin_use(user: object) -> FirstUse:
    """The one of this process, begun if need be; to be ended by `end_use`."""
    with _lock:
        if not _shared or _shared[0].is_over:
            _shared[:] = [FirstUse()]
        _shared[0].users.add(id(user))
        return _shared[0]


def end_use(use: FirstUse, user: object) -> None:
    """One user less; the last one closes it. Ending twice does nothing."""
    with _lock:
        if id(user) not in use.users:
            return
        use.users.discard(id(user))
        is_last = not use.users
        if is_last and use in _shared:
            _shared.clear()
    if is_last:
        use.close()
