"""Mistakes of the people who type: none may pass for success, and none may change a file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import pytest

from icheat_usd.cli import main

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World"
{
    def Sphere "Ball" {}
    def Sphere "Wall" {}
    def Camera "Camera" {}
}
"""

SELECTED = ("--receivers", "Ball", "--casters", "Wall")


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    assert main(["edit", "add", str(path), "warm", *SELECTED, "--set", "gain=2"]) == 0
    return path


def files(folder: Path) -> Mapping[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("edit add SHOT new --operation sale", "no operation is called 'sale'; there are albedo"),
        ("edit set SHOT warm --operation sale", "no operation is called 'sale'; there are albedo"),
        ("edit set SHOT warm", "there is nothing to set on /World/Edits/warm"),
        ("edit set SHOT warm --frame 10", "there is nothing to set on /World/Edits/warm"),
        ("edit set SHOT warm --layer session --amount 0.5", "layer 'session' has no file"),
        ("edit add SHOT new --layer session", "layer 'session' has no file"),
        ("region add SHOT R --sphere 0,0,0,1 --layer session", "layer 'session' has no file"),
        ("edit set SHOT warm --layer no.usda --amount 0.5", "no.usda' is not in the layer stack"),
        ("edit set SHOT warm --frame nan --amount 0.5", "'nan' is no time code"),
        ("key set SHOT warm --frame inf", "'inf' is no time code"),
        ("key copy SHOT warm --from nan --frame 3", "'nan' is no time code"),
        ("key remove SHOT warm --frame 3", "no key at 3; it has one payload for all times"),
        ("edit add SHOT new --set gian=2", "has no parameter 'gian'; it has color, gain"),
        ("edit add SHOT new --set gain=1e39", "new: parameter 'gain' is 1e+39, expected no size above 1e+18"),
        ("relight SHOT -o DIR/a.png --view nope", "has no view 'nope'"),
        ("edit add SHOT new --before new", "new cannot lie before or after itself"),
        ("edit add SHOT new --receivers Bal", "no prim /World/Bal; did you mean /World/Ball?"),
        ("edit add SHOT new --receivers Xyz/Deep", "no prim /World/Xyz/Deep; /World has Ball, Wall, Camera, Edits"),
        ("stack create SHOT Other --camera Ball", "/World/Ball is no camera"),
        ("edit add SHOT new --receivers Ball --receiver-sphere 90,0,0,1,2", "the brush touches none of the surfaces"),
        ("key set SHOT warm --frame 3 --receiver-sphere 90,0,0,1,2", "the brush touches none of the surfaces"),
    ],
)
def test_a_mistake_is_one_line_and_changes_nothing(
    words: str, message: str, shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = files(shot.parent)
    capsys.readouterr()
    words = words.replace("SHOT", str(shot)).replace("DIR", str(shot.parent))
    assert main([*words.split(), "--json"]) == 2
    output = capsys.readouterr()
    assert message in output.err and output.err.count("\n") == 1
    assert json.loads(output.out) == {"version": 1, "error": output.err.strip().removeprefix("icheat: error: ")}
    assert files(shot.parent) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--casters", "Wall"), "icheatReceivers: selects nothing"),
        (("--receivers", "Ball", "--casters-expression", "//Props//*"), "icheatCasters: no prim matches '"),
        ((*SELECTED, "--operation", "unshadow"), "occluders"),
    ],
)
def test_what_a_new_edit_lacks_is_said_at_once(
    words: tuple[str, ...], message: str, shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["edit", "add", str(shot), "new", *words]) == 1
    assert message in capsys.readouterr().err
    assert main(["edit", "remove", str(shot), "new"]) == 0
    assert main(["check", str(shot)]) == 0


def test_an_exclusion_alone_keeps_what_is_included(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["edit", "set", str(shot), "warm", "--receivers", "Ball", "Wall"]) == 0
    assert main(["edit", "set", str(shot), "warm", "--exclude-receivers", "Wall"]) == 0
    capsys.readouterr()
    assert main(["edit", "list", str(shot), "--json"]) == 0
    (edit,) = json.loads(capsys.readouterr().out)["edits"]
    assert set(edit["receivers"]["includes"]) == {"/World/Ball", "/World/Wall"}
    assert edit["receivers"]["excludes"] == ["/World/Wall"]
    assert main(["edit", "set", str(shot), "warm", "--casters-expression", "//{isa:Sphere}"]) == 0
    assert main(["edit", "set", str(shot), "warm", "--exclude-casters", "Ball"]) == 2
    assert "exclude with --casters-expression" in capsys.readouterr().err


