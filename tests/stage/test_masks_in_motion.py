"""A mask painted at one frame selects the same material points at any other: it rides with its surface."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, Vt

from icheat_usd.edits.model import Selection
from icheat_usd.edits.painting import paint_mask, soft_sphere
from icheat_usd.edits.selection import bind_selection
from icheat_usd.materials import points_on_surface
from icheat_usd.scene import SceneSnapshot
from icheat_usd.stage import take_snapshot
from tests.stage.test_skinning import define_leg

PATHS = ("/World/Leg/Mesh", "/World/Ball", "/World/Many")


@pytest.fixture(scope="module")
def stage() -> Usd.Stage:
    """A skinned leg, a subdivided ball that moves and dents, and point instances that swap places and order."""
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.Xform.Define(stage, "/World")
    define_leg(stage, "/World/Leg")
    ball = UsdGeom.Mesh.Define(stage, "/World/Ball")
    ball.CreateSubdivisionSchemeAttr("catmullClark")
    corners = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)
    ball.CreateFaceVertexCountsAttr([4] * 6)
    ball.CreateFaceVertexIndicesAttr([0, 2, 3, 1, 4, 5, 7, 6, 0, 1, 5, 4, 2, 6, 7, 3, 0, 4, 6, 2, 1, 3, 7, 5])
    for frame, push in ((1.0, 0.0), (20.0, 0.8)):
        ball.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(corners * (1 + push * corners[:, :1])), frame)
    move = ball.AddTransformOp()
    move.Set(Gf.Matrix4d().SetTranslate((4, 0, 0)), 1)
    move.Set(Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(1, 2, 0), 70)) * Gf.Matrix4d().SetTranslate((-3, 1, 2)), 20)
    UsdGeom.Mesh.Define(stage, "/World/Many/Card")
    many = UsdGeom.PointInstancer.Define(stage, "/World/Many")
    card = UsdGeom.Mesh.Get(stage, "/World/Many/Card")
    card.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)])
    card.CreateFaceVertexCountsAttr([4])
    card.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    card.CreateSubdivisionSchemeAttr("none")
    many.CreatePrototypesRel().SetTargets([card.GetPath()])
    many.CreateProtoIndicesAttr([0, 0])
    many.GetIdsAttr().Set([7, 9], 1)
    many.GetIdsAttr().Set([9, 7], 20)
    many.GetPositionsAttr().Set([(0, 5, 0), (3, 5, 0)], 1)
    many.GetPositionsAttr().Set([(0, 8, 0), (3, 8, 0)], 20)
    return stage


def weights_at(snapshot: SceneSnapshot, mask: object, path: str, instance_id: int) -> np.ndarray:
    """Weights at the same triangles and barycentrics of one surface, whatever the frame."""
    everywhere = Selection(frozenset(PATHS))
    row = next(i for i, s in enumerate(snapshot.surfaces) if (s.path, s.instance_id) == (path, instance_id))
    instance = int(np.flatnonzero(snapshot.geometry.instance_surface == row)[0])
    mesh = snapshot.geometry.instance_mesh[instance]
    begin, end = snapshot.geometry.mesh_begin[mesh : mesh + 2]
    random = np.random.default_rng(2)
    triangle = random.integers(begin, end, size=300)
    barycentric = random.dirichlet((1, 1, 1), 300)[:, :2]
    points = points_on_surface(snapshot, np.full(300, instance), triangle, barycentric, np.zeros(300))
    return bind_selection(everywhere, mask, snapshot, "/edit").at(points)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("path", "instance_id", "centre"),
    [(PATHS[0], -1, (0.2, -1.0, 0.1)), (PATHS[1], -1, (4.5, 0.4, 0.4)), (PATHS[2], 7, (0.5, 5.3, 0))],
    ids=["skinned", "moved, deformed and subdivided", "point instance"],
)
def test_material_points_keep_their_weight(
    stage: Usd.Stage, path: str, instance_id: int, centre: tuple[float, float, float]
) -> None:
    first, last = (take_snapshot(stage, camera="auto", time=time) for time in (1.0, 20.0))
    assert not [f for f in (*first.findings, *last.findings) if "skin" in f.feature]
    brush = soft_sphere(tuple(np.array(centre) - first.centre), 0.2, 0.9)
    mask = paint_mask(first, PATHS, brush, resolution=16)
    before, after = (weights_at(shot, mask, path, instance_id) for shot in (first, last))
    assert before.min() < 0.1 and before.max() > 0.6  # the brush really tells parts apart
    np.testing.assert_allclose(after, before, atol=1e-6)
    assert bind_selection(Selection(frozenset(PATHS)), mask, last, "/edit").findings == ()
