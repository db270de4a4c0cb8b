"""A snapshot holds what the stage shows at a time, the same wherever the stage puts its origin and its unit."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdRender, UsdShade

from icheat_usd.errors import StageError
from icheat_usd.scene import SceneSnapshot
from icheat_usd.stage import take_snapshot


def room(offset: tuple[float, float, float] = (0, 0, 0), unit: float = 1.0) -> Usd.Stage:
    """A small scene of everything, the same in metres for any unit and any place."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    world = UsdGeom.Xform.Define(stage, "/world")
    world.AddTranslateOp().Set(Gf.Vec3d(*offset) / unit)
    world.AddScaleOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(1.0 / unit))
    mesh = UsdGeom.Mesh.Define(stage, "/world/wall")
    mesh.CreatePointsAttr([(0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.AddRotateXYZOp().Set(Gf.Vec3f(10, 20, 30))
    UsdGeom.Sphere.Define(stage, "/world/ball").AddTranslateOp().Set(Gf.Vec3d(1, 1, 2))
    instancer = UsdGeom.PointInstancer.Define(stage, "/world/dots")
    UsdGeom.Cube.Define(stage, "/world/dots/proto")
    instancer.CreatePrototypesRel().SetTargets(["/world/dots/proto"])
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([(5, 0, 0), (0, 5, 1)])
    camera = UsdGeom.Camera.Define(stage, "/world/cam")
    camera.AddTranslateOp().Set(Gf.Vec3d(1, 2, 9))
    camera.GetHorizontalApertureAttr().Set(20.0 / unit)
    camera.GetVerticalApertureAttr().Set(15.0 / unit)
    camera.GetFocalLengthAttr().Set(50.0 / unit)
    camera.GetFStopAttr().Set(4.0)
    camera.GetFocusDistanceAttr().Set(3.0 / unit)
    return stage


def assert_same(a: SceneSnapshot, b: SceneSnapshot) -> None:
    for name in a.geometry._fields:
        x, y = getattr(a.geometry, name), getattr(b.geometry, name)
        assert x.shape == y.shape
        if x.dtype != np.float32:
            assert np.array_equal(x, y), name
    points_a, points_b = world_points(a), world_points(b)
    assert np.abs(points_a - points_b).max() < 2e-6
    assert np.allclose(a.camera.to_world, b.camera.to_world, atol=1e-7)
    assert a.camera.window == pytest.approx(b.camera.window)
    assert a.camera.lens_radius == pytest.approx(b.camera.lens_radius)
    assert a.camera.focus_distance == pytest.approx(b.camera.focus_distance)
    assert a.radius == pytest.approx(b.radius)


def world_points(snapshot: SceneSnapshot) -> np.ndarray:
    g = snapshot.geometry
    parts = []
    for mesh, matrix in zip(g.instance_mesh, g.instance_to_world, strict=True):
        points = g.points[g.mesh_begin[mesh] : g.mesh_begin[mesh + 1]].reshape(-1, 3).astype(np.float64)
        parts.append(points @ matrix[:, :3].T.astype(np.float64) + matrix[:, 3])
    return np.concatenate(parts)


@pytest.mark.parametrize("offset", [(10_000, -10_000, 10_000), (123_456.789, 0, 0.1)])
def test_a_room_ten_kilometres_away_is_the_same_room(offset: tuple[float, float, float]) -> None:
    here, there = take_snapshot(room()), take_snapshot(room(offset))
    assert_same(here, there)
    assert np.allclose(there.centre - here.centre, offset)


@pytest.mark.parametrize("unit", [0.001, 0.01, 1000.0, 0.0254])
def test_the_unit_of_the_stage_does_not_matter(unit: float) -> None:
    assert_same(take_snapshot(room()), take_snapshot(room((5, 6, 7), unit)))


def test_everything_lies_within_the_radius_about_the_origin() -> None:
    snapshot = take_snapshot(room((3, 4, 5)))
    distance = np.linalg.norm(world_points(snapshot), axis=1)
    assert distance.max() <= snapshot.radius * (1 + 1e-6) < 2.0 * distance.max()
    g = snapshot.geometry
    for matrix, inverse in zip(g.instance_to_world, g.instance_to_object, strict=True):
        full = np.vstack([matrix, [0, 0, 0, 1]]) @ np.vstack([inverse, [0, 0, 0, 1]])
        assert np.allclose(full, np.eye(4), atol=1e-5)


def test_surfaces_and_tables_refer_to_each_other() -> None:
    snapshot = take_snapshot(room())
    g = snapshot.geometry
    assert [s.path for s in snapshot.surfaces] == ["/world/wall", "/world/ball", "/world/dots", "/world/dots"]
    assert g.instance_surface.tolist() == [0, 1, 2, 3] and g.instance_mesh.tolist() == [0, 1, 2, 2]
    assert g.mesh_begin[-1] == len(g.points) == len(g.face) == len(g.material)
    assert snapshot.surfaces[0].n_faces == 1 and len(snapshot.surfaces[0].topology_digest) == 64
    assert snapshot.findings == ()
    for array in g:
        assert array.flags.c_contiguous and array.flags.writeable


def test_up_axis_is_kept() -> None:
    stage = room()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    assert_same(take_snapshot(stage), take_snapshot(room()))


def test_hidden_inactive_and_guide_prims_are_not_shown() -> None:
    stage = room()
    stage.GetPrimAtPath("/world/wall").GetAttribute("visibility").Set("invisible")
    stage.GetPrimAtPath("/world/dots").SetActive(False)
    guide = UsdGeom.Cube.Define(stage, "/world/guide")
    guide.GetPurposeAttr().Set("guide")
    proxy = UsdGeom.Cube.Define(stage, "/world/proxy")
    proxy.GetPurposeAttr().Set("proxy")
    assert [s.path for s in take_snapshot(stage).surfaces] == ["/world/ball"]
    shown = take_snapshot(stage, purposes=("default", "proxy"))
    assert [s.path for s in shown.surfaces] == ["/world/ball", "/world/proxy"]
    settings = UsdRender.Settings.Define(stage, "/Render")
    settings.CreateIncludedPurposesAttr().Set(["default", "guide"])
    stage.SetMetadata("renderSettingsPrimPath", "/Render")
    assert [s.path for s in take_snapshot(stage).surfaces] == ["/world/ball", "/world/guide"]


def test_visibility_transforms_and_points_are_those_of_the_time() -> None:
    stage = room()
    ball = UsdGeom.Sphere(stage.GetPrimAtPath("/world/ball"))
    ball.GetVisibilityAttr().Set("invisible", 1)
    ball.GetVisibilityAttr().Set("inherited", 5)
    wall = UsdGeom.Mesh(stage.GetPrimAtPath("/world/wall"))
    wall.GetPointsAttr().Set([(0, 0, 0), (4, 0, 0), (4, 3, 0), (0, 3, 0)], 1)
    wall.GetPointsAttr().Set([(0, 0, 0), (8, 0, 0), (8, 3, 0), (0, 3, 0)], 11)
    first, middle = take_snapshot(stage), take_snapshot(stage, time=6.0)
    assert "/world/ball" not in [s.path for s in first.surfaces]
    assert "/world/ball" in [s.path for s in middle.surfaces]
    assert middle.geometry.points[:2].max() == 6.0 and first.geometry.points[:2].max() == 4.0
    assert first.time_code is None and middle.time_code == 6.0
    stage.SetStartTimeCode(6.0)
    assert take_snapshot(stage).time_code == 6.0
    assert take_snapshot(stage).geometry.points[:2].max() == 6.0


def test_faces_of_subsets_take_their_own_material() -> None:
    stage = room()
    wall = UsdGeom.Mesh(stage.GetPrimAtPath("/world/wall"))
    wall.GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)])
    wall.GetFaceVertexCountsAttr().Set([4, 4])
    wall.GetFaceVertexIndicesAttr().Set([0, 1, 2, 3, 1, 4, 5, 2])
    subset = UsdGeom.Subset.CreateGeomSubset(wall, "second", "face", [1], "materialBind")
    for name, prim in (("a", wall.GetPrim()), ("b", subset.GetPrim())):
        material = UsdShade.Material.Define(stage, f"/looks/{name}")
        shader = UsdShade.Shader.Define(stage, f"/looks/{name}/shader")
        shader.CreateIdAttr("UsdPreviewSurface")
        material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
        UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
    snapshot = take_snapshot(stage)
    used = [snapshot.material_paths[row] for row in snapshot.geometry.material[:4]]
    assert used == ["/looks/a", "/looks/a", "/looks/b", "/looks/b"]