def test_an_expression_that_matches_nothing_is_said_when_it_is_set(
    shot: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["edit", "set", str(shot), "warm", "--receivers-expression", "//Props//*"]) == 1
    assert "no prim matches '//Props//*'" in capsys.readouterr().err
    assert main(["check", str(shot)]) == 1
    assert "no prim matches '//Props//*'" in capsys.readouterr().out


def test_the_history_of_a_packaged_edit_is_read_from_the_package(
    shot: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from pxr import UsdUtils

    monkeypatch.chdir(shot.parent)
    assert UsdUtils.CreateNewUsdzPackage("shot.usda", "shot.usdz")
    capsys.readouterr()
    assert main(["history", "shot.usdz", "warm", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert len(content["events"]) == 1 and content["problems"] == []


def test_an_edit_that_a_layer_took_out_is_named_as_such(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    over = shot.parent / "over.usda"
    over.write_text('#usda 1.0\n(\n    defaultPrim = "World"\n    subLayers = [@./shot.usda@]\n)\n')
    assert main(["edit", "remove", str(over), "warm"]) == 0
    assert main(["edit", "add", str(over), "warm", *SELECTED]) == 2
    assert "exists already; choose another name as the stack does not list it" in capsys.readouterr().err


def test_a_grade_can_be_looked_at_without_selecting_it(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from pxr import Usd

    stage = Usd.Stage.Open(str(shot))
    grades = stage.GetPrimAtPath("/World/Edits").GetVariantSets().AddVariantSet("grade")
    for name in ("day", "dusk"):
        grades.AddVariant(name)
    grades.SetVariantSelection("day")
    stage.Save()
    dusk = ("--variant", "grade=dusk")
    assert main(["edit", "add", str(shot), "glow", *SELECTED, "--set", "gain=3", *dusk]) == 0
    before = files(shot.parent)
    capsys.readouterr()
    for verb, arguments in (("edit list", ()), ("tree", ()), ("key list", ("glow",))):
        assert main([*verb.split(), str(shot), *arguments, *dusk]) == 0
        assert "glow" in capsys.readouterr().out
    assert main(["tree", str(shot)]) == 0
    assert "glow" not in capsys.readouterr().out
    assert main(["tree", str(shot), "--variant", "grade=noon"]) == 2
    assert "no variant 'noon'; it has day, dusk" in capsys.readouterr().err
    assert files(shot.parent) == before


def test_edits_are_listed_in_columns(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["edit", "add", str(shot), "muchLonger", "--operation", "hsv", *SELECTED, "--set", "hue=20"]) == 0
    capsys.readouterr()
    assert main(["edit", "list", str(shot)]) == 0
    assert capsys.readouterr().out == "warm        scale  gain=2\nmuchLonger  hsv    hue=20\n"


def test_keys_say_why_by_default_as_edits_do(shot: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["key", "set", str(shot), "warm", "--frame", "3", "--set", "gain=4", "--why", "hotter"]) == 0
    assert main(["key", "set", str(shot), "warm", "--frame", "5", "--set", "gain=5"]) == 0
    capsys.readouterr()
    assert main(["history", str(shot), "warm", "--json"]) == 0
    whys = [event["why"] for event in json.loads(capsys.readouterr().out)["events"]]
    assert "hotter" in whys and f"icheat key set {shot} warm --frame 5 --set gain=5" in whys


@pytest.mark.parametrize("words", [["--noise", "0.1"], ["--edge-samples", "0"]])
def test_what_only_cached_light_has_is_no_option_of_the_brute_method(
    shot: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    before = files(shot.parent)
    assert main(["render", str(shot), "-o", str(shot.parent / "f.exr"), "--method", "brute", *words]) == 2
    assert f"the brute method has no use for {words[0]}; leave that out" in capsys.readouterr().err
    assert main(["render", str(shot), "-o", str(shot.parent / "f.exr"), "--quick", "--noise", "0.1"]) == 2
    assert "the gathered method has no use for --noise; leave that out" in capsys.readouterr().err
    assert files(shot.parent) == before
