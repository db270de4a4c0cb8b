"""Polygon shapes of the sample stages, as points and faces; no USD."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Shape:
    """Points, faces counter-clockwise from outside, and texture coordinates per face corner or None."""

    points: F64
    faces: list[list[int]]
    st: F64 | None = None


def quad(corners: Sequence[Sequence[float]], st_size: tuple[float, float] = (1.0, 1.0)) -> Shape:
    """One four-sided face; `st` runs from 0 to `st_size` along its first and last edge."""
    s, t = st_size
    return Shape(np.array(corners, float), [[0, 1, 2, 3]], np.array([[0, 0], [s, 0], [s, t], [0, t]], float))


def box(size: Sequence[float], st_per_metre: float | None = None) -> Shape:
    """A box that stands on y = 0, centred in x and z."""
    w, h, d = size
    return _lattice_box([-w / 2, w / 2], [0, h], [-d / 2, d / 2], st_per_metre)


def cushion(size: Sequence[float], radius: float) -> Shape:
    """Cage of a box with round edges, standing on y = 0; subdivide it."""
    w, h, d = size
    r = min(radius, 0.45 * min(size))

    def lines(low: float, high: float) -> list[float]:
        return [low, low + r, high - r, high]

    return _lattice_box(lines(-w / 2, w / 2), lines(0, h), lines(-d / 2, d / 2), None)


def _lattice_box(xs: list[float], ys: list[float], zs: list[float], st_per_metre: float | None) -> Shape:
    """Surface quads of the lattice xs x ys x zs."""
    index: dict[tuple[int, int, int], int] = {}
    points: list[tuple[float, float, float]] = []
    faces: list[list[int]] = []
    st: list[tuple[float, float]] = []

    def vertex(i: int, j: int, k: int) -> int:
        if (i, j, k) not in index:
            index[i, j, k] = len(points)
            points.append((xs[i], ys[j], zs[k]))
        return index[i, j, k]

    counts = (len(xs) - 1, len(ys) - 1, len(zs) - 1)
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for end in (0, counts[axis]):
            for i in range(counts[a]):
                for j in range(counts[b]):
                    corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
                    if end == 0:
                        corners.reverse()
                    face = []
                    for ci, cj in corners:
                        place = [0, 0, 0]
                        place[axis], place[a], place[b] = end, ci, cj
                        face.append(vertex(place[0], place[1], place[2]))
                    faces.append(face)
                    for corner in face:
                        p = points[corner]
                        # Texture runs along the longer way of the face, so that planks follow a table top.
                        u, v = ((p[2], p[1]), (p[0], p[2]), (p[0], p[1]))[axis]
                        st.append((u, v))
    scaled = np.array(st) * st_per_metre if st_per_metre is not None else None
    return Shape(np.array(points, float), faces, scaled)


def lathe(profile: Sequence[tuple[float, float]], sides: int = 12, closed: bool = True) -> Shape:
    """A profile of (radius, y), bottom to top, turned about Y; `closed` adds end caps."""
    rings = [((0.0, y, 0.0), r, r) for r, y in profile]
    return tube(rings, sides, closed)


def tube(
    rings: Sequence[tuple[Sequence[float], float, float]],
    sides: int = 8,
    closed: bool = True,
    pleats: tuple[int, float] = (0, 0.0),
) -> Shape:
    """Horizontal ellipses (centre, radius in x, radius in z) joined bottom to top.

    `pleats` = (n, depth) makes the radius wave n times around, deepest at the first ring.
    """
    angles = np.arange(sides) * 2 * np.pi / sides
    points: list[F64] = []
    for row, (centre, rx, rz) in enumerate(rings):
        n, depth = pleats
        wave = 1 + depth * np.cos(n * angles) * (1 - row / max(len(rings) - 1, 1)) if n else np.ones(sides)
        # +x to -z: counter-clockwise seen from above.
        ring = np.stack([np.cos(angles) * rx * wave, np.zeros(sides), -np.sin(angles) * rz * wave], 1)
        points.append(ring + np.asarray(centre, float))
    faces = []
    for row in range(len(rings) - 1):
        for i in range(sides):
            j = (i + 1) % sides
            a, b = row * sides, (row + 1) * sides
            faces.append([a + i, a + j, b + j, b + i])
    if closed:
        faces.append(list(range(sides))[::-1])
        faces.append([(len(rings) - 1) * sides + i for i in range(sides)])
    return Shape(np.concatenate(points), faces)


def wall_with_hole(
    width: float, height: float, hole: tuple[float, float, float, float], st_per_metre: float = 1.0
) -> Shape:
    """A wall in the XY plane facing +Z with a rectangular opening (x0, x1, y0, y1); lower left corner at the origin."""
    x0, x1, y0, y1 = hole
    xs, ys = [0, x0, x1, width], [0, y0, y1, height]
    points = np.array([(x, y, 0) for y in ys for x in xs], float)
    faces = [
        [j * 4 + i, j * 4 + i + 1, (j + 1) * 4 + i + 1, (j + 1) * 4 + i]
        for j in range(3)
        for i in range(3)
        if (i, j) != (1, 1)
    ]
    st = np.array([points[i, :2] for face in faces for i in face]) * st_per_metre
    return Shape(points, faces, st)


def staircase(n_steps: int, width: float, rise: float, run: float) -> Shape:
    """Solid steps that climb towards -Z from z = 0, centred in x: treads, risers, and the sides, a column a step."""
    x = width / 2
    points: list[tuple[float, float, float]] = []
    faces: list[list[int]] = []

    def face(*corners: tuple[float, float, float]) -> None:
        faces.append(list(range(len(points), len(points) + 4)))
        points.extend(corners)

    for step in range(n_steps):
        low, high = step * rise, (step + 1) * rise
        front, back = -step * run, -(step + 1) * run
        face((-x, low, front), (x, low, front), (x, high, front), (-x, high, front))
        face((-x, high, front), (x, high, front), (x, high, back), (-x, high, back))
        face((x, 0, front), (x, 0, back), (x, high, back), (x, high, front))
        face((-x, 0, back), (-x, 0, front), (-x, high, front), (-x, high, back))
    return Shape(np.array(points, float), faces)
