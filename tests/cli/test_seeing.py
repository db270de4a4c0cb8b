"""The verbs that look: tree, stats, check, diff, explain; as text, as JSON, and with bad input."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Sdf, Usd

from icheat_usd.cli import main
from icheat_usd.image.exr import read_exr
from icheat_usd.session import Session, soft_sphere
from tests.session.test_session import ROOM


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    """A painted edit with two keys in the sequence, another edit in the shot, which also changes an amount."""
    (tmp_path / "room.usda").write_text(ROOM)
    for name, weaker in (("sequence", "room"), ("shot", "sequence")):
        head = '#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    upAxis = "Y"\n'
        (tmp_path / f"{name}.usda").write_text(head + f"    subLayers = [@./{weaker}.usda@]\n)\n")
    path = tmp_path / "shot.usda"
    session = Session.open(path, width=24, height=18)
    common: dict[str, Any] = {"receivers": ["/World/Room"], "casters": ["/World/Block"]}
    brush = soft_sphere((0, -2, 0), 0.5, 3.0)
    session.add_edit("warm", layer="sequence.usda", parameters={"gain": 3.0}, receiver_brush=brush, frame=1, **common)
    session.set_edit("/World/Edits/warm", layer="shot.usda", amount=0.5)
    session.add_edit("grey", layer="shot.usda", operation="hsv", parameters={"saturation": 0.2}, **common)
    return path


@pytest.fixture
def copy(shot: Path) -> Path:
    """The same files in another folder."""
    return Path(shutil.copytree(shot.parent, shot.parent / "copy")) / shot.name


def out(capsys: pytest.CaptureFixture[str], *arguments: object, status: int = 0) -> str:
    capsys.readouterr()
    assert main([str(argument) for argument in arguments]) == status
    return capsys.readouterr().out


def as_json(capsys: pytest.CaptureFixture[str], *arguments: object, status: int = 0) -> dict[str, Any]:
    content = json.loads(out(capsys, *arguments, "--json", status=status))
    assert content.pop("version") == 1
    return dict(content)


# --------------------------------------------------------------------------- tree and stats


def test_tree_has_a_line_for_each_edit_with_columns(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = out(capsys, "tree", shot).splitlines()
    heads = [line[3:].split() for line in lines if line.startswith(("├─", "└─"))]
    assert [head[:5] for head in heads] == [
        ["warm", "scale", "amount", "0.5", "rank-1"],
        ["grey", "hsv", "amount", "1", "recipe"],
    ]
    columns = [line.index("amount") for line in lines if line.startswith(("├─", "└─"))]
    assert columns[0] == columns[1]
    text = "\n".join(lines)
    assert "shot.usda: amount=0.5" in text and "sequence.usda: operation=scale, gain=3" in text
    assert "receivers: /World/Room" in text and "payload at 1: " in text and "receiver-mask" in text
    assert "STALE" not in text


TREE_KEYS = {
    "path", "active", "enabled", "operation", "amount", "blend", "parameters", "receivers", "casters", "receiverLimits",
    "casterLimits", "occluders", "lights", "target", "anchor", "keyTimes", "file", "payload", "listedBy", "layers",
    "problem", "encoding", "stale", "payloads",
}  # fmt: skip


def test_tree_as_json_keeps_its_keys(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = as_json(capsys, "tree", shot)
    assert set(content) == {"stage", "stack", "enabled", "cameras", "edits", "missing", "removed"}
    warm, grey = content["edits"]
    assert TREE_KEYS <= set(warm) and (warm["encoding"], grey["encoding"]) == ("rank-1", "recipe")
    (payload,) = warm["payloads"]
    keys = {"time", "digest", "file", "parameters", "elements", "storedBytes", "stale", "notes", "problem"}
    assert set(payload) == keys and payload["parameters"]["gain"] == 3.0
    assert payload["time"] == 1.0 and payload["storedBytes"] > 100 and payload["stale"] == []
    assert warm["amount"]["value"] == 0.5 and warm["amount"]["layer"].endswith("shot.usda")


def test_tree_notes_what_a_new_value_leaves_behind(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """To turn a knob is no mistake: `check` and `publish` have nothing to say."""
    assert main(["edit", "set", str(shot), "warm", "--set", "gain=2"]) == 0
    text = out(capsys, "tree", shot)
    assert "STALE" not in text and "note: gain is 2, and was 3 when it was baked" in text
    assert as_json(capsys, "check", shot)["findings"] == []
    assert main(["publish", str(shot)]) == 0


def test_rows_that_are_really_baked_become_stale_with_the_light(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = ["--width", "24", "--height", "18", "--gather", "256", "--epsilon", "0.1"]
    assert main(["bake", str(shot), "warm", "grey", *small]) < 2  # a finding: rows of hsv hold for this light
    assert as_json(capsys, "check", shot)["findings"] == []
    edits = as_json(capsys, "tree", shot)["edits"]
    assert all("rows" in edit["payloads"][0]["elements"] and not edit["stale"] for edit in edits)

    room = Usd.Stage.Open(str(shot.with_name("room.usda")))
    room.GetPrimAtPath("/World/Lamp").GetAttribute("inputs:intensity").Set(30.0)
    room.GetRootLayer().Save()
    warm, grey = as_json(capsys, "tree", shot)["edits"]
    assert not warm["stale"] and grey["payloads"][0]["stale"] == ["light Lamp got brighter (1.5 times)"]
    assert as_json(capsys, "tree", shot, "--quick")["edits"][1]["stale"] is False
    (finding,) = as_json(capsys, "check", shot, status=1)["findings"]
    assert finding["rule"] == "BakedStale" and finding["prim"] == "/World/Edits/grey"
    assert main(["bake", str(shot), "grey", *small]) < 2
    assert as_json(capsys, "check", shot)["findings"] == []

    room.GetPrimAtPath("/World/Block").GetAttribute("xformOp:translate").Set((0.5, -1.5, 0.5))
    room.GetRootLayer().Save()
    stale = [edit["payloads"][0]["stale"] for edit in as_json(capsys, "tree", shot)["edits"]]
    assert stale == [["surface Block moved"]] * 2


def test_tree_shows_a_payload_that_is_lost(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot.with_name("sequence.v001.icheat.h5").unlink()
    text = out(capsys, "tree", shot)
    assert "problem: " in text and "was not found" in text
    stats = as_json(capsys, "stats", shot, status=1)
    assert len(stats["problems"]) == 1 and stats["payloads"] == 1


def test_stats_count_and_weigh(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = as_json(capsys, "stats", shot)
    assert set(content) == {
        "stage", "stacks", "edits", "muted", "unlisted", "operations", "blends", "keys", "payloads", "paintedSurfaces",
        "texels", "paintedTexels", "rows", "sidecars", "problems",
    }  # fmt: skip
    assert (content["stacks"], content["edits"], content["keys"], content["payloads"]) == (1, 2, 2, 2)
    assert content["operations"] == {"hsv": 1, "scale": 1} and content["paintedSurfaces"] == 1
    assert 0 < content["paintedTexels"] < content["texels"]
    sequence, own = content["sidecars"]
    assert set(sequence) == {"file", "fileBytes", "payloads", "used", "payloadBytes"}
    assert sequence["fileBytes"] == shot.with_name("sequence.v001.icheat.h5").stat().st_size
    assert (own["payloads"], own["used"]) == (1, 1)
    assert out(capsys, "stats", shot).splitlines()[1].split() == ["edits", "2", "(1", "hsv,", "1", "scale)"]


# --------------------------------------------------------------------------- check


def test_check_exits_with_what_it_found(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert out(capsys, "check", shot) == ""
    assert as_json(capsys, "check", shot) == {"stage": str(shot), "findings": []}
    layer = Sdf.Layer.FindOrOpen(str(shot))
    Sdf.AttributeSpec(layer.GetPrimAtPath("/World/Edits/grey"), "icheat:amuont", Sdf.ValueTypeNames.Float)
    layer.Save()
    findings = as_json(capsys, "check", shot, status=1)["findings"]
    assert all(set(f) == {"prim", "feature", "message", "severity", "rule"} for f in findings) and findings
    assert {f["severity"] for f in findings} == {"warning"}
    assert out(capsys, "check", shot, "--errors") != ""
    assert main(["check", "nowhere.usda"]) == 2
    assert main(["check"]) == 2


def test_check_lists_every_rule_with_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    lines = out(capsys, "check", "--list").splitlines()
    rules = as_json(capsys, "check", "--list")["rules"]
    assert [line.split()[0] for line in lines] == [rule["name"] for rule in rules]
    assert len(rules) > 30 and all(set(rule) == {"name", "severity", "doc"} for rule in rules)


# --------------------------------------------------------------------------- diff


def test_a_stage_is_no_different_from_its_copy(shot: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert out(capsys, "diff", shot, copy) == ""
    assert out(capsys, "diff", "--layers", shot, copy) == ""
    assert as_json(capsys, "diff", shot, copy) == {"a": str(shot), "b": str(copy), "differences": []}


def change(copy: Path, *arguments: str) -> None:
    verb, what, *rest = arguments
    assert main([verb, what, str(copy), *rest]) == 0


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ("edit set warm --amount 0.25", ["warm: amount 0.5 → 0.25 (shot.usda)"]),
        ("edit set warm --set gain=2", ["warm: gain 3 → 2 (shot.usda)"]),
        ("edit set grey --blend over", ["grey: blend compose → over (shot.usda)"]),
        ("edit mute warm", ["warm muted (shot.usda)"]),
        ("edit remove grey", ["grey removed"]),
        ("edit move grey --before warm", ["order: warm, grey → grey, warm"]),
        (
            "edit add glow --operation emit --receivers Room --casters Block --after warm",
            ["glow added after warm (shot.usda)"],
        ),
    ],
)
def test_diff_says_it_in_an_artists_words(
    arguments: str, expected: list[str], shot: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(copy, *arguments.split())
    assert out(capsys, "diff", shot, copy, status=1).splitlines() == expected
    difference = as_json(capsys, "diff", shot, copy, status=1)["differences"][0]
    assert set(difference) == {"edit", "aspect", "text", "layer"} and difference["text"] == expected[0]
    assert out(capsys, "diff", copy, shot, status=1) != ""


def test_diff_sees_a_changed_selection(shot: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = copy.read_text()
    assert text.count("</World/Room>") == 1
    copy.write_text(text.replace("</World/Room>", "[</World/Room>, </World/Block>]"))
    assert out(capsys, "diff", shot, copy, status=1) == "grey: receivers + Block\n"


def test_diff_sees_what_was_painted_anew(shot: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path, radius in ((shot, 2.0), (copy, 1.0)):
        session = Session.open(path, width=24, height=18)
        brush = soft_sphere((0.5, -2, 0), 0.2, radius)
        common: dict[str, Any] = {"receivers": ["/World/Room"], "casters": ["/World/Block"]}
        session.add_edit("pool", layer="shot.usda", receiver_brush=brush, frame=12, **common)
    (line,) = out(capsys, "diff", shot, copy, status=1).splitlines()
    assert line.startswith("pool: key at 12: receiver mask repainted (1 surface, ") and "% of texels differ" in line
    files = [path.with_name("shot.v002.icheat.h5") for path in (shot, copy)]
    assert all(file.is_file() for file in files)
    text = out(capsys, "diff", *files, status=1)
    assert "receiver mask repainted (1 surface" in text and text.count("\n") == 1
    assert out(capsys, "diff", files[0], files[0]) == ""


def test_diff_of_layers_names_single_opinions(shot: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(copy, "edit", "set", "warm", "--amount", "0.25")
    change(copy, "edit", "mute", "warm")
    assert out(capsys, "diff", "--layers", shot, copy, status=1).splitlines() == [
        "warm: amount 0.5 → 0.25",
        "warm: enabled authored: False",
    ]


@pytest.mark.parametrize(
    "arguments",
    [
        ["{shot}", "nowhere.usda"],
        ["{shot}", "nowhere.icheat.h5"],
        ["nowhere.icheat.h5", "nowhere.icheat.h5"],
        ["--layers", "{shot}", "nowhere.usda"],
        ["--layers", "{shot}", "{folder}"],
    ],
)
def test_diff_of_what_is_not_there_fails(arguments: list[str], shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert main(["diff", *(a.format(shot=shot, folder=shot.parent) for a in arguments)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("icheat: error: ") and error.count("\n") == 1


# --------------------------------------------------------------------------- explain

SMALL = ["--width", "16", "--height", "12", "--gather", "256", "--rays", "64"]


def test_explain_tells_a_pixel_and_writes_maps(shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exr, png = tmp_path / "maps.exr", tmp_path / "maps.png"
    content = as_json(capsys, "explain", shot, *SMALL, "--image", exr, "--image", png)
    assert content["layers"] == ["edit.warm", "edit.grey"] and content["files"] == [str(exr), str(png)]
    film = read_exr(exr)
    assert {"beauty", "edit.warm", "edit.grey"} <= set(film.layers) and png.stat().st_size > 200
    y, x = np.unravel_index(np.abs(film.layer("edit.warm")).sum(axis=2).argmax(), (12, 16))
    found = as_json(capsys, "explain", shot, *SMALL, "--pixel", x, y)["pixel"]
    assert set(found) == {
        "x", "y", "width", "height", "camera", "surfaces", "direct", "indirect", "indirectEdited", "edits",
    }  # fmt: skip
    warm = found["edits"][0]
    assert set(warm) == {"edit", "operation", "change", "mask", "casters", "note", "values"}
    assert warm["casters"][0]["path"] == "/World/Block" and warm["values"]["amount"]["layer"].endswith("shot.usda")
    text = out(capsys, "explain", shot, *SMALL, "--pixel", x, y)
    assert (
        f"pixel {x} {y} of 16 x 12" in text and "from /World/Block  100 %" in text and "shot.usda: amount=0.5" in text
    )


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "--pixel X Y or --image"),
        (["--pixel", "99", "0"], "no pixel 99 0"),
        (["--image", "a.jpg"], ".exr or .png"),
        (["--image", "no/such/a.exr"], "no folder"),
        (["--pixel", "0", "0", "--stack", "Nope"], "Nope"),
    ],
)
def test_explain_refuses_in_one_line(
    arguments: list[str], complaint: str, shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["explain", str(shot), *SMALL, *arguments]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("icheat: error")]
    assert len(lines) == 1 and complaint in lines[0]


# --------------------------------------------------------------------------- help


def test_help_is_there_at_once() -> None:
    code = "import sys; from icheat_usd.cli import main; main(['--help']); print(sorted(sys.modules))"
    began = time.perf_counter()
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert time.perf_counter() - began < 5
    for verb in ("tree", "diff", "explain", "stats", "check"):
        assert f"\n    {verb}" in told
    loaded = told.splitlines()[-1]
    assert not any(f"'{name}'" in loaded for name in ("numpy", "pxr", "h5py", "numba"))
