"""Exit codes, error lines and the options of every verb."""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from icheat_usd.cli import main
from icheat_usd.cli.options import assignment, read_value
from icheat_usd.cli.program import VERBS, build_parser
from icheat_usd.errors import EditError

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


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    return path


@pytest.fixture
def edited(stage: Path) -> Path:
    assert main(["edit", "add", str(stage), "warm", "--receivers", "Ball", "--casters", "Wall"]) == 0
    return stage


def from_json(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> dict[str, object]:
    capsys.readouterr()
    status = main([*arguments, "--json"])
    content = json.loads(capsys.readouterr().out)
    assert content["version"] == 1
    assert status == 0
    return dict(content)


@pytest.mark.parametrize("verb", [name.replace("_", "-") for name in VERBS])
def test_every_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([verb, "--help"]) == 0
    assert f"usage: icheat {verb}" in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [[], ["nonsense"], ["relight", "a.usda"], ["edit"], ["render", "a.usda", "-o"]])
def test_a_usage_error_exits_with_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("icheat") and "--help` tells more" in error and error.count("\n") == 1


def test_a_usage_error_is_json_too_where_json_was_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tree", "a.usda", "--bogus", "--json"]) == 2
    output = capsys.readouterr()
    assert json.loads(output.out) == {"version": 1, "error": output.err.strip()} and "--bogus" in output.err


def test_values_may_begin_with_a_minus() -> None:
    parser = build_parser()
    region = parser.parse_args(["region", "add", "a.usda", "R", "--sphere", "-1,.5,-2,1"])
    edit = parser.parse_args(["edit", "add", "a.usda", "E", "--caster-sphere", "-.5,0,0,1,2", "--amount", "-1"])
    assert region.sphere == (-1, 0.5, -2, 1) and edit.caster_sphere == (-0.5, 0, 0, 1, 2) and edit.amount == -1


