"""Catmull-Clark surfaces, refined a few times and then set on their limit.

OpenSubdiv does not come with the ``usd-core`` wheel, and no light package has
it. Creases and corners that are sharp on purpose are not followed; boundaries
are, by ``interpolateBoundary``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.scene import F64, I64
from icheat_usd.stage.polygons import next_corners, previous_corners


class Cage(NamedTuple):
    """A polygon mesh whose values live on its vertices or on its corners."""

    vertices: F64  #: (n_vertices, k) smoothed: positions first, then primvars that follow them
    counts: I64  #: (n_faces,) each at least 3
    indices: I64  #: (n_corners,)
    corners: F64  #: (n_corners, m) interpolated linearly within faces
    face: I64  #: (n_faces,) control face


class _Edges(NamedTuple):
    of_corner: I64  #: edge from each corner to the next
    lo: I64
    hi: I64
    n_faces: I64
    smooth: NDArray[np.bool_]  #: shared by exactly two faces


def refine(cage: Cage, level: int, *, smooth: bool = True, sharp_corners: bool = True) -> Cage:
    """Subdivide `level` times and move the vertices to the limit surface.

    Parameters
    ----------
    cage
        The control mesh.
    level
        How often each face is split; every face becomes quads. 0 returns the cage.
    smooth
        False keeps the shape (USD's ``bilinear`` scheme).
    sharp_corners
        USD's ``edgeAndCorner``: boundary vertices of a single face stay where they are.

    Notes
    -----
    Edges of one face, or of more than two, are boundaries: their vertices
    follow the cubic B-spline through the boundary alone.

    References
    ----------
    .. [1] Catmull and Clark, CAD 10(6), 1978.
    .. [2] Halstead, Kass and DeRose, SIGGRAPH 1993: limit positions.
    """
    for _ in range(level):
        cage = _split(cage, smooth, sharp_corners)
    if level > 0 and smooth:
        cage = cage._replace(vertices=_limit(cage, sharp_corners))
    return cage


def _find_edges(counts: I64, indices: I64, n_vertices: int) -> _Edges:
    a, b = indices, indices[next_corners(counts)]
    key = np.minimum(a, b) * n_vertices + np.maximum(a, b)
    unique, of_corner, n_faces = np.unique(key, return_inverse=True, return_counts=True)
    return _Edges(of_corner, unique // n_vertices, unique % n_vertices, n_faces, n_faces == 2)


def _sum_by(rows: I64, values: F64, n: int) -> F64:
    return np.stack([np.bincount(rows, values[:, k], n) for k in range(values.shape[1])], axis=1)


class _Boundary(NamedTuple):
    edges: I64  #: boundary edges at each vertex
    neighbours: F64  #: sum of the vertices at their other ends
    crease: NDArray[np.bool_]  #: two boundary edges pass through
    corner: NDArray[np.bool_]  #: stays where it is


def _find_boundary(cage: Cage, edges: _Edges, valence: I64, sharp_corners: bool) -> _Boundary:
    n = len(cage.vertices)
    lo, hi = edges.lo[~edges.smooth], edges.hi[~edges.smooth]
    count = np.bincount(lo, minlength=n) + np.bincount(hi, minlength=n)
    neighbours = _sum_by(lo, cage.vertices[hi], n) + _sum_by(hi, cage.vertices[lo], n)
    crease = count == 2
    corner = (count > 0) & ~crease
    if sharp_corners:
        corner |= crease & (valence == 1)
        crease &= ~corner
    return _Boundary(count, neighbours, crease, corner)


def _split(cage: Cage, smooth: bool, sharp_corners: bool) -> Cage:
    vertices, counts, indices = cage.vertices, cage.counts, cage.indices
    n, n_faces = len(vertices), len(counts)
    following, preceding = next_corners(counts), previous_corners(counts)
    starts = np.cumsum(counts) - counts
    face_of_corner = np.repeat(np.arange(n_faces), counts)
    edges = _find_edges(counts, indices, n)

    face_points = np.add.reduceat(vertices[indices], starts, axis=0) / counts[:, None]
    edge_points = 0.5 * (vertices[edges.lo] + vertices[edges.hi])
    moved = vertices
    if smooth:
        middles = edge_points
        beside = _sum_by(edges.of_corner, face_points[face_of_corner], len(edges.lo))
        edge_points = np.where(edges.smooth[:, None], 0.5 * middles + 0.25 * beside, middles)

        valence = np.bincount(indices, minlength=n)
        around = np.maximum(valence, 1)[:, None]
        faces_mean = _sum_by(indices, face_points[face_of_corner], n) / around
        n_edges = np.bincount(edges.lo, minlength=n) + np.bincount(edges.hi, minlength=n)
        middles_sum = _sum_by(edges.lo, middles, n) + _sum_by(edges.hi, middles, n)
        middles_mean = middles_sum / np.maximum(n_edges, 1)[:, None]
        boundary = _find_boundary(cage, edges, valence, sharp_corners)
        moved = (faces_mean + 2.0 * middles_mean + (around - 3.0) * vertices) / around
        moved = np.where(boundary.crease[:, None], 0.75 * vertices + 0.125 * boundary.neighbours, moved)
        moved = np.where((boundary.corner | (valence == 0))[:, None], vertices, moved)

    quads = np.empty((len(indices), 4), np.int64)
    quads[:, 0] = indices
    quads[:, 1] = n + edges.of_corner
    quads[:, 2] = n + len(edges.lo) + face_of_corner
    quads[:, 3] = n + edges.of_corner[preceding]

    corners = np.empty((len(indices), 4, cage.corners.shape[1]))
    corners[:, 0] = cage.corners
    corners[:, 1] = 0.5 * (cage.corners + cage.corners[following])
    corners[:, 2] = (np.add.reduceat(cage.corners, starts, axis=0) / counts[:, None])[face_of_corner]
    corners[:, 3] = corners[preceding, 1]
    return Cage(
        np.concatenate([moved, edge_points, face_points]),
        np.full(len(indices), 4, np.int64),
        quads.reshape(-1),
        corners.reshape(-1, corners.shape[2]),
        cage.face[face_of_corner],
    )


def _limit(cage: Cage, sharp_corners: bool) -> F64:
    """Where the vertices of an all-quad mesh end up after infinitely many steps."""
    vertices = cage.vertices
    n = len(vertices)
    edges = _find_edges(cage.counts, cage.indices, n)
    valence = np.bincount(cage.indices, minlength=n)
    boundary = _find_boundary(cage, edges, valence, sharp_corners)
    across = cage.indices.reshape(-1, 4)[:, [2, 3, 0, 1]].reshape(-1)
    diagonals = _sum_by(cage.indices, vertices[across], n)
    beside = _sum_by(edges.lo, vertices[edges.hi], n) + _sum_by(edges.hi, vertices[edges.lo], n)
    v = np.maximum(valence, 1)[:, None].astype(np.float64)
    limit = (v * v * vertices + 4.0 * beside + diagonals) / (v * (v + 5.0))
    limit = np.where(boundary.crease[:, None], (4.0 * vertices + boundary.neighbours) / 6.0, limit)
    return np.where((boundary.corner | (valence == 0))[:, None], vertices, limit)
