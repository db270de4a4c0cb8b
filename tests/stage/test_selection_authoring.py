"""What an edit is about, as opinions in one layer."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from icheat_usd.edits.model import Region, Shape, SurfacesOf
from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.authoring import Members, add_edit, add_region, add_selection, create_stack, save_layer, set_edit
from icheat_usd.stage.description import describe_edit
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.selections import read_region
from tests.stage.edit_stages import SURFACES, layer, shot_stage, stock_findings

STACK, EDIT = "/World/indirect", "/World/indirect/warm"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Usd.Stage]:
    made = shot_stage(tmp_path)
    create_stack(made, "indirect", layer="seq.usda")
    made.SetEditTarget(layer(made, "seq.usda"))
    UsdShade.Material.Define(made, "/World/Looks/oak")
    UsdLux.SphereLight.Define(made, "/World/lamp")
    yield made


def add(stage: Usd.Stage, **more: object) -> str:
    given: dict[str, object] = {"receivers": ["floor"], "casters": ["Room"], **more}
    return add_edit(stage, STACK, "warm", layer="seq.usda", **given)  # type: ignore[arg-type]


def targets(stage: Usd.Stage, relationship: str) -> list[str]:
    return [str(path) for path in stage.GetPrimAtPath(EDIT).GetRelationship(relationship).GetTargets()]


def test_everything_an_edit_is_about_is_authored_and_read_again(stage: Usd.Stage) -> None:
    region = add_region(stage, "Limits/box", layer="seq.usda", shape="box", centre=(0, 1, 0), size=(1, 2, 3))
    both = add_selection(stage, "Limits/both", ["Looks/oak", region], layer="seq.usda", rule="union")
    add(stage, receiver_limits=[both, "floor"], caster_limits=["Looks/oak"], lights=["lamp"], target="Room/wall")
    described = describe_edit(stage, EDIT)
    assert described.receiver_limits == ("/World/Limits/both", "/World/floor")
    assert (described.caster_limits, described.lights) == (("/World/Looks/oak",), ("/World/lamp",))
    assert described.target == "/World/Room/wall"
    stack, findings = read_edit_stack(stage, STACK, None, SURFACES)
    (edit,) = stack.edits
    assert findings == () and edit.casters.limits == (SurfacesOf(frozenset(["/World/Looks/oak"])),)
    assert edit.lights == ("/World/lamp",) and edit.target == pytest.approx((0.5, 0.5, 0))
    assert stock_findings(stage) in (None, [])


def test_a_shot_narrows_by_appending(stage: Usd.Stage) -> None:
    add(stage, receiver_limits=["Looks/oak"], lights=["lamp"])
    assert set_edit(stage, EDIT, layer="shot.usda", receiver_limits=["Looks/oak", "floor"]) == ()
    items = layer(stage, "shot.usda").GetRelationshipAtPath(f"{EDIT}.{schema.RECEIVER_LIMITS}").targetPathList
    assert (list(items.appendedItems), items.isExplicit) == ([Sdf.Path("/World/floor")], False)
    stage.SetEditTarget(layer(stage, "seq.usda"))
    stage.GetPrimAtPath(EDIT).GetRelationship(schema.RECEIVER_LIMITS).AddTarget("/World/Room")
    assert set(targets(stage, schema.RECEIVER_LIMITS)) == {"/World/Looks/oak", "/World/floor", "/World/Room"}
    set_edit(stage, EDIT, layer="shot.usda", receiver_limits=[], lights=[])
    assert targets(stage, schema.RECEIVER_LIMITS) == targets(stage, schema.LIGHTS) == []
    sequence = Usd.Stage.Open(layer(stage, "seq.usda"))
    assert targets(sequence, schema.LIGHTS) == ["/World/lamp"]
    assert set(targets(sequence, schema.RECEIVER_LIMITS)) == {"/World/Looks/oak", "/World/Room"}


def test_a_target_is_replaced_not_added(stage: Usd.Stage) -> None:
    add(stage, target="floor")
    set_edit(stage, EDIT, layer="shot.usda", target="Room/wall")
    assert targets(stage, schema.TARGET) == ["/World/Room/wall"]
    set_edit(stage, EDIT, layer="shot.usda", target="")
    assert targets(stage, schema.TARGET) == []


def test_what_a_stronger_layer_decides_is_a_finding(stage: Usd.Stage) -> None:
    add(stage)
    set_edit(stage, EDIT, layer="shot.usda", lights=["lamp"])
    findings = set_edit(stage, EDIT, layer="seq.usda", lights=[])
    assert [f.feature for f in findings] == [schema.LIGHTS]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"receiver_limits": ["Lookz/oak"]},
            "icheat:receiverLimits: the stage .* has no prim /World/Lookz/oak; did you",
        ),
        ({"lights": ["/World/indirect.collection:x"]}, "has no prim /World/indirect.collection:x"),
        ({"target": f"{EDIT}.collection:icheatCasters"}, "icheat:target: expected prims, got"),
        ({"lights": "lamp"}, "expected a list of paths, got the text 'lamp'"),
        ({"receivers": Members(expression="//{isa:Mesh")}, "is no membership expression \\("),
        ({"receivers": Members(("floor",), (), "//*")}, "takes the place of paths; give one or the other"),
    ],
)
def test_what_does_not_fit_is_refused_and_changes_nothing(stage: Usd.Stage, values: dict, message: str) -> None:
    add(stage)
    before = layer(stage, "shot.usda").ExportToString()
    with pytest.raises(EditError, match=message):
        set_edit(stage, EDIT, layer="shot.usda", **values)
    assert layer(stage, "shot.usda").ExportToString() == before


# --------------------------------------------------------------------------- membership expressions


def selected(stage: Usd.Stage) -> list[str]:
    return sorted(read_edit_stack(stage, STACK, None, SURFACES)[0].edits[0].receivers.paths)


def test_expressions_take_the_place_of_paths_and_paths_that_of_expressions(stage: Usd.Stage) -> None:
    add(stage, receivers=Members(expression="Room//{isa:Mesh}"))
    assert selected(stage) == ["/World/Room/ceiling", "/World/Room/wall"]
    assert describe_edit(stage, EDIT).receivers_expression == '/World/Room//{isa:"Mesh"}'
    assert set_edit(stage, EDIT, layer="shot.usda", receivers=["floor"]) == ()
    assert selected(stage) == ["/World/floor"] and describe_edit(stage, EDIT).receivers_expression == ""
    assert set_edit(stage, EDIT, layer="shot.usda", receivers=Members(expression="//* - Room/wall")) == ()
    assert selected(stage) == ["/World/Room/ceiling", "/World/floor"]


def test_a_predicate_that_usd_does_not_know_is_an_error_unless_the_edit_is_muted(stage: Usd.Stage) -> None:
    add(stage)
    collection = Usd.CollectionAPI(stage.GetPrimAtPath(EDIT), schema.RECEIVERS)
    collection.GetIncludesRel().ClearTargets(True)
    collection.CreateMembershipExpressionAttr().Set(Sdf.PathExpression("//{shiny:yes}"))
    with pytest.raises(EditError, match=f"{EDIT}: the membership expression of icheatReceivers cannot be used"):
        selected(stage)
    set_edit(stage, EDIT, layer="shot.usda", enabled=False)
    assert selected(stage) == []


# --------------------------------------------------------------------------- regions and selections


def region_box(stage: Usd.Stage, path: str, time: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half edges of a region, metres."""
    region = read_region(stage.GetPrimAtPath(path), time)
    to_world = np.linalg.inv(np.vstack([np.reshape(region.to_shape, (3, 4)), [0, 0, 0, 1]]))
    return to_world[:3, 3], to_world[:3, :3]


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_a_region_lies_where_it_was_asked_for(stage: Usd.Stage, unit: float) -> None:
    stage.SetEditTarget(stage.GetRootLayer())
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    path = add_region(
        stage, "Limits/box", layer="shot.usda", shape=Shape.BOX, centre=(1, 2, 3), size=(1, 2, 4), softness=0.25
    )
    prim = stage.GetPrimAtPath(path)
    assert path == "/World/Limits/box" and prim.GetTypeName() == "Cube" and schema.has_schema(prim, schema.REGION_API)
    assert UsdGeom.Imageable(prim).ComputePurpose() == "guide"
    centre, half = region_box(stage, path)
    np.testing.assert_allclose(centre, (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(half, np.diag([0.5, 1, 2]), atol=1e-6)
    assert read_region(prim, None).softness == 0.25
    save_layer(layer(stage, "shot.usda"))
    assert stock_findings(stage) in (None, [])


def test_a_region_below_a_moved_and_turned_parent_lies_there_too(stage: Usd.Stage) -> None:
    rig = UsdGeom.Xform.Define(stage, "/World/rig")
    rig.AddTranslateOp().Set((5, 0, 0))
    rig.AddRotateYOp().Set(30)
    rig.AddScaleOp().Set((2, 1, 3))
    path = add_region(stage, "rig/ball", layer="shot.usda", shape="sphere", centre=(1, 2, 3), size=(0.5,))
    centre, half = region_box(stage, path)
    np.testing.assert_allclose(centre, (1, 2, 3), atol=1e-6)
    np.testing.assert_allclose(half, 0.5 * np.eye(3), atol=1e-6)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"shape": "cone"}, "no shape is called 'cone'; there are box, sphere"),
        ({"size": (1, 0, 1)}, "the size of a box is"),
        ({"size": (1,)}, "expected 3 above 0"),
        ({"centre": (0, float("nan"), 0)}, "expected three finite numbers"),
        ({"softness": 2.0}, "softness is 2.0, expected 0 to 1"),
        ({"path": "/Elsewhere/box"}, "place it below the default prim"),
        ({"path": "floor"}, "/World/floor exists already"),
        ({"path": "no path"}, "'no path' is not a prim path"),
    ],
)
def test_regions_that_make_no_sense_are_refused(stage: Usd.Stage, values: dict, message: str) -> None:
    given: dict = {"path": "Limits/box", "shape": "box", "centre": (0, 0, 0), "size": (1, 1, 1), **values}
    before = layer(stage, "shot.usda").ExportToString()
    with pytest.raises(EditError, match=message):
        add_region(stage, given.pop("path"), layer="shot.usda", **given)
    assert layer(stage, "shot.usda").ExportToString() == before


