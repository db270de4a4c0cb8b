"""Progress appears only where work takes long, and leaves no half line behind."""

from __future__ import annotations

import io
import time

import pytest

from icheat_usd.cli import progress as module
from icheat_usd.cli.progress import ProgressLine


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    return now


def test_a_step_under_two_seconds_says_nothing(clock: list[float]) -> None:
    stream = Terminal()
    with ProgressLine(stream, ticks=False) as report:
        report("read", 0.0)
        clock[0] += 1.9
        report("read", 0.99)
        report("read", 1.0)
    assert stream.getvalue() == ""


def test_on_a_terminal_one_line_is_rewritten_and_wiped(clock: list[float]) -> None:
    stream = Terminal()
    with ProgressLine(stream, ticks=False) as report:
        report("trace", 0.0)
        for fraction in (0.25, 0.5, 0.75):
            clock[0] += 3
            report("trace", fraction)
        report("trace", 1.0)
    text = stream.getvalue()
    assert "\n" not in text
    assert "trace  25 %  3 s" in text and "trace  75 %  9 s" in text
    assert text.endswith("\r\x1b[K")


def test_in_a_log_lines_are_few_and_plain(clock: list[float]) -> None:
    stream = io.StringIO()
    with ProgressLine(stream, prefix="frame 2: ", ticks=False) as report:
        report("trace", 0.0)
        for step in range(60):
            clock[0] += 1
            report("trace", step / 60)
        report("trace", 1.0)
    lines = stream.getvalue().splitlines()
    assert 3 <= len(lines) <= 6
    assert all(line.startswith("frame 2: trace") for line in lines)
    assert lines[-1].startswith("frame 2: trace done")
    assert "\x1b" not in stream.getvalue()


def test_an_interruption_wipes_the_line(clock: list[float]) -> None:
    stream = Terminal()
    with pytest.raises(KeyboardInterrupt), ProgressLine(stream, ticks=False) as report:
        report("trace", 0.0)
        clock[0] += 5
        report("trace", 0.5)
        raise KeyboardInterrupt
    assert stream.getvalue().endswith("\r\x1b[K")


def test_a_step_that_reports_only_its_beginning_is_shown_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "QUIET_SECONDS", 0.05)
    stream = Terminal()
    with ProgressLine(stream) as report:
        report("compile", 0.0)
        deadline = time.monotonic() + 10
        while "compile" not in stream.getvalue() and time.monotonic() < deadline:
            time.sleep(0.05)
    assert "compile  " in stream.getvalue()
