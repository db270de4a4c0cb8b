"""Tells who waits that kernels are being compiled, which in a new installation takes longer than what they do."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

from numba.core import event

_told: ContextVar[tuple[object, ...]] = ContextVar("_told", default=())


@contextmanager
def told_of_compiling(tell: Callable[[int, str], None]) -> Iterator[None]:
    """Have `tell` called before each function that is compiled for the block, not for those found on disk.

    That is in this thread, and in others that run in its context. `tell` is given how many it has been so far, and
    the name of this one. It must not raise.
    """
    listener = _Listener(tell)
    before = _told.set((*_told.get(), listener))
    try:
        with event.install_listener("numba:compile", listener):
            yield
    finally:
        _told.reset(before)


class _Listener(event.Listener):  # type: ignore[misc]
    def __init__(self, tell: Callable[[int, str], None]) -> None:
        self._tell, self._n = tell, 0

    def on_start(self, event: Any) -> None:
        function = event.data["dispatcher"].py_func
        # Numba's own are small, and their names say nothing.
        if self in _told.get() and not function.__module__.startswith("numba."):
            self._n += 1
            self._tell(self._n, function.__name__)

    def on_end(self, event: Any) -> None:
        """Nothing to say."""