def fails_with(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> None:
    def command(options: argparse.Namespace) -> int:
        raise error

    monkeypatch.setattr("icheat_usd.cli.plugin_path.command", command)


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (EditError("shot.usda: no edit\n'x'; it has y"), 2, "icheat: error: shot.usda: no edit 'x'; it has y\n"),
        (PermissionError(13, "Permission denied", "/out/a.exr"), 2, "icheat: error: /out/a.exr: Permission denied\n"),
        (KeyboardInterrupt(), 130, "\nicheat: interrupted; nothing was left half-written\n"),
    ],
)
def test_what_stops_a_verb_is_one_line_and_a_status(
    error: BaseException,
    status: int,
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    fails_with(monkeypatch, error)
    assert main(["plugin-path"]) == status
    assert capsys.readouterr().err == line


def test_a_mistake_in_the_program_is_not_taken_for_findings(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fails_with(monkeypatch, ZeroDivisionError("division by zero"))
    assert main(["plugin-path"]) == 2
    error = capsys.readouterr().err
    assert "Traceback" in error and error.splitlines()[-1].startswith(
        "icheat: error: internal error (ZeroDivisionError"
    )


def test_an_error_is_json_too_where_json_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fails_with(monkeypatch, EditError("no such edit"))
    assert main(["plugin-path", "--json"]) == 2
    assert json.loads(capsys.readouterr().out) == {"version": 1, "error": "no such edit"}


@pytest.mark.parametrize("verb", ["check", "tree", "stack list", "edit list"])
def test_a_missing_stage_is_a_failure_of_every_verb(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*verb.split(), "nowhere.usda"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("icheat: error: ") and "nowhere.usda" in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "value"),
    [("0.5", 0.5), ("1.2,1,0.8", (1.2, 1.0, 0.8)), ("true", True), ("False", False), ("held", "held"), ("-3", -3.0)],
)
def test_parameter_values_are_read_as_typed(text: str, value: object) -> None:
    assert read_value(text) == value and type(read_value(text)) is type(value)


@pytest.mark.parametrize("text", ["gain", "gain=", "=1", ""])
def test_a_setting_needs_a_name_and_a_value(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        assignment(text)


def test_the_plugin_path_holds_the_schemas(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugin-path"]) == 0
    folder = Path(capsys.readouterr().out.strip().split(os.pathsep)[0])
    assert folder.is_absolute() and (folder / "plugInfo.json").is_file() and (folder / "generatedSchema.usda").is_file()


@pytest.mark.parametrize("verb", ["relight", "render"])
@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["-o", "a.jpg"], ".exr or .png"),
        (["-o", "a.exr", "--frames", "1:3"], "####"),
        (["-o", "a.####.exr"], "--frame"),
        (["-o", "no/such/folder/a.exr"], "no folder"),
        (["-o", "a.####.exr", "--frame", "1.5"], "decimals"),
    ],
)
def test_an_output_that_cannot_be_written_is_found_before_any_work(
    verb: str, options: list[str], complaint: str, stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([verb, str(stage), *options]) == 2
    assert complaint in capsys.readouterr().err


def test_frame_and_frames_exclude_each_other() -> None:
    with pytest.raises(SystemExit):
        build_parser().parse_args(["relight", "s.usda", "-o", "a.exr", "--frame", "1", "--frames", "1:2"])


def test_a_stack_is_created_and_listed(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stack", "create", str(stage), "Looks", "--camera", "/World/Camera"]) == 0
    assert capsys.readouterr().out == "/World/Looks\n"
    assert from_json(capsys, ["stack", "list", str(stage)])["stacks"] == [
        {"path": "/World/Looks", "enabled": True, "cameras": ["/World/Camera"], "edits": []}
    ]


def test_an_added_edit_has_its_payload_beside_the_layer(edited: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sidecar = edited.with_name("shot.v001.icheat.h5")
    assert sidecar.is_file()
    content = from_json(capsys, ["cat", str(sidecar), "--verify"])
    tree = from_json(capsys, ["tree", str(edited)])
    (edit,) = tree["edits"]  # type: ignore[misc]
    assert content["payloads"] == [edit["payload"]]
    assert edit["receivers"]["includes"] == ["/World/Ball"] and edit["casters"]["includes"] == ["/World/Wall"]


def test_set_mute_move_and_remove_change_what_list_says(edited: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = ["--receivers", "Ball", "--casters", "Wall"]
    assert main(["edit", "add", str(edited), "tint", "--operation", "hsv", "--set", "hue=20", *both]) == 0

    def names() -> list[str]:
        edits = from_json(capsys, ["edit", "list", str(edited)])["edits"]
        return [edit["path"].rpartition("/")[2] for edit in edits]  # type: ignore[attr-defined]

    def value(name: str, key: str) -> object:
        edits = from_json(capsys, ["edit", "list", str(edited)])["edits"]
        (edit,) = [edit for edit in edits if edit["path"].endswith("/" + name)]  # type: ignore[attr-defined]
        return edit[key]["value"]

    assert names() == ["warm", "tint"]
    assert main(["edit", "move", str(edited), "tint", "--before", "warm"]) == 0
    assert names() == ["tint", "warm"]
    assert main(["edit", "set", str(edited), "warm", "--amount", "0.25", "--blend", "over"]) == 0
    assert value("warm", "amount") == 0.25 and value("warm", "blend") == "over"
    assert main(["edit", "mute", str(edited), "warm"]) == 0
    assert value("warm", "enabled") is False
    assert main(["edit", "mute", str(edited), "warm", "--off"]) == 0
    assert value("warm", "enabled") is True
    assert main(["edit", "remove", str(edited), "tint"]) == 0
    assert names() == ["warm"]


def test_a_value_that_a_stronger_layer_hides_is_a_finding(edited: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = edited.with_name("over.usda")
    shot.write_text('#usda 1.0\n(\n    defaultPrim = "World"\n    subLayers = [@./shot.usda@]\n)\n')
    assert main(["edit", "set", str(shot), "warm", "--amount", "0.5"]) == 0
    before = shot.read_text()
    assert main(["edit", "set", str(shot), "warm", "--amount", "0.75", "--layer", "shot.usda"]) == 1
    assert "stronger" in capsys.readouterr().err
    assert shot.read_text() == before


def test_only_the_named_layer_is_written(edited: Path) -> None:
    shot = edited.with_name("over.usda")
    shot.write_text('#usda 1.0\n(\n    defaultPrim = "World"\n    subLayers = [@./shot.usda@]\n)\n')
    before = edited.read_text()
    assert main(["edit", "mute", str(shot), "warm"]) == 0
    assert edited.read_text() == before and "enabled" in shot.read_text()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["edit", "set", "{}", "nope", "--amount", "1"], "nope"),
        (["edit", "set", "{}", "warm", "--set", "nope=1"], "nope"),
        (["edit", "set", "{}", "warm", "--layer", "nope.usda"], "nope.usda"),
        (["edit", "add", "{}", "warm"], "exists"),
        (["edit", "add", "{}", "cold", "--receivers", "Nothing"], "Nothing"),
        (["tree", "{}", "--stack", "Nope"], "Nope"),
    ],
)
def test_a_refused_edit_leaves_the_layer_alone(
    arguments: list[str], complaint: str, edited: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in edited.parent.iterdir()}
    assert main([argument.format(edited) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert complaint in error and error.count("\n") == 1
    assert {path: path.read_bytes() for path in edited.parent.iterdir()} == before


def test_check_is_clean_until_the_sidecar_goes(edited: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(edited)]) == 0
    assert capsys.readouterr().out.strip() in ("", "/World/Edits/warm")
    edited.with_name("shot.v001.icheat.h5").unlink()
    assert main(["check", str(edited), "--json"]) == 1
    findings = json.loads(capsys.readouterr().out)["findings"]
    assert any("shot.v001.icheat.h5" in finding["message"] for finding in findings)


def test_a_file_that_is_no_sidecar_cannot_be_listed(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["cat", str(stage)]) == 2
    assert str(stage) in capsys.readouterr().err


def test_tree_names_the_layer_behind_each_value(edited: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shot = edited.with_name("over.usda")
    shot.write_text('#usda 1.0\n(\n    defaultPrim = "World"\n    subLayers = [@./shot.usda@]\n)\n')
    assert main(["edit", "set", str(shot), "warm", "--amount", "0.5"]) == 0
    capsys.readouterr()
    assert main(["tree", str(shot)]) == 0
    text = capsys.readouterr().out
    assert "└─ warm  scale" in text and "over.usda: amount=0.5" in text and "shot.usda: operation=scale" in text


@pytest.fixture(autouse=True)
def _in_a_scratch_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    monkeypatch.chdir(tmp_path)
    return lambda: None


def test_a_package_that_a_host_lacks_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(options: argparse.Namespace) -> int:
        raise ModuleNotFoundError("No module named 'numba'", name="numba")

    monkeypatch.setattr("icheat_usd.cli.check.command", command)
    assert main(["check", "stage.usda"]) == 2
    assert capsys.readouterr().err == (
        "icheat: error: this needs the package 'numba', which is not installed here; pip install numba\n"
    )
