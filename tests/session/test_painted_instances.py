"""A brush paints every placement of an instanced surface for itself, and finds it again by its id."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom

from icheat_usd.edits.binding import bind
from icheat_usd.edits.painting import soft_sphere
from icheat_usd.materials import points_on_surface
from icheat_usd.session import Session

#: Brush around the second placement: it is 3 m away from the others.
PLACES = ((-3.0, 0, 0), (0.0, 0, 0), (3.0, 0, 0))


def quad(stage: Usd.Stage, path: str) -> None:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([(-0.5, 0, 0.5), (0.5, 0, 0.5), (0.5, 0, -0.5), (-0.5, 0, -0.5)])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateSubdivisionSchemeAttr("none")


def native(stage: Usd.Stage) -> None:
    stage.CreateClassPrim("/Asset")
    quad(stage, "/Asset/mesh")
    for name, place in zip("abc", PLACES, strict=True):
        prim = UsdGeom.Xform.Define(stage, f"/World/many/{name}")
        prim.AddTranslateOp().Set(Gf.Vec3d(*place))
        prim.GetPrim().GetReferences().AddInternalReference("/Asset")
        prim.GetPrim().SetInstanceable(True)


def points(stage: Usd.Stage) -> None:
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/many")
    quad(stage, "/World/many/prototype")
    instancer.CreatePrototypesRel().AddTarget("/World/many/prototype")
    instancer.CreateProtoIndicesAttr([0, 0, 0])
    instancer.CreatePositionsAttr([Gf.Vec3f(*place) for place in PLACES])
    instancer.CreateIdsAttr([7, 8, 9])


def weights(session: Session) -> dict[float, float]:
    """Receiver weight in the middle of each placement, by its x."""
    snapshot = session.snapshot
    n = snapshot.n_instances
    middle = points_on_surface(
        snapshot,
        np.arange(n, dtype=np.int32),
        snapshot.geometry.mesh_begin[snapshot.geometry.instance_mesh].astype(np.int32),
        np.tile(np.array([0.0, 0.5], np.float32), (n, 1)),
        np.zeros(n, np.uint8),
    )
    found = bind(session.stack, snapshot).receiver_masks(middle)[0]
    x = middle.position[:, 0] + snapshot.centre[0]
    return {round(float(at), 3): round(float(w), 3) for at, w in zip(x, found, strict=True)}


@pytest.mark.parametrize("kind", [native, points])
def test_each_placement_is_painted_for_itself(kind: object, tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    kind(stage)  # type: ignore[operator]
    stage.Save()
    session = Session.open(tmp_path / "scene.usda", camera="auto", width=4, height=4)
    centre = tuple(float(a - b) for a, b in zip(PLACES[1], session.snapshot.centre, strict=True))
    session.add_edit(
        "near", layer="scene.usda", receivers=["many"], casters=["many"], receiver_brush=soft_sphere(centre, 1.0, 2.0)
    )
    assert weights(session) == {-3.0: 0.0, 0.0: 1.0, 3.0: 0.0}


def test_paint_stays_with_its_instance_when_the_order_changes(tmp_path: Path) -> None:
    test_each_placement_is_painted_for_itself(points, tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    instancer = UsdGeom.PointInstancer(stage.GetPrimAtPath("/World/many"))
    instancer.GetIdsAttr().Set([9, 7, 8])  # The painted one, 8, is now the last, at x = 3.
    stage.Save()
    reopened = Session.open(tmp_path / "scene.usda", camera="auto", width=4, height=4)
    assert weights(reopened) == {-3.0: 0.0, 0.0: 0.0, 3.0: 1.0}


def test_an_expression_and_a_collection_can_be_painted(tmp_path: Path) -> None:
    from icheat_usd.stage.authoring import Members

    stage = Usd.Stage.CreateNew(str(tmp_path / "scene.usda"))
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    native(stage)
    chosen = Usd.CollectionAPI.Apply(stage.GetPrimAtPath("/World"), "chosen")
    chosen.CreateIncludesRel().SetTargets(["/World/many/a", "/World/many/b"])
    stage.Save()
    everywhere = soft_sphere((0, 0, 0), 10.0, 11.0)
    for name, members in (
        ("expression", Members(expression="//many//* - //many/c//*")),
        ("collection", Members(("/World.collection:chosen",))),
    ):
        session = Session.open(tmp_path / "scene.usda", camera="auto", width=4, height=4)
        path = session.add_edit(
            name, layer="scene.usda", receivers=members, casters=["many"], receiver_brush=everywhere
        )
        assert weights(session) == {-3.0: 1.0, 0.0: 1.0, 3.0: 0.0}
        session.mute_edit(path, layer="scene.usda")
