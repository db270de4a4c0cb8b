"""Stages that this project did not write load, with the sizes that USD itself computes for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdSkel

from icheat_usd.errors import StageError
from icheat_usd.scene import SceneSnapshot
from icheat_usd.stage import open_stage, take_snapshot

#: stage, camera, triangles of its meshes (None: counted below), placed surfaces, sources of light
STAGES: list[tuple[str, str | None, int | None, int]] = [
    ("bitterli_veach-ajar/veach-ajar.usda", None, 4482, 15),
    ("bitterli_living-room/living-room.usda", None, 142973, 65),
    ("cornell_box/usdpreviewsurface/cornell-box.usda", None, 32, 16),
    ("cornell_box/display-color/cornell-box.usda", None, 32, 16),
    ("cornell_box/mdl/cornell-box.usda", None, 32, 16),
    ("maya_pointinstancer/PointInstancer_Grid_14.usda", "auto", 84, 14),
    ("maya_pointinstancer/PointInstancer_Grid_7k.usda", "auto", 84, 7000),
    ("maya_pointinstancer/PointInstancer_Grid_70k.usda", "auto", 84, 70000),
    ("maya_pointinstancer/ballset_StandaloneScene/Assembly_room_set.usda", "auto", None, 35),
    ("usdwg_intent_vfx/scenes/teapotScene.usd", None, None, 1000),
    ("usdwg_intent_vfx/scenes/simpleAssetScene.usd", "auto", None, 1000),
    ("usdwg_Teapot/Teapot.usd", "auto", None, 1),
    ("usdwg_Teapot/DrawModes.usd", None, None, 35),
    ("usdwg_anim/CesiumMan.usdz", "auto", 4672, 1),
    ("usdwg_anim/RiggedFigure.usdz", "auto", 256, 1),
    ("usdwg_anim/AnimatedCube.usdz", "auto", 12, 1),
    ("usdwg_anim/Creases_SpinningPyramids.usda", None, None, 3),
    ("openusd_testenv/AnimCube.usda", None, 12, 1),
    ("openusd_testenv/testUsdImagingGLAnimatedCamera/cameraMoving.usda", None, None, 2),
    ("openusd_testenv/testUsdImagingGLVelocityMotion/scene.usda", None, None, 10),
    ("openusd_testenv/testUsdImagingGLVaryingTopology/varying.usda", "auto", None, 1),
    ("openusd_testenv/testUsdImagingGLSkelBlendShapes/blendshapes.usda", "auto", None, 2),
    ("nv_kitchens/kitchen_galley_s11.usd", "auto", None, 632),
    ("nv_kitchens/block.usda", "auto", None, 11919),
]


def shown_by_usd(stage: Usd.Stage, time: Usd.TimeCode) -> int:
    """Surfaces that ought to be placed, counted prim by prim."""
    total = 0
    prims = iter(Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
            instancer = UsdGeom.PointInstancer(prim)
            if UsdGeom.Imageable(prim).ComputeVisibility(time) == "invisible":
                continue
            indices = list(instancer.GetProtoIndicesAttr().Get(time) or ())
            mask = list(instancer.ComputeMaskAtTime(time)) or [True] * len(indices)
            targets = instancer.GetPrototypesRel().GetForwardedTargets()
            inside = [gprims_below(stage.GetPrimAtPath(target), time) for target in targets]
            total += sum(inside[i] for i, shown in zip(indices, mask, strict=True) if shown)
        elif prim.IsA(UsdGeom.Gprim) and not prim.IsA(UsdGeom.Points):
            total += is_shown(prim, time)
    return total


def is_shown(prim: Usd.Prim, time: Usd.TimeCode) -> bool:
    imageable = UsdGeom.Imageable(prim)
    return imageable.ComputeVisibility(time) != "invisible" and imageable.ComputePurpose() in ("default", "render")


def gprims_below(root: Usd.Prim, time: Usd.TimeCode) -> int:
    return sum(
        prim.IsA(UsdGeom.Gprim) and is_shown(prim, time) for prim in Usd.PrimRange(root, Usd.TraverseInstanceProxies())
    )


def world_box(snapshot: SceneSnapshot) -> tuple[np.ndarray, np.ndarray]:
    g = snapshot.geometry
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for mesh in range(len(g.mesh_begin) - 1):
        points = g.points[g.mesh_begin[mesh] : g.mesh_begin[mesh + 1]].reshape(-1, 3)
        if len(points) > 4000:  # extreme points along a few hundred directions stand for the rest
            directions = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
            points = points[np.unique(np.argmax(points @ directions.T, axis=0))]
        for matrix in g.instance_to_world[g.instance_mesh == mesh]:
            world = points @ matrix[:, :3].T + matrix[:, 3]
            lower, upper = np.minimum(lower, world.min(axis=0)), np.maximum(upper, world.max(axis=0))
    return lower + snapshot.centre, upper + snapshot.centre


def without_skeletons(stage: Usd.Stage) -> Usd.Stage:
    """A copy whose meshes hold their skinned points: of a skeleton, USD's box is a guess from its joints."""
    if not any(prim.IsA(UsdSkel.Root) for prim in stage.Traverse()):
        return stage
    baked = Usd.Stage.Open(stage.Flatten())
    assert UsdSkel.BakeSkinning(baked.Traverse())
    for prim in baked.Traverse():
        if prim.IsA(UsdSkel.Root):
            prim.SetTypeName("Xform")
    return baked


