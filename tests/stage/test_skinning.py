"""Skinned meshes lie where an independent sum over joints puts them, and the stage is left alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from icheat_usd.scene import SceneSnapshot
from icheat_usd.stage import open_stage, take_snapshot

F64 = np.ndarray
JOINTS = ("Hip", "Hip/Knee", "Hip/Knee/Foot")
N_ROWS = 6


def matrix(translation: tuple[float, float, float], degrees: float, scale: float = 1.0) -> Gf.Matrix4d:
    turn = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0.3, 0.5, 1.0), degrees))
    return Gf.Matrix4d().SetScale(scale) * turn * Gf.Matrix4d().SetTranslate(Gf.Vec3d(*translation))


def leg(root: str = "/Leg", scheme: str = "none") -> Usd.Stage:
    """A strip of quads bound to three joints by random weights; every transform on the way says something."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    world = UsdGeom.Xform.Define(stage, "/World")
    world.AddTransformOp().Set(matrix((3.0, -1.0, 2.0), 40.0))
    define_leg(stage, f"/World{root}", scheme)
    return stage


def define_leg(stage: Usd.Stage, root: str, scheme: str = "none") -> None:
    UsdSkel.Root.Define(stage, root)
    skeleton = UsdSkel.Skeleton.Define(stage, f"{root}/Skeleton")
    skeleton.AddTransformOp().Set(matrix((0.2, 0.1, 0.0), 10.0))
    skeleton.CreateJointsAttr(JOINTS)
    skeleton.CreateBindTransformsAttr([matrix((0, -float(i), 0), 5.0 * i) for i in range(3)])
    skeleton.CreateRestTransformsAttr([matrix((0, -1.0 if i else 0.0, 0), 0.0) for i in range(3)])
    animation = UsdSkel.Animation.Define(stage, f"{root}/Animation")
    animation.CreateJointsAttr(JOINTS)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    animation.CreateTranslationsAttr([(0, 0, 0), (0, -1, 0), (0, -1, 0)])
    animation.CreateScalesAttr([(1, 1, 1)] * 3)
    rotations = animation.CreateRotationsAttr()
    for frame, degrees in ((1.0, 0.0), (20.0, 50.0)):
        turn = Gf.Quatf(Gf.Rotation(Gf.Vec3d(1, 0.2, 0), degrees).GetQuat())
        rotations.Set(Vt.QuatfArray([turn] * 3), frame)

    mesh = UsdGeom.Mesh.Define(stage, f"{root}/Mesh")
    mesh.AddTransformOp().Set(matrix((-0.4, 0.3, 0.1), -25.0))  # cancels: skinned points live with the skeleton
    points = [(x, -0.5 * row, 0.1 * x * row) for row in range(N_ROWS) for x in (-0.2, 0.2)]
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr([4] * (N_ROWS - 1))
    mesh.CreateFaceVertexIndicesAttr([2 * r + c for r in range(N_ROWS - 1) for c in (0, 2, 3, 1)])
    mesh.CreateSubdivisionSchemeAttr(scheme)
    mesh.CreateNormalsAttr([(0.1 * i, 0.2, 1.0) for i in range(2 * N_ROWS)])
    mesh.SetNormalsInterpolation("vertex")
    random = np.random.default_rng(5)
    weights = random.dirichlet((1.0, 1.0), 2 * N_ROWS).astype(np.float32)
    indices = np.array([random.permutation(3)[:2] for _ in range(2 * N_ROWS)], np.int32)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 2).Set(indices.reshape(-1).tolist())
    binding.CreateJointWeightsPrimvar(False, 2).Set(weights.reshape(-1).tolist())
    binding.CreateGeomBindTransformAttr().Set(matrix((0.05, 0.0, -0.1), 15.0))


