"""Catmull-Clark surfaces, refined a few times and then set on their limit.

OpenSubdiv does not come with the ``usd-core`` wheel, and no light package has
it. Creases and corners that are sharp on purpose are not followed; boundaries
are, by ``interpolateBoundary``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import meshing
from icheat_usd.scene import F64, I64, U8


class Cage(NamedTuple):
    """A polygon mesh whose values live on its vertices or on its corners."""

    vertices: F64  #: (n_vertices, k) smoothed: positions first, then primvars that follow them
    counts: I64  #: (n_faces,) each at least 3
    indices: I64  #: (n_corners,)
    corners: F64  #: (n_corners, m) interpolated linearly within faces
    face: I64  #: (n_faces,) control face


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


class _Topology(NamedTuple):
    """What one step asks about a cage."""

    starts: I64  #: (n_faces + 1,)
    of_corner: I64  #: (n_corners,) edge from each corner to the next
    lo: I64
    hi: I64
    n_faces: I64  #: faces at each edge
    valence: I64  #: faces at each vertex
    kind: U8  #: 0 smooth, 1 on a boundary curve, 2 fixed
    neighbours: F64  #: sum of the neighbours along the boundary


def _analyse(cage: Cage, sharp_corners: bool) -> _Topology:
    n, n_corners = len(cage.vertices), len(cage.indices)
    starts = np.concatenate([[0], np.cumsum(cage.counts)])
    of_corner, lo, hi, n_faces = (np.empty(n_corners, np.int64) for _ in range(4))
    n_edges = meshing.find_edges(starts, cage.indices, n, of_corner, lo, hi, n_faces)
    lo, hi, n_faces = lo[:n_edges].copy(), hi[:n_edges].copy(), n_faces[:n_edges].copy()
    valence = np.bincount(cage.indices, minlength=n)
    kind, neighbours = np.empty(n, np.uint8), np.empty(cage.vertices.shape)
    meshing.boundary(cage.vertices, valence, lo, hi, n_faces, sharp_corners, kind, neighbours)
    return _Topology(starts, of_corner, lo, hi, n_faces, valence, kind, neighbours)


def _split(cage: Cage, smooth: bool, sharp_corners: bool) -> Cage:
    t = _analyse(cage, sharp_corners)
    n, n_edges, n_faces, n_corners = len(cage.vertices), len(t.lo), len(cage.counts), len(cage.indices)
    vertices = np.empty((n + n_edges + n_faces, cage.vertices.shape[1]))
    meshing.split_vertices(
        cage.vertices,
        t.starts,
        cage.indices,
        t.of_corner,
        t.lo,
        t.hi,
        t.n_faces,
        t.valence,
        t.kind,
        t.neighbours,
        smooth,
        vertices,
    )
    quads = np.empty((n_corners, 4), np.int64)
    corners = np.empty((n_corners, 4, cage.corners.shape[1]))
    meshing.split_corners(t.starts, cage.indices, t.of_corner, n, n_edges, cage.corners, quads, corners)
    return Cage(
        vertices,
        np.full(n_corners, 4, np.int64),
        quads.reshape(-1),
        corners.reshape(4 * n_corners, -1),
        np.repeat(cage.face, cage.counts),
    )


def _limit(cage: Cage, sharp_corners: bool) -> F64:
    """Where the vertices of an all-quad mesh end up after infinitely many steps."""
    t = _analyse(cage, sharp_corners)
    limit = np.empty_like(cage.vertices)
    meshing.limit_vertices(cage.vertices, cage.indices, t.lo, t.hi, t.valence, t.kind, t.neighbours, limit)
    return limit