@pytest.mark.parametrize(("name", "camera", "triangles", "surfaces"), STAGES, ids=[row[0] for row in STAGES])
def test_a_stage_loads_with_the_surfaces_and_the_box_that_usd_computes(
    shared_scenes: Path, name: str, camera: str | None, triangles: int | None, surfaces: int
) -> None:
    path = shared_scenes / name
    if not path.exists():
        pytest.skip(f"{path} is absent")
    stage = open_stage(path)
    snapshot = take_snapshot(stage, camera=camera, width=64, height=36, subdivision_level=int(surfaces < 20))
    g = snapshot.geometry
    assert snapshot.n_instances == len(snapshot.surfaces) == surfaces
    if triangles is not None:
        assert len(g.points) == triangles
    time = Usd.TimeCode.EarliestTime() if snapshot.time_code is None else Usd.TimeCode(snapshot.time_code)
    assert surfaces == shown_by_usd(stage, time)

    # Sound numbers, whatever the stage.
    assert all(np.isfinite(array).all() for array in g)
    assert np.allclose(np.linalg.norm(g.normals, axis=2), 1.0, atol=1e-5)
    assert 0.0 <= g.face_uv.min() and g.face_uv.max() <= 1.0
    assert len({(s.path, s.instance_id, s.part) for s in snapshot.surfaces}) == surfaces
    assert g.material.min() >= 0 and g.material.max() < len(snapshot.material_paths)
    assert not any("__Prototype" in s.path for s in snapshot.surfaces)
    features = [(f.prim, f.feature) for f in snapshot.findings]
    assert len(features) == len(set(features))

    # Subdivision surfaces and inscribed spheres lie within the box of their control points.
    if snapshot.n_instances < 2_000:
        ours = world_box(snapshot)
        stage = without_skeletons(stage)
        cache = UsdGeom.BBoxCache(time, ["default", "render"], useExtentsHint=False)
        box = cache.ComputeWorldBound(stage.GetPseudoRoot()).ComputeAlignedRange()
        unit = UsdGeom.GetStageMetersPerUnit(stage)
        theirs = np.array(box.min) * unit, np.array(box.max) * unit
        size = float(np.linalg.norm(theirs[1] - theirs[0]))
        assert (ours[0] > theirs[0] - 1e-3 * size).all() and (ours[1] < theirs[1] + 1e-3 * size).all()


def test_triangles_are_those_of_the_polygons_less_the_ones_without_area(shared_scenes: Path) -> None:
    stage = open_stage(shared_scenes / "bitterli_living-room/living-room.usda")
    expected = empty = 0
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Mesh):
            mesh = UsdGeom.Mesh(prim)
            points = np.array(mesh.GetPointsAttr().Get(), np.float64)
            faces = np.split(
                np.array(mesh.GetFaceVertexIndicesAttr().Get()), np.cumsum(mesh.GetFaceVertexCountsAttr().Get())[:-1]
            )
            fans = np.array([(face[0], face[i], face[i + 1]) for face in faces for i in range(1, len(face) - 1)])
            a, b, c = np.moveaxis(points[fans], 1, 0)
            expected += len(fans)
            empty += int((np.cross(b - a, c - a) == 0.0).all(axis=1).sum())
    assert empty > 0
    assert len(take_snapshot(stage, subdivision_level=0).geometry.points) == expected - empty


def test_a_broken_stage_says_what_is_missing_once(shared_scenes: Path, capfd: pytest.CaptureFixture[str]) -> None:
    stage = open_stage(shared_scenes / "usdwg_intent_vfx/scenes/teapotScene.usd")
    snapshot = take_snapshot(stage, subdivision_level=0)
    broken = [f for f in snapshot.findings if f.feature.startswith("composition")]
    assert len(stage.GetCompositionErrors()) == 548
    assert len(broken) == 1 and "teapot_animCycle" in broken[0].message and "547 more" in broken[0].message
    assert capfd.readouterr().err == ""


def test_a_file_too_old_for_usd_is_an_error_of_one_sentence(shared_scenes: Path) -> None:
    if Usd.GetVersion() < (0, 26, 11):
        pytest.skip("older USD may still read it")
    with pytest.raises(StageError, match="obsolete version"):
        open_stage(shared_scenes / "maya_pointinstancer/ballset_StandaloneScene/Room_set.usd")


def test_a_stage_without_camera_says_so(shared_scenes: Path) -> None:
    with pytest.raises(StageError, match="has no camera"):
        take_snapshot(open_stage(shared_scenes / "nv_kitchens/kitchen_s11.usd"))


@pytest.mark.parametrize("name", sorted(["pi_bad_schema_input", "pi_masking", "pi_pi_time", "pi_ni_pi", "pi_varying"]))
def test_point_instancer_cases_of_openusd_load(shared_scenes: Path, name: str) -> None:
    stage = open_stage(shared_scenes / f"openusd_testenv/testUsdImagingGLPointInstancer/{name}.usda")
    snapshot = take_snapshot(stage, camera="auto", width=8, height=8)
    assert bool(snapshot.findings) == (name == "pi_bad_schema_input")
    expected = {"pi_bad_schema_input": 0, "pi_masking": 4, "pi_pi_time": 8, "pi_ni_pi": 9, "pi_varying": 2}
    assert snapshot.n_instances == expected[name]
