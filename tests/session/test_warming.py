"""Warming: every task runs in a process of its own, and a failure is one sentence."""

from __future__ import annotations

import json
import sys
import time

import pytest

from icheat_usd.cli import main
from icheat_usd.errors import IcheatError
from icheat_usd.session import warming


def test_tasks_run_in_processes_and_are_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warming, "TASKS", {"relight": warming.TASKS["relight"]})
    assert main(["warm", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert list(content["seconds"]) == ["relight"] and content["folder"].endswith("kernels")


def test_a_task_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warming, "TASKS", {"nonsense": lambda: None})
    with pytest.raises(IcheatError, match="kernels of 'nonsense' failed: KeyError"):
        warming.warm()


def test_a_task_that_says_much_is_not_held_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """More than a pipe holds, and then a failure, whose last line is what is told."""
    code = "import sys; sys.stderr.write('much to say\\n' * 100_000); sys.exit('enough')"
    start = warming.subprocess.Popen

    def noisy(command: list[str], **options: object) -> object:
        return start([sys.executable, "-c", code], **options)

    monkeypatch.setattr(warming.subprocess, "Popen", noisy)
    began = time.monotonic()
    with pytest.raises(IcheatError, match="failed: enough"):
        warming.warm(1)
    assert time.monotonic() - began < 30