@pytest.mark.parametrize(
    ("parts", "rule", "message"),
    [
        (["Looks/lost"], "union", "has no prim /World/Looks/lost"),
        (["Looks/oak"], "xor", "no rule is called 'xor'; there are intersection, union, difference"),
        (["Limits/set"], "union", "leads in a circle: /World/Limits/set -> /World/Limits/set"),
    ],
)
def test_selections_that_make_no_sense_are_refused(stage: Usd.Stage, parts: list[str], rule: str, message: str) -> None:
    before = layer(stage, "shot.usda").ExportToString()
    with pytest.raises(EditError, match=message):
        add_selection(stage, "Limits/set", parts, layer="shot.usda", rule=rule)
    assert layer(stage, "shot.usda").ExportToString() == before


@pytest.mark.parametrize(
    ("kind", "name", "allowed"),
    [
        ("Scope", schema.SELECTION_API, True),
        ("Cube", schema.SELECTION_API, False),
        ("Cube", schema.REGION_API, True),
        ("Sphere", schema.REGION_API, True),
        ("Mesh", schema.REGION_API, False),
    ],
)
def test_schemas_apply_where_they_mean_something(kind: str, name: str, allowed: bool) -> None:
    assert bool(Usd.Stage.CreateInMemory().DefinePrim("/prim", kind).CanApplyAPI(name)) == allowed


def test_the_model_of_a_region_is_a_region(stage: Usd.Stage) -> None:
    path = add_region(stage, "ball", layer="seq.usda", shape="sphere", centre=(0, 0, 0), size=(2,))
    add(stage, receiver_limits=[path])
    (limit,) = read_edit_stack(stage, STACK, None, SURFACES)[0].edits[0].receivers.limits
    assert limit == Region(Shape.SPHERE, (0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 0.5, 0))
