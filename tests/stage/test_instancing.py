"""Instances stand where USD puts them, under names that survive, without copies of their triangles."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from icheat_usd.scene import SceneSnapshot
from icheat_usd.stage.snapshot import take_snapshot


def world_boxes(snapshot: SceneSnapshot) -> list[tuple[np.ndarray, np.ndarray]]:
    """Exact box of each instance, stage metres."""
    g = snapshot.geometry
    boxes = []
    for mesh, matrix in zip(g.instance_mesh, g.instance_to_world, strict=True):
        points = g.points[g.mesh_begin[mesh] : g.mesh_begin[mesh + 1]].reshape(-1, 3).astype(np.float64)
        world = points @ matrix[:, :3].T + matrix[:, 3] + snapshot.centre
        boxes.append((world.min(axis=0), world.max(axis=0)))
    return boxes


def stage_in_metres() -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage


def square(stage: Usd.Stage, path: str) -> UsdGeom.Mesh:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateSubdivisionSchemeAttr("none")
    return mesh


def instancer(stage: Usd.Stage, path: str, prototypes: list[str], which: list[int]) -> UsdGeom.PointInstancer:
    made = UsdGeom.PointInstancer.Define(stage, path)
    made.CreatePrototypesRel().SetTargets([Sdf.Path(p) for p in prototypes])
    made.CreateProtoIndicesAttr(which)
    made.CreatePositionsAttr([(3.0 * i, 0, 0) for i in range(len(which))])
    return made


def auto(stage: Usd.Stage, **options: object) -> SceneSnapshot:
    return take_snapshot(stage, camera="auto", width=16, height=9, **options)  # type: ignore[arg-type]


# Native instances --------------------------------------------------------


def instanced_stage(n: int = 3) -> Usd.Stage:
    stage = stage_in_metres()
    UsdGeom.Xform.Define(stage, "/asset")
    square(stage, "/asset/geo/plate")
    for i in range(n):
        xform = UsdGeom.Xform.Define(stage, f"/world/i{i}")
        xform.GetPrim().GetReferences().AddInternalReference("/asset")
        xform.GetPrim().SetInstanceable(True)
        xform.AddTranslateOp().Set(Gf.Vec3d(2 * i, 0, 0))
    stage.OverridePrim("/asset").SetSpecifier(Sdf.SpecifierClass)
    return stage


def test_native_instances_share_one_mesh_under_their_scene_paths() -> None:
    snapshot = auto(instanced_stage())
    assert snapshot.findings == ()
    assert len(snapshot.geometry.mesh_begin) == 2 and snapshot.n_instances == 3
    assert [s.path for s in snapshot.surfaces] == [f"/world/i{i}/geo/plate" for i in range(3)]
    assert {s.instance_id for s in snapshot.surfaces} == {-1}
    assert [box[0][0] for box in world_boxes(snapshot)] == pytest.approx([0, 2, 4])
    assert not any("Prototype" in s.path for s in snapshot.surfaces)


def test_an_instance_that_inherits_another_colour_gets_its_own_mesh() -> None:
    stage = instanced_stage()
    parent = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/world/i1"))
    parent.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "constant").Set([(1, 0, 0)])
    snapshot = auto(stage)
    g = snapshot.geometry
    colors = [tuple(g.color[g.mesh_begin[mesh], 0].tolist()) for mesh in g.instance_mesh]
    assert colors[1] == (1.0, 0.0, 0.0)
    assert g.instance_mesh[0] == g.instance_mesh[2] != g.instance_mesh[1]


def test_an_instance_bound_to_another_material_gets_its_own_rows() -> None:
    stage = instanced_stage()
    material = UsdShade.Material.Define(stage, "/red")
    shader = UsdShade.Shader.Define(stage, "/red/shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/world/i2")).Bind(material)
    snapshot = auto(stage)
    g = snapshot.geometry
    rows = [int(g.material[g.mesh_begin[mesh]]) for mesh in g.instance_mesh]
    assert [snapshot.material_paths[row] for row in rows] == ["", "", "/red"]


# Point instancers --------------------------------------------------------


def test_point_instances_carry_ids_and_leave_out_the_hidden_ones() -> None:
    stage = stage_in_metres()
    square(stage, "/pi/protos/plate")
    made = instancer(stage, "/pi", ["/pi/protos/plate"], [0] * 5)
    made.CreateIdsAttr([100, 101, 102, 103, 104])
    made.CreateInvisibleIdsAttr([101])
    made.DeactivateId(103)
    snapshot = auto(stage)
    assert [(s.path, s.instance_id, s.part) for s in snapshot.surfaces] == [
        ("/pi", 100, ""),
        ("/pi", 102, ""),
        ("/pi", 104, ""),
    ]
    assert [box[0][0] for box in world_boxes(snapshot)] == pytest.approx([0, 6, 12])
    assert len(snapshot.geometry.mesh_begin) == 2


def test_orientations_scales_and_the_prototypes_own_transform_apply_as_usd_computes_them() -> None:
    stage = stage_in_metres()
    UsdGeom.Xform.Define(stage, "/top").AddTranslateOp().Set(Gf.Vec3d(0, 0, 7))
    made = instancer(stage, "/top/pi", ["/top/pi/protos/thing"], [0, 0, 0])
    thing = UsdGeom.Xform.Define(stage, "/top/pi/protos/thing")
    thing.AddRotateZOp().Set(30.0)
    inner = square(stage, "/top/pi/protos/thing/plate")
    inner.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
    half = float(np.sqrt(0.5))
    made.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0), Gf.Quath(half, half, 0, 0), Gf.Quath(half, 0, 0, half)])
    made.CreateScalesAttr([(1, 1, 1), (2, 2, 2), (1, -3, 1)])
    snapshot = auto(stage)
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", "render"])
    bounds = cache.ComputePointInstanceWorldBounds(made, [0, 1, 2])
    for (lower, upper), bound in zip(world_boxes(snapshot), bounds, strict=True):
        exact = bound.ComputeAlignedRange()
        # The tolerance is of orientations, which are half floats.
        assert np.allclose(lower, exact.min, atol=1e-3) and np.allclose(upper, exact.max, atol=1e-3)
    assert snapshot.geometry.instance_flip.tolist() == [0, 0, 1]


def test_a_prototype_of_several_meshes_names_its_parts() -> None:
    stage = stage_in_metres()
    UsdGeom.Xform.Define(stage, "/pi/protos/a")
    square(stage, "/pi/protos/a/left")
    square(stage, "/pi/protos/a/sub/right")
    square(stage, "/pi/protos/b")
    instancer(stage, "/pi", ["/pi/protos/a", "/pi/protos/b"], [0, 1, 0])
    snapshot = auto(stage)
    assert Counter((s.instance_id, s.part) for s in snapshot.surfaces) == Counter(
        [(0, "left"), (2, "left"), (0, "sub/right"), (2, "sub/right"), (1, "")]
    )


def test_what_hides_inside_a_prototype_stays_hidden_and_what_hides_the_prototypes_parent_does_not() -> None:
    stage = stage_in_metres()
    scope = UsdGeom.Scope.Define(stage, "/library")
    scope.GetVisibilityAttr().Set("invisible")
    UsdGeom.Xform.Define(stage, "/library/a")
    square(stage, "/library/a/seen")
    square(stage, "/library/a/hidden").GetVisibilityAttr().Set("invisible")
    square(stage, "/library/a/guide").GetPurposeAttr().Set("guide")
    instancer(stage, "/pi", ["/library/a"], [0, 0])
    snapshot = auto(stage)
    assert len(snapshot.surfaces) == 2 and {s.path for s in snapshot.surfaces} == {"/pi"}


def test_an_instancer_in_a_prototype_multiplies_out() -> None:
    stage = stage_in_metres()
    UsdGeom.Xform.Define(stage, "/outer/protos/cluster").AddTranslateOp().Set(Gf.Vec3d(0, 50, 0))
    square(stage, "/outer/protos/cluster/pi/protos/plate")
    inner = instancer(stage, "/outer/protos/cluster/pi", ["/outer/protos/cluster/pi/protos/plate"], [0, 0])
    inner.GetPositionsAttr().Set([(0, 0, 0), (0, 0, 5)])
    instancer(stage, "/outer", ["/outer/protos/cluster"], [0, 0, 0])
    snapshot = auto(stage)
    places = sorted(tuple(np.round(box[0], 4).tolist()) for box in world_boxes(snapshot))
    assert places == sorted((3.0 * i, 50.0, 5.0 * j) for i in range(3) for j in range(2))
    assert {(s.instance_id, s.part) for s in snapshot.surfaces} == {(i, f"pi[{j}]") for i in range(3) for j in range(2)}
    assert len(snapshot.geometry.mesh_begin) == 2


def test_native_instances_inside_prototypes_and_instancers_inside_instances_are_followed() -> None:
    stage = instanced_stage(0)
    leaf = UsdGeom.Xform.Define(stage, "/pi/protos/leaf")
    leaf.GetPrim().GetReferences().AddInternalReference("/asset")
    leaf.GetPrim().SetInstanceable(True)
    instancer(stage, "/pi", ["/pi/protos/leaf"], [0, 0])
    assert [(s.path, s.instance_id) for s in auto(stage).surfaces] == [("/pi", 0), ("/pi", 1)]

    stage = stage_in_metres()
    stage.CreateClassPrim("/kit")
    square(stage, "/kit/pi/protos/plate")
    instancer(stage, "/kit/pi", ["/kit/pi/protos/plate"], [0, 0])
    for name in ("a", "b"):
        prim = UsdGeom.Xform.Define(stage, f"/{name}").GetPrim()
        prim.GetReferences().AddInternalReference("/kit")
        prim.SetInstanceable(True)
    snapshot = auto(stage)
    assert [(s.path, s.instance_id) for s in snapshot.surfaces] == [
        ("/a/pi", 0),
        ("/a/pi", 1),
        ("/b/pi", 0),
        ("/b/pi", 1),
    ]
    assert len(snapshot.geometry.mesh_begin) == 2


def test_positions_at_the_time_are_taken() -> None:
    stage = stage_in_metres()
    square(stage, "/pi/protos/plate")
    made = instancer(stage, "/pi", ["/pi/protos/plate"], [0])
    made.GetPositionsAttr().Set([(0, 0, 0)], 1)
    made.GetPositionsAttr().Set([(10, 0, 0)], 11)
    assert world_boxes(auto(stage, time=6.0))[0][0][0] == pytest.approx(5.0)
    assert world_boxes(auto(stage))[0][0][0] == pytest.approx(0.0)


def test_velocities_without_a_time_do_not_fling_instances_away() -> None:
    stage = stage_in_metres()
    square(stage, "/pi/protos/plate")
    made = instancer(stage, "/pi", ["/pi/protos/plate"], [0])
    made.GetPositionsAttr().Set([(4, 0, 0)], 1)
    made.CreateVelocitiesAttr().Set([(24, 0, 0)], 1)
    assert world_boxes(auto(stage))[0][0][0] == pytest.approx(4.0)
    assert world_boxes(auto(stage, time=1.5))[0][0][0] == pytest.approx(4.5)  # 24 units a second, half a frame


@pytest.mark.parametrize("fault", ["positions", "prototype", "which", "ids", "orientations", "empty"])
def test_a_broken_instancer_is_one_finding(fault: str) -> None:
    stage = stage_in_metres()
    square(stage, "/floor")
    square(stage, "/pi/protos/plate")
    made = instancer(stage, "/pi", ["/pi/protos/plate"], [0, 0, 0])
    n_left = 0
    if fault == "positions":
        made.GetPositionsAttr().Set([(0, 0, 0)])
    elif fault == "prototype":
        made.GetPrototypesRel().SetTargets([Sdf.Path("/nowhere")])
    elif fault == "which":
        made.GetProtoIndicesAttr().Set([0, 7, -1])
        n_left = 1
    elif fault == "ids":
        made.CreateIdsAttr([5, 5, 5])
        n_left = 3
    elif fault == "orientations":
        made.CreateOrientationsAttr([Gf.Quath(1, 0, 0, 0)])
        n_left = 3
    elif fault == "empty":
        made.GetProtoIndicesAttr().Set([])
    snapshot = auto(stage)
    assert [f.prim for f in snapshot.findings] == ["/pi"]
    assert [s.path for s in snapshot.surfaces] == ["/floor"] + ["/pi"] * n_left


def test_seventy_thousand_instances_take_a_moment_and_no_copies() -> None:
    stage = stage_in_metres()
    square(stage, "/pi/protos/plate")
    made = instancer(stage, "/pi", ["/pi/protos/plate"], [0])
    rng = np.random.default_rng(1)
    n = 70_000
    made.GetProtoIndicesAttr().Set(Vt.IntArray.FromNumpy(np.zeros(n, np.int32)))
    positions = rng.uniform(-100, 100, (n, 3)).astype(np.float32)
    made.GetPositionsAttr().Set(Vt.Vec3fArray.FromNumpy(positions))
    begin = time.process_time()
    snapshot = auto(stage)
    assert time.process_time() - begin < 5.0
    assert snapshot.n_instances == n and len(snapshot.geometry.points) == 2
    assert np.allclose(snapshot.geometry.instance_to_world[:, :, 3] + snapshot.centre, positions, atol=1e-4)
    assert [s.instance_id for s in snapshot.surfaces] == list(range(n))


def test_a_prototype_that_holds_its_own_instancer_does_not_recurse() -> None:
    stage = stage_in_metres()
    UsdGeom.Xform.Define(stage, "/group")
    square(stage, "/group/plate")
    instancer(stage, "/group/pi", ["/group"], [0] * 50)
    snapshot = auto(stage)
    assert [(f.prim, f.feature) for f in snapshot.findings] == [("/group", "prototypes")]
    assert len(snapshot.surfaces) == 51
