"""Loop's subdivision surfaces against known limits and against properties of the scheme."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.stage.subdivision import INFINITE, Cage, refine
from tests.stage.test_creases import creased
from tests.stage.test_meshes import define, read
from tests.stage.test_subdivision import cage

FACES = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
EQUATOR = [(0, 2), (2, 1), (1, 3), (3, 0)]
ALL = sorted({tuple(sorted((f[k], f[k - 1]))) for f in FACES for k in range(3)})


def octahedron() -> Cage:
    return cage(np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]), FACES)


@pytest.mark.parametrize("level", [1, 2, 4])
def test_an_octahedrons_vertices_lie_on_the_known_limit(level: int) -> None:
    # Valence 4: beta = (5/8 - (3/8)^2) / 4 = 31/256; the neighbours of a vertex sum to 0, so that its limit is
    # 1 - 4 / (4 + 3 / (8 beta)) = 24/55 of it.
    refined = refine(octahedron(), level, "loop")
    assert np.allclose(refined.vertices[:6], 24 / 55 * octahedron().vertices, atol=1e-12)
    assert len(refined.counts) == 8 * 4**level and np.array_equal(np.bincount(refined.face), [4**level] * 8)


def test_a_flat_regular_sheet_stays_where_it_is() -> None:
    points = np.array([(x + 0.5 * y, y * 0.75**0.5, 0) for y in range(5) for x in range(5)])
    faces = []
    for y in range(4):
        for x in range(4):
            i = 5 * y + x
            faces += [(i, i + 1, i + 5), (i + 1, i + 6, i + 5)]
    refined = refine(cage(points, faces), 2, "loop")
    inside = [6, 7, 8, 11, 12, 13, 16, 17, 18]
    assert np.allclose(refined.vertices[inside], points[inside], atol=1e-12)
    corner = [0, 24]  # of one face each
    assert np.array_equal(refined.vertices[corner], points[corner])
    triangles = refined.vertices[refined.indices].reshape(-1, 3, 3)
    area = 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])[:, 2]
    assert area.min() > 0


@pytest.mark.parametrize("sharpness", [0.0, 0.4, 1.0, 2.5, INFINITE])
@pytest.mark.parametrize("edges", [EQUATOR, EQUATOR[:2], EQUATOR[:1], ALL])
def test_refining_further_only_adds_points_to_the_same_surface(edges: list[tuple[int, int]], sharpness: float) -> None:
    control = creased(octahedron(), edges, sharpness, (4,), 0.5 * sharpness)
    coarse, fine = refine(control, 1, "loop").vertices, refine(control, 4, "loop").vertices
    distance = np.linalg.norm(coarse[:, None] - fine[None], axis=2).min(axis=1)
    assert distance.max() < 1e-12


def test_sharp_edges_stay_and_a_loop_of_them_is_a_b_spline() -> None:
    assert np.allclose(np.abs(refine(creased(octahedron(), ALL, INFINITE), 2, "loop").vertices).sum(axis=1), 1)
    ring = refine(creased(octahedron(), EQUATOR, INFINITE), 2, "loop").vertices
    assert np.allclose(ring[0], (2 / 3, 0, 0), atol=1e-12)
    assert ring[4, 2] > 24 / 55 - 1e-12


def test_a_loop_mesh_of_a_stage_is_refined() -> None:
    triangles = read(define(octahedron().vertices, [list(face) for face in FACES], "loop"), 2)
    assert len(triangles.points) == 8 * 16 and triangles.n_faces == 8
    radius = np.linalg.norm(triangles.points, axis=2)
    assert radius.max() < 0.6 and radius.min() > 0.4
    outward = triangles.points / radius[..., None]
    assert (triangles.normals * outward).sum(axis=2).min() > 0.95
    # Places in a control face reach from its corners to its corners.
    assert triangles.face_uv.min() == 0 and triangles.face_uv.max() == 1
