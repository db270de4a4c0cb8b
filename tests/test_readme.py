"""The examples of the README run."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.cli import main
from icheat_usd.image.exr import read_exr
from icheat_usd.resources import resource_path

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


def test_the_python_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    first, *_ = blocks("python")
    exec(compile(first, "README.md", "exec"), {})
    assert float(capsys.readouterr().out) > 1.01
    assert (tmp_path / "after.exr").is_file() and (tmp_path / "after.png").is_file()


def test_the_pipeline_script_overrides_publishes_checks_and_compares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _, script, *_ = blocks("python")
    exec(compile(script, "README.md", "exec"), {})
    published, *shots = capsys.readouterr().out.splitlines()
    assert published == "3 payloads in sequence.published.v001.icheat.h5"
    assert len(shots) == 10
    for number, line in enumerate(shots):
        assert line.startswith(f"sh{10 * (number + 1):03d}.usda 0 findings; ")
        for change in (
            f"wallOnPerson: amount 1 → {number / 10:g}",
            "key at 28: gain 8 → 4",
            "wallOnCouch: key",
            "spill muted",
        ):
            assert change in line
    # The sequence's file is as it was but for the name of its sidecar; the shots wrote only to their own.
    assert "sequence.published.v001.icheat.h5" in (tmp_path / "film" / "sequence.usda").read_text()
    assert "sequence.v001" not in (tmp_path / "film" / "sequence.usda").read_text()


def test_the_live_example_ends_in_the_layer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    _, _, live, _ = blocks("python")
    names: dict[str, object] = {}
    exec(compile(live, "README.md", "exec"), names)
    image = names["image"]
    assert isinstance(image, np.ndarray) and image.shape == (64, 64, 3) and image.mean() > 0
    assert len(list(tmp_path.glob("amount_*.png"))) == 5
    fresh, committed = (
        path / "shot.usda" for path in (resource_path("sample_stages/cornell_box"), tmp_path / "live_box")
    )
    assert committed.read_text() != Path(fresh).read_text()


def test_the_shell_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    example, _ = blocks("sh")
    copy, *commands = example.splitlines()
    assert copy == "cp -r sample_stages/cornell_box . && cd cornell_box"
    shutil.copytree(resource_path("sample_stages/cornell_box"), tmp_path / "cornell_box")
    monkeypatch.chdir(tmp_path / "cornell_box")
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == "icheat"
        assert main(arguments) == 0, command
    assert (tmp_path / "cornell_box" / "preview.png").is_file()


def test_the_replay_example_follows_the_amount(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks("python")[3], "README.md", "exec"), {})
    means = [read_exr(path).layer("indirect_edited").mean() for path in sorted(tmp_path.glob("replayed_*.exr"))]
    assert len(means) == 5
    steps = np.diff(means)
    np.testing.assert_allclose(steps, steps.mean(), rtol=1e-3)
    assert abs(means[-1] / means[0] - 1) > 1e-3


def test_the_examples_of_final_frames_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.copytree(resource_path("sample_stages/animated_room"), tmp_path / "room")
    monkeypatch.chdir(tmp_path / "room")
    small = ["--width", "16", "--height", "12", "--samples", "1", "--edge-samples", "1", "--noise", "1"]
    for command in blocks("sh")[1].splitlines():
        _, *arguments = shlex.split(command.replace("1:48", "1:2"))
        assert main([*arguments, *small]) == 0, command
    names = {path.name for path in (tmp_path / "room").glob("*.exr")}
    assert {"frame.exr", "frame.0001.exr", "frame.0002.exr", "comp.exr"} <= names
