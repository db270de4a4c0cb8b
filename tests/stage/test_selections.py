"""Collections, materials, regions and set algebra on a stage, down to the weights of surface points."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from icheat_usd.edits.model import Combination, Region, Rule, SurfacesAt, SurfacesOf
from icheat_usd.edits.selection import bind_selection
from icheat_usd.errors import EditError
from icheat_usd.materials import points_on_surface
from icheat_usd.scene import SceneSnapshot, SurfacePoints
from icheat_usd.stage import schema, take_snapshot
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.stacks import EditFinding
from tests.stage.edit_stages import python

STACK = "/World/Edits"
EDIT = "/World/Edits/edit"


@pytest.fixture
def stage() -> Usd.Stage:
    """Two floors of four quads each along x, in centimetres, and an edit of all light between them."""
    made = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(made, 0.01)
    UsdGeom.SetStageUpAxis(made, UsdGeom.Tokens.y)
    made.SetDefaultPrim(UsdGeom.Xform.Define(made, "/World").GetPrim())
    for name, z in (("near", 0.0), ("far", -300.0)):
        strip(made, f"/World/{name}", z)
    camera = UsdGeom.Camera.Define(made, "/World/camera")
    UsdGeom.XformCommonAPI(camera).SetTranslate((0, 100, 500))
    made.DefinePrim(STACK, "Scope").ApplyAPI(schema.STACK_API)
    edit = made.DefinePrim(EDIT, "Scope")
    edit.ApplyAPI(schema.EDIT_API)
    made.GetPrimAtPath(STACK).GetRelationship(schema.EDITS).AddTarget(EDIT)
    for name in (schema.RECEIVERS, schema.CASTERS):
        Usd.CollectionAPI(edit, name).CreateIncludesRel().AddTarget("/World")
    return made


def strip(stage: Usd.Stage, path: str, z: float) -> UsdGeom.Mesh:
    """Four unit quads (100 cm) side by side, centred at x = -150, -50, 50, 150."""
    mesh = UsdGeom.Mesh.Define(stage, path)
    xs = np.linspace(-200, 200, 5)
    mesh.CreatePointsAttr([(float(x), 0, float(d)) for d in (50, -50) for x in xs])
    mesh.CreateFaceVertexCountsAttr([4] * 4)
    mesh.CreateFaceVertexIndicesAttr([i + j for i in range(4) for j in (0, 1, 6, 5)])
    mesh.CreateSubdivisionSchemeAttr("none")
    UsdGeom.XformCommonAPI(mesh).SetTranslate((0, 0, z))
    return mesh


def limit(stage: Usd.Stage, *paths: str, side: str = schema.RECEIVER_LIMITS) -> None:
    stage.GetPrimAtPath(EDIT).GetRelationship(side).SetTargets([Sdf.Path(path) for path in paths])


def selection(stage: Usd.Stage, path: str, rule: str, *parts: str) -> str:
    prim = stage.DefinePrim(path, "Scope")
    prim.ApplyAPI(schema.SELECTION_API)
    prim.GetAttribute(schema.RULE).Set(rule)
    prim.GetRelationship(schema.PARTS).SetTargets([Sdf.Path(part) for part in parts])
    return path


def box(stage: Usd.Stage, path: str, centre: Sequence[float], half: Sequence[float], softness: float = 0.0) -> str:
    prim = UsdGeom.Cube.Define(stage, path)
    prim.CreatePurposeAttr("guide")
    UsdGeom.XformCommonAPI(prim).SetTranslate(Gf.Vec3d(*centre))
    UsdGeom.XformCommonAPI(prim).SetScale(Gf.Vec3f(*half))
    if softness:
        prim.GetPrim().ApplyAPI(schema.REGION_API)
        prim.GetPrim().GetAttribute(schema.SOFTNESS).Set(softness)
    return path


def read(stage: Usd.Stage, time: float | None = None) -> tuple[object, tuple[EditFinding, ...], SceneSnapshot]:
    snapshot = take_snapshot(stage, time=time, width=4, height=4)
    stack, findings = read_edit_stack(stage, STACK, time, {surface.path for surface in snapshot.surfaces})
    return stack, findings, snapshot


def middles(snapshot: SceneSnapshot) -> SurfacePoints:
    """The middle of every quad: of the long edge of its first triangle."""
    geometry = snapshot.geometry
    instance, triangle = [], []
    for i, mesh in enumerate(geometry.instance_mesh):
        for t in range(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1], 2):
            instance.append(i)
            triangle.append(t)
    n = len(instance)
    return points_on_surface(
        snapshot,
        np.array(instance, np.int32),
        np.array(triangle, np.int32),
        np.tile(np.array([0.0, 0.5], np.float32), (n, 1)),
        np.zeros(n, np.uint8),
    )


def weights(stage: Usd.Stage, time: float | None = None) -> dict[str, list[float]]:
    """Receiver weight of each quad's middle, by surface."""
    stack, findings, snapshot = read(stage, time)
    assert findings == ()
    points = middles(snapshot)
    receivers = stack.edits[0].receivers  # type: ignore[attr-defined]
    found = bind_selection(receivers, None, snapshot, EDIT).at(points)
    result: dict[str, list[float]] = {}
    for i, weight in zip(points.instance, found, strict=True):
        result.setdefault(snapshot.surfaces[i].path, []).append(round(float(weight), 4))
    return result


