"""Rules of subdivision surfaces with edges and corners that are sharp to some degree.

As in OpenSubdiv: a sharpness falls by one with each step; `INFINITE` stays, and
boundaries have it. Within its last step an edge or vertex is a mixture of
sharp and smooth (DeRose, Kass, Truong, SIGGRAPH 1998, section 4).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.loop import limit_weight, neighbour_weight

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

INFINITE = 10.0

_SMOOTH, _CREASE, _CORNER = 0, 1, 2

# Where a crease that lasts ends at a smooth vertex (a dart), no closed form is at hand; each step at least halves what
# is left, about.
_STEPS_OF_DART = 64


@kernel
def after_step(sharpness: float) -> float:
    """Sharpness of what a step makes of an edge or vertex."""
    if sharpness >= INFINITE:
        return INFINITE
    return max(sharpness - 1.0, 0.0)


@kernel
def _rule(corner: float, n_sharp: int) -> int:
    if corner > 0.0 or n_sharp > 2:
        return _CORNER
    return _CREASE if n_sharp == 2 else _SMOOTH


@kernel
def vertex_rule(
    corner: float, n_sharp: int, n_sharp_after: int, ending: float, n_ending: int
) -> tuple[float, float, bool]:
    """Weights of the smooth and the crease rule for a vertex (the rest is that of a corner), and whose crease it is.

    Parameters
    ----------
    corner
        Sharpness of the vertex.
    n_sharp, n_sharp_after
        Sharp edges at it, before and after the step.
    ending, n_ending
        Summed sharpness and number of the edges that are sharp for the last time.

    Returns
    -------
    (float, float, bool)
        The last: the crease is made of the edges that stay sharp, not of all that are.
    """
    corner_after = after_step(corner)
    before, after = _rule(corner, n_sharp), _rule(corner_after, n_sharp_after)
    share = 1.0
    if before != after:
        if corner > 0.0 and corner_after <= 0.0:
            ending += corner
            n_ending += 1
        share = min(ending / n_ending, 1.0)
    smooth = (share if before == _SMOOTH else 0.0) + (1.0 - share if after == _SMOOTH else 0.0)
    crease = (share if before == _CREASE else 0.0) + (1.0 - share if after == _CREASE else 0.0)
    return smooth, crease, after == _CREASE


@kernel
def mark_boundaries(
    lo: I64, hi: I64, n_faces: I64, valence: I64, sharp_corners: bool, edges: F64, corners: F64
) -> None:
    """Give boundaries their sharpness.

    Parameters
    ----------
    lo, hi, n_faces : (n_edges,)
        Edges, and polygons at each.
    valence : (n,)
        Polygons at each vertex.
    sharp_corners
        Whether boundary vertices of one polygon are corners.
    edges, corners : (n_edges,), (n,) in place
        Sharpness of edges and vertices.
    """
    count = np.zeros(len(valence), np.int64)
    for e in range(len(lo)):
        if n_faces[e] != 2:
            edges[e] = INFINITE
            count[lo[e]] += 1
            count[hi[e]] += 1
    for v in range(len(valence)):
        is_curve = count[v] == 2 and not (sharp_corners and valence[v] == 1)
        if valence[v] == 0 or (count[v] > 0 and not is_curve):
            corners[v] = INFINITE


@kernel
def vertex_rules(vertices: F64, lo: I64, hi: I64, edges: F64, corners: F64, weights: F64, neighbours: F64) -> None:
    """`vertex_rule` of all vertices.

    Parameters
    ----------
    vertices : (n, k)
    lo, hi, edges : (n_edges,)
        Edges and their sharpness.
    corners : (n,)
        Sharpness of vertices.
    weights : (n, 2) out
        Of the smooth and the crease rule.
    neighbours : (n, k) out
        Sum of the two ends of the crease through a vertex; elsewhere of no meaning.
    """
    n, width = vertices.shape
    sharp, sharp_after, n_ending = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
    ending = np.zeros(n)
    for e in range(len(lo)):
        if edges[e] > 0.0:
            stays = after_step(edges[e]) > 0.0
            for v in (lo[e], hi[e]):
                sharp[v] += 1
                if stays:
                    sharp_after[v] += 1
                else:
                    n_ending[v] += 1
                    ending[v] += edges[e]
    those_that_stay = np.zeros(n, np.bool_)
    for v in range(n):
        smooth, crease, stay = vertex_rule(corners[v], sharp[v], sharp_after[v], ending[v], n_ending[v])
        weights[v, 0], weights[v, 1], those_that_stay[v] = smooth, crease, stay
    neighbours[:] = 0.0
    for e in range(len(lo)):
        if edges[e] > 0.0:
            stays = after_step(edges[e]) > 0.0
            a, b = lo[e], hi[e]
            for k in range(width):
                if stays or not those_that_stay[a]:
                    neighbours[a, k] += vertices[b, k]
                if stays or not those_that_stay[b]:
                    neighbours[b, k] += vertices[a, k]


@kernel
def find_fading(lo: I64, hi: I64, edges: F64, corners: F64, fading: NDArray[np.bool_]) -> None:
    """Which vertices, (n,) out, are sharp to a degree that ends, by themselves or by an edge, or end a crease."""
    lasting = np.zeros(len(corners), np.int64)
    fading[:] = False
    for e in range(len(lo)):
        for v in (lo[e], hi[e]):
            if edges[e] >= INFINITE:
                lasting[v] += 1
            elif edges[e] > 0.0:
                fading[v] = True
    for v in range(len(corners)):
        if 0.0 < corners[v] < INFINITE or (lasting[v] == 1 and corners[v] <= 0.0):
            fading[v] = True


@kernel
def _limit_of_ring(
    centre: F64, ends: F64, faces: F64, sharpness: F64, sides: I64, corner: float, is_loop: bool, out: F64
) -> None:
    """Limit of one vertex of quads or (Loop) triangles: steps of its ring until only what lasts is sharp, then masks.

    Parameters
    ----------
    centre : (k,) changed
    ends, sharpness : (n_edges, k), (n_edges,) changed
        Of the edges at the vertex.
    faces, sides : (n_faces, k), (n_faces, 2) changed, not changed
        The vertices opposite in the quads at it, and which two edges each face has.
    out : (k,) out
    """
    n_edges, n_around, width = len(ends), len(faces), len(centre)
    middle, ring = np.empty((n_edges, width)), np.empty((n_edges, width))
    curve, total, mean = np.empty(width), np.empty(width), np.empty(width)
    for step in range(_STEPS_OF_DART):
        fades = 0.0 < corner < INFINITE
        sharp = after = n_ending = 0
        ending = 0.0
        for e in range(n_edges):
            fades = fades or 0.0 < sharpness[e] < INFINITE
            if sharpness[e] > 0.0:
                sharp += 1
                if after_step(sharpness[e]) > 0.0:
                    after += 1
                else:
                    n_ending += 1
                    ending += sharpness[e]
        smooth, crease, stay = vertex_rule(corner, sharp, after, ending, n_ending)
        curve[:] = 0.0
        for e in range(n_edges):
            if sharpness[e] > 0.0 and (not stay or after_step(sharpness[e]) > 0.0):
                curve += ends[e]
        is_dart = sharp == 1 and smooth == 1.0
        if step == _STEPS_OF_DART - 1 or not (fades or is_dart):
            break

        ring[:] = 0.0
        total[:] = 0.0
        mean[:] = 0.0
        for e in range(n_edges):
            middle[e] = 0.5 * (centre + ends[e])
            mean += middle[e] / n_edges
            total += ends[e]
        if is_loop:
            for q in range(n_around):
                ring[sides[q, 0]] += ends[sides[q, 1]]
                ring[sides[q, 1]] += ends[sides[q, 0]]
            share = neighbour_weight(n_edges)
            total[:] = (1.0 - n_edges * share) * centre + share * total
            ring[:] = 0.75 * middle + 0.125 * ring
        else:
            total[:] = 0.0
            for q in range(n_around):
                faces[q] = 0.25 * (centre + faces[q] + ends[sides[q, 0]] + ends[sides[q, 1]])
            for q in range(n_around):
                ring[sides[q, 0]] += faces[q]
                ring[sides[q, 1]] += faces[q]
                total += faces[q]
            d = float(n_around)
            total[:] = (total / d + 2.0 * mean + (d - 3.0) * centre) / d
            ring[:] = 0.5 * middle + 0.25 * ring
        centre[:] = smooth * total + crease * (0.75 * centre + 0.125 * curve) + (1.0 - smooth - crease) * centre
        for e in range(n_edges):
            keep = min(sharpness[e], 1.0)
            ends[e] = keep * middle[e] + (1.0 - keep) * ring[e]
            sharpness[e] = after_step(sharpness[e])
        corner = after_step(corner)

    total[:] = 0.0
    for e in range(n_edges):
        total += ends[e]
    if is_loop:
        share = limit_weight(n_edges)
        total[:] = (1.0 - n_edges * share) * centre + share * total
    else:
        d = float(n_around)
        total[:] = 4.0 * total + d * d * centre
        for q in range(n_around):
            total += faces[q]
        total /= d * (d + 5.0)
    out[:] = smooth * total + crease * (4.0 * centre + curve) / 6.0 + (1.0 - smooth - crease) * centre


@kernel
def limits_where_fading(
    vertices: F64, indices: I64, of_corner: I64, edges: F64, corners: F64, fading: I64, begin: I64, corner_of: I64,
    size: int, out: F64,
) -> None:  # fmt: skip
    """Limit positions of some vertices; the faces around a vertex decide where it ends up.

    Parameters
    ----------
    of_corner : (n_corners,)
        Edge from each corner to the next.
    fading : (m,)
        The vertices.
    begin, corner_of : (m + 1,), (n,)
        Corners of each: ``corner_of[begin[i] : begin[i + 1]]``.
    size
        Corners of every face: 4, or 3 for Loop's scheme.
    out : (n_vertices, k)
        Their rows are written.
    """
    width = vertices.shape[1]
    for i in range(len(fading)):
        v = fading[i]
        n_around = begin[i + 1] - begin[i]
        known = np.empty(2 * n_around, np.int64)
        ends, faces = np.empty((2 * n_around, width)), np.empty((n_around, width))
        sides = np.empty((n_around, 2), np.int64)
        n_edges = 0
        for q in range(n_around):
            c = corner_of[begin[i] + q]
            first, place = c - c % size, c % size
            ahead, behind = first + (place + 1) % size, first + (place + size - 1) % size
            faces[q] = vertices[indices[first + (place + 2) % size]]
            for side, edge, other in ((0, of_corner[c], indices[ahead]), (1, of_corner[behind], indices[behind])):
                slot = 0
                while slot < n_edges and known[slot] != edge:
                    slot += 1
                if slot == n_edges:
                    known[slot] = edge
                    ends[slot] = vertices[other]
                    n_edges += 1
                sides[q, side] = slot
        rows = known[:n_edges]
        _limit_of_ring(vertices[v].copy(), ends[:n_edges], faces, edges[rows], sides, corners[v], size == 3, out[v])


@kernel
def _root(parent: I64, c: int) -> int:
    while parent[c] != c:
        c = parent[c]
    return c


@kernel
def group_corners(
    starts: I64, indices: I64, of_corner: I64, n_vertices: int, splits: NDArray[np.bool_], group: I64
) -> int:
    """Number the corners of polygons: those of one vertex share a number unless splitting edges part them.

    Parameters
    ----------
    splits : (n_edges,)
    group : (n_corners,) out

    Returns
    -------
    int
        How many numbers there are.
    """
    n = len(indices)
    behind = np.empty(n, np.int64)
    is_split = np.zeros(n_vertices, np.bool_)
    for f in range(len(starts) - 1):
        for c in range(starts[f], starts[f + 1]):
            behind[c] = c - 1 if c > starts[f] else starts[f + 1] - 1
            if splits[of_corner[c]] or splits[of_corner[behind[c]]]:
                is_split[indices[c]] = True
    of_vertex = np.full(n_vertices, -1, np.int64)
    at_end = np.full((len(splits), 2), -1, np.int64)  # a corner at one and at the other end of each edge
    parent = np.arange(n)
    for c in range(n):
        v = indices[c]
        if not is_split[v]:
            if of_vertex[v] < 0:
                of_vertex[v] = c
            parent[c] = of_vertex[v]
            continue
        # The edges ahead of a corner and of the one behind it are the two at its vertex.
        for edge in (of_corner[c], of_corner[behind[c]]):
            if splits[edge]:
                continue
            end = 0 if at_end[edge, 0] < 0 or indices[at_end[edge, 0]] == v else 1
            if at_end[edge, end] < 0:
                at_end[edge, end] = c
            a, b = _root(parent, c), _root(parent, at_end[edge, end])
            parent[max(a, b)] = min(a, b)
    n_groups = 0
    for c in range(n):
        root = _root(parent, c)
        if root == c:
            group[c] = n_groups
            n_groups += 1
        else:
            group[c] = group[root]
    return n_groups