def test_each_unsupported_prim_is_reported_once() -> None:
    stage = room()
    for kind in ("Points", "BasisCurves", "NurbsPatch", "NurbsCurves", "TetMesh", "Volume", "HermiteCurves"):
        stage.DefinePrim(f"/world/{kind}", kind)
    wall = stage.GetPrimAtPath("/world/wall")
    joints = UsdGeom.PrimvarsAPI(wall).CreatePrimvar("skel:jointIndices", Sdf.ValueTypeNames.IntArray, "constant")
    joints.Set([0])
    findings = take_snapshot(stage).findings
    assert sorted((f.prim, f.feature) for f in findings) == sorted(
        [(f"/world/{k}", f"type {k}") for k in ("Points", "BasisCurves", "NurbsPatch", "NurbsCurves", "TetMesh")]
        + [("/world/Volume", "type Volume"), ("/world/HermiteCurves", "type HermiteCurves")]
        + [("/world/wall", "skinning")]
    )


def test_mirrored_and_flattened_transforms_stay_usable() -> None:
    stage = room()
    wall = UsdGeom.Xformable(stage.GetPrimAtPath("/world/wall"))
    wall.AddScaleOp().Set(Gf.Vec3f(-1, 1, 1))
    flat = UsdGeom.Cube.Define(stage, "/world/flat")
    flat.AddScaleOp().Set(Gf.Vec3f(1, 1, 0))
    gone = UsdGeom.Cube.Define(stage, "/world/gone")
    gone.AddScaleOp().Set(Gf.Vec3f(0, 0, 0))
    snapshot = take_snapshot(stage)
    paths = [s.path for s in snapshot.surfaces]
    assert snapshot.geometry.instance_flip[paths.index("/world/wall")] == 1
    assert "/world/flat" in paths and "/world/gone" not in paths
    assert all(np.isfinite(array).all() for array in snapshot.geometry)