def world_points(snapshot: SceneSnapshot, path: str) -> tuple[F64, F64]:
    """World points and normals of the corners of a surface's triangles, (n, 3) each."""
    row = next(i for i, surface in enumerate(snapshot.surfaces) if surface.path == path)
    g = snapshot.geometry
    mesh = g.instance_mesh[row]
    some = slice(g.mesh_begin[mesh], g.mesh_begin[mesh + 1])
    to_world = g.instance_to_world[row].astype(np.float64)
    points = g.points[some].reshape(-1, 3) @ to_world[:, :3].T + to_world[:, 3] + snapshot.centre
    normals = g.normals[some].reshape(-1, 3) @ np.linalg.inv(to_world[:, :3])
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def joint_matrices(stage: Usd.Stage, root: str, time: float) -> F64:
    """World matrices (3, 4, 4), row vectors, from bind pose to now, from the animation's numbers alone."""
    skeleton = UsdSkel.Skeleton.Get(stage, f"{root}/Skeleton")
    animation = UsdSkel.Animation.Get(stage, f"{root}/Animation")
    turns = animation.GetRotationsAttr().Get(time)
    translations = animation.GetTranslationsAttr().Get(time)
    to_world = np.array(UsdGeom.XformCache(time).GetLocalToWorldTransform(skeleton.GetPrim()))
    above, result = np.eye(4), []
    for turn, translation, bind in zip(turns, translations, skeleton.GetBindTransformsAttr().Get(), strict=True):
        w, (x, y, z) = turn.GetReal(), turn.GetImaginary()
        local = np.eye(4)
        local[:3, :3] = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
                [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
                [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        local[3, :3] = translation
        above = local @ above
        result.append(np.linalg.inv(np.array(bind)) @ above @ to_world)
    return np.array(result)


def blended(stage: Usd.Stage, root: str, time: float) -> tuple[F64, F64]:
    """Linear blend skinning by hand: world points and normals of the mesh's points."""
    mesh = UsdGeom.Mesh.Get(stage, f"{root}/Mesh")
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    indices = np.array(binding.GetJointIndicesPrimvar().Get()).reshape(-1, 2)
    weights = np.array(binding.GetJointWeightsPrimvar().Get(), np.float64).reshape(-1, 2)
    joints = np.array(binding.GetGeomBindTransformAttr().Get()) @ joint_matrices(stage, root, time)
    points, normals = [], []
    for i, (point, normal) in enumerate(zip(mesh.GetPointsAttr().Get(), mesh.GetNormalsAttr().Get(), strict=True)):
        mixed = sum(weights[i, k] * joints[indices[i, k]] for k in range(2))
        points.append((np.array([*point, 1.0]) @ mixed)[:3])
        across = np.array(normal) @ np.linalg.inv(mixed[:3, :3]).T
        normals.append(across / np.linalg.norm(across))
    corners = [2 * r + c for r in range(N_ROWS - 1) for c in (0, 2, 3, 0, 3, 1)]
    return np.array(points)[corners], np.array(normals)[corners]


def same_set(a: F64, b: F64) -> float:
    """Largest distance from a corner in one list to the nearest in the other."""
    distance = np.linalg.norm(a[:, None] - b[None], axis=2)
    return float(max(distance.min(axis=0).max(), distance.min(axis=1).max()))


@pytest.mark.parametrize("time", [1.0, 7.3, 20.0])
def test_linear_blend_skinning_is_the_weighted_sum_over_joints(time: float) -> None:
    stage = leg()
    before = stage.GetRootLayer().ExportToString()
    snapshot = take_snapshot(stage, camera="auto", time=time)
    points, normals = world_points(snapshot, "/World/Leg/Mesh")
    expected_points, expected_normals = blended(stage, "/World/Leg", time)
    # Points with their normals, so that a normal at the wrong point is seen too.
    found, expected = np.hstack([points, normals]), np.hstack([expected_points, expected_normals])
    assert same_set(found, expected) < 2e-6
    assert not [finding for finding in snapshot.findings if "skin" in finding.feature]
    assert stage.GetRootLayer().ExportToString() == before


def test_normals_on_corners_turn_with_the_points_they_are_at() -> None:
    stage = leg()
    mesh = UsdGeom.Mesh.Get(stage, "/World/Leg/Mesh")
    per_point = mesh.GetNormalsAttr().Get()
    on_vertices = world_points(take_snapshot(stage, camera="auto", time=20), "/World/Leg/Mesh")[1]
    mesh.GetNormalsAttr().Set([per_point[i] for i in mesh.GetFaceVertexIndicesAttr().Get()])
    mesh.SetNormalsInterpolation("faceVarying")
    on_corners = world_points(take_snapshot(stage, camera="auto", time=20), "/World/Leg/Mesh")[1]
    np.testing.assert_array_equal(on_vertices, on_corners)


def test_the_topology_digest_stays_and_the_points_move() -> None:
    stage = leg()
    shots = [take_snapshot(stage, camera="auto", time=time) for time in (1.0, 20.0)]
    assert shots[0].surfaces == shots[1].surfaces
    points = [world_points(shot, "/World/Leg/Mesh")[0] for shot in shots]
    assert np.abs(points[0] - points[1]).max() > 0.3


def test_subdivision_refines_the_skinned_cage() -> None:
    stage = leg(scheme="catmullClark")
    skinned = world_points(take_snapshot(stage, camera="auto", time=20), "/World/Leg/Mesh")[0]
    at_rest = leg(scheme="catmullClark")
    mesh = UsdGeom.Mesh.Get(at_rest, "/World/Leg/Mesh")
    unskinned(mesh.GetPrim())
    # The cage that USD's own baking gives, at rest on another stage.
    baked = leg()
    assert UsdSkel.BakeSkinning(baked.Traverse())
    mesh.GetPointsAttr().Set(UsdGeom.Mesh.Get(baked, "/World/Leg/Mesh").GetPointsAttr().Get(20))
    expected = world_points(take_snapshot(at_rest, camera="auto", time=20), "/World/Leg/Mesh")[0]
    np.testing.assert_allclose(skinned, expected, atol=2e-6)


def unskinned(prim: Usd.Prim) -> None:
    prim.RemoveAPI(UsdSkel.BindingAPI)
    for attribute in prim.GetAuthoredProperties():
        if "skel:" in attribute.GetName():
            prim.RemoveProperty(attribute.GetName())


def test_dual_quaternion_skinning_keeps_lengths_where_linear_blending_shrinks() -> None:
    """Half way between two joints that turn against each other by 160 degrees."""
    distances = {}
    for method in ("classicLinear", "dualQuaternion"):
        stage = leg()
        mesh = UsdGeom.Mesh.Get(stage, "/World/Leg/Mesh")
        skeleton = UsdSkel.Skeleton.Get(stage, "/World/Leg/Skeleton")
        skeleton.GetBindTransformsAttr().Set([Gf.Matrix4d(1)] * 3)
        animation = UsdSkel.Animation.Get(stage, "/World/Leg/Animation")
        animation.GetTranslationsAttr().Set([(0, 0, 0)] * 3)
        animation.GetRotationsAttr().Clear()
        turns = [Gf.Quatf(Gf.Rotation(Gf.Vec3d(0, 1, 0), angle).GetQuat()) for angle in (0.0, 160.0, 0.0)]
        animation.GetRotationsAttr().Set(Vt.QuatfArray(turns))
        binding = UsdSkel.BindingAPI(mesh.GetPrim())
        n = 2 * N_ROWS
        binding.GetJointIndicesPrimvar().Set([0, 1] * n)
        binding.GetJointWeightsPrimvar().Set([0.5, 0.5] * n)
        binding.GetGeomBindTransformAttr().Set(Gf.Matrix4d(1))
        binding.CreateSkinningMethodAttr().Set(method)
        points = world_points(take_snapshot(stage, camera="auto", time=1), "/World/Leg/Mesh")[0]
        to_world = np.array(UsdGeom.XformCache(1).GetLocalToWorldTransform(skeleton.GetPrim()))
        local = (np.hstack([points, np.ones((len(points), 1))]) @ np.linalg.inv(to_world))[:, :3]
        distances[method] = np.linalg.norm(local[:, [0, 2]], axis=1)  # from the axis of the turn
        rest = np.array([mesh.GetPointsAttr().Get()[i] for i in mesh.GetFaceVertexIndicesAttr().Get()])
    from_axis = np.unique(np.linalg.norm(rest[:, [0, 2]], axis=1).round(5))
    assert same_set(distances["dualQuaternion"][:, None], from_axis[:, None]) < 1e-5
    shrunk = from_axis * np.cos(np.radians(80))  # the mean of two vectors that are 160 degrees apart
    assert same_set(distances["classicLinear"][:, None], shrunk[:, None]) < 1e-5


def add_blend_shapes(stage: Usd.Stage) -> None:
    mesh = UsdGeom.Mesh.Get(stage, "/World/Leg/Mesh")
    bulge = UsdSkel.BlendShape.Define(stage, "/World/Leg/Mesh/bulge")
    bulge.CreatePointIndicesAttr([3, 4])
    bulge.CreateOffsetsAttr([(1.0, 0, 0), (0, 2.0, 0)])
    bulge.CreateNormalOffsetsAttr([(0, 1.0, 0), (0, 1.0, 0)])
    half = bulge.CreateInbetween("half")
    half.SetWeight(0.5)
    half.SetOffsets([(0, 0, 1.0), (0, 0, 1.0)])
    binding = UsdSkel.BindingAPI(mesh.GetPrim())
    binding.CreateBlendShapesAttr(["bulge"])
    binding.CreateBlendShapeTargetsRel().SetTargets([bulge.GetPath()])
    animation = UsdSkel.Animation.Get(stage, "/World/Leg/Animation")
    animation.CreateBlendShapesAttr(["bulge"])
    animation.CreateBlendShapeWeightsAttr().Set([0.0], 1)
    animation.GetBlendShapeWeightsAttr().Set([1.0], 21)


@pytest.mark.parametrize(
    ("time", "offsets"),
    [
        (1.0, {}),
        (6.0, {3: (0, 0, 0.5), 4: (0, 0, 0.5)}),  # half way to the inbetween at weight 0.5
        (11.0, {3: (0, 0, 1.0), 4: (0, 0, 1.0)}),
        (16.0, {3: (0.5, 0, 0.5), 4: (0, 1.0, 0.5)}),  # between the inbetween and the shape
        (21.0, {3: (1.0, 0, 0), 4: (0, 2.0, 0)}),
    ],
)
def test_blend_shapes_and_their_inbetweens_move_points_before_the_joints_do(
    time: float, offsets: dict[int, tuple[float, ...]]
) -> None:
    stage = leg()
    add_blend_shapes(stage)
    moved = leg()
    mesh = UsdGeom.Mesh.Get(moved, "/World/Leg/Mesh")
    points = np.array(mesh.GetPointsAttr().Get(), np.float64)
    for point, offset in offsets.items():
        points[point] += offset
    mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    snapshot = take_snapshot(stage, camera="auto", time=time)
    found = world_points(snapshot, "/World/Leg/Mesh")[0]
    assert same_set(found, blended(moved, "/World/Leg", time)[0]) < 3e-6
    assert not [finding for finding in snapshot.findings if "blend" in finding.feature or "skin" in finding.feature]


def test_normals_take_the_offsets_of_blend_shapes() -> None:
    stage, moved = leg(), leg()
    add_blend_shapes(stage)
    mesh = UsdGeom.Mesh.Get(moved, "/World/Leg/Mesh")
    normals = np.array(mesh.GetNormalsAttr().Get(), np.float32)
    normals[[3, 4]] += (0, 1, 0)
    mesh.GetNormalsAttr().Set(Vt.Vec3fArray.FromNumpy(normals))
    found = world_points(take_snapshot(stage, camera="auto", time=21), "/World/Leg/Mesh")[1]
    assert same_set(found, blended(moved, "/World/Leg", 21)[1]) < 3e-6


def test_a_sphere_bound_rigidly_goes_where_its_joint_goes() -> None:
    stage = leg()
    ball = UsdGeom.Sphere.Define(stage, "/World/Leg/Ball")
    ball.CreateRadiusAttr(0.1)
    ball.AddTranslateOp().Set((5.0, 5.0, 5.0))  # without effect, as for any skinned prim
    binding = UsdSkel.BindingAPI.Apply(ball.GetPrim())
    binding.CreateSkeletonRel().SetTargets(["/World/Leg/Skeleton"])
    binding.CreateJointIndicesPrimvar(True, 1).Set([2])
    binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    at = Gf.Matrix4d().SetTranslate((0, -2.0, 0.3))
    binding.CreateGeomBindTransformAttr().Set(at)
    for time in (1.0, 20.0):
        found = world_points(take_snapshot(stage, camera="auto", time=time), "/World/Leg/Ball")[0]
        middle = 0.5 * (found.min(axis=0) + found.max(axis=0))
        expected = (np.array([0, 0, 0, 1.0]) @ np.array(at) @ joint_matrices(stage, "/World/Leg", time)[2])[:3]
        np.testing.assert_allclose(middle, expected, atol=2e-3)


def test_point_instances_of_a_figure_are_skinned_with_all_their_parts() -> None:
    alone = leg()
    stage = leg("/Crowd/Figure")
    crowd = UsdGeom.PointInstancer.Define(stage, "/World/Crowd")
    crowd.CreatePrototypesRel().SetTargets(["/World/Crowd/Figure"])
    crowd.CreateProtoIndicesAttr([0])
    crowd.CreatePositionsAttr([(0, 0, 0)])
    for target, root in ((alone, "/World/Leg"), (stage, "/World/Crowd/Figure")):
        ball = UsdGeom.Sphere.Define(target, f"{root}/Ball")
        binding = UsdSkel.BindingAPI.Apply(ball.GetPrim())
        binding.CreateSkeletonRel().SetTargets([f"{root}/Skeleton"])
        binding.CreateJointIndicesPrimvar(True, 1).Set([2])
        binding.CreateJointWeightsPrimvar(True, 1).Set([1.0])
    one, many = (take_snapshot(target, camera="auto", time=20) for target in (alone, stage))
    assert sorted(surface.part for surface in many.surfaces) == ["Ball", "Mesh"]
    boxes = []
    for snapshot in (one, many):
        g = snapshot.geometry
        corners = [
            g.points[g.mesh_begin[m] : g.mesh_begin[m + 1]].reshape(-1, 3) @ w[:, :3].T + w[:, 3] + snapshot.centre
            for m, w in zip(g.instance_mesh, g.instance_to_world, strict=True)
        ]
        boxes.append(sorted(np.concatenate([c.min(axis=0), c.max(axis=0)]).tolist() for c in corners))
    np.testing.assert_allclose(boxes[0], boxes[1], atol=1e-5)


def test_instances_of_one_skeleton_take_their_own_animation() -> None:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    define_leg(stage, "/Prototype")
    stage.GetPrimAtPath("/Prototype").SetSpecifier(Sdf.SpecifierClass)
    stage.GetPrimAtPath("/Prototype/Skeleton").RemoveProperty("skel:animationSource")
    for name, degrees in (("Left", 10.0), ("Right", 70.0)):
        animation = UsdSkel.Animation.Define(stage, f"/{name}Animation")
        animation.CreateJointsAttr(JOINTS)
        animation.CreateTranslationsAttr([(0, 0, 0), (0, -1, 0), (0, -1, 0)])
        animation.CreateScalesAttr([(1, 1, 1)] * 3)
        turn = Gf.Quatf(Gf.Rotation(Gf.Vec3d(1, 0.2, 0), degrees).GetQuat())
        animation.CreateRotationsAttr(Vt.QuatfArray([turn] * 3))
        leg_prim = stage.DefinePrim(f"/{name}", "SkelRoot")
        leg_prim.GetReferences().AddInternalReference("/Prototype")
        leg_prim.SetInstanceable(True)
        UsdGeom.Xformable(leg_prim).AddTransformOp().Set(matrix((1.0, 0, 0), degrees))
        UsdSkel.BindingAPI.Apply(leg_prim).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    flat = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(flat, 1.0)
    snapshot = take_snapshot(stage, camera="auto", time=1)
    assert stage.GetPrimAtPath("/Left/Mesh").IsInstanceProxy()
    for name, degrees in (("Left", 10.0), ("Right", 70.0)):
        define_leg(flat, f"/{name}")
        UsdGeom.Xformable(flat.GetPrimAtPath(f"/{name}")).AddTransformOp().Set(matrix((1.0, 0, 0), degrees))
        rotations = UsdSkel.Animation.Get(flat, f"/{name}/Animation").GetRotationsAttr()
        rotations.Clear()
        rotations.Set(UsdSkel.Animation.Get(stage, f"/{name}Animation").GetRotationsAttr().Get())
        found = world_points(snapshot, f"/{name}/Mesh")[0]
        assert same_set(found, blended(flat, f"/{name}", 1)[0]) < 3e-6
    assert snapshot.surfaces[0].topology_digest == snapshot.surfaces[1].topology_digest


def no_root(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Leg").SetTypeName("Xform")


def no_skeleton(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Leg/Mesh").GetRelationship("skel:skeleton").SetTargets([])


def joint_beyond(stage: Usd.Stage) -> None:
    attribute = stage.GetPrimAtPath("/World/Leg/Mesh").GetAttribute("primvars:skel:jointIndices")
    attribute.Set([7_000_000] * len(attribute.Get()))


def joint_negative(stage: Usd.Stage) -> None:
    attribute = stage.GetPrimAtPath("/World/Leg/Mesh").GetAttribute("primvars:skel:jointIndices")
    attribute.Set([-1] * len(attribute.Get()))


def weights_not_finite(stage: Usd.Stage) -> None:
    attribute = stage.GetPrimAtPath("/World/Leg/Mesh").GetAttribute("primvars:skel:jointWeights")
    attribute.Set([float("nan")] * len(attribute.Get()))


def short_weights(stage: Usd.Stage) -> None:
    stage.GetPrimAtPath("/World/Leg/Mesh").GetAttribute("primvars:skel:jointWeights").Set([1.0, 0.0])


def short_both(stage: Usd.Stage) -> None:
    short_weights(stage)
    stage.GetPrimAtPath("/World/Leg/Mesh").GetAttribute("primvars:skel:jointIndices").Set([1, 0])


def bind_poses_missing(stage: Usd.Stage) -> None:
    UsdSkel.Skeleton.Get(stage, "/World/Leg/Skeleton").GetBindTransformsAttr().Set([Gf.Matrix4d(1)])


def rest_poses_missing(stage: Usd.Stage) -> None:
    UsdSkel.Skeleton.Get(stage, "/World/Leg/Skeleton").GetRestTransformsAttr().Clear()
    animation = UsdSkel.Animation.Get(stage, "/World/Leg/Animation")
    animation.GetJointsAttr().Set(JOINTS[:2])  # so that the third would have to be as in the rest pose
    animation.GetTranslationsAttr().Set([(0, 0, 0), (0, -1, 0)])
    animation.GetScalesAttr().Set([(1, 1, 1)] * 2)
    animation.GetRotationsAttr().Clear()
    animation.GetRotationsAttr().Set(Vt.QuatfArray([Gf.Quatf(1)] * 2))


def shape_beyond(stage: Usd.Stage) -> None:
    add_blend_shapes(stage)
    UsdSkel.BlendShape.Get(stage, "/World/Leg/Mesh/bulge").GetPointIndicesAttr().Set([3, 4_000_000])


def short_shape(stage: Usd.Stage) -> None:
    add_blend_shapes(stage)
    UsdSkel.BlendShape.Get(stage, "/World/Leg/Mesh/bulge").GetOffsetsAttr().Set([(1, 0, 0)])


@pytest.mark.parametrize(
    "spoil",
    [
        no_root,
        no_skeleton,
        joint_beyond,
        joint_negative,
        weights_not_finite,
        short_weights,
        short_both,
        bind_poses_missing,
        rest_poses_missing,
        shape_beyond,
        short_shape,
    ],
)
def test_what_cannot_be_skinned_is_reported_and_at_rest(spoil: Callable[[Usd.Stage], None]) -> None:
    stage = leg()
    spoil(stage)
    snapshot = take_snapshot(stage, camera="auto", time=20)
    assert [f.prim for f in snapshot.findings if "skinning" in f.feature or "blend" in f.feature] == ["/World/Leg/Mesh"]
    found = world_points(snapshot, "/World/Leg/Mesh")[0]
    rest = leg()
    unskinned(rest.GetPrimAtPath("/World/Leg/Mesh"))
    assert same_set(found, world_points(take_snapshot(rest, camera="auto", time=20), "/World/Leg/Mesh")[0]) == 0.0


@pytest.mark.parametrize("name", ["CesiumMan", "RiggedFigure"])
def test_outside_figures_lie_where_usd_bakes_them(shared_scenes: Path, name: str) -> None:
    file = shared_scenes / f"usdwg_anim/{name}.usdz"
    if not file.exists():
        pytest.skip(f"no {file}")
    stage = open_stage(file)
    baked = Usd.Stage.Open(stage.Flatten())
    assert UsdSkel.BakeSkinning(baked.Traverse())
    path = next(str(prim.GetPath()) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    unskinned(baked.GetPrimAtPath(path))
    boxes = []
    for time in (1.0, 12.0, 25.0):
        snapshot = take_snapshot(stage, camera="auto", time=time)
        points, normals = world_points(snapshot, path)
        assert np.isfinite(points).all() and np.isfinite(normals).all()
        expected = world_points(take_snapshot(baked, camera="auto", time=time), path)[0]
        np.testing.assert_allclose(points, expected, atol=1e-6)
        boxes.append(np.concatenate([points.min(axis=0), points.max(axis=0)]))
        # Shading normals turn along: were they left at rest, they would part from the faces.
        corners = points.reshape(-1, 3, 3)
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        along = np.einsum("nki,ni->nk", normals.reshape(-1, 3, 3), flat)
        assert along.mean() > 0.9
        assert not [finding for finding in snapshot.findings if "skin" in finding.feature]
    assert min(np.abs(boxes[0] - boxes[1]).max(), np.abs(boxes[1] - boxes[2]).max()) > 0.02


def test_the_blend_shapes_of_openusd_itself_give_its_ground_truth(shared_scenes: Path) -> None:
    file = shared_scenes / "openusd_testenv/testUsdImagingGLSkelBlendShapes/blendshapes.usda"
    if not file.exists():
        pytest.skip(f"no {file}")
    stage = open_stage(file)
    truth = UsdGeom.Mesh.Get(stage, "/GroundTruth/Mesh").GetPointsAttr()
    times = truth.GetTimeSamples() or [stage.GetStartTimeCode()]
    for time in (times[0], times[len(times) // 2], times[-1]):
        snapshot = take_snapshot(stage, camera="auto", time=time)
        found, expected = (world_points(snapshot, path)[0] for path in ("/TestPlane/Mesh", "/GroundTruth/Mesh"))
        aside = expected.mean(axis=0) - found.mean(axis=0)  # it stands beside
        np.testing.assert_allclose(found + aside, expected, atol=1e-5 * np.ptp(expected))