NONE, ALL = [0.0] * 4, [1.0] * 4


def near(stage: Usd.Stage, time: float | None = None) -> list[float]:
    return weights(stage, time)["/World/near"]


# --------------------------------------------------------------------------- kinds of limits


def test_without_limits_the_collection_decides(stage: Usd.Stage) -> None:
    assert weights(stage) == {"/World/near": ALL, "/World/far": ALL}


def test_a_box_selects_the_space_within(stage: Usd.Stage) -> None:
    # A Cube of size 2 scaled by its half extents.
    limit(stage, box(stage, "/World/box", (100, 0, 0), (100, 10, 60)))
    assert weights(stage) == {"/World/near": [0, 0, 1, 1], "/World/far": NONE}


def test_size_of_a_cube_and_radius_of_a_sphere_count(stage: Usd.Stage) -> None:
    UsdGeom.Cube(stage.GetPrimAtPath(box(stage, "/World/box", (-150, 0, 0), (1, 1, 1)))).CreateSizeAttr(120)
    limit(stage, "/World/box")
    assert near(stage) == [1, 0, 0, 0]
    sphere = UsdGeom.Sphere.Define(stage, "/World/ball")
    sphere.CreatePurposeAttr("guide")
    sphere.CreateRadiusAttr(60)
    limit(stage, "/World/ball")
    assert weights(stage) == {"/World/near": [0, 1, 1, 0], "/World/far": NONE}


def test_softness_falls_towards_the_border(stage: Usd.Stage) -> None:
    limit(stage, box(stage, "/World/box", (0, 0, 0), (200, 50, 400), softness=1.0))
    quarter = 0.25**2 * (3 - 2 * 0.25)  # At 150 of 200.
    three_quarters = 0.75**2 * (3 - 2 * 0.75)
    assert near(stage) == pytest.approx([quarter, three_quarters, three_quarters, quarter], abs=1e-4)


