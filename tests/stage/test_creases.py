"""Creases and corners of subdivision surfaces are as sharp as they say."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import UsdGeom

from icheat_usd.scene import F64
from icheat_usd.stage.meshes import FaceMaterials, read_mesh
from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.subdivision import INFINITE, Cage, Creases, refine
from tests.stage.test_meshes import NOW, SQUARE, define, geometric_normals, read
from tests.stage.test_subdivision import CUBE_FACES, cube, grid

TOP = [(4, 5), (5, 7), (7, 6), (6, 4)]  # edges of the cube's face at z = 1
ALL = sorted({tuple(sorted((f[k], f[k - 1]))) for f in CUBE_FACES for k in range(4)})


def creased(
    cage: Cage, edges: list[tuple[int, int]], sharpness: float, corners: tuple[int, ...] = (), at_corners: float = 0.0
) -> Cage:
    return cage._replace(
        creases=Creases(
            np.array(edges, np.int64).reshape(-1, 2),
            np.full(len(edges), sharpness),
            np.array(corners, np.int64),
            np.full(len(corners), at_corners),
        )
    )


def one_step(cage: Cage) -> F64:
    """Points after one step, before they go to the limit: face points of the step after next follow from them."""
    from icheat_usd.stage.subdivision import _split

    return _split(cage, True, True).vertices


def test_a_cube_whose_edges_stay_sharp_stays_a_cube() -> None:
    vertices = refine(creased(cube(), ALL, INFINITE), 3).vertices
    assert np.array_equal(vertices[:8], cube().vertices)
    assert np.allclose(np.abs(vertices).max(axis=1), 1, atol=1e-12)
    mesh = define(cube().vertices, [list(face) for face in CUBE_FACES], "catmullClark")
    mesh.CreateCreaseIndicesAttr([v for edge in ALL for v in edge])
    mesh.CreateCreaseLengthsAttr([2] * 12)
    mesh.CreateCreaseSharpnessesAttr([10.0] * 12)
    triangles = read(mesh, 2)
    # Flat to the eye too: no normal is shared across an edge.
    assert np.allclose(triangles.normals, geometric_normals(triangles.points)[:, None], atol=1e-6)


def test_a_loop_that_stays_sharp_is_the_b_spline_through_it() -> None:
    refined = refine(creased(cube(), TOP, INFINITE), 3)
    # Limit of a cubic B-spline at a control point: (4 v + its two neighbours) / 6.
    assert np.allclose(refined.vertices[5], (2 / 3, -2 / 3, 1), atol=1e-12)
    top = refined.vertices[np.unique(refined.indices.reshape(-1, 4)[refined.face == 4])]
    assert np.allclose(top[:, 2], 1, atol=1e-12)  # nothing outside the loop bends what is inside
    below = refined.vertices[np.unique(refined.indices.reshape(-1, 4)[refined.face == 5])]
    assert below[:, 2].max() > -1 + 0.05  # the other side is as round as ever
    mesh = define(cube().vertices, [list(face) for face in CUBE_FACES], "catmullClark")
    mesh.CreateCreaseIndicesAttr([4, 5, 7, 6, 4])
    mesh.CreateCreaseLengthsAttr([5])
    mesh.CreateCreaseSharpnessesAttr([10.0])
    triangles = read(mesh, 3)
    normals = triangles.normals[triangles.face == 4]
    assert np.allclose(normals, (0, 0, 1), atol=1e-6)
    assert triangles.normals[triangles.face == 3][..., 2].max() < 0.9


def test_one_sharp_step_of_a_cube_has_the_limit_worked_by_hand() -> None:
    # Vertices, edge middles and face middles of the cube first; then the limit at a corner, of valence 3:
    # (9 v + 4 e + f) / 24 with edge middles that sum to 2 v and face middles that sum to v.
    for level in (1, 2, 3):
        vertices = refine(creased(cube(), ALL, 1.0), level).vertices
        assert np.allclose(vertices[:8], 0.75 * cube().vertices, atol=1e-12)


@pytest.mark.parametrize("edges", [TOP, ALL, ALL[:1], ALL[:2], TOP[:3]])
def test_a_sharpness_below_one_is_a_mixture_of_sharp_and_smooth(edges: list[tuple[int, int]]) -> None:
    smooth, sharp = (one_step(creased(cube(), edges, s)) for s in (0.0, 1.0))
    assert len(edges) == 1 or np.abs(smooth - sharp).max() > 0.1
    for s in (0.25, 0.7):
        assert np.allclose(one_step(creased(cube(), edges, s)), (1 - s) * smooth + s * sharp, atol=1e-12)
        # Between two steps it is the mixture of one step fewer.
        later = one_step(creased(cube(), edges, 1 + s))
        assert np.allclose(later, sharp, atol=1e-12)


def test_a_corner_below_one_is_a_mixture_too() -> None:
    smooth, sharp = one_step(cube()), one_step(creased(cube(), [], 0.0, (5,), 1.0))
    assert np.array_equal(sharp[5], cube().vertices[5])
    mixed = one_step(creased(cube(), [], 0.0, (5,), 0.4))
    assert np.allclose(mixed, 0.6 * smooth + 0.4 * sharp, atol=1e-12)


def test_a_crease_that_ends_on_a_face_ends_smoothly() -> None:
    # One sharp edge at a vertex changes nothing there (a dart), only where the edge itself goes.
    one = creased(cube(), [(5, 7)], 1.0)
    after, smooth = one_step(one), one_step(cube())
    changed = np.abs(after - smooth).max(axis=1) > 1e-12
    assert changed.sum() == 1 and np.allclose(after[changed], (1, 0, 1))


@pytest.mark.parametrize("sharpness", [0.3, 1.0, 1.6, 2.5, 4.0, INFINITE])
@pytest.mark.parametrize("edges", [TOP, TOP[:3], ALL, ALL[:2]])
def test_refining_further_only_adds_points_to_the_same_surface(edges: list[tuple[int, int]], sharpness: float) -> None:
    mixed = creased(cube(), edges, sharpness, (0, 2), 1.5)
    uneven = mixed.creases._replace(sharpness=mixed.creases.sharpness * np.linspace(1, 0.4, len(edges)))
    for cage in (mixed, mixed._replace(creases=uneven)):
        coarse, fine = refine(cage, 1).vertices, refine(cage, 4).vertices
        distance = np.linalg.norm(coarse[:, None] - fine[None], axis=2).min(axis=1)
        assert distance.max() < 1e-12


def test_creases_meet_boundaries() -> None:
    # A crease across a sheet, bent along it: its ends on the boundary are corners, as three sharp edges meet there.
    sheet = grid(2)
    bent = sheet._replace(vertices=sheet.vertices + np.abs(sheet.vertices[:, :1] - 1) * (0, 0, 1))
    refined = refine(creased(bent, [(1, 4), (4, 7)], INFINITE), 2)
    on_crease = refined.vertices[np.abs(refined.vertices[:, 0] - 1) < 1e-9]
    assert len(on_crease) == 9 and np.allclose(on_crease[:, 2], 0, atol=1e-12)
    assert np.allclose(refined.vertices[:, 2], np.abs(refined.vertices[:, 0] - 1), atol=1e-9)
    round_ = refine(bent, 2).vertices
    assert round_[4, 2] > 0.1


def test_one_sharpness_per_edge_or_per_crease() -> None:
    faces = [list(face) for face in CUBE_FACES]
    results = []
    for sharpnesses in ([1.5], [1.5] * 4, [1.5, 1.5, 1.5, 0.2]):
        mesh = define(cube().vertices, faces, "catmullClark")
        mesh.CreateCreaseIndicesAttr([4, 5, 7, 6, 4])
        mesh.CreateCreaseLengthsAttr([5])
        mesh.CreateCreaseSharpnessesAttr(sharpnesses)
        mesh.CreateCornerIndicesAttr([0])
        mesh.CreateCornerSharpnessesAttr([10.0])
        results.append(read(mesh, 2).points)
    assert np.array_equal(results[0], results[1])
    assert not np.array_equal(results[0], results[2])
    expected = refine(creased(cube(), TOP, 1.5, (0,), INFINITE), 2).vertices
    assert np.allclose(results[0].reshape(-1, 3).max(axis=0), expected.max(axis=0), atol=1e-6)
    assert np.allclose(results[0].reshape(-1, 3).min(axis=0), -1, atol=1e-6)


@pytest.mark.parametrize(
    ("values", "feature", "words"),
    [
        ({"creaseIndices": [0, 1], "creaseLengths": [3], "creaseSharpnesses": [1.0]}, "creases", "sum to 3"),
        ({"creaseIndices": [0], "creaseLengths": [1], "creaseSharpnesses": [1.0]}, "creases", "fewer than 2"),
        ({"creaseIndices": [0, 1], "creaseLengths": [2], "creaseSharpnesses": [1.0, 2.0, 3.0]}, "creases", "3 crease"),
        ({"creaseIndices": [0, 9], "creaseLengths": [2], "creaseSharpnesses": [1.0]}, "creases", "no face has"),
        ({"creaseIndices": [0, 2], "creaseLengths": [2], "creaseSharpnesses": [1.0]}, "creases", "1 of their edges"),
        ({"cornerIndices": [0, 1], "cornerSharpnesses": [1.0]}, "corners", "2 cornerIndices"),
        ({"cornerIndices": [-1], "cornerSharpnesses": [1.0]}, "corners", "no face has"),
    ],
)
def test_creases_that_do_not_fit_are_reported_and_left_out(
    values: dict[str, list[float]], feature: str, words: str
) -> None:
    mesh = define(SQUARE, [[0, 1, 2, 3]], "catmullClark")
    smooth = read(mesh, 2)
    for name, value in values.items():
        mesh.GetPrim().GetAttribute(name).Set(value)
    report = Reporter()
    triangles = read_mesh(mesh, NOW, FaceMaterials(0), 2, report)
    (finding,) = report.findings()
    assert (finding.prim, finding.feature) == ("/mesh", feature) and words in finding.message
    assert triangles is not None and np.array_equal(triangles.points, smooth.points)


def test_faces_at_a_boundary_that_is_not_interpolated_only_shape_their_neighbours() -> None:
    sheet = grid(3)
    faces = sheet.indices.reshape(-1, 4).tolist()
    mesh = define(sheet.vertices, faces, "catmullClark")
    mesh.GetInterpolateBoundaryAttr().Set(UsdGeom.Tokens.none)
    assert set(read(mesh, 1).face) == {4}
    # A boundary edge whose neighbours along the boundary are sharp as well brings its face back.
    rim = [0, 1, 2, 3, 7, 11, 15, 14, 13, 12, 8, 4, 0]
    mesh.CreateCreaseIndicesAttr(rim)
    mesh.CreateCreaseLengthsAttr([len(rim)])
    mesh.CreateCreaseSharpnessesAttr([10.0])
    assert set(read(mesh, 1).face) == set(range(9))
