"""Interrupts that come where Python cannot raise them end the command all the same."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Iterator

import pytest

from icheat_usd.cli.interrupts import dropped_interrupts_again


class Dropping:
    """Drops an exception: Python cannot raise what its finalizer raises."""

    def __init__(self, error: BaseException):
        self.error = error

    def __del__(self) -> None:
        raise self.error


@pytest.fixture(autouse=True)
def interrupts_raise() -> Iterator[None]:
    """As on a terminal: a shell may have started the tests in the background, where interrupts are ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def work(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.01)


def test_an_interrupt_in_a_finalizer_ends_the_work() -> None:
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), dropped_interrupts_again():
        Dropping(KeyboardInterrupt())
        work(20)
    assert time.monotonic() - start < 10


def test_other_errors_are_told_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: told.append(dropped.exc_value))
    mine = sys.unraisablehook
    error = ValueError("a mistake")
    with dropped_interrupts_again():
        Dropping(error)
        work(0.1)
    assert told == [error] and sys.unraisablehook is mine


def test_an_interrupt_that_came_at_the_end_hits_nobody() -> None:
    with dropped_interrupts_again():
        Dropping(KeyboardInterrupt())
    work(0.1)