def test_a_region_moves_with_its_transform_and_its_parents(stage: Usd.Stage) -> None:
    rig = UsdGeom.Xform.Define(stage, "/World/rig")
    move = rig.AddTranslateOp()
    move.Set((-150, 0, 0), 1)
    move.Set((150, 0, 0), 4)
    size = UsdGeom.Cube.Define(stage, "/World/rig/box").CreateSizeAttr()
    size.Set(80, 1)
    size.Set(160, 4)
    UsdGeom.Imageable(rig).CreatePurposeAttr("guide")
    limit(stage, "/World/rig/box")
    assert [near(stage, time) for time in (1, 2, 3, 4)] == [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    digests = {read(stage, time)[0].digest for time in (1, 2, 3, 4)}  # type: ignore[attr-defined]
    assert len(digests) == 4


def test_a_guide_that_is_a_region_is_not_rendered(stage: Usd.Stage) -> None:
    box(stage, "/World/box", (0, 0, 0), (100, 100, 100), softness=0.5)
    assert {surface.path for surface in read(stage)[2].surfaces} == {"/World/near", "/World/far"}


@pytest.mark.parametrize("scale", [(0, 1, 1), (0, 0, 0), (float("nan"), 1, 1)])
def test_a_region_without_space_is_an_error_that_names_it(stage: Usd.Stage, scale: Sequence[float]) -> None:
    limit(stage, box(stage, "/World/box", (0, 0, 0), scale))
    with pytest.raises(EditError, match="/World/box: selects no space"):
        read(stage)
    stage.GetPrimAtPath(EDIT).GetAttribute(schema.ENABLED).Set(False)
    assert read(stage)[1] == ()  # A muted edit is never in the way.


def test_a_softness_out_of_range_is_an_error(stage: Usd.Stage) -> None:
    limit(stage, box(stage, "/World/box", (0, 0, 0), (9, 9, 9), softness=1.5))
    with pytest.raises(EditError, match="/World/box: icheat:softness is 1.5, expected 0 to 1"):
        read(stage)


def test_a_material_selects_the_faces_it_is_bound_to(stage: Usd.Stage) -> None:
    bind_material(stage)
    limit(stage, "/World/Looks/brass")
    assert weights(stage) == {"/World/near": [0, 1, 0, 1], "/World/far": ALL}
    limit(stage, "/World/Looks/oak")
    assert weights(stage) == {"/World/near": [1, 0, 1, 0], "/World/far": NONE}


def bind_material(stage: Usd.Stage) -> None:
    """Oak on near, brass on its faces 1 and 3 and on far."""
    oak, brass = (UsdShade.Material.Define(stage, f"/World/Looks/{name}") for name in ("oak", "brass"))
    mesh = stage.GetPrimAtPath("/World/near")
    UsdShade.MaterialBindingAPI.Apply(mesh).Bind(oak)
    subset = UsdShade.MaterialBindingAPI(mesh).CreateMaterialBindSubset("inlay", [1, 3])
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(brass)
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/World/far")).Bind(brass)


def test_a_material_of_an_instance_selects_it_in_all_of_them(stage: Usd.Stage, tmp_path: Path) -> None:
    asset = Usd.Stage.CreateNew(str(tmp_path / "asset.usda"))
    asset.SetDefaultPrim(UsdGeom.Xform.Define(asset, "/asset").GetPrim())
    UsdShade.MaterialBindingAPI.Apply(strip(asset, "/asset/mesh", 0).GetPrim()).Bind(
        UsdShade.Material.Define(asset, "/asset/look")
    )
    asset.Save()
    for name in ("a", "b"):
        prim = UsdGeom.Xform.Define(stage, f"/World/{name}").GetPrim()
        prim.GetReferences().AddReference(str(tmp_path / "asset.usda"))
        prim.SetInstanceable(True)
    for name in ("a", "b"):
        limit(stage, f"/World/{name}/look")
        assert weights(stage) == {
            "/World/near": NONE,
            "/World/far": NONE,
            "/World/a/mesh": ALL,
            "/World/b/mesh": ALL,
        }
    limit(stage, "/World/a/look", "/World/b")
    assert [path for path, found in weights(stage).items() if any(found)] == ["/World/b/mesh"]


def test_a_prim_or_a_collection_selects_surfaces(stage: Usd.Stage) -> None:
    limit(stage, "/World/near")
    assert weights(stage) == {"/World/near": ALL, "/World/far": NONE}
    chosen = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "chosen")
    chosen.CreateIncludesRel().AddTarget("/World")
    chosen.CreateExcludesRel().AddTarget("/World/near")
    limit(stage, "/World.collection:chosen")
    assert weights(stage) == {"/World/near": NONE, "/World/far": ALL}


