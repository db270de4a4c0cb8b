"""Points, lengths and directions of an edit travel with the asset that carries it."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom

from icheat_usd.edits.model import Edit, Payload, Region, Value
from icheat_usd.errors import EditError
from icheat_usd.stage import schema, take_snapshot
from icheat_usd.stage.authoring import set_payload_key
from icheat_usd.stage.edit_stack import read_edit_stack
from tests.stage.edit_stages import DIGEST, OTHER

STACK = "/World/rig/Edits"


def add(stage: Usd.Stage, operation: str, **parameters: object) -> Usd.Prim:
    edit = stage.DefinePrim(f"{STACK}/{operation}", "Scope")
    edit.ApplyAPI(schema.EDIT_API)
    edit.ApplyAPI(schema.operations()[operation].api_schema)
    edit.GetAttribute(schema.OPERATION).Set(operation)
    for name, value in parameters.items():
        edit.GetAttribute(f"icheat:{operation}:{name}").Set(value)
    stage.GetPrimAtPath(STACK).GetRelationship(schema.EDITS).AddTarget(edit.GetPath())
    return edit


def fill(stage: Usd.Stage) -> Usd.Stage:
    """Edits below a rig, in centimetres; the rig is turned by 90 degrees about z, doubled and moved."""
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    rig = UsdGeom.Xform.Define(stage, "/World/rig")
    rig.AddTranslateOp().Set((100, 0, 0))
    rig.AddRotateZOp().Set(90)
    rig.AddScaleOp().Set((2, 2, 2))
    stage.DefinePrim(STACK, "Scope").ApplyAPI(schema.STACK_API)
    add(stage, "falloff", pivot=25.0, exponent=1.0)
    add(stage, "redirect", target=Gf.Vec3f(50, 0, 0))
    add(stage, "direction", direction=Gf.Vec3f(0, 5, 0))
    return stage


@pytest.fixture
def stage() -> Usd.Stage:
    return fill(Usd.Stage.CreateInMemory())


def read(stage: Usd.Stage, time: float | None = None, stack: str = STACK) -> dict[str, Edit]:
    return {edit.name: edit for edit in read_edit_stack(stage, stack, time, [])[0].edits}


def same(value: object, expected: object) -> None:
    np.testing.assert_allclose(np.asarray(value), np.asarray(expected), atol=1e-6)


def test_parameters_come_in_metres_and_stage_axes(stage: Usd.Stage) -> None:
    edits = read(stage)
    same(edits["falloff"].parameters["pivot"], 0.5)  # 25 units, doubled, of a centimetre.
    same(edits["falloff"].parameters["exponent"], 1)
    same(edits["redirect"].parameters["target"], (1, 1, 0))  # The rig's x is the stage's y.
    same(edits["redirect"].parameters["spread"], 30)
    same(edits["direction"].parameters["direction"], (-1, 0, 0))


def test_fallbacks_are_in_the_same_space(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(f"{STACK}/redirect").GetAttribute("icheat:redirect:target").Clear()
    stage.GetPrimAtPath(f"{STACK}/direction").GetAttribute("icheat:direction:direction").Clear()
    stage.GetPrimAtPath(f"{STACK}/falloff").GetAttribute("icheat:falloff:pivot").Clear()
    edits = read(stage)
    same(edits["redirect"].parameters["target"], (1, 0, 0))
    same(edits["direction"].parameters["direction"], (-1, 0, 0))
    assert edits["falloff"].parameters["pivot"] == 0


def test_animated_ancestors_count_at_the_time(stage: Usd.Stage) -> None:
    move = UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddTranslateOp()
    move.Set((0, 0, 0), 1)
    move.Set((0, 0, 400), 5)
    same([read(stage, time)["redirect"].parameters["target"] for time in (1, 2, 5)], [(1, 1, 0), (1, 1, 1), (1, 1, 4)])
    digests = {read_edit_stack(stage, STACK, time, [])[0].digest for time in (1, 2, 5)}
    assert len(digests) == 3


@pytest.mark.parametrize("scale", [0.5, -3.0])
def test_a_referenced_asset_carries_its_edits_along(tmp_path: Path, scale: float) -> None:
    asset = fill(Usd.Stage.CreateNew(str(tmp_path / "asset.usda")))
    cube = UsdGeom.Cube.Define(asset, "/World/rig/region")  # [-1, 1] in the rig's space.
    cube.CreatePurposeAttr("guide")
    prim = asset.GetPrimAtPath(f"{STACK}/direction")
    prim.GetRelationship(schema.RECEIVER_LIMITS).AddTarget("/World/rig/region")
    prim.GetRelationship(schema.TARGET).AddTarget("/World/rig/region")
    asset.Save()
    shot = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(shot, 0.01)
    placed = UsdGeom.Xform.Define(shot, "/set/prop")
    placed.AddTranslateOp().Set((0, 0, 700))
    placed.AddRotateZOp().Set(-90)
    placed.AddScaleOp().Set((scale, scale, scale))
    placed.GetPrim().GetReferences().AddReference(str(tmp_path / "asset.usda"))
    # The asset's default prim is the place of the reference, so that its own edits' paths move there.
    edits = read(shot, stack="/set/prop/rig/Edits")
    same(edits["falloff"].parameters["pivot"], 0.5 * abs(scale))
    same(edits["redirect"].parameters["target"], (scale, -scale, 7))
    same(edits["direction"].parameters["direction"], (0, math.copysign(1, scale), 0))
    same(edits["direction"].target, (0, -scale, 7))
    (region,) = edits["direction"].receivers.limits
    assert isinstance(region, Region)
    corner = np.array([scale * 0.02, -scale * 1.02, 7 + scale * 0.02, 1.0])
    same(np.abs(np.reshape(region.to_shape, (3, 4)) @ corner), (1, 1, 1))


def test_recipes_of_payloads_are_in_the_space_of_the_edit(stage: Usd.Stage, tmp_path: Path) -> None:
    (tmp_path / "e.v001.icheat.h5").write_bytes(b"payloads")
    stage.GetRootLayer().Export(str(tmp_path / "scene.usda"))
    saved = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    path = f"{STACK}/redirect"
    saved.GetPrimAtPath(path).GetAttribute("icheat:redirect:target").Clear()
    for time, digest in ((0, DIGEST), (10, OTHER)):
        set_payload_key(saved, path, layer="scene.usda", time=time, payload=(tmp_path / "e.v001.icheat.h5", digest))
    recipes: dict[str, dict[str, Value]] = {
        DIGEST: {"target": (50.0, 0.0, 0.0), "spread": 10.0},
        OTHER: {"target": (100.0, 0.0, 0.0), "spread": 20.0},
    }

    def reader(file: str, source: str | bytes, digest: str, anchor: str) -> Payload:
        return Payload("redirect", recipes[digest])

    edit = read_edit_stack(saved, STACK, 5, [], reader)[0].edits[1]
    same(edit.parameters["target"], (1, 1.5, 0))
    assert [key.payload.parameters["spread"] for key in edit.keys if key.payload] == [10, 20]
    same([key.payload.parameters["target"] for key in edit.keys if key.payload], [(1, 1, 0), (1, 2, 0)])
    saved.GetPrimAtPath(path).GetRelationship(schema.TARGET).AddTarget("/World")
    edit = read_edit_stack(saved, STACK, 5, [], reader)[0].edits[1]
    same([key.payload.parameters["target"] for key in edit.keys if key.payload], [(0, 0, 0), (0, 0, 0)])


# --------------------------------------------------------------------------- targets


def aim(stage: Usd.Stage, *targets: str) -> None:
    relationship = stage.GetPrimAtPath(f"{STACK}/redirect").GetRelationship(schema.TARGET)
    relationship.SetTargets([Sdf.Path(target) for target in targets])


def test_a_target_stands_for_the_parameter(stage: Usd.Stage) -> None:
    ball = UsdGeom.Sphere.Define(stage, "/World/props/ball")
    ball.CreateRadiusAttr(10)
    move = ball.AddTranslateOp()
    move.Set((300, 0, 0), 1)
    move.Set((500, 0, 0), 3)
    aim(stage, "/World/props/ball")
    for time, x in ((1, 3), (2, 4), (3, 5)):
        edit = read(stage, time)["redirect"]
        same(edit.target, (x, 0, 0))
        assert edit.parameters["target"] == edit.target
    assert read(stage)["falloff"].target is None


def test_a_target_without_geometry_is_its_origin_and_hidden_ones_count(stage: Usd.Stage) -> None:
    locator = UsdGeom.Xform.Define(stage, "/World/rig/locator")
    locator.AddTranslateOp().Set((0, 50, 0))
    aim(stage, "/World/rig/locator")
    same(read(stage)["redirect"].target, (0, 0, 0))
    cube = UsdGeom.Cube.Define(stage, "/World/rig/locator/handle")
    cube.CreatePurposeAttr("guide")
    cube.AddTranslateOp().Set((25, 0, 0))
    cube.CreateVisibilityAttr("invisible")
    same(read(stage)["redirect"].target, (0, 0.5, 0))


def test_a_missing_target_is_reported_and_the_parameter_counts(stage: Usd.Stage) -> None:
    aim(stage, "/World/lost")
    stack, findings = read_edit_stack(stage, STACK, None, [])
    assert [f.feature for f in findings if "/World/lost" in f.message] == [schema.TARGET]
    same(stack.edits[1].parameters["target"], (1, 1, 0))


def test_several_targets_are_an_error(stage: Usd.Stage) -> None:
    aim(stage, "/World", "/World/rig")
    with pytest.raises(EditError, match=f"{STACK}/redirect: icheat:target has 2 targets, expected one"):
        read(stage)


# --------------------------------------------------------------------------- what cannot be placed


def test_a_transform_without_volume_is_an_error_for_those_whom_it_concerns(stage: Usd.Stage) -> None:
    UsdGeom.Xformable(stage.GetPrimAtPath("/World")).AddScaleOp().Set((1, 0, 1))
    with pytest.raises(EditError, match="falloff: its transform squashes space flat"):
        read(stage)
    for name in ("falloff", "redirect", "direction"):
        stage.GetPrimAtPath(f"{STACK}/{name}").GetAttribute(schema.ENABLED).Set(False)
    add(stage, "scale")
    assert not read(stage)["redirect"].enabled


def test_a_direction_of_no_length_is_an_error(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(f"{STACK}/direction").GetAttribute("icheat:direction:direction").Set(Gf.Vec3f(0, 0, 0))
    with pytest.raises(EditError, match="direction is .* points nowhere"):
        read(stage)


def test_lights_are_named_and_missing_ones_reported(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath(f"{STACK}/falloff").GetRelationship(schema.LIGHTS).SetTargets(["/World/lost", "/World"])
    stack, findings = read_edit_stack(stage, STACK, None, [])
    assert stack.edits[0].lights == ("/World/lost", "/World")  # None left out: no light at all would mean all.
    assert [f.message.split()[0] for f in findings if f.feature == schema.LIGHTS] == ["/World/lost"]


@pytest.mark.parametrize("authored", [None, 0.0, -1.0])
def test_units_are_those_of_the_snapshot(stage: Usd.Stage, authored: float | None) -> None:
    if authored is None:
        stage.ClearMetadata("metersPerUnit")
    else:
        stage.SetMetadata("metersPerUnit", authored)
    cube = UsdGeom.Cube.Define(stage, "/World/cube")
    cube.AddTranslateOp().Set((500, 0, 0))
    aim(stage, "/World/cube")
    snapshot = take_snapshot(stage, camera="auto", width=4, height=4)
    same(read(stage)["redirect"].target, snapshot.centre)
    same(snapshot.centre, (5, 0, 0))
