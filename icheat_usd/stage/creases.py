"""What a mesh prim says about sharp edges, sharp corners and the faces at its boundary."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from icheat_usd.scene import F64, I64
from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.subdivision import INFINITE, NO_CREASES, Creases, find_edges


def read_creases(mesh: UsdGeom.Mesh, time: Usd.TimeCode, counts: I64, indices: I64, report: Reporter) -> Creases:
    """Creases and corners of a mesh; what does not fit is left out with a finding.

    Parameters
    ----------
    counts, indices
        Its polygons.
    """
    edges, sharpness = _edges(mesh, time, indices, report)
    corners = _integers(mesh.GetCornerIndicesAttr(), time)
    sharpness_of_corners = _numbers(mesh.GetCornerSharpnessesAttr(), time)
    problem = ""
    if len(corners) != len(sharpness_of_corners):
        problem = f"there are {len(corners)} cornerIndices and {len(sharpness_of_corners)} cornerSharpnesses"
    elif not np.isin(corners, indices).all():
        problem = "cornerIndices name points that no face has"
    if problem:
        report(mesh.GetPrim(), "corners", f"{problem}; the surface is smooth there.")
        corners, sharpness_of_corners = NO_CREASES.corners, NO_CREASES.corner_sharpness
    if len(edges):
        there = find_edges(*_sides(counts, indices), edges) >= 0
        if not there.all():
            report(mesh.GetPrim(), "creases", f"{(~there).sum()} of their edges are none of the mesh's; left out.")
            edges, sharpness = edges[there], sharpness[there]
    return Creases(edges, sharpness, corners, sharpness_of_corners)


def _edges(mesh: UsdGeom.Mesh, time: Usd.TimeCode, indices: I64, report: Reporter) -> tuple[I64, F64]:
    vertices, lengths = _integers(mesh.GetCreaseIndicesAttr(), time), _integers(mesh.GetCreaseLengthsAttr(), time)
    sharpness = _numbers(mesh.GetCreaseSharpnessesAttr(), time)
    n_edges = int((lengths - 1).sum())
    problem = ""
    if len(lengths) and lengths.min() < 2:
        problem = "creaseLengths has a crease of fewer than 2 points"
    elif lengths.sum() != len(vertices):
        problem = f"creaseLengths sum to {lengths.sum()} and there are {len(vertices)} creaseIndices"
    elif len(sharpness) not in (len(lengths), n_edges):
        problem = (
            f"there are {len(sharpness)} creaseSharpnesses; {len(lengths)} (one per crease) or {n_edges} (one per "
            "edge) are expected"
        )
    elif not np.isin(vertices, indices).all():
        problem = "creaseIndices name points that no face has"
    if problem:
        report(mesh.GetPrim(), "creases", f"{problem}; the surface is smooth there.")
        return NO_CREASES.edges, NO_CREASES.sharpness
    is_last = np.zeros(len(vertices), np.bool_)
    is_last[np.cumsum(lengths) - 1] = True
    first = np.flatnonzero(~is_last)
    if len(sharpness) == len(lengths):
        sharpness = np.repeat(sharpness, lengths - 1)
    return np.stack([vertices[first], vertices[first + 1]], axis=1), sharpness


def faces_without_a_surface(counts: I64, indices: I64, creases: Creases) -> NDArray[np.bool_]:
    """(n_faces,) faces that only shape their neighbours, where ``interpolateBoundary`` is none.

    Those are the faces at boundary vertices, but not where all boundary edges there are creases that stay sharp.
    """
    lo, hi = _sides(counts, indices)
    n = int(indices.max()) + 1 if len(indices) else 0
    keys, per_edge = np.unique(lo * n + hi, return_counts=True)
    open_keys = keys[per_edge != 2]
    sharp = creases.edges[creases.sharpness >= INFINITE]
    loose = np.setdiff1d(open_keys, sharp.min(axis=1) * n + sharp.max(axis=1))
    at_loose_edges = np.zeros(n, np.bool_)
    at_loose_edges[loose // n] = at_loose_edges[loose % n] = True
    touched = np.zeros(len(counts), np.bool_)
    touched[np.repeat(np.arange(len(counts)), counts)[at_loose_edges[indices]]] = True
    return touched


def _sides(counts: I64, indices: I64) -> tuple[I64, I64]:
    """Lower and higher vertex of the side that starts at each corner."""
    starts = np.cumsum(counts) - counts
    following = np.arange(1, len(indices) + 1)
    following[(starts + counts - 1)[counts > 0]] = starts[counts > 0]
    return np.minimum(indices, indices[following]), np.maximum(indices, indices[following])


def _integers(attribute: Usd.Attribute, time: Usd.TimeCode) -> I64:
    return np.array(attribute.Get(time) or (), np.int64).reshape(-1)


def _numbers(attribute: Usd.Attribute, time: Usd.TimeCode) -> F64:
    """Sharpnesses; what is no number is 0."""
    values = np.array(attribute.Get(time) or (), np.float64).reshape(-1)
    return np.maximum(np.nan_to_num(values, nan=0.0, posinf=INFINITE), 0.0)
