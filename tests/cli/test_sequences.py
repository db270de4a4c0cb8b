"""`icheat render` over several frames: what is kept, what is rendered again, and what is said when one fails."""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import time
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icheat_usd.cli import main
from icheat_usd.image.exr import read_exr
from icheat_usd.image.png import read_text
from icheat_usd.session import Session
from icheat_usd.session.layer_names import FAMILIES, LAYERS
from tests.cli.interruptible import start
from tests.cli.sequence_stage import QUICK, STAGE, make_stage


@pytest.fixture
def shot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    stage = make_stage(tmp_path)
    capsys.readouterr()
    return stage


def render(shot: Path, *more: str) -> int:
    return main(["render", str(shot), "--frames", "1:3", "-o", str(shot.parent / "f.####.exr"), *QUICK, *more])


def kept(capsys: pytest.CaptureFixture[str], shot: Path, *more: str) -> list[list[str]]:
    """Names of the files of each frame that were left as they are."""
    assert render(shot, "--json", *more) == 0
    images = json.loads(capsys.readouterr().out)["images"]
    return [[Path(path).name for path in image["kept"]] for image in images]


def content(shot: Path) -> dict[str, tuple[bytes, int]]:
    return {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in sorted(shot.parent.glob("*.exr"))}


def test_frames_made_of_the_same_are_kept_and_others_rendered(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert kept(capsys, shot) == [[], [], []]
    first = content(shot)
    assert list(first) == ["f.0001.exr", "f.0002.exr", "f.0003.exr"]
    assert kept(capsys, shot) == [["f.0001.exr"], ["f.0002.exr"], ["f.0003.exr"]] and content(shot) == first
    # Cut short, and of another program: rendered again, as the same bytes.
    (shot.parent / "f.0002.exr").write_bytes(first["f.0002.exr"][0][:-100])
    (shot.parent / "f.0003.exr").write_bytes(b"something else")
    assert kept(capsys, shot) == [["f.0001.exr"], [], []]
    assert {name: bits for name, (bits, _) in content(shot).items()} == {n: b for n, (b, _) in first.items()}
    assert kept(capsys, shot, "--force") == [[], [], []]
    assert kept(capsys, shot, "--aov", "beauty") == [[], [], []]


@pytest.mark.parametrize(
    "change",
    [
        ("gain", ["edit", "set", "SHOT", "bleed", "--set", "gain=2"], [[], [], []]),
        ("one frame", ["key", "set", "SHOT", "bleed", "--frame", "9", "--set", "gain=2"], None),
    ],
    ids=lambda change: change[0],
)
def test_frames_whose_edits_changed_are_rendered_again(
    change: tuple[str, list[str], Any], shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, words, expected = change
    assert kept(capsys, shot) == [[], [], []]
    before = content(shot)
    assert main([str(shot) if word == "SHOT" else word for word in words]) == 0
    capsys.readouterr()
    found = kept(capsys, shot)
    after = content(shot)
    if expected is not None:
        assert found == expected
    same = [before[name][0] == after[name][0] for name in before]
    assert [bool(names) for names in found] == same


def test_a_png_is_kept_too_and_seen_through_another_view_it_is_not(
    shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    png = shot.parent / "f.png"
    command = ["render", str(shot), "-o", str(png), *QUICK]
    assert main(command) == 0
    before = png.stat().st_mtime_ns
    assert "inputs" in read_text(png)
    assert main(command) == 0 and png.stat().st_mtime_ns == before
    assert "kept" in capsys.readouterr().err
    assert main([*command, "--exposure", "1"]) == 0 and png.stat().st_mtime_ns > before
    whole = png.read_bytes()
    png.write_bytes(whole[:-20])
    assert main([*command, "--exposure", "1"]) == 0 and png.read_bytes() == whole


def test_a_frame_that_fails_is_named_and_those_before_it_stay(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(shot), "--frames", "1,9", "-o", str(shot.parent / "f.####.exr"), *QUICK]) == 2
    output = capsys.readouterr()
    assert output.err.splitlines()[-1].startswith("icheat: error: frame 9: ") and "no surface" in output.err
    assert list(content(shot)) == ["f.0001.exr"]


def test_no_frame_keeps_another_one_in_memory(shot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sessions: list[weakref.ref[Session]] = []
    alive: list[int] = []
    opened = Session.open

    def watched(*args: Any, **values: Any) -> Session:
        gc.collect()
        alive.append(sum(session() is not None for session in sessions))
        session = opened(*args, **values)
        sessions.append(weakref.ref(session))
        return session

    monkeypatch.setattr(Session, "open", watched)
    assert render(shot) == 0
    assert alive == [0, 0, 0]


def test_records_are_pictured_frame_by_frame(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["render", str(shot), "--frames", "1:2", "-o", str(shot.parent / "f.####.exr"), *QUICK]
    maps = ["--records", str(shot.parent / "map.####.png")]
    assert main([*words, *maps]) == 2
    assert "the brute method places no records" in capsys.readouterr().err
    cached = ["--method", "cached"]
    assert main([*words, *maps, *cached]) == 0
    first = [(shot.parent / f"map.000{frame}.png").read_bytes() for frame in (1, 2)]
    assert first[0] != first[1] and (shot.parent / "f.0001.exr").is_file()
    (shot.parent / "map.0002.png").unlink()
    capsys.readouterr()
    assert main([*words, *maps, *cached]) == 0
    assert capsys.readouterr().err.count("kept") == 3
    assert (shot.parent / "map.0002.png").read_bytes() == first[1]
    for wrong, message in (("map.####.exr", "must end in .png"), ("map.png", "2 frames would share one file")):
        assert main([*words, "--records", str(shot.parent / wrong), *cached]) == 2
        assert message in capsys.readouterr().err
    assert main(["render", str(shot), "--records", str(shot.parent / "m.png")]) == 2
    assert "--records goes with -o FILE" in capsys.readouterr().err


def test_layers_are_not_asked_of_a_png(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(shot), "-o", str(shot.parent / "f.png"), "--aov", "depth", *QUICK]) == 2
    assert "--aov is for .exr files" in capsys.readouterr().err
    assert main(["render", str(shot), "-o", str(shot.parent / "f.png"), "--show", "crypto_object", *QUICK]) == 2
    assert "--show crypto_object: is no image" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--aov nope", "--aov: there is no layer 'nope'; there are beauty, direct, indirect"),
        ("--aov lpe:C<RD>L", "no layer holds exactly the light of 'lpe:C<RD>L'; there are C.* (beauty)"),
        ("--aov light.Sun", "frame 1: there is no layer 'light.Sun' at this frame; there are light.Lamp"),
        ("--aov edit.warm", "there is no layer 'edit.warm' at this frame; there are edit.bleed"),
        ("--seed -1", "'-1' is no seed: a whole number from 0 to 999999999"),
        ("--seed 99999999999999999999", "'99999999999999999999' is no seed"),
        ("--exposure nan", "'nan' is no number, such as 1 or -0.5"),
        ("--camera /World/No", "/World/No is named as camera but does not exist in"),
        ("--product /Render/No", "no RenderProduct /Render/No; the stage has none"),
    ],
)
def test_what_cannot_be_rendered_is_one_line(
    words: str, message: str, shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert render(shot, *words.split()) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert not content(shot)


def test_a_folder_that_cannot_be_written_is_known_before_the_work(
    shot: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("icheat_usd.session.rendering.render_film", lambda *_: pytest.fail("it was rendered"))
    (shot.parent / "taken.exr").mkdir()
    for out, message in (("/proc/f.exr", "cannot write in this folder"), ("taken.exr", "is a folder; name a file")):
        assert main(["render", str(shot), "-o", str(shot.parent / out), *QUICK]) == 2
        assert message in capsys.readouterr().err


def test_the_help_lists_every_layer(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"\n  {name} " in text for name in (*LAYERS, *FAMILIES))


def test_layers_of_lights_and_edits_add_up(shot: Path) -> None:
    out = shot.parent / "all.exr"
    names = ["beauty", "direct", "indirect", "emission", "background", "edit_delta", "edit_ratio", "lights", "edits"]
    names += ["lights_direct", "lights_indirect", "unlit"]
    aovs = [word for name in names for word in ("--aov", name)]
    assert (
        main(["render", str(shot), "-o", str(out), *aovs, "--aov", "crypto_object", "--aov", "crypto_edit", *QUICK])
        == 0
    )
    film = read_exr(out)
    layer = film.layers
    lit = {prefix: layer[f"{prefix}.Lamp"] for prefix in ("light", "light_direct", "light_indirect")}
    assert set(layer) == {*names[:7], "unlit", "edit.bleed", *(f"{prefix}.Lamp" for prefix in lit)}
    np.testing.assert_allclose(lit["light"], layer["beauty"], rtol=1e-5)
    np.testing.assert_allclose(lit["light_direct"], layer["direct"], rtol=1e-6)
    np.testing.assert_allclose(lit["light_indirect"], layer["indirect"], rtol=1e-5)
    np.testing.assert_allclose(layer["unlit"], 0, atol=1e-6)
    np.testing.assert_allclose(layer["edit.bleed"], layer["edit_delta"], atol=1e-6)
    unedited = layer["direct"] + layer["indirect"]
    np.testing.assert_allclose(layer["edit_ratio"] * unedited, layer["beauty"], rtol=1e-5)
    assert layer["edit_ratio"].max() > 1.05
    assert film.metadata["layer:light.Lamp"] == "/World/Lamp"
    assert [matte.name for matte in film.mattes] == ["CryptoObject", "CryptoEdit"]
    assert set(film.mattes[0].manifest) == {"/World/Room", "/World/Block"}
    np.testing.assert_allclose(film.mattes[0].ranks[..., 1].sum(axis=-1), 1.0, rtol=1e-6)


def test_mattes_and_edits_of_a_moving_block_are_blurred_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moving = STAGE.replace("float focalLength", "double shutter:close = 1\n        float focalLength")
    shot = make_stage(tmp_path, moving)
    layers = [word for name in ("beauty", "edit_delta", "edits", "crypto_object") for word in ("--aov", name)]
    command = ["render", str(shot), "--frame", "2", "-o", str(tmp_path / "f.exr"), *QUICK, "--samples", "4", *layers]
    assert main(command) == 0
    film = read_exr(tmp_path / "f.exr")
    (matte,) = film.mattes
    ids = matte.ranks[..., 0].view(np.uint32)
    block = np.where(ids == int(matte.manifest["/World/Block"], 16), matte.ranks[..., 1], 0).sum(axis=-1)
    assert np.isin(np.round(block * 4, 4), range(5)).all() and np.isin(block, (0.25, 0.5, 0.75)).any()
    np.testing.assert_allclose(matte.ranks[..., 1].sum(axis=-1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(film.layer("edit.bleed"), film.layer("edit_delta"), atol=1e-6)
    capsys.readouterr()
    assert main([*command, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["images"][0]["kept"] == [str(tmp_path / "f.exr")]
    (tmp_path / "still").mkdir()
    still = make_stage(tmp_path / "still")
    assert main([str(still) if word == str(shot) else word.replace("f.exr", "still.exr") for word in command]) == 0
    assert not np.array_equal(read_exr(tmp_path / "still.exr").mattes[0].ranks, matte.ranks)


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_an_interrupted_sequence_keeps_its_finished_frames(tmp_path: Path) -> None:
    shot = make_stage(tmp_path, STAGE.replace("(16, 12)", "(64, 48)").replace(', 9: "invisible"', ""))
    pattern = str(tmp_path / "f.####.exr")
    command = [sys.executable, "-m", "icheat_usd", "render", str(shot), "--frames", "1:200", "-o", pattern, *QUICK]
    process = start(command)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130 and "interrupted" in error and "Traceback" not in error
    done = sorted(path.name for path in tmp_path.iterdir() if not path.name.startswith("shot."))
    assert done and done == [f"f.{index:04d}.exr" for index in range(1, len(done) + 1)]
    for name in done:
        assert read_exr(tmp_path / name).metadata["frame"] == str(int(name[2:6]))
