"""What `icheat tree` and `check` say of composed edits, and what `icheat edit` writes into variants."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from icheat_usd.cli import main
from tests.composition.cases_of_arcs import GREY, ROSY, borrowed, library
from tests.composition.cases_of_layers import BLOCK, PILLAR, ROOM, dim, hue, shot, warm
from tests.composition.cases_of_variants import GRADED, selecting
from tests.composition.stages import SCENE, STACK, amount, edit, layer, listing, over, select, stack, values


def write(folder: Path, sequence: str, shot_layer: str, library_layer: str = "") -> str:
    (folder / "library").mkdir()
    (folder / "library" / "edits.usda").write_text(library_layer or library())
    (folder / "scene.usda").write_text(layer(SCENE))
    (folder / "sequence.usda").write_text(sequence)
    (folder / "shot.usda").write_text(shot_layer)
    return str(folder / "shot.usda")


def run(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> Any:
    capsys.readouterr()
    assert main([*arguments, "--json"]) == status
    return json.loads(capsys.readouterr().out)


def test_tree_names_the_layer_of_each_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write(
        tmp_path,
        layer(
            stack(
                borrowed("rosy", select("Receivers", ROOM), select("Casters", ROOM)),
                warm(),
                dim(),
                listed=["rosy", "warm", "dim"],
            ),
            weaker=["scene.usda"],
        ),
        shot(
            over("rosy", values(gain=2), amount({1: 0, 9: 1})),
            over("warm", "color3f icheat:scale:color = None", "uniform bool icheat:enabled = false"),
            hue(),
            listing("dim", how="delete"),
        ).replace("delete rel icheat:edits", f"append rel icheat:edits = <{STACK}/hue>\ndelete rel icheat:edits"),
        library(edit("rosy", ROSY, 'uniform token icheat:blend = "over"')),
    )
    told = run(capsys, "tree", root, "--frame", "5", "--quick")
    rosy, warmth, added = told["edits"]

    def said(value: dict[str, Any]) -> tuple[Any, str, str]:
        return value["value"], Path(value["layer"]).name, value["source"]

    assert [Path(each["listedBy"]).name for each in told["edits"]] == ["sequence.usda", "sequence.usda", "shot.usda"]
    assert told["removed"] == [
        {
            "path": f"{STACK}/dim",
            "listedBy": str(tmp_path / "sequence.usda"),
            "removedBy": str(tmp_path / "shot.usda"),
        }
    ]
    assert said(rosy["amount"]) == (0.5, "shot.usda", "timeSamples")
    assert said(rosy["blend"]) == ("over", "edits.usda", "default")
    assert said(rosy["parameters"]["gain"]) == (2.0, "shot.usda", "default")
    assert said(rosy["parameters"]["color"])[1] == "edits.usda"
    assert said(warmth["enabled"]) == (False, "shot.usda", "default")
    assert said(warmth["parameters"]["color"]) == ([1.0, 1.0, 1.0], "shot.usda", "block")
    assert said(added["amount"]) == (1.0, "", "fallback")
    assert main(["tree", root, "--quick"]) == 0
    assert "dim  (removed by shot.usda)" in capsys.readouterr().out


def test_check_names_every_target_that_a_library_cannot_bring(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A library's edit aims at the scene of the shot it was made in; each relationship is told, with its layer."""
    relationships = ("receiverLimits", "casterLimits", "lights", "occluders", "target", "anchor")
    outside = [f"rel icheat:{name} = </World/Lamp>" for name in relationships]
    excluded = "append rel collection:icheatCasters:excludes = </World/Pillar>"
    root = write(
        tmp_path,
        layer('def "Edits" (\nprepend references = @./library/edits.usda@\n)\n{\n}', weaker=["scene.usda"]),
        shot(over("grey", select("Receivers", ROOM), select("Casters", PILLAR))),
        library(
            edit("rosy", ROSY, *outside, excluded, receivers=[ROOM], casters=[BLOCK]),
            GREY,
            body="append rel icheat:edits = [</Library/rosy>, </Library/grey>, </World/Edits/other>]",
            metadata='prepend apiSchemas = ["IcheatStackAPI"]',
        ),
    )
    findings = run(capsys, "check", root, status=1)["findings"]
    dropped = {(f["prim"], f["feature"]): f["message"] for f in findings if f["rule"] == "TargetDropped"}
    collections = ("Receivers:includes", "Casters:includes", "Casters:excludes")
    assert set(dropped) == {
        (STACK, "icheat:edits"),
        *((f"{STACK}/rosy", f"icheat:{name}") for name in relationships),
        *((f"{STACK}/rosy", f"collection:icheat{name}") for name in collections),
    }
    where = f"in {tmp_path / 'library' / 'edits.usda'} lies outside what is referenced"
    assert all(where in message for message in dropped.values())


def test_a_shot_that_aims_a_library_itself_has_no_findings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write(
        tmp_path,
        layer(stack(borrowed("rosy"), borrowed("grey"), listed=["rosy", "grey"]), weaker=["scene.usda"]),
        shot(
            over("rosy", select("Receivers", ROOM), select("Casters", BLOCK), "rel icheat:anchor = </World>"),
            over("grey", select("Receivers", ROOM), select("Casters", PILLAR)),
        ),
        # What the shot replaces by a list of its own was never dropped.
        library(edit("rosy", ROSY, "rel icheat:anchor = </Library/Set>"), GREY),
    )
    assert run(capsys, "check", root)["findings"] == []


# --------------------------------------------------------------------------- variants


def test_edits_are_written_into_a_grade(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write(tmp_path, GRADED, shot())
    day = ("--variant", "grade=day")
    sequence = (tmp_path / "sequence.usda").read_text()
    added = run(capsys, "edit", "add", root, "rim", "--receivers", "Room", "--casters", "Block", *day)
    assert added["edit"] == f"{STACK}/rim"
    assert run(capsys, "edit", "set", root, "hue", "--set", "hue=45", *day)["findings"] == []
    assert run(capsys, "edit", "mute", root, "rim", *day)["findings"] == []
    run(capsys, "edit", "move", root, "rim", "--before", "hue", *day)
    assert [each["path"].rpartition("/")[2] for each in run(capsys, "edit", "list", root)["edits"]] == ["dim", "warm"]
    chosen = stack(over=True, metadata=selecting("grade", "day"))
    (tmp_path / "day.usda").write_text(layer(chosen, weaker=["shot.usda"]))
    edits = run(capsys, "edit", "list", str(tmp_path / "day.usda"))["edits"]
    assert [each["path"].rpartition("/")[2] for each in edits] == ["rim", "hue", "warm"]
    assert (edits[0]["enabled"]["value"], edits[1]["parameters"]["hue"]["value"]) == (False, 45.0)
    run(capsys, "edit", "remove", root, "rim", *day)
    assert (tmp_path / "sequence.usda").read_text() == sequence


def test_a_grade_that_does_not_exist_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write(tmp_path, GRADED, shot())
    before = Path(root).read_text()
    assert main(["edit", "set", root, "warm", "--amount", "0.5", "--variant", "grade=noon"]) == 2
    assert "variant set 'grade' has no variant 'noon'; it has day, dusk" in capsys.readouterr().err
    assert main(["edit", "mute", root, "warm", "--variant", "noon"]) == 2
    assert "'noon' is no SET=VARIANT, such as grade=dusk" in capsys.readouterr().err
    assert Path(root).read_text() == before and not list(tmp_path.glob("*.h5"))
