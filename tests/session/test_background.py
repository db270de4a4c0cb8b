"""The background of a live session tidies up now and then, and not when nothing has happened."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import pytest

from icheat_usd.session import background
from icheat_usd.session.background import Background

Start = Callable[[float], tuple[Background, threading.Semaphore]]


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """Starts one that has nothing to do, given how often it is to tidy up; and counts how often it has."""
    started: list[Background] = []

    def one(seconds: float) -> tuple[Background, threading.Semaphore]:
        monkeypatch.setattr(background, "_TIDY_SECONDS", seconds)
        calls = threading.Semaphore(0)
        started.append(Background(lambda: None, lambda error: None, tidy=calls.release))
        started[-1].start()
        return started[-1], calls

    yield one
    for own in started:
        own.close()


def test_it_tidies_up_once_after_the_last_command(start: Start):
    one, calls = start(0.1)
    assert not calls.acquire(timeout=0.3), "nothing has happened yet"
    one.wake()
    assert calls.acquire(timeout=10)
    assert not calls.acquire(timeout=0.3), "nothing has happened since"
    one.wake()
    assert calls.acquire(timeout=10)


def test_it_tidies_up_while_commands_go_on(start: Start):
    one, calls = start(0.05)
    for _ in range(2000):
        one.wake()
        if calls.acquire(timeout=0.005):
            return
    pytest.fail("commands kept it from tidying up")


def test_it_does_not_tidy_up_all_the_time(start: Start):
    one, calls = start(1000.0)
    for _ in range(100):
        one.wake()
    assert not calls.acquire(timeout=0.2)
