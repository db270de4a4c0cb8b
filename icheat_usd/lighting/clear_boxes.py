"""Few tight boxes around see-through triangles: what misses them all needs no look at glass and leaves."""

from __future__ import annotations

import numpy as np

from icheat_usd.scene import F32, F64, Bool, Geometry

_MOST_BOXES = 16
_MOST_PIECES = 4096  # boxes of a few triangles each that these are made of
_GAIN = 0.95  # of the surface: what a cut must leave of it at most
# A ray that meets a triangle meets its box, too: of the largest coordinate, more than tracers let triangles grow by.
_SLACK = 1e-4


def boxes_around(geometry: Geometry, kept: Bool, hidden: Bool | None = None) -> F32:
    """Boxes in world space around some triangles.

    Parameters
    ----------
    kept : (n_triangles,)
        Triangles that are meant, of every instance of their mesh.
    hidden : (n_instances,), optional
        Instances that are not.

    Returns
    -------
    (n, 6) float32
        Least and largest corner of each; at most 16.
    """
    pieces = _pieces(geometry, kept, hidden)
    if not len(pieces):
        return np.zeros((0, 6), np.float32)
    boxes = [pieces]
    while len(boxes) < _MOST_BOXES:
        # The largest one that can be cut with a gain.
        sizes = [float(_surface(_around(some))) for some in boxes]
        for k in np.argsort(sizes)[::-1]:
            parts = _cut(boxes[k])
            if parts is not None:
                boxes[k : k + 1] = parts
                break
        else:
            break
    found = np.stack([_around(some) for some in boxes])
    slack = _SLACK * np.abs(found).max()
    found[:, :3] -= slack
    found[:, 3:] += slack
    return found.astype(np.float32)


def _pieces(geometry: Geometry, kept: Bool, hidden: Bool | None) -> F64:
    """Boxes (n, 6) of a few triangles each, about `_MOST_PIECES` where these are many."""
    shown = np.ones(len(geometry.instance_mesh), np.bool_) if hidden is None else ~hidden
    uses = np.bincount(geometry.instance_mesh[shown], minlength=len(geometry.mesh_begin) - 1)
    of_meshes = np.add.reduceat(np.append(kept, False), geometry.mesh_begin[:-1]) * (np.diff(geometry.mesh_begin) > 0)
    at_once = max(1, int(np.sum(of_meshes * uses)) // _MOST_PIECES)
    boxes = [np.zeros((0, 6))]
    for mesh in np.flatnonzero((of_meshes > 0) & (uses > 0)):
        some = slice(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1])
        corners = geometry.points[some][kept[some]].astype(np.float64)
        begin = np.arange(0, len(corners), at_once)
        low, high = np.minimum.reduceat(corners.min(axis=1), begin), np.maximum.reduceat(corners.max(axis=1), begin)
        matrix = geometry.instance_to_world[shown & (geometry.instance_mesh == mesh)].astype(np.float64)
        # Half sizes grow by the sizes of a matrix's entries.
        middle = (low + high) / 2 @ matrix[:, :, :3].transpose(0, 2, 1) + matrix[:, None, :, 3]
        half = (high - low) / 2 @ np.abs(matrix[:, :, :3]).transpose(0, 2, 1)
        boxes.append(np.concatenate([middle - half, middle + half], axis=2).reshape(-1, 6))
    return np.concatenate(boxes)


def _around(boxes: F64) -> F64:
    return np.concatenate([boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)])


def _surface(boxes: F64) -> F64:
    size = boxes[..., 3:] - boxes[..., :3]
    x, y, z = np.moveaxis(size, -1, 0)
    found: F64 = x * y + y * z + z * x
    return found


def _cut(boxes: F64) -> list[F64] | None:
    """Boxes in two parts, around which boxes have the least surface; None if that is hardly less than before."""
    least, best = _GAIN * float(_surface(_around(boxes))), None
    for axis in range(3):
        order = np.argsort(boxes[:, axis] + boxes[:, 3 + axis], kind="stable")
        some = boxes[order]
        before, behind = (
            np.concatenate([np.minimum.accumulate(part[:, :3]), np.maximum.accumulate(part[:, 3:])], axis=1)
            for part in (some, some[::-1])
        )
        surface = _surface(before[:-1]) + _surface(behind[-2::-1])
        if len(surface) and surface.min() < least:
            least, first = float(surface.min()), int(surface.argmin()) + 1
            best = [some[:first], some[first:]]
    return best