def test_an_empty_stage_is_a_snapshot_with_a_finding() -> None:
    stage = Usd.Stage.CreateInMemory()
    with pytest.raises(StageError, match="no camera"):
        take_snapshot(stage)
    snapshot = take_snapshot(stage, camera="auto")
    assert snapshot.n_instances == 0 and snapshot.geometry.points.shape == (0, 3, 3)
    assert [f.feature for f in snapshot.findings] == ["geometry"]


def test_reading_does_not_change_the_stage_and_reports_progress() -> None:
    stage = room()
    before = stage.Flatten().ExportToString()
    steps: list[float] = []
    take_snapshot(stage, progress=lambda step, fraction: steps.append(fraction))
    assert stage.Flatten().ExportToString() == before
    assert steps == sorted(steps) and steps[0] == 0.0 and steps[-1] == 1.0


def test_the_same_stage_gives_the_same_bits() -> None:
    first, second = take_snapshot(room()), take_snapshot(room())
    for name in first.geometry._fields:
        assert getattr(first.geometry, name).tobytes() == getattr(second.geometry, name).tobytes()
    assert first.surfaces == second.surfaces


@pytest.mark.parametrize("level", [-1])
def test_a_negative_subdivision_level_is_refused(level: int) -> None:
    with pytest.raises(StageError, match="subdivision level"):
        take_snapshot(room(), subdivision_level=level)


WRONG_TYPES = """#usda 1.0
( metersPerUnit = 1 )
def Mesh "points" {
    float[] points = [1, 2]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}
def Mesh "strings" {
    string[] points = ["a"]
    string[] faceVertexCounts = ["b"]
    int[] faceVertexIndices = [0]
}
def Mesh "values" {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
    string[] primvars:displayColor = ["red"]
    float[] primvars:st = [1, 2, 3] ( interpolation = "vertex" )
    normal3f[] primvars:normals = [(0, 0, 1)] ( interpolation = "somewhere" )
    uniform token subdivisionScheme = "none"
    uniform token orientation = "sideways"
    int[] holeIndices = [-4, 9]
}
def PointInstancer "dots" {
    int[] protoIndices = [0]
    float[] positions = [0, 0, 0]
}
def Sphere "ball" {
    string radius = "large"
}
"""


def test_values_of_a_wrong_type_are_findings_and_never_tracebacks() -> None:
    stage = Usd.Stage.CreateInMemory()
    assert stage.GetRootLayer().ImportFromString(WRONG_TYPES)
    snapshot = take_snapshot(stage, camera="auto")
    assert [s.path for s in snapshot.surfaces] == ["/values"]
    assert sorted((f.prim, f.feature) for f in snapshot.findings) == [
        ("/ball", "implicit shape"),
        ("/dots", "point instancer"),
        ("/points", "mesh"),
        ("/strings", "mesh"),
        ("/values", "holeIndices"),
        ("/values", "primvar displayColor"),
        ("/values", "primvar normals"),
        ("/values", "primvar st"),
    ]
