"""Loops over faces and corners of polygon meshes: edges, Catmull-Clark steps, normals, triangles.

Serial: a stage has many small meshes, for which waking threads costs more than
the work, and large ones are bound by memory.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


@kernel
def find_edges(starts: I64, indices: I64, n_vertices: int, of_corner: I64, lo: I64, hi: I64, n_faces: I64) -> int:
    """Number the edges of a mesh; returns how many there are.

    Parameters
    ----------
    starts : (n_polygons + 1,)
        First corner of each polygon.
    indices : (n_corners,)
        Vertex of each corner.
    n_vertices
    of_corner : (n_corners,) out
        Edge from each corner to the next of its polygon.
    lo, hi, n_faces : (n_corners,) out
        The first rows receive each edge's vertices and the number of polygons at it.
    """
    following = np.empty(len(indices), np.int64)
    begin = np.zeros(n_vertices + 1, np.int64)
    for f in range(len(starts) - 1):
        for c in range(starts[f], starts[f + 1]):
            following[c] = indices[c + 1] if c + 1 < starts[f + 1] else indices[starts[f]]
            begin[min(indices[c], following[c]) + 1] += 1
    for v in range(n_vertices):
        begin[v + 1] += begin[v]
    # Corners sorted by their edge's lower vertex; few share one, so that a search among them is short.
    fill = begin[:-1].copy()
    ordered = np.empty(len(indices), np.int64)
    for c in range(len(indices)):
        v = min(indices[c], following[c])
        ordered[fill[v]] = c
        fill[v] += 1
    n = 0
    for v in range(n_vertices):
        first = n
        for k in range(begin[v], begin[v + 1]):
            c = ordered[k]
            other = max(indices[c], following[c])
            edge = first
            while edge < n and hi[edge] != other:
                edge += 1
            if edge == n:
                lo[n], hi[n], n_faces[n] = v, other, 0
                n += 1
            n_faces[edge] += 1
            of_corner[c] = edge
    return n


@kernel
def split_vertices(
    vertices: F64,
    starts: I64,
    indices: I64,
    of_corner: I64,
    lo: I64,
    hi: I64,
    edges: F64,
    valence: I64,
    weights: F64,
    neighbours: F64,
    smooth: bool,
    out: F64,
) -> None:
    """Vertex, edge and face points of one Catmull-Clark step, in that order [1]_.

    Parameters
    ----------
    edges : (n_edges,)
        Sharpness; boundaries are sharp.
    weights, neighbours
        From `creases.vertex_rules`.
    smooth
        False puts every new vertex in the middle and moves none.
    out : (n_vertices + n_edges + n_polygons, k) out

    References
    ----------
    .. [1] Catmull and Clark, CAD 10(6), 1978.
    """
    n, width = vertices.shape
    n_edges = len(lo)
    first_face = n + n_edges
    out[: n + n_edges] = 0.0
    for f in range(len(starts) - 1):
        size = starts[f + 1] - starts[f]
        for k in range(width):
            total = 0.0
            for c in range(starts[f], starts[f + 1]):
                total += vertices[indices[c], k]
            middle = total / size
            out[first_face + f, k] = middle
            if smooth:
                for c in range(starts[f], starts[f + 1]):
                    out[n + of_corner[c], k] += middle
                    out[indices[c], k] += middle
    degree = np.zeros(n, np.int64)
    ends = np.zeros((n, width))
    for e in range(n_edges):
        a, b = lo[e], hi[e]
        degree[a] += 1
        degree[b] += 1
        for k in range(width):
            middle = 0.5 * (vertices[a, k] + vertices[b, k])
            ends[a, k] += middle
            ends[b, k] += middle
            sharp = min(edges[e], 1.0) if smooth else 1.0
            if sharp < 1.0:
                out[n + e, k] = sharp * middle + (1.0 - sharp) * (0.5 * middle + 0.25 * out[n + e, k])
            else:
                out[n + e, k] = middle
    for v in range(n):
        rounded, curved = weights[v]
        fixed = 1.0 - rounded - curved
        for k in range(width):
            if not smooth:
                out[v, k] = vertices[v, k]
                continue
            value = 0.0
            if rounded > 0.0:
                faces, middles = out[v, k] / valence[v], ends[v, k] / degree[v]
                value += rounded * ((faces + 2.0 * middles + (valence[v] - 3.0) * vertices[v, k]) / valence[v])
            if curved > 0.0:
                value += curved * (0.75 * vertices[v, k] + 0.125 * neighbours[v, k])
            out[v, k] = value + fixed * vertices[v, k]


@kernel
def split_corners(
    starts: I64, indices: I64, of_corner: I64, n_vertices: int, n_edges: int, corners: F64, quads: I64, out: F64
) -> None:
    """Quads of one step, one per corner, with the values on their corners.

    Parameters
    ----------
    corners : (n_corners, m)
        Values on corners, interpolated linearly within each polygon.
    quads : (n_corners, 4) out
        Vertices: the corner, the edge ahead, the polygon, the edge behind.
    out : (n_corners, 4, m) out
    """
    width = corners.shape[1]
    for f in range(len(starts) - 1):
        first, last = starts[f], starts[f + 1]
        for c in range(first, last):
            ahead = c + 1 if c + 1 < last else first
            behind = c - 1 if c > first else last - 1
            quads[c, 0] = indices[c]
            quads[c, 1] = n_vertices + of_corner[c]
            quads[c, 2] = n_vertices + n_edges + f
            quads[c, 3] = n_vertices + of_corner[behind]
            for k in range(width):
                out[c, 0, k] = corners[c, k]
                out[c, 1, k] = 0.5 * (corners[c, k] + corners[ahead, k])
                out[c, 3, k] = 0.5 * (corners[c, k] + corners[behind, k])
        for k in range(width):
            total = 0.0
            for c in range(first, last):
                total += corners[c, k]
            for c in range(first, last):
                out[c, 2, k] = total / (last - first)


@kernel
def limit_vertices(
    vertices: F64, indices: I64, lo: I64, hi: I64, valence: I64, weights: F64, neighbours: F64, out: F64
) -> None:
    """Limit positions of the vertices of an all-quad mesh [1]_, with what is sharp sharp for ever.

    `weights` and `neighbours` are from `creases.vertex_rules`.

    References
    ----------
    .. [1] Halstead, Kass and DeRose, SIGGRAPH 1993, section 3.
    """
    n, width = vertices.shape
    out[:] = 0.0
    for c in range(len(indices)):
        across = indices[(c // 4) * 4 + (c + 2) % 4]
        for k in range(width):
            out[indices[c], k] += vertices[across, k]
    for e in range(len(lo)):
        for k in range(width):
            out[lo[e], k] += 4.0 * vertices[hi[e], k]
            out[hi[e], k] += 4.0 * vertices[lo[e], k]
    for v in range(n):
        d = float(valence[v])
        for k in range(width):
            if weights[v, 0] > 0.0:
                out[v, k] = (d * d * vertices[v, k] + out[v, k]) / (d * (d + 5.0))
            elif weights[v, 1] > 0.0:
                out[v, k] = (4.0 * vertices[v, k] + neighbours[v, k]) / 6.0
            else:
                out[v, k] = vertices[v, k]


@kernel
def vertex_normals(vertices: F64, starts: I64, indices: I64, group: I64, out: F64) -> None:
    """Sum, over each group of corners, of the cross products of the edges there; ``(n_groups, 3)`` out, not unit."""
    out[:] = 0.0
    for f in range(len(starts) - 1):
        first, last = starts[f], starts[f + 1]
        for c in range(first, last):
            v = indices[c]
            a = indices[c + 1 if c + 1 < last else first]
            b = indices[c - 1 if c > first else last - 1]
            ax, ay, az = (
                vertices[a, 0] - vertices[v, 0],
                vertices[a, 1] - vertices[v, 1],
                vertices[a, 2] - vertices[v, 2],
            )
            bx, by, bz = (
                vertices[b, 0] - vertices[v, 0],
                vertices[b, 1] - vertices[v, 1],
                vertices[b, 2] - vertices[v, 2],
            )
            out[group[c], 0] += ay * bz - az * by
            out[group[c], 1] += az * bx - ax * bz
            out[group[c], 2] += ax * by - ay * bx


@kernel
def find_reflex(points: F64, starts: I64, indices: I64, reflex: I64) -> None:
    """The first corner of each polygon that turns the wrong way, counted from its first corner; -1 where none does.

    Parameters
    ----------
    reflex : (n_polygons,) out
    """
    for f in range(len(starts) - 1):
        reflex[f] = -1
        first, last = starts[f], starts[f + 1]
        if last - first < 4:
            continue
        origin = points[indices[first]]
        nx, ny, nz = 0.0, 0.0, 0.0
        for c in range(first + 1, last - 1):
            p, q = points[indices[c]], points[indices[c + 1]]
            px, py, pz = p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]
            qx, qy, qz = q[0] - origin[0], q[1] - origin[1], q[2] - origin[2]
            nx += py * qz - pz * qy
            ny += pz * qx - px * qz
            nz += px * qy - py * qx
        tolerance = 1e-9 * (nx * nx + ny * ny + nz * nz)
        for c in range(first, last):
            v = points[indices[c]]
            p = points[indices[c + 1 if c + 1 < last else first]]
            q = points[indices[c - 1 if c > first else last - 1]]
            px, py, pz = p[0] - v[0], p[1] - v[1], p[2] - v[2]
            qx, qy, qz = q[0] - v[0], q[1] - v[1], q[2] - v[2]
            sense = nx * (py * qz - pz * qy) + ny * (pz * qx - px * qz) + nz * (px * qy - py * qx)
            if sense < -tolerance:
                reflex[f] = c - first
                break


@kernel
def measure_triangles(positions: F64, vertex: I64, thinnest: float, flat: F64, good: U8) -> None:
    """Unit normals of triangles, and which of them have an area.

    Parameters
    ----------
    positions : (n_vertices, 3)
    vertex : (n, 3)
    thinnest
        Share of the longest edge that a triangle's height must exceed.
    flat : (n, 3) out
    good : (n,) out
    """
    for t in range(len(vertex)):
        a, b, c = positions[vertex[t, 0]], positions[vertex[t, 1]], positions[vertex[t, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = np.sqrt(x * x + y * y + z * z)
        longest = max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz)
        if length > thinnest * longest:
            good[t] = 1
            flat[t, 0], flat[t, 1], flat[t, 2] = x / length, y / length, z / length
        else:
            good[t] = 0
            flat[t] = 0.0


@kernel
def unit_normals(values: F64, rows: I64, flat: F64, out: F32) -> None:
    """Unit normals per corner; the triangle's own where a value has no length.

    Parameters
    ----------
    values : (n_values, 3)
    rows : (n, 3)
        Value of each corner.
    flat : (n, 3)
        Normals of the triangles.
    out : (n, 3, 3) out
    """
    for t in range(len(rows)):
        for k in range(3):
            v = values[rows[t, k]]
            length = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
            for axis in range(3):
                out[t, k, axis] = v[axis] / length if length > 1e-30 else flat[t, axis]


@kernel
def take(values: F64, begin: int, rows: I64, out: F32) -> None:
    """``out[t, k, j] = values[rows[t, k], begin + j]``, converted on the way."""
    for t in range(len(rows)):
        for k in range(rows.shape[1]):
            for j in range(out.shape[2]):
                out[t, k, j] = values[rows[t, k], begin + j]