def test_several_limits_multiply_and_casters_have_their_own(stage: Usd.Stage) -> None:
    bind_material(stage)
    limit(stage, "/World/Looks/brass", box(stage, "/World/box", (-100, 0, 0), (100, 10, 500)))
    limit(stage, "/World/far", side=schema.CASTER_LIMITS)
    assert weights(stage) == {"/World/near": [0, 1, 0, 0], "/World/far": [1, 1, 0, 0]}
    stack, _, snapshot = read(stage)
    casters = bind_selection(stack.edits[0].casters, None, snapshot, EDIT)  # type: ignore[attr-defined]
    assert casters.constant_on_instances and casters.at(middles(snapshot)).tolist() == NONE + ALL


# --------------------------------------------------------------------------- set algebra


@pytest.mark.parametrize(
    ("rule", "expected"),
    [("intersection", [0, 1, 0, 0]), ("union", [1, 1, 0, 1]), ("difference", [1, 0, 0, 0])],
)
def test_rules(stage: Usd.Stage, rule: str, expected: list[float]) -> None:
    bind_material(stage)
    left = box(stage, "/World/box", (-100, 0, 0), (100, 10, 60))
    limit(stage, "/World/near", selection(stage, "/World/Edits/set", rule, left, "/World/Looks/brass"))
    assert near(stage) == expected


def test_parts_nest_and_inactive_ones_are_skipped(stage: Usd.Stage) -> None:
    left = box(stage, "/World/left", (-100, 0, 0), (100, 10, 60))
    middle = box(stage, "/World/middle", (0, 0, 0), (100, 10, 60))
    inner = selection(stage, "/World/Edits/inner", "difference", "/World/near", middle)
    outer = selection(stage, "/World/Edits/outer", "intersection", inner, left)
    limit(stage, outer)
    assert near(stage) == [1, 0, 0, 0]
    stage.GetPrimAtPath(left).SetActive(False)
    assert near(stage) == [1, 0, 0, 1]
    stage.GetPrimAtPath(middle).SetActive(False)
    assert near(stage) == ALL


def test_a_difference_whose_first_part_is_inactive_selects_nothing(stage: Usd.Stage) -> None:
    left = box(stage, "/World/left", (-100, 0, 0), (100, 10, 60))
    limit(stage, selection(stage, "/World/Edits/set", "difference", "/World/Props/gone", left))
    stage.DefinePrim("/World/Props/gone", "Scope")
    stage.GetPrimAtPath("/World/Props").SetActive(False)
    assert near(stage) == NONE


def test_a_selection_without_parts_selects_nothing(stage: Usd.Stage) -> None:
    limit(stage, selection(stage, "/World/Edits/set", "union"))
    assert near(stage) == NONE


def test_a_circle_is_an_error_that_names_it(stage: Usd.Stage) -> None:
    for name, part in (("a", "b"), ("b", "c"), ("c", "b")):
        selection(stage, f"/World/Edits/{name}", "union", f"/World/Edits/{part}")
    limit(stage, "/World/Edits/a")
    with pytest.raises(EditError, match="in a circle: /World/Edits/b -> /World/Edits/c -> /World/Edits/b;"):
        read(stage)


def test_shared_parts_cannot_stand_for_endless_work(stage: Usd.Stage) -> None:
    selection(stage, "/World/Edits/s0", "union", "/World/near")
    for i in range(1, 40):
        selection(stage, f"/World/Edits/s{i}", "union", f"/World/Edits/s{i - 1}", f"/World/Edits/other{i}")
        selection(stage, f"/World/Edits/other{i}", "union", f"/World/Edits/s{i - 1}")
    limit(stage, "/World/Edits/s39")
    with pytest.raises(EditError, match="has over 10000 parts"):
        read(stage)


