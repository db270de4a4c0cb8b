"""Catmull-Clark against known limits and against properties of the scheme."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from icheat_usd.stage.subdivision import Cage, refine

CUBE_FACES = [(0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6), (4, 5, 7, 6), (1, 0, 2, 3)]


def cage(points: np.ndarray, faces: Sequence[tuple[int, ...]], corners: np.ndarray | None = None) -> Cage:
    counts = np.array([len(face) for face in faces], np.int64)
    indices = np.array([i for face in faces for i in face], np.int64)
    if corners is None:
        corners = np.zeros((len(indices), 2))
    return Cage(np.asarray(points, np.float64), counts, indices, corners, np.arange(len(faces)))


def cube() -> Cage:
    return cage(np.array([(x, y, z) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]), CUBE_FACES)


def grid(n: int) -> Cage:
    x, y = np.meshgrid(np.arange(n + 1.0), np.arange(n + 1.0))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    faces = [
        (j * (n + 1) + i, j * (n + 1) + i + 1, (j + 1) * (n + 1) + i + 1, (j + 1) * (n + 1) + i)
        for j in range(n)
        for i in range(n)
    ]
    return cage(points, faces)


@pytest.mark.parametrize("level", [1, 2, 4])
def test_a_cubes_vertices_face_and_edge_points_lie_on_the_known_limit(level: int) -> None:
    # Worked by hand from the limit masks. Corner (valence 3): (9 v + 4 e + f) / 24 with edge neighbours summing to
    # v (each flips one sign: 3 v - 2 v) and face diagonals to -v: (9 + 4 - 1) / 24 = 1/2.
    # Face centre after one step: 36 F + edge points (+-3/4 of the way out) and vertices.
    vertices = refine(cube(), level).vertices
    assert np.allclose(vertices[:8], 0.5 * cube().vertices, atol=1e-12)
    largest = np.abs(vertices).max(axis=0)
    # One step: face point 1; edge points (0.75, 0.75, 0); vertex points 5/9. Limit of the face point (valence 4):
    # (16 * 1 + 4 * (4 * 0.75) + 4 * 5/9) / 36.
    assert np.allclose(largest, (16 + 12 + 20 / 9) / 36, atol=1e-12)


def test_refining_further_only_adds_points_to_the_same_surface() -> None:
    coarse, fine = refine(cube(), 2).vertices, refine(cube(), 4).vertices
    distance = np.linalg.norm(coarse[:, None] - fine[None], axis=2).min(axis=1)
    assert distance.max() < 1e-12


def test_a_flat_grid_stays_flat_within_its_rectangle_and_keeps_its_area() -> None:
    refined = refine(grid(3), 2)
    quads = refined.vertices[refined.indices].reshape(-1, 4, 3)
    assert np.all(quads[..., 2] == 0.0)
    area = 0.5 * np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])[:, 2]
    assert (area > 0).all() and area.sum() == pytest.approx(9.0)
    corners = {(0.0, 0.0), (3.0, 0.0), (3.0, 3.0), (0.0, 3.0)}
    assert corners <= {tuple(p) for p in refined.vertices[:, :2]}


def test_edge_only_rounds_the_corners_of_a_sheet() -> None:
    refined = refine(grid(1), 3, sharp_corners=False)
    quads = refined.vertices[refined.indices].reshape(-1, 4, 3)
    area = 0.5 * np.cross(quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1])[:, 2].sum()
    assert area < 0.75  # a round patch inside the unit square
    assert np.allclose(refined.vertices[0, :2], (1 / 6, 1 / 6))  # (4 (0,0) + (1,0) + (0,1)) / 6


def test_a_boundary_is_the_b_spline_of_the_boundary_alone() -> None:
    sheet = grid(3)
    moved = sheet._replace(vertices=sheet.vertices + np.where(sheet.vertices[:, :1] == 2, [0, 0, 5.0], 0.0))
    inner = (moved.vertices[:, 0] % 3 != 0) & (moved.vertices[:, 1] % 3 != 0)
    bumpy = moved._replace(vertices=np.where(inner[:, None], moved.vertices + [0, 0, 100.0], moved.vertices))
    on_rim = np.isin(np.arange(16), np.flatnonzero(~inner))
    assert np.array_equal(refine(moved, 2).vertices[:16][on_rim], refine(bumpy, 2).vertices[:16][on_rim])


def test_refinement_does_not_depend_on_where_things_stand() -> None:
    shift = np.array([3.0, -2.0, 7.0])
    moved = cube()._replace(vertices=cube().vertices * 2.0 + shift)
    assert np.allclose(refine(moved, 2).vertices, refine(cube(), 2).vertices * 2.0 + shift)


def test_mixed_polygons_become_quads_with_faces_and_corner_values_inherited() -> None:
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0.5, 0), (0.5, 2, 0), (-1, 1, 0)])
    faces = [(0, 1, 2, 3), (1, 4, 2), (3, 2, 5, 6, 0)]
    flat = np.concatenate([points[list(face), :2] for face in faces])
    refined = refine(cage(points, faces, flat), 1, "bilinear")
    assert len(refined.counts) == 12 and set(refined.counts) == {4}
    assert np.array_equal(refined.face, np.repeat([0, 1, 2], [4, 3, 5]))
    # Linear corner values that equal the position keep equalling it.
    assert np.allclose(refined.corners, refined.vertices[refined.indices, :2])


def test_level_zero_is_the_cage() -> None:
    assert refine(cube(), 0) is not None
    assert np.array_equal(refine(cube(), 0).vertices, cube().vertices)


def test_a_fin_shared_by_three_faces_keeps_its_edge_straight() -> None:
    points = np.array([(0, 0, 0), (0, 0, 1), (1, 0, 0), (1, 0, 1), (-1, 1, 0), (-1, 1, 1), (-1, -1, 0), (-1, -1, 1)])
    refined = refine(cage(points, [(0, 2, 3, 1), (0, 4, 5, 1), (0, 6, 7, 1)]), 2)
    assert np.allclose(refined.vertices[0], points[0]) and np.allclose(refined.vertices[1], points[1])
    assert np.isfinite(refined.vertices).all()
