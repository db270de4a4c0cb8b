"""Steps and limits of Loop's subdivision surfaces, made of triangles."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


@kernel
def neighbour_weight(n: int) -> float:
    """Weight of each of a smooth vertex's `n` neighbours in a step (Loop 1987)."""
    c = 0.375 + 0.25 * math.cos(2.0 * math.pi / n)
    return (0.625 - c * c) / n


@kernel
def limit_weight(n: int) -> float:
    """Weight of each of a smooth vertex's `n` neighbours in its limit."""
    return 1.0 / (n + 0.375 / neighbour_weight(n))


@kernel
def split_vertices(
    vertices: F64, indices: I64, of_corner: I64, lo: I64, hi: I64, edges: F64, weights: F64, neighbours: F64, out: F64
) -> None:
    """Vertex and edge points of one step of triangles, in that order.

    Parameters
    ----------
    edges : (n_edges,)
        Sharpness; boundaries are sharp.
    weights, neighbours
        From `creases.vertex_rules`.
    out : (n_vertices + n_edges, k) out
    """
    n, width = vertices.shape
    out[:] = 0.0
    for c in range(len(indices)):
        out[n + of_corner[c]] += vertices[indices[c - c % 3 + (c + 2) % 3]]
    degree = np.zeros(n, np.int64)
    for e in range(len(lo)):
        a, b = lo[e], hi[e]
        degree[a] += 1
        degree[b] += 1
        sharp = min(edges[e], 1.0)
        for k in range(width):
            out[a, k] += vertices[b, k]
            out[b, k] += vertices[a, k]
            both = vertices[a, k] + vertices[b, k]
            out[n + e, k] = sharp * 0.5 * both + (1.0 - sharp) * (0.375 * both + 0.125 * out[n + e, k])
    for v in range(n):
        rounded, curved = weights[v]
        share = neighbour_weight(max(degree[v], 1))
        for k in range(width):
            smooth = (1.0 - degree[v] * share) * vertices[v, k] + share * out[v, k]
            curve = 0.75 * vertices[v, k] + 0.125 * neighbours[v, k]
            out[v, k] = rounded * smooth + curved * curve + (1.0 - rounded - curved) * vertices[v, k]


@kernel
def split_corners(indices: I64, of_corner: I64, n_vertices: int, corners: F64, triangles: I64, out: F64) -> None:
    """Four triangles for each one, with the values on their corners, which are linear within it.

    Parameters
    ----------
    corners : (n_corners, m)
    triangles : (n_triangles, 4, 3) out
        At each corner one, which starts there; last the middle one.
    out : (n_triangles, 4, 3, m) out
    """
    for f in range(len(triangles)):
        for k in range(3):
            here, ahead, behind = 3 * f + k, 3 * f + (k + 1) % 3, 3 * f + (k + 2) % 3
            triangles[f, k, 0] = indices[here]
            triangles[f, k, 1] = n_vertices + of_corner[here]
            triangles[f, k, 2] = n_vertices + of_corner[behind]
            triangles[f, 3, k] = n_vertices + of_corner[here]
            out[f, k, 0] = corners[here]
            out[f, k, 1] = 0.5 * (corners[here] + corners[ahead])
            out[f, k, 2] = 0.5 * (corners[here] + corners[behind])
            out[f, 3, k] = 0.5 * (corners[here] + corners[ahead])


@kernel
def limit_vertices(vertices: F64, lo: I64, hi: I64, weights: F64, neighbours: F64, out: F64) -> None:
    """Limit positions of the vertices of triangles, with what is sharp sharp for ever."""
    n, width = vertices.shape
    degree = np.zeros(n, np.int64)
    out[:] = 0.0
    for e in range(len(lo)):
        degree[lo[e]] += 1
        degree[hi[e]] += 1
        for k in range(width):
            out[lo[e], k] += vertices[hi[e], k]
            out[hi[e], k] += vertices[lo[e], k]
    for v in range(n):
        share = limit_weight(max(degree[v], 1))
        for k in range(width):
            if weights[v, 0] > 0.0:
                out[v, k] = (1.0 - degree[v] * share) * vertices[v, k] + share * out[v, k]
            elif weights[v, 1] > 0.0:
                out[v, k] = (4.0 * vertices[v, k] + neighbours[v, k]) / 6.0
            else:
                out[v, k] = vertices[v, k]
