"""Interrupts that come where Python, or a library, drops them end the command all the same."""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from icheat_usd.cli import main, program
from icheat_usd.cli.interrupts import lost_interrupts_again


class Dropping:
    """Drops an exception: Python cannot raise what its finalizer raises."""

    def __init__(self, fail: Callable[[], object]):
        self.fail = fail

    def __del__(self) -> None:
        self.fail()


class Cleared(type):
    """An attribute that is looked for on the type, as numpy does, and whose error is then cleared."""

    is_armed = False

    def __getattr__(cls, name: str) -> object:
        if Cleared.is_armed:
            Cleared.is_armed = False
            interrupt()
        raise AttributeError(name)


class Number(int, metaclass=Cleared):
    pass


def interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.fixture(autouse=True)
def interrupts_raise() -> Iterator[None]:
    """As on a terminal: a shell may have started the tests in the background, where interrupts are ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def work(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.001)


def in_a_finalizer() -> None:
    Dropping(interrupt)


def in_a_search_for_attributes() -> None:
    Cleared.is_armed = True
    np.add(np.arange(3), Number(1))
    assert not Cleared.is_armed


def in_code_that_goes_on() -> None:
    try:
        interrupt()
    except KeyboardInterrupt:
        pass


@pytest.mark.parametrize("lost", [in_a_finalizer, in_a_search_for_attributes, in_code_that_goes_on])
def test_a_lost_interrupt_ends_the_work(lost: Callable[[], None], capsys: pytest.CaptureFixture[str]) -> None:
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), lost_interrupts_again():
        lost()
        work(20)
    assert time.monotonic() - start < 10 and not capsys.readouterr().err


def test_one_that_is_lost_again_and_again_ends_the_work() -> None:
    with pytest.raises(KeyboardInterrupt), lost_interrupts_again():
        in_code_that_goes_on()
        for _ in range(3):
            try:
                work(20)
            except KeyboardInterrupt:
                pass
        work(20)


def test_what_handles_an_interrupt_ends_its_work() -> None:
    steps: list[str] = []
    with pytest.raises(KeyboardInterrupt), lost_interrupts_again():
        try:
            try:
                interrupt()
            finally:
                work(0.2)
                steps.append("finally")
                raise OSError  # as cleaning up may
        except OSError:
            work(0.2)
            steps.append("other error")
        work(20)  # the interrupt was lost with the other error
    assert steps == ["finally", "other error"]


def test_a_second_interrupt_ends_what_handles_the_first() -> None:
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt), lost_interrupts_again():
        try:
            interrupt()
        finally:
            interrupt()
            work(20)
    assert time.monotonic() - start < 10


def test_other_errors_are_told_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: told.append(dropped.exc_value))
    mine = sys.unraisablehook
    error = ValueError("a mistake")

    def fail() -> None:
        raise error

    with lost_interrupts_again():
        Dropping(fail)
        work(0.1)
    assert told == [error] and sys.unraisablehook is mine


def test_an_interrupt_that_came_at_the_end_hits_nobody() -> None:
    with lost_interrupts_again():
        in_a_finalizer()
    work(0.1)


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda number, frame: None])
def test_a_handler_of_the_program_around_stays(handler: Callable[..., None], interrupts_raise: None) -> None:
    before = signal.signal(signal.SIGINT, handler)
    with lost_interrupts_again():
        assert signal.getsignal(signal.SIGINT) is handler
        interrupt()
    signal.signal(signal.SIGINT, before)


def test_other_threads_have_no_interrupts() -> None:
    seen: list[object] = []

    def inside() -> None:
        with lost_interrupts_again():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=inside)
    thread.start()
    thread.join()
    assert seen == [signal.default_int_handler]


def test_an_interrupt_while_the_command_line_is_read_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(program, "build_parser", interrupt)
    assert main(["stats", "shot.usda"]) == 130
    assert "interrupted" in capsys.readouterr().err
