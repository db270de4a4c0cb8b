"""Interrupts (Ctrl-C) that get lost are given again, so that a command always ends when it is asked to."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

DELAY = 0.02
"""Seconds after which an interrupt that nothing handles is given again: long enough to be out of what dropped it."""


@contextmanager
def lost_interrupts_again() -> Iterator[None]:
    """Raise `KeyboardInterrupt` again, until it leaves this block, where it was raised in code that drops it.

    Python prints "Exception ignored in" and goes on when an interrupt comes in a finalizer or in the callback of a weak
    reference. Libraries in C clear whatever error comes of looking for an attribute that they can do without, as numpy
    does beside the member of an enumeration. A sequence would then be rendered to its end.

    An interrupt is not raised again while `finally`, `except` or `with` handle it, so that these end their work; a
    second one that the user gives is. Nothing is done outside the main thread, or where a program that holds this one
    handles interrupts in its own way.
    """
    mine = threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    # What the handler does may come in the middle of anything in the main thread, itself included; of the ways to wake
    # another thread, this queue's `put` is the one made for that.
    given: SimpleQueue[bool] = SimpleQueue()
    repeated = threading.Event()
    hook_before = sys.unraisablehook

    def repeat() -> None:
        while given.get():
            try:
                while given.get(timeout=DELAY):
                    pass
                return
            except Empty:
                repeated.set()
                _thread.interrupt_main()

    def handle(number: int, frame: Any) -> None:
        given.put(True)
        if repeated.is_set():
            repeated.clear()
            if _is_handled(sys.exc_info()[1]):
                return
        signal.default_int_handler(number, frame)

    def hook(dropped: UnraisableHookArgs) -> None:
        if not isinstance(dropped.exc_value, KeyboardInterrupt):
            hook_before(dropped)

    repeater = threading.Thread(target=repeat, name="lost interrupts", daemon=True)
    repeater.start()
    signal.signal(signal.SIGINT, handle)
    sys.unraisablehook = hook
    try:
        yield
    finally:
        try:
            given.put(False)
            repeater.join()
        finally:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            sys.unraisablehook = hook_before


def _is_handled(error: BaseException | None) -> bool:
    """Whether an interrupt is among the errors that are being handled."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None
