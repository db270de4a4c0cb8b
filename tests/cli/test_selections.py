"""Narrowing edits from the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pxr import Usd

from icheat_usd.cli import main
from icheat_usd.stage.description import describe_edit

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
    def Material "Oak" {}
    def SphereLight "Lamp" {}
    def Camera "Camera" {}
}
"""
EDIT = "/World/Edits/warm"


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    path = tmp_path / "shot.usda"
    path.write_text(STAGE)
    return path


def test_an_edit_is_narrowed_by_regions_materials_lights_and_set_algebra(
    stage: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    name = str(stage)
    assert main(["region", "add", name, "Limits/box", "--box=-1,0,0,2,2,2", "--softness", "0.5"]) == 0
    assert main(["region", "add", name, "Limits/ball", "--sphere", "0,0,0,1.5"]) == 0
    assert main(["selection", "add", name, "Limits/any", "Limits/box", "Limits/ball", "--rule", "union"]) == 0
    assert capsys.readouterr().out.split() == ["/World/Limits/box", "/World/Limits/ball", "/World/Limits/any"]
    add = ["edit", "add", name, "warm", "--receivers", "Ball", "--casters-expression", "//{isa:Sphere} - /World/Ball"]
    assert main([*add, "--receiver-limit", "Limits/any", "Oak", "--light", "Lamp", "--target", "Wall"]) == 0
    described = describe_edit(Usd.Stage.Open(name), EDIT)
    assert described.receiver_limits == ("/World/Limits/any", "/World/Oak")
    assert (described.lights, described.target) == (("/World/Lamp",), "/World/Wall")
    assert described.casters == () and described.casters_expression == '//{isa:"Sphere"} - /World/Ball'
    change = ["edit", "set", name, "warm", "--receiver-limit", "--caster-limit", "Oak", "--light", "--target", ""]
    assert main([*change, "--occluder", "Wall"]) == 0
    described = Usd.Stage.Open(name) and describe_edit(Usd.Stage.Open(name), EDIT)
    assert (described.receiver_limits, described.caster_limits) == ((), ("/World/Oak",))
    assert (described.lights, described.target, described.occluders) == ((), "", ("/World/Wall",))


def test_programs_get_one_object(stage: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["region", "add", str(stage), "Limits/box", "--box", "0,0,0,1,1,1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"version": 1, "region": "/World/Limits/box", "layer": str(stage)}
    assert main(["selection", "add", str(stage), "Limits/any", "Limits/box", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["selection"] == "/World/Limits/any"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["region", "add", "S", "Limits/box"], "one of the arguments --box --sphere is required"),
        (["region", "add", "S", "Limits/box", "--box", "1,2,3"], "'1,2,3' is not 6 numbers with commas between"),
        (["region", "add", "S", "Ball", "--sphere", "0,0,0,1"], "/World/Ball exists already (Sphere)"),
        (["region", "add", "S", "x", "--sphere", "0,0,0,0"], "expected 1 above 0"),
        (["selection", "add", "S", "x", "Lost"], "has no prim /World/Lost"),
        (["edit", "add", "S", "e", "--receivers", "Ball", "--receiver-limit", "Lost"], "has no prim /World/Lost"),
        (["edit", "add", "S", "e", "--receivers", "Ball", "--receivers-expression", "//*"], "one or the other"),
        (["edit", "add", "S", "e", "--receivers-expression", "//["], "is no membership expression"),
    ],
)
def test_mistakes_are_one_line_and_leave_the_stage_alone(
    stage: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main([str(stage) if part == "S" else part for part in arguments]) == 2
    assert message in capsys.readouterr().err
    assert stage.read_text() == STAGE and [file.name for file in stage.parent.iterdir()] == ["shot.usda"]
