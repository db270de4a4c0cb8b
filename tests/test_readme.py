"""The examples of the README run."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from icheat_usd.cli import main
from icheat_usd.resources import resource_path

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    (found,) = re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
    return str(found)


def test_the_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(block("python"), "README.md", "exec"), {})
    assert float(capsys.readouterr().out) > 1.01
    assert (tmp_path / "after.exr").is_file() and (tmp_path / "after.png").is_file()


def test_the_shell_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy, *commands = block("sh").splitlines()
    assert copy == "cp -r sample_stages/cornell_box . && cd cornell_box"
    shutil.copytree(resource_path("sample_stages/cornell_box"), tmp_path / "cornell_box")
    monkeypatch.chdir(tmp_path / "cornell_box")
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == "icheat"
        assert main(arguments) == 0, command
    assert (tmp_path / "cornell_box" / "preview.png").is_file()