def test_an_unknown_rule_is_an_error(stage: Usd.Stage) -> None:
    limit(stage, selection(stage, "/World/Edits/set", "xor", "/World/near"))
    with pytest.raises(EditError, match="icheat:rule is 'xor', expected one of intersection, union, difference"):
        read(stage)


@pytest.mark.parametrize("target", ["/World/lost", "/World.collection:lost", "/World/near.points"])
def test_a_missing_target_selects_nothing_and_is_reported(stage: Usd.Stage, target: str) -> None:
    limit(stage, target)
    stack, findings, _ = read(stage)
    assert [(f.prim, f.feature, f.message.split()[0]) for f in findings] == [(EDIT, schema.RECEIVER_LIMITS, target)]
    assert stack.edits[0].receivers.limits == (SurfacesAt(frozenset()),)  # type: ignore[attr-defined]


def test_a_limit_without_surfaces_is_reported(stage: Usd.Stage) -> None:
    limit(stage, "/World/camera")
    stack, findings, _ = read(stage)
    assert [f.message for f in findings] == [
        "/World/camera holds no surface that is shown, so that it selects nothing; name another"
    ]
    assert stack.edits[0].receivers.limits == (SurfacesAt(frozenset()),)  # type: ignore[attr-defined]


def test_every_limit_decides_the_digest(stage: Usd.Stage) -> None:
    bind_material(stage)
    box(stage, "/World/box", (0, 0, 0), (50, 50, 50))
    seen = {read(stage)[0].digest}  # type: ignore[attr-defined]
    for path in ("/World/near", "/World/Looks/oak", "/World/box"):
        limit(stage, path)
        seen.add(read(stage)[0].digest)  # type: ignore[attr-defined]
    for rule in ("union", "difference"):
        limit(stage, selection(stage, "/World/Edits/set", rule, "/World/near", "/World/box"))
        seen.add(read(stage)[0].digest)  # type: ignore[attr-defined]
    UsdGeom.Cube(stage.GetPrimAtPath("/World/box")).CreateSizeAttr(3)
    seen.add(read(stage)[0].digest)  # type: ignore[attr-defined]
    stage.GetPrimAtPath("/World/box").ApplyAPI(schema.REGION_API)
    stage.GetPrimAtPath("/World/box").GetAttribute(schema.SOFTNESS).Set(0.5)
    seen.add(read(stage)[0].digest)  # type: ignore[attr-defined]
    assert len(seen) == 8


# --------------------------------------------------------------------------- collections


def receivers(stage: Usd.Stage) -> Usd.CollectionAPI:
    return Usd.CollectionAPI(stage.GetPrimAtPath(EDIT), schema.RECEIVERS)


def selected(stage: Usd.Stage) -> list[str]:
    return sorted(path for path, found in weights(stage).items() if any(found))


@pytest.mark.parametrize(
    ("rule", "expected"),
    [
        ("explicitOnly", []),
        ("expandPrims", ["/World/far", "/World/near"]),
        ("expandPrimsAndProperties", ["/World/far", "/World/near"]),
    ],
)
def test_expansion_rules(stage: Usd.Stage, rule: str, expected: list[str]) -> None:
    receivers(stage).CreateExpansionRuleAttr().Set(rule)
    stack = read(stage)[0]
    assert sorted(stack.edits[0].receivers.paths) == expected  # type: ignore[attr-defined]
    receivers(stage).GetIncludesRel().AddTarget("/World/far")
    assert selected(stage) == (expected or ["/World/far"])


