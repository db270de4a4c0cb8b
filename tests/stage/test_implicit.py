"""Implicit shapes have the extent, volume, normals and faces of the shapes they stand for."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from icheat_usd.stage.implicit import AROUND, display_color, parameters, read_implicit
from icheat_usd.stage.meshes import FaceMaterials, TriangleMesh
from icheat_usd.stage.reporting import Reporter

NOW = Usd.TimeCode.EarliestTime()


def shape(kind: str, **attributes: object) -> TriangleMesh:
    stage = Usd.Stage.CreateInMemory()
    prim = stage.DefinePrim("/shape", kind)
    for name, value in attributes.items():
        prim.GetAttribute(name).Set(value)
    report = Reporter()
    mesh = read_implicit(parameters(prim, NOW), display_color(prim, NOW, report), FaceMaterials(2), prim, report)
    assert report.findings() == () and mesh is not None
    return mesh


def volume(mesh: TriangleMesh) -> float:
    t = mesh.points.astype(np.float64)
    return float(np.einsum("ni,ni->n", t[:, 0], np.cross(t[:, 1], t[:, 2])).sum() / 6.0)


def area(mesh: TriangleMesh) -> float:
    t = mesh.points.astype(np.float64)
    return float(0.5 * np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum())


#: An inscribed regular polygon's share of its circle's area.
POLYGON = AROUND / (2 * np.pi) * np.sin(2 * np.pi / AROUND)


def test_a_cube_has_six_faces_facing_out() -> None:
    mesh = shape("Cube", size=3.0)
    assert mesh.n_faces == 6 and len(mesh.points) == 12 and mesh.face.tolist() == sorted([0, 1, 2, 3, 4, 5] * 2)
    assert volume(mesh) == pytest.approx(27.0) and area(mesh) == pytest.approx(54.0)
    assert np.allclose(np.abs(mesh.normals).max(axis=2), 1.0)
    for face in range(6):
        corners = mesh.face_uv[mesh.face == face].reshape(-1, 2)
        assert {tuple(c) for c in corners} == {(0, 0), (1, 0), (1, 1), (0, 1)}


@pytest.mark.parametrize("axis", ["X", "Y", "Z"])
def test_round_solids_hold_their_volume_along_their_axis(axis: str) -> None:
    cylinder = shape("Cylinder", radius=0.5, height=3.0, axis=axis)
    assert volume(cylinder) == pytest.approx(np.pi * 0.25 * 3.0 * POLYGON, rel=1e-5)
    cone = shape("Cone", radius=0.5, height=3.0, axis=axis)
    assert volume(cone) == pytest.approx(np.pi * 0.25 * POLYGON, rel=1e-5)
    capsule = shape("Capsule", radius=0.5, height=3.0, axis=axis)
    assert volume(capsule) == pytest.approx(np.pi * (0.25 * 3.0 + 0.5 / 3.0), rel=0.01)
    along = "XYZ".index(axis)
    for mesh, half in ((cylinder, 1.5), (cone, 1.5), (capsule, 2.0)):
        lower, upper = mesh.bounds
        assert upper[along] == pytest.approx(half) and lower[along] == pytest.approx(-half)
        assert np.delete(upper, along) == pytest.approx(0.5, abs=1e-6)
    tip = cone.points.reshape(-1, 3)[cone.points.reshape(-1, 3)[:, along].argmax()]
    assert np.delete(tip, along) == pytest.approx(0.0, abs=1e-6)  # a cone points along +axis


def test_a_sphere_carries_its_true_normals_on_its_surface() -> None:
    mesh = shape("Sphere", radius=2.0)
    radius = np.linalg.norm(mesh.points, axis=2)
    assert np.allclose(radius, 2.0, rtol=1e-6)
    assert np.allclose(mesh.normals, mesh.points / 2.0, atol=1e-5)
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi * 8, rel=0.01)
    assert area(mesh) == pytest.approx(16 * np.pi, rel=0.01)


def test_a_cones_and_a_tapered_cylinders_normals_stand_on_their_slope() -> None:
    for mesh, slope in (
        (shape("Cone", radius=1.0, height=2.0, axis="Z"), (2.0, 1.0)),
        (shape("Cylinder_1", radiusBottom=2.0, radiusTop=1.0, height=2.0, axis="Z"), (2.0, 1.0)),
    ):
        normals = mesh.normals[mesh.face < AROUND].reshape(-1, 3)
        assert np.allclose(np.hypot(normals[:, 0], normals[:, 1]), slope[0] / np.hypot(*slope), atol=1e-6)
        assert np.allclose(normals[:, 2], slope[1] / np.hypot(*slope), atol=1e-6)


@pytest.mark.parametrize(("axis", "width_along", "length_along"), [("X", 2, 1), ("Y", 0, 2), ("Z", 0, 1)])
def test_a_plane_lies_across_its_axis_and_is_double_sided(axis: str, width_along: int, length_along: int) -> None:
    mesh = shape("Plane", width=4.0, length=2.0, axis=axis)
    lower, upper = mesh.bounds
    size = upper - lower
    assert size[width_along] == 4.0 and size[length_along] == 2.0 and size["XYZ".index(axis)] == 0.0
    assert mesh.n_faces == 1 and len(mesh.points) == 2 and mesh.double_sided
    assert np.allclose(mesh.normals, np.eye(3)["XYZ".index(axis)])


@pytest.mark.parametrize("kind", ["Cube", "Sphere", "Cylinder", "Cone", "Capsule", "Plane"])
@pytest.mark.parametrize("orientation", ["rightHanded", "leftHanded"])
def test_winding_agrees_with_normals_and_values_fill_the_unit_square(kind: str, orientation: str) -> None:
    mesh = shape(kind, orientation=orientation)
    t = mesh.points.astype(np.float64)
    cross = np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
    assert (np.einsum("ni,nki->nk", cross, mesh.normals) > 0).all()
    assert mesh.st.min() == 0.0 and mesh.st.max() == pytest.approx(1.0)
    assert mesh.face_uv.min() == 0.0 and mesh.face_uv.max() == 1.0
    assert mesh.face.max() < mesh.n_faces and np.all(mesh.material == 2)
    if kind != "Plane":
        assert (volume(mesh) > 0) == (orientation == "rightHanded")


@pytest.mark.parametrize("kind", ["Cube", "Sphere", "Cylinder", "Cone", "Capsule", "Plane"])
def test_solids_are_closed_and_lie_within_usds_extent(kind: str) -> None:
    stage = Usd.Stage.CreateInMemory()
    prim = stage.DefinePrim("/shape", kind)
    mesh = shape(kind)
    lower, upper = mesh.bounds
    extent = UsdGeom.Boundable.ComputeExtentFromPlugins(UsdGeom.Boundable(prim), Usd.TimeCode.Default())
    assert np.allclose(lower, extent[0], atol=1e-6) and np.allclose(upper, extent[1], atol=1e-6)
    if kind != "Plane":  # vector areas of a closed surface cancel
        t = mesh.points.astype(np.float64)
        assert np.allclose(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]).sum(axis=0), 0.0, atol=1e-5)


def test_sizes_are_read_at_the_time() -> None:
    stage = Usd.Stage.CreateInMemory()
    sphere = UsdGeom.Sphere.Define(stage, "/s")
    sphere.GetRadiusAttr().Set(1.0, 1)
    sphere.GetRadiusAttr().Set(3.0, 11)
    report = Reporter()
    made = parameters(sphere.GetPrim(), Usd.TimeCode(6))
    mesh = read_implicit(made, (1.0, 1.0, 1.0), FaceMaterials(0), sphere.GetPrim(), report)
    assert mesh is not None and mesh.bounds[1][2] == pytest.approx(2.0)


@pytest.mark.parametrize("radius", [0.0, -1.0, float("nan")])
def test_a_shape_without_area_is_reported(radius: float) -> None:
    stage = Usd.Stage.CreateInMemory()
    sphere = UsdGeom.Sphere.Define(stage, "/s")
    sphere.GetRadiusAttr().Set(radius)
    report = Reporter()
    prim = sphere.GetPrim()
    assert read_implicit(parameters(prim, NOW), (1.0, 1.0, 1.0), FaceMaterials(0), prim, report) is None
    assert [(f.prim, f.feature) for f in report.findings()] == [("/s", "implicit shape")]


@pytest.mark.parametrize(
    ("value", "kind", "expected", "n_findings"),
    [
        ([(0.1, 0.2, 0.3)], "color3f[]", (0.1, 0.2, 0.3), 0),
        ([(0.1, 0.2, 0.3), (1, 1, 1)], "color3f[]", (0.1, 0.2, 0.3), 1),
        ([(float("nan"), 0, 0)], "color3f[]", (0.18, 0.18, 0.18), 1),
        ([], "color3f[]", (0.18, 0.18, 0.18), 0),
    ],
)
def test_display_color_is_one_colour_or_the_grey_fallback(
    value: object, kind: str, expected: tuple[float, float, float], n_findings: int
) -> None:
    stage = Usd.Stage.CreateInMemory()
    sphere = UsdGeom.Sphere.Define(stage, "/s")
    primvars = UsdGeom.PrimvarsAPI(sphere)
    primvars.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Find(kind), "vertex").Set(value)
    report = Reporter()
    assert display_color(sphere.GetPrim(), NOW, report) == pytest.approx(expected)
    assert len(report.findings()) == n_findings
