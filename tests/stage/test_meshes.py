"""Meshes of every make become the triangles that USD means."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from icheat_usd.stage.meshes import DEFAULT_COLOR, FaceMaterials, TriangleMesh, read_mesh, topology_digest
from icheat_usd.stage.polygons import clip_ears, triangulate
from icheat_usd.stage.reporting import Reporter

NOW = Usd.TimeCode.EarliestTime()
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def define(points: object, faces: list[list[int]], scheme: str = "none") -> UsdGeom.Mesh:
    stage = Usd.Stage.CreateInMemory()
    mesh = UsdGeom.Mesh.Define(stage, "/mesh")
    mesh.__dict__["stage"] = stage  # the stage lives as long as the mesh
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.array(points, np.float32)))
    mesh.CreateFaceVertexCountsAttr([len(face) for face in faces])
    mesh.CreateFaceVertexIndicesAttr([i for face in faces for i in face])
    mesh.CreateSubdivisionSchemeAttr(scheme)
    return mesh


def read(mesh: UsdGeom.Mesh, level: int = 0, materials: FaceMaterials | None = None) -> TriangleMesh:
    report = Reporter()
    result = read_mesh(mesh, NOW, materials or FaceMaterials(0), level, report)
    assert report.findings() == ()
    assert result is not None
    return result


def read_reporting(mesh: UsdGeom.Mesh, level: int = 0) -> tuple[TriangleMesh | None, list[tuple[str, str]]]:
    report = Reporter()
    result = read_mesh(mesh, NOW, FaceMaterials(0), level, report)
    return result, [(f.prim, f.feature) for f in report.findings()]


def areas(triangles: np.ndarray) -> np.ndarray:
    return 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)


def geometric_normals(triangles: np.ndarray) -> np.ndarray:
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return cross / np.linalg.norm(cross, axis=1, keepdims=True)


# Polygons ----------------------------------------------------------------


def test_a_quad_keeps_its_winding_its_parametrisation_and_a_flat_normal() -> None:
    mesh = read(define(SQUARE, [[0, 1, 2, 3]]))
    assert mesh.points.tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
    ]
    assert np.array_equal(mesh.face_uv, mesh.points[..., :2])
    assert np.array_equal(mesh.normals, np.broadcast_to(np.array([0, 0, 1], np.float32), (2, 3, 3)))
    assert mesh.face.tolist() == [0, 0] and mesh.n_faces == 1
    assert np.all(mesh.color == np.float32(DEFAULT_COLOR))
    for array in (mesh.points, mesh.normals, mesh.st, mesh.color, mesh.face_uv):
        assert array.dtype == np.float32 and array.flags.c_contiguous


def test_a_triangle_and_a_pentagon_have_the_agreed_parametrisation() -> None:
    angle = 2 * np.pi * np.arange(5) / 5
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    mesh = read(define(np.concatenate([ring, [(3, 0, 0)]]), [[0, 5, 1], [0, 1, 2, 3, 4]]))
    assert mesh.face_uv[0].tolist() == [[0, 0], [1, 0], [0, 1]]
    assert np.allclose(mesh.face_uv[1:], 0.5 + 0.5 * mesh.points[1:, :, :2], atol=1e-6)
    assert mesh.face.tolist() == [0, 1, 1, 1]


@pytest.mark.parametrize("start", range(4))
def test_a_concave_quad_is_cut_at_its_reflex_corner(start: int) -> None:
    arrow = np.array([(0, 0, 0), (2, -1, 0), (0.5, 0, 0), (2, 1, 0)])
    points = np.roll(arrow, start, axis=0)
    mesh = read(define(points, [[0, 1, 2, 3]]))
    assert areas(mesh.points).sum() == pytest.approx(0.5)  # a fan from the wrong corner covers 1.5
    normal = geometric_normals(mesh.points)
    assert np.allclose(normal, normal[0])
    assert normal[0, 2] == -1.0 or normal[0, 2] == 1.0


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.2, 1.0), min_size=4, max_size=14), st.floats(0, 6.28), st.booleans())
def test_any_star_shaped_polygon_is_covered_once(radii: list[float], turn: float, reverse: bool) -> None:
    angle = 2 * np.pi * np.arange(len(radii)) / len(radii)
    flat = np.array(radii)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    tilt = np.array([[np.cos(turn), 0.3, 0.0], [0.0, 1.0, np.sin(turn) + 1.5]])
    points = flat @ tilt
    order = np.arange(len(radii))[:: -1 if reverse else 1]
    corners, face = triangulate(points, np.array([len(radii)]), order)
    triangles = points[order[corners]]
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    ahead = np.roll(points[order], -1, axis=0)
    newell = np.cross(points[order], ahead).sum(axis=0)
    # The vector areas add up for any split; that their lengths do too says that none is turned over.
    assert np.linalg.norm(cross, axis=1).sum() == pytest.approx(np.linalg.norm(newell), rel=1e-6)
    assert len(face) == len(radii) - 2


def test_ears_of_a_comb_are_found() -> None:
    comb = np.array([(0, 0), (9, 0), (9, 4), (8, 4), (8, 1), (6, 1), (6, 4), (5, 4), (5, 1), (1, 1), (1, 4), (0, 4)])
    triangles = comb[np.array(clip_ears(comb.astype(np.float64)))]
    edges = np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], axis=1)
    signed = 0.5 * np.linalg.det(edges)
    assert (signed > 0).all() and signed.sum() == pytest.approx(18.0)


def test_hole_faces_are_left_out_and_the_others_keep_their_numbers() -> None:
    points = [*SQUARE, (2, 0, 0), (2, 1, 0)]
    mesh = define(points, [[0, 1, 2, 3], [1, 4, 5, 2]])
    mesh.CreateHoleIndicesAttr([0])
    triangles = read(mesh)
    assert triangles.face.tolist() == [1, 1] and triangles.n_faces == 2


def test_holes_of_a_subdivision_surface_shape_it_but_do_not_show() -> None:
    points = [*SQUARE, (2, 0, 3), (2, 1, 3)]
    whole = read(define(points, [[0, 1, 2, 3], [1, 4, 5, 2]], "catmullClark"), 1)
    mesh = define(points, [[0, 1, 2, 3], [1, 4, 5, 2]], "catmullClark")
    mesh.CreateHoleIndicesAttr([1])
    pierced = read(mesh, 1)
    assert np.array_equal(pierced.points, whole.points[whole.face == 0])
    assert np.array_equal(pierced.normals, whole.normals[whole.face == 0])


def test_left_handed_meshes_are_wound_the_other_way_with_their_values_in_place() -> None:
    mesh = define(SQUARE, [[0, 1, 2, 3]])
    mesh.CreateOrientationAttr("leftHanded")
    triangles = read(mesh)
    assert np.allclose(geometric_normals(triangles.points), [0, 0, -1])
    assert np.allclose(triangles.normals, [0, 0, -1])
    assert np.array_equal(triangles.face_uv, triangles.points[..., :2])


def test_smooth_normals_of_a_left_handed_subdivision_surface_follow_its_winding() -> None:
    mesh = define(SQUARE, [[0, 1, 2, 3]], "catmullClark")
    mesh.CreateOrientationAttr("leftHanded")
    triangles = read(mesh, 2)
    assert np.allclose(triangles.normals, [0, 0, -1])
    assert np.allclose(geometric_normals(triangles.points), [0, 0, -1])


def test_degenerate_faces_are_dropped() -> None:
    points = [*SQUARE, (2, 0, 0)]
    mesh = read(define(points, [[0, 1, 2], [0, 1, 1], [0, 1, 4], [2, 3], [0, 2, 3]]))
    assert mesh.face.tolist() == [0, 4] and mesh.n_faces == 5


# Values ------------------------------------------------------------------

TWO = [[0, 1, 2, 3], [1, 4, 5, 2]]
TWO_POINTS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0, 0), (2, 1, 0)]


def authored(interpolation: str, width: int) -> np.ndarray:
    n = {"constant": 1, "uniform": 2, "varying": 6, "vertex": 6, "faceVarying": 8}[interpolation]
    return np.random.default_rng(len(interpolation)).random((n, width)).astype(np.float32)


def expected(interpolation: str, values: np.ndarray) -> np.ndarray:
    corner_vertex = np.array([i for face in TWO for i in face])
    per_corner = {
        "constant": lambda: np.repeat(values, 8, axis=0),
        "uniform": lambda: values[[0] * 4 + [1] * 4],
        "varying": lambda: values[corner_vertex],
        "vertex": lambda: values[corner_vertex],
        "faceVarying": lambda: values,
    }[interpolation]()
    return per_corner[[[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]]


@pytest.mark.parametrize("indexed", [False, True])
@pytest.mark.parametrize("interpolation", ["constant", "uniform", "varying", "vertex", "faceVarying"])
def test_primvars_of_every_interpolation_reach_the_corners(interpolation: str, indexed: bool) -> None:
    mesh = define(TWO_POINTS, TWO)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    wanted = {}
    for name, kind, width in (
        ("st", Sdf.ValueTypeNames.TexCoord2fArray, 2),
        ("displayColor", Sdf.ValueTypeNames.Color3fArray, 3),
        ("normals", Sdf.ValueTypeNames.Normal3fArray, 3),
    ):
        values = authored(interpolation, width)
        primvar = primvars.CreatePrimvar(name, kind, interpolation)
        wanted[name] = expected(interpolation, values)
        array = Vt.Vec2fArray if width == 2 else Vt.Vec3fArray
        if indexed:
            order = np.random.default_rng(7).permutation(len(values))
            primvar.Set(array.FromNumpy(np.ascontiguousarray(values[order])))
            primvar.SetIndices(Vt.IntArray.FromNumpy(np.argsort(order).astype(np.int32)))
        else:
            primvar.Set(array.FromNumpy(values))
    triangles = read(mesh)
    assert np.allclose(triangles.st, wanted["st"])
    assert np.allclose(triangles.color, wanted["displayColor"])
    unit = wanted["normals"] / np.linalg.norm(wanted["normals"], axis=2, keepdims=True)
    assert np.allclose(triangles.normals, unit, atol=1e-6)


@pytest.mark.parametrize("interpolation", ["constant", "uniform", "varying", "vertex", "faceVarying"])
def test_refined_values_still_belong_to_their_places(interpolation: str) -> None:
    mesh = define(TWO_POINTS, TWO, "catmullClark")
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, interpolation)
    flat = np.array(TWO_POINTS, np.float32)[:, :2]
    corner = flat[[i for face in TWO for i in face]]
    values = {"constant": flat[:1], "uniform": flat[:2], "faceVarying": corner}.get(interpolation, flat)
    primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(values)))
    triangles = read(mesh, 2)
    if interpolation == "constant":
        assert np.all(triangles.st == values[0])
    elif interpolation == "uniform":
        assert np.array_equal(triangles.st, np.repeat(values[triangles.face][:, None], 3, axis=1))
    elif interpolation == "vertex":  # smoothed with the points
        assert np.allclose(triangles.st, triangles.points[..., :2], atol=1e-6)
    else:  # bilinear within the face
        expected_st = triangles.face_uv + np.stack([triangles.face, 0 * triangles.face], axis=1)[:, None]
        assert np.allclose(triangles.st, expected_st, atol=1e-6)


def test_control_faces_parametrise_refined_quads_bilinearly() -> None:
    triangles = read(define(SQUARE, [[0, 1, 2, 3]], "bilinear"), 2)
    assert np.allclose(triangles.face_uv, triangles.points[..., :2], atol=1e-6)
    assert len(triangles.points) == 32 and set(triangles.face) == {0}


def test_primvar_normals_beat_normals_and_subdivision_ignores_both() -> None:
    mesh = define(SQUARE, [[0, 1, 2, 3]])
    mesh.CreateNormalsAttr([(0, 1, 0)] * 4)
    mesh.SetNormalsInterpolation("vertex")
    assert np.allclose(read(mesh).normals, [0, 1, 0])
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("normals", Sdf.ValueTypeNames.Normal3fArray, "constant")
    primvar.Set([(2, 0, 0)])
    assert np.allclose(read(mesh).normals, [1, 0, 0])
    mesh.GetSubdivisionSchemeAttr().Set("catmullClark")
    assert np.allclose(read(mesh).normals, [0, 0, 1])


def test_a_normal_without_length_gives_way_to_the_triangles_own() -> None:
    mesh = define(SQUARE, [[0, 1, 2, 3]])
    mesh.CreateNormalsAttr([(0, 0, 0)] * 4)
    assert np.allclose(read(mesh).normals, [0, 0, 1])


def test_constant_primvars_are_inherited_from_ancestors() -> None:
    stage = Usd.Stage.CreateInMemory()
    parent = UsdGeom.Xform.Define(stage, "/parent")
    primvar = UsdGeom.PrimvarsAPI(parent).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, "constant")
    primvar.Set([(0.1, 0.2, 0.3)])
    mesh = UsdGeom.Mesh.Define(stage, "/parent/mesh")
    mesh.CreatePointsAttr(SQUARE)
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    assert np.allclose(read(mesh).color, [0.1, 0.2, 0.3])


def test_each_subset_reads_the_coordinates_its_material_asks_for() -> None:
    mesh = define(TWO_POINTS, TWO)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    for name, value in (("st", (0.25, 0.5)), ("map2", (0.75, 1.0))):
        primvars.CreatePrimvar(name, Sdf.ValueTypeNames.TexCoord2fArray, "constant").Set([Gf.Vec2f(*value)])
    triangles = read(mesh, materials=FaceMaterials(3, ((5, np.array([1])),), ((5, "map2"),)))
    assert triangles.material.tolist() == [3, 3, 5, 5]
    assert np.allclose(triangles.st[:2], (0.25, 0.5)) and np.allclose(triangles.st[2:], (0.75, 1.0))


def test_equal_meshes_are_refined_once_and_shared_whatever_their_material() -> None:
    known: dict[bytes, TriangleMesh | None] = {}
    first, second, third = (define(TWO_POINTS, TWO, "catmullClark") for _ in range(3))
    third.GetDoubleSidedAttr().Set(True)
    a = read_mesh(first, NOW, FaceMaterials(0), 2, Reporter(), known)
    b = read_mesh(second, NOW, FaceMaterials(0), 2, Reporter(), known)
    c = read_mesh(second, NOW, FaceMaterials(4), 2, Reporter(), known)
    d = read_mesh(third, NOW, FaceMaterials(0), 2, Reporter(), known)
    assert a is b and a is not None and c is not None and d is not None
    assert c.points is a.points and set(c.material) == {4}
    assert d is not a and d.double_sided and not a.double_sided


def test_the_topology_digest_depends_on_topology_alone() -> None:
    base = read(define(TWO_POINTS, TWO))
    moved = read(define(np.array(TWO_POINTS) + 1.0, TWO, "catmullClark"), 1)
    turned = read(define(TWO_POINTS, [TWO[0], TWO[1][1:] + TWO[1][:1]]))
    assert base.topology_digest == moved.topology_digest != turned.topology_digest
    assert topology_digest(np.array([3, 1]), np.array([0])) != topology_digest(np.array([3]), np.array([1, 0]))


def test_points_far_from_their_origin_keep_float32_precision() -> None:
    stage = Usd.Stage.CreateInMemory()
    mesh = UsdGeom.Mesh.Define(stage, "/mesh")
    mesh.CreatePointsAttr([(p[0] + 4096, p[1] + 8192, 16384) for p in SQUARE])
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateSubdivisionSchemeAttr("none")
    triangles = read(mesh)
    assert np.allclose(triangles.origin, (4096.5, 8192.5, 16384))
    assert np.abs(triangles.points).max() == 0.5


# Bad data ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "counts", "indices"),
    [
        ([(0, 0, 0), (1, 0, 0), (float("nan"), 1, 0)], [3], [0, 1, 2]),
        ([(0, 0, 0), (1, 0, 0), (float("inf"), 1, 0)], [3], [0, 1, 2]),
        (SQUARE, [4], [0, 1, 2, 4]),
        (SQUARE, [4], [0, 1, 2, -1]),
        (SQUARE, [4], [0, 1, 2]),
        (SQUARE, [-1, 5], [0, 1, 2, 3]),
        (SQUARE, [], []),
        ([], [3], [0, 1, 2]),
        (SQUARE, [2, 2], [0, 1, 2, 3]),
        ([(0, 0, 0)] * 4, [4], [0, 1, 2, 3]),
    ],
)
@pytest.mark.parametrize("scheme", ["none", "catmullClark"])
def test_a_mesh_that_cannot_be_used_is_dropped_with_one_finding(
    points: object, counts: list[int], indices: list[int], scheme: str
) -> None:
    mesh = define(SQUARE, [[0, 1, 2, 3]], scheme)
    mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.array(points, np.float32).reshape(-1, 3)))
    mesh.GetFaceVertexCountsAttr().Set(counts)
    mesh.GetFaceVertexIndicesAttr().Set(indices)
    triangles, findings = read_reporting(mesh, 1)
    assert triangles is None
    assert findings == [("/mesh", "mesh")]


def test_an_unused_bad_point_harms_nothing() -> None:
    mesh = define([*SQUARE, (float("nan"), 0, 0)], [[0, 1, 2, 3]])
    assert np.isfinite(read(mesh).points).all()


@pytest.mark.parametrize("name", ["st", "displayColor", "normals"])
@pytest.mark.parametrize("fault", ["count", "index", "nan"])
def test_a_primvar_that_does_not_fit_falls_back_with_one_finding(name: str, fault: str) -> None:
    mesh = define(SQUARE, [[0, 1, 2, 3]])
    width = 2 if name == "st" else 3
    kind = Sdf.ValueTypeNames.TexCoord2fArray if width == 2 else Sdf.ValueTypeNames.Float3Array
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, "vertex")
    values = np.full((3 if fault == "count" else 4, width), np.nan if fault == "nan" else 0.5, np.float32)
    primvar.Set((Vt.Vec2fArray if width == 2 else Vt.Vec3fArray).FromNumpy(values))
    if fault == "index":
        primvar.SetIndices([0, 1, 2, 9])
    triangles, findings = read_reporting(mesh)
    assert findings == [("/mesh", f"primvar {name}")]
    assert triangles is not None
    assert np.all(triangles.st == 0) and np.all(triangles.color == np.float32(DEFAULT_COLOR))
    assert np.allclose(triangles.normals, [0, 0, 1])


def test_loop_subdivision_of_other_faces_than_triangles_is_reported_once() -> None:
    mesh, smooth = define(SQUARE, [[0, 1, 2, 3]], "loop"), define(SQUARE, [[0, 1, 2, 3]], "catmullClark")
    triangles, findings = read_reporting(mesh, 2)
    assert findings == [("/mesh", "subdivisionScheme loop")]
    assert triangles is not None and np.array_equal(triangles.points, read(smooth, 2).points)