def test_a_collection_includes_another_one(stage: Usd.Stage) -> None:
    inner = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "inner")
    inner.CreateIncludesRel().AddTarget("/World/far")
    receivers(stage).GetIncludesRel().SetTargets([Sdf.Path("/World.collection:inner")])
    assert selected(stage) == ["/World/far"]


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("/World/n*", ["/World/near"]),
        ("//{isa:Mesh}", ["/World/far", "/World/near"]),
        ("/World//* - /World/near", ["/World/far"]),
        ("/World/nothing", []),
    ],
)
def test_membership_expressions(stage: Usd.Stage, expression: str, expected: list[str]) -> None:
    receivers(stage).GetIncludesRel().ClearTargets(True)
    receivers(stage).CreateMembershipExpressionAttr().Set(Sdf.PathExpression(expression))
    stack = read(stage)[0]
    assert sorted(stack.edits[0].receivers.paths) == expected  # type: ignore[attr-defined]


# --------------------------------------------------------------------------- hosts without our schemas

LATE = """
from pxr import Usd
Usd.SchemaRegistry().FindConcretePrimDefinition("Scope")
import icheat_usd
"""

READ = """
import json, sys
from icheat_usd.stage import schema
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.selections import limit_content
stage = Usd.Stage.Open(sys.argv[1])
stack, findings = read_edit_stack(stage, "/World/Edits", None, ["/World/near", "/World/far"])
edit = stack.edits[0]
limits = [limit_content(limit) for limit in edit.receivers.limits]
found = {"casters": sorted(edit.casters.paths), "limits": limits, "lights": edit.lights, "target": edit.target}
found["digest"] = stack.digest
print(json.dumps({"registered": schema.is_registered(), "findings": len(findings), **found}))
"""


def test_a_host_that_composed_first_reads_the_same(stage: Usd.Stage, tmp_path: Path) -> None:
    bind_material(stage)
    box(stage, "/World/box", (0, 0, 0), (50, 50, 50), softness=0.25)
    selection(stage, "/World/Edits/set", "union", "/World/box", "/World/Looks/brass", "/World/lost")
    limit(stage, "/World/Edits/set", "/World/near", f"{EDIT}.collection:{schema.RECEIVERS}")
    edit = stage.GetPrimAtPath(EDIT)
    edit.GetRelationship(schema.LIGHTS).SetTargets(["/World/near"])
    casters = Usd.CollectionAPI(edit, schema.CASTERS)
    casters.GetIncludesRel().ClearTargets(True)
    casters.CreateMembershipExpressionAttr().Set(Sdf.PathExpression("//{isa:Mesh} - /World/far"))
    edit.GetRelationship(schema.TARGET).SetTargets(["/World/box"])
    stage.GetRootLayer().Export(str(tmp_path / "scene.usda"))
    early = json.loads(python("import icheat_usd\nfrom pxr import Usd\n" + READ, str(tmp_path / "scene.usda")))
    late = json.loads(python(LATE + READ, str(tmp_path / "scene.usda")))
    assert (early.pop("registered"), late.pop("registered")) == (True, False)
    assert early == late
    assert early["casters"] == ["/World/near"]
    assert early["findings"] == 1 and len(early["limits"]) == 3 and early["target"] == [0, 0, 0]
    assert early["limits"][0][1][0][2] == (0.25).hex() and early["limits"][2][1] == ["/World/far", "/World/near"]


def test_model_of_a_nested_selection(stage: Usd.Stage) -> None:
    bind_material(stage)
    box(stage, "/World/box", (0, 0, 0), (50, 50, 50))
    limit(stage, selection(stage, "/World/Edits/set", "difference", "/World/Looks/oak", "/World/box"))
    (found,) = read(stage)[0].edits[0].receivers.limits  # type: ignore[attr-defined]
    assert isinstance(found, Combination) and found.rule is Rule.DIFFERENCE
    oak, region = found.parts
    assert oak == SurfacesOf(frozenset(["/World/Looks/oak"])) and isinstance(region, Region)
    corner = np.reshape(region.to_shape, (3, 4)) @ [0.5, 0.5, -0.5, 1]  # Metres.
    np.testing.assert_allclose(corner, [1, 1, -1])
