"""Polygons to triangles: convex ones as a fan, concave ones by cutting off ears."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import meshing
from icheat_usd.scene import F64, I64

#: A triangle whose height is below this share of its longest edge is thinner than float32 can place it.
THINNEST = 1e-8


def triangulate(points: F64, counts: I64, indices: I64) -> tuple[I64, I64]:
    """Split faces into triangles that keep their winding.

    Parameters
    ----------
    points : (n_points, 3) float64
    counts : (n_faces,) int64
        Corners per face. Faces of fewer than three corners give no triangle.
    indices : (n_corners,) int64
        Points of the faces' corners, one face after another.

    Returns
    -------
    corners : (n_triangles, 3) int64
        Rows of `indices`, in face order.
    face : (n_triangles,) int64

    Notes
    -----
    Concave faces are cut in the plane of their Newell normal. A polygon that
    crosses itself is split as a fan from wherever no ear is left.
    """
    starts = np.cumsum(counts) - counts
    per_face = np.maximum(counts - 2, 0)
    first = np.cumsum(per_face) - per_face
    face = np.repeat(np.arange(len(counts)), per_face)
    # A fan around corner 0 of every face.
    step = np.arange(int(per_face.sum())) - first[face]
    corners = np.empty((len(face), 3), np.int64)
    corners[:, 0] = starts[face]
    corners[:, 1] = corners[:, 0] + step + 1
    corners[:, 2] = corners[:, 0] + step + 2
    if not np.any(counts > 3):
        return corners, face

    reflex = np.empty(len(counts), np.int64)
    meshing.find_reflex(points, np.concatenate([[0], np.cumsum(counts)]), indices, reflex)
    for f in np.flatnonzero(reflex >= 0):
        begin, start, count = first[f], starts[f], int(counts[f])
        if count == 4:
            # A quad is cut from its reflex corner: the fan around corner 1 where corner 1 or 3 is the reflex one.
            if reflex[f] % 2 == 1:
                corners[begin : begin + 2] = start + np.array([[1, 2, 3], [1, 3, 0]])
            continue
        loop = points[indices[start : start + count]]
        loop = loop - loop[0]
        newell = np.cross(loop[1:-1], loop[2:]).sum(axis=0)
        corners[begin : begin + count - 2] = start + np.array(clip_ears(_project(loop, newell)), np.int64)
    return corners, face


def _project(points: F64, normal: F64) -> F64:
    """Points in a plane across `normal`, counter-clockwise where they were about it."""
    axis = int(np.argmax(np.abs(normal)))
    u, v = (axis + 1) % 3, (axis + 2) % 3
    return points[:, [u, v]] if normal[axis] > 0 else points[:, [v, u]]


def clip_ears(polygon: F64) -> list[tuple[int, int, int]]:
    """Triangles of a simple counter-clockwise polygon ``(n, 2)``, by ear clipping."""
    ring = list(range(len(polygon)))
    triangles: list[tuple[int, int, int]] = []
    while len(ring) > 3:
        best, best_shape = 0, -np.inf
        for place in range(len(ring)):
            a, b, c = ring[place - 1], ring[place], ring[(place + 1) % len(ring)]
            area = _cross(polygon[a], polygon[b], polygon[c])
            if area <= 0.0:
                continue
            others = polygon[[i for i in ring if i not in (a, b, c)]]
            if _any_inside(others, polygon[a], polygon[b], polygon[c]):
                continue
            # The roundest ear first keeps slivers rare.
            edges = polygon[[b, c, a]] - polygon[[a, b, c]]
            shape = area / float((edges**2).sum())
            if shape > best_shape:
                best, best_shape = place, shape
        triangles.append((ring[best - 1], ring[best], ring[(best + 1) % len(ring)]))
        del ring[best]
    triangles.append((ring[0], ring[1], ring[2]))
    return triangles


def _cross(a: F64, b: F64, c: F64) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _any_inside(points: F64, a: F64, b: F64, c: F64) -> bool:
    def left_of(p: F64, q: F64) -> NDArray[np.bool_]:
        return (q[0] - p[0]) * (points[:, 1] - p[1]) - (q[1] - p[1]) * (points[:, 0] - p[0]) >= 0.0

    # Points that coincide with a corner (a bridge to a hole, drawn as one loop) do not stand in an ear's way.
    inside = left_of(a, b) & left_of(b, c) & left_of(c, a)
    for corner in (a, b, c):
        inside &= np.any(points != corner, axis=1)
    return bool(inside.any())


def face_parametrisation(counts: I64) -> F64:
    """Place of each corner in its own face, ``(n_corners, 2)``.

    Triangles (0, 0), (1, 0), (0, 1); quads the unit square; larger faces lie
    on the circle inscribed in the unit square, corner 0 at angle 0.
    """
    count = np.repeat(counts, counts)
    step = np.arange(len(count)) - np.repeat(np.cumsum(counts) - counts, counts)
    angle = 2.0 * np.pi * step / np.maximum(count, 1)
    uv = 0.5 + 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    triangle, quad = count == 3, count == 4
    uv[triangle] = np.array([(0, 0), (1, 0), (0, 1)], np.float64)[step[triangle]]
    uv[quad] = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float64)[step[quad]]
    return uv
