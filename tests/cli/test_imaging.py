"""`relight` and `render` from the command line to files."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icheat_usd.cli import main, sequence
from icheat_usd.image.exr import read_exr
from icheat_usd.resources import resource_path
from icheat_usd.session import GatherSettings, Quality, quality
from tests.cli.interruptible import start

BOX = str(resource_path("sample_stages/cornell_box/shot.usda"))
ANIMATED = str(resource_path("sample_stages/animated_room/shot.usda"))
LAYERS = {"beauty", "direct", "indirect", "indirect_edited", "edit_delta", "albedo", "normal", "depth"}
QUICK = ["--width", "16", "--height", "16"]
SMALL = [*QUICK, "--draft", "--gather", "512", "--rays", "32", "--bounces", "3"]


def test_a_preview_is_written_in_every_form_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exr, png = tmp_path / "box.exr", tmp_path / "box.png"
    assert main(["relight", BOX, "-o", str(exr), "-o", str(png), *SMALL, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["version"] == 1 and content["findings"] == []
    (image,) = content["images"]
    assert image["files"] == [str(exr), str(png)] and (image["width"], image["height"]) == (16, 16)
    assert image["metadata"]["stack"] == "/World/Edits" and image["metadata"]["camera"] == "/World/Cameras/Main"
    assert png.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    film = read_exr(exr)
    assert set(film.layers) >= LAYERS
    layers = film.layers
    assert np.allclose(layers["indirect"] + layers["edit_delta"], layers["indirect_edited"], atol=1e-6)
    assert np.abs(layers["edit_delta"]).max() > 0.01


def test_a_final_frame_agrees_with_the_preview(tmp_path: Path) -> None:
    preview, final = tmp_path / "preview.exr", tmp_path / "final.exr"
    effort = ["--samples", "4", "--rays", "64"]
    assert main(["relight", BOX, "-o", str(preview), *QUICK, "--gather", "4096", *effort]) == 0
    assert main(["render", BOX, "-o", str(final), *QUICK, *effort]) == 0
    for layer in ("direct", "indirect", "indirect_edited"):
        ratio = read_exr(preview).layers[layer].mean() / read_exr(final).layers[layer].mean()
        assert ratio == pytest.approx(1.0, abs=0.05), layer


def test_frames_go_to_numbered_files_and_differ(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pattern = str(tmp_path / "room.####.exr")
    assert main(["relight", ANIMATED, "-o", pattern, "--frames", "10:40x30", *SMALL]) == 0
    first, last = tmp_path / "room.0010.exr", tmp_path / "room.0040.exr"
    assert capsys.readouterr().out.split() == [str(first), str(last)]
    assert {path.name for path in tmp_path.iterdir()} == {first.name, last.name}
    assert not np.array_equal(read_exr(first).layers["depth"], read_exr(last).layers["depth"])
    assert read_exr(last).metadata["frame"] == "40"


def test_the_same_seed_gives_the_same_bits(tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert main(["relight", BOX, "-o", str(tmp_path / f"{name}.exr"), *SMALL, "--seed", "3"]) == 0
    a, b = read_exr(tmp_path / "a.exr"), read_exr(tmp_path / "b.exr")
    assert all(np.array_equal(a.layers[name], b.layers[name]) for name in LAYERS)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupted_render_leaves_nothing_behind(tmp_path: Path) -> None:
    out = tmp_path / "final.exr"
    # Minutes of work, in steps that are short on one core, too: what is being computed ends before anything is stopped.
    work = ["--width", "160", "--height", "120", "--samples", "4096"]
    arguments = [sys.executable, "-m", "icheat_usd", "render", BOX, "-o", str(out), *work]
    process = start(arguments)
    assert process.stderr is not None
    # The first line of progress says that work is under way.
    started = process.stderr.readline()
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, rest = process.communicate(timeout=120)
    assert process.returncode == 130, started + rest
    assert "interrupted" in rest and "Traceback" not in rest
    assert list(tmp_path.iterdir()) == []


def test_photons_and_the_denoiser_are_flags_of_render(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[GatherSettings] = []

    def note(options: object, settings: GatherSettings, cells: Quality) -> int:
        assert cells == quality.PREVIEW
        chosen.append(settings)
        return 0

    monkeypatch.setattr(sequence, "render_frames", note)
    for flags in ([], ["--photons"], ["--denoise"]):
        assert main(["render", BOX, "-o", "x.exr", *flags]) == 0
    assert [(one.bounces, one.denoise) for one in chosen] == [("cells", False), ("photons", False), ("cells", True)]


def test_a_quick_frame_is_a_choice_of_efforts_that_others_change(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[tuple[GatherSettings, Quality]] = []

    def note(options: object, *effort: Any) -> int:
        chosen.append(effort)  # type: ignore[arg-type]
        return 0

    monkeypatch.setattr(sequence, "render_frames", note)
    assert main(["render", BOX, "-o", "x.exr", "--quick"]) == 0
    assert main(["render", BOX, "-o", "x.exr", "--quick", "--rays", "32", "--edge-samples", "3", "--seed", "4"]) == 0
    assert chosen[0] == (quality.QUICK, quality.QUICK_CELLS)
    assert chosen[1] == (replace(quality.QUICK, gather_rays=32, edge_samples=3, seed=4), quality.QUICK_CELLS)


@pytest.mark.skipif(find_spec("pyoidn") is None, reason="needs the extra 'denoise'")
def test_a_quick_frame_is_near_a_slow_one(tmp_path: Path) -> None:
    size = ["--width", "64", "--height", "64"]
    means = []
    for name, *flags in (("quick", "--quick"), ("slow", "--samples", "4")):
        assert main(["render", BOX, "-o", str(tmp_path / f"{name}.exr"), *size, *flags]) == 0
        image = read_exr(tmp_path / f"{name}.exr").layers["indirect"]
        means.append(image.reshape(8, 8, 8, 8, 3).mean(axis=(1, 3)))
    assert abs(means[0].mean() / means[1].mean() - 1) < 0.02
    assert np.abs(means[0] / means[1] - 1).mean() < 0.05
