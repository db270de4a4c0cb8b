"""Interrupts (Ctrl-C) that Python drops are given again, so that a command always ends when it is asked to."""

from __future__ import annotations

import _thread
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

DELAY = 0.02
"""Seconds until a dropped interrupt is given again: long enough to be out of the code that dropped it."""


@contextmanager
def dropped_interrupts_again() -> Iterator[None]:
    """Raise `KeyboardInterrupt` again where it was raised inside code that cannot raise.

    Python prints "Exception ignored in" and goes on when an interrupt comes in a finalizer, in the callback of a weak
    reference or in a callback from C. A sequence would then be rendered to its end.
    """
    before = sys.unraisablehook
    waiting: list[threading.Timer] = []

    def hook(dropped: UnraisableHookArgs) -> None:
        if isinstance(dropped.exc_value, KeyboardInterrupt):
            again = threading.Timer(DELAY, _thread.interrupt_main)
            waiting.append(again)
            again.start()
        else:
            before(dropped)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = before
        for again in waiting:
            again.cancel()
