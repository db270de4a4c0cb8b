"""Catmull-Clark and Loop surfaces, refined a few times and then set on their limit.

OpenSubdiv does not come with the ``usd-core`` wheel, and no light package has
it. Its rules are followed: boundaries by ``interpolateBoundary``, creases and
corners as sharp as they say.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import creases, loop, meshing
from icheat_usd.scene import F64, I64

#: From here on, an edge or corner is sharp for ever: USD's SHARPNESS_INFINITE.
INFINITE = creases.INFINITE


class Creases(NamedTuple):
    """What is sharp on a mesh, and how much: 0 is smooth, 1 sharp for one step, `INFINITE` for ever."""

    edges: I64  #: (n, 2) vertices
    sharpness: F64  #: (n,)
    corners: I64  #: (m,) vertices
    corner_sharpness: F64  #: (m,)


NO_CREASES = Creases(np.empty((0, 2), np.int64), np.empty(0), np.empty(0, np.int64), np.empty(0))


class Cage(NamedTuple):
    """A polygon mesh whose values live on its vertices or on its corners."""

    vertices: F64  #: (n_vertices, k) smoothed: positions first, then primvars that follow them
    counts: I64  #: (n_faces,) each at least 3
    indices: I64  #: (n_corners,)
    corners: F64  #: (n_corners, m) interpolated linearly within faces
    face: I64  #: (n_faces,) control face
    creases: Creases = NO_CREASES


def refine(cage: Cage, level: int, scheme: str = "catmullClark", *, sharp_corners: bool = True) -> Cage:
    """Subdivide `level` times and move the vertices to the limit surface.

    Parameters
    ----------
    cage
        The control mesh.
    level
        How often each face is split; every face becomes quads, or triangles by Loop's scheme. 0 returns the cage.
    scheme
        "catmullClark"; "bilinear", which keeps the shape; or "loop", for faces that all are triangles.
    sharp_corners
        USD's ``edgeAndCorner``: boundary vertices of a single face stay where they are.

    Notes
    -----
    Edges of one face, or of more than two, are boundaries, and sharp for ever:
    their vertices follow the cubic B-spline through the boundary alone. So do
    those on a crease, as long as it is sharp. Creases that are no edges are left out.

    References
    ----------
    .. [1] Catmull and Clark, CAD 10(6), 1978.
    .. [2] Halstead, Kass and DeRose, SIGGRAPH 1993: limit positions.
    .. [3] DeRose, Kass and Truong, SIGGRAPH 1998: sharpness.
    .. [4] Loop, master's thesis, University of Utah, 1987.
    """
    is_loop = scheme == "loop"
    for _ in range(level):
        cage = _split_triangles(cage, sharp_corners) if is_loop else _split(cage, scheme != "bilinear", sharp_corners)
    if level > 0 and scheme != "bilinear":
        cage = cage._replace(vertices=_limit(cage, sharp_corners, is_loop))
    return cage


class _Topology(NamedTuple):
    """What one step asks about a cage."""

    starts: I64  #: (n_faces + 1,)
    of_corner: I64  #: (n_corners,) edge from each corner to the next
    lo: I64
    hi: I64
    valence: I64  #: faces at each vertex
    edges: F64  #: sharpness of each edge
    corners: F64  #: sharpness of each vertex


def _analyse(cage: Cage, sharp_corners: bool) -> _Topology:
    n, n_corners = len(cage.vertices), len(cage.indices)
    starts = np.concatenate([[0], np.cumsum(cage.counts)])
    of_corner, lo, hi, n_faces = (np.empty(n_corners, np.int64) for _ in range(4))
    n_edges = meshing.find_edges(starts, cage.indices, n, of_corner, lo, hi, n_faces)
    lo, hi, n_faces = lo[:n_edges].copy(), hi[:n_edges].copy(), n_faces[:n_edges].copy()
    valence = np.bincount(cage.indices, minlength=n)
    edges, corners = np.zeros(n_edges), np.zeros(n)
    found = find_edges(lo, hi, cage.creases.edges)
    edges[found[found >= 0]] = np.minimum(cage.creases.sharpness[found >= 0], INFINITE)
    corners[cage.creases.corners] = np.minimum(cage.creases.corner_sharpness, INFINITE)
    creases.mark_boundaries(lo, hi, n_faces, valence, sharp_corners, edges, corners)
    return _Topology(starts, of_corner, lo, hi, valence, edges, corners)


def find_edges(lo: I64, hi: I64, wanted: I64) -> I64:
    """Rows of edges (n, 2) in a list of edges; -1 for one that is not there.

    Parameters
    ----------
    lo, hi : (n_edges,)
        Lower and higher vertex of each.
    """
    if not len(wanted) or not len(lo):
        return np.full(len(wanted), -1, np.int64)
    n = int(max(hi.max(), wanted.max())) + 1
    keys = lo * n + hi
    order = np.argsort(keys, kind="stable")
    key = wanted.min(axis=1) * n + wanted.max(axis=1)
    at = np.minimum(np.searchsorted(keys, key, sorter=order), len(keys) - 1)
    rows: I64 = order[at]
    return np.where(keys[rows] == key, rows, -1)


def _rules(cage: Cage, t: _Topology) -> tuple[F64, F64]:
    weights, neighbours = np.empty((len(cage.vertices), 2)), np.empty(cage.vertices.shape)
    creases.vertex_rules(cage.vertices, t.lo, t.hi, t.edges, t.corners, weights, neighbours)
    return weights, neighbours


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
        t.edges,
        t.valence,
        *_rules(cage, t),
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
        _after_step(cage, t),
    )


def _split_triangles(cage: Cage, sharp_corners: bool) -> Cage:
    t = _analyse(cage, sharp_corners)
    n, n_faces = len(cage.vertices), len(cage.counts)
    vertices = np.empty((n + len(t.lo), cage.vertices.shape[1]))
    loop.split_vertices(cage.vertices, cage.indices, t.of_corner, t.lo, t.hi, t.edges, *_rules(cage, t), vertices)
    triangles = np.empty((n_faces, 4, 3), np.int64)
    corners = np.empty((n_faces, 4, 3, cage.corners.shape[1]))
    loop.split_corners(cage.indices, t.of_corner, n, cage.corners, triangles, corners)
    return Cage(
        vertices,
        np.full(4 * n_faces, 3, np.int64),
        triangles.reshape(-1),
        corners.reshape(12 * n_faces, -1),
        np.repeat(cage.face, 4),
        _after_step(cage, t),
    )


def _after_step(cage: Cage, t: _Topology) -> Creases:
    """What is still sharp after a step: both halves of an edge, and vertices."""
    sharp = cage.creases
    found = find_edges(t.lo, t.hi, sharp.edges)
    left, left_of_corners = (
        np.where(s >= INFINITE, INFINITE, np.maximum(s - 1.0, 0.0)) for s in (sharp.sharpness, sharp.corner_sharpness)
    )
    kept, corners = (left > 0) & (found >= 0), left_of_corners > 0
    middle = len(cage.vertices) + found[kept]
    halves = [np.stack([sharp.edges[kept, end], middle], axis=1) for end in (0, 1)]
    return Creases(np.concatenate(halves), np.tile(left[kept], 2), sharp.corners[corners], left_of_corners[corners])


def _limit(cage: Cage, sharp_corners: bool, is_loop: bool) -> F64:
    """Where the vertices of an all-quad or all-triangle mesh end up after infinitely many steps."""
    t = _analyse(cage, sharp_corners)
    limit = np.empty_like(cage.vertices)
    weights, neighbours = _rules(cage, t)
    if is_loop:
        loop.limit_vertices(cage.vertices, t.lo, t.hi, weights, neighbours, limit)
    else:
        meshing.limit_vertices(cage.vertices, cage.indices, t.lo, t.hi, t.valence, weights, neighbours, limit)
    fading = np.empty(len(limit), np.bool_)
    creases.find_fading(t.lo, t.hi, t.edges, t.corners, fading)
    rows = np.flatnonzero(fading & (t.valence > 0))
    if len(rows):
        own = np.flatnonzero(fading[cage.indices])
        own = own[np.argsort(cage.indices[own], kind="stable")]
        begin = np.searchsorted(cage.indices[own], np.append(rows, len(limit)))
        creases.limits_where_fading(
            cage.vertices,
            cage.indices,
            t.of_corner,
            t.edges,
            t.corners,
            rows,
            begin,
            own,
            3 if is_loop else 4,
            limit,
        )
    return limit


def smooth_normals(cage: Cage) -> tuple[F64, I64]:
    """Area-weighted mean of the faces' normals about each vertex, on each side of what is sharp there.

    Returns
    -------
    (n, 3) float64, (n_corners,) int64
        Not unit; and the row of each corner.
    """
    starts = np.concatenate([[0], np.cumsum(cage.counts)])
    group, n = cage.indices, len(cage.vertices)
    # What will be sharp for less than another step is as round as the faces are small.
    parted = cage.creases.edges[cage.creases.sharpness >= 1.0]
    if len(parted):
        of_corner, lo, hi, n_faces = (np.empty(len(cage.indices), np.int64) for _ in range(4))
        n_edges = meshing.find_edges(starts, cage.indices, n, of_corner, lo, hi, n_faces)
        found = find_edges(lo[:n_edges], hi[:n_edges], parted)
        splits = np.zeros(n_edges, np.bool_)
        splits[found[found >= 0]] = True
        group = np.empty_like(cage.indices)
        n = creases.group_corners(starts, cage.indices, of_corner, n, splits, group)
    normals = np.empty((n, 3))
    meshing.vertex_normals(cage.vertices, starts, cage.indices, group, normals)
    return normals, group
