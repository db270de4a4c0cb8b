"""Points by where they lie, so that a selection costs the points on its surfaces and a dab those that it touches."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakValueDictionary

import numpy as np

from icheat_usd.edits.masks import texel_weights
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.kernels.texels import touched_places
from icheat_usd.scene import F32, I64, SurfacePoints


class PointsByInstance:
    """The points of one sample set, sorted by the instance that they lie on."""

    def __init__(self, points: SurfacePoints) -> None:
        self.points = points
        self._order = np.argsort(points.instance, kind="stable").astype(np.int64)
        n_instances = int(points.instance.max(initial=-1)) + 1
        self._begin = np.searchsorted(points.instance[self._order], np.arange(n_instances + 1))
        # Edits of the same surfaces share them while one of them is shown.
        self._found: WeakValueDictionary[bytes, I64] = WeakValueDictionary()

    def on(self, on_instances: F32) -> I64:
        """Points, ascending, on instances whose weight (n_instances,) is not 0; not to be written to."""
        some = np.flatnonzero(on_instances[: len(self._begin) - 1])
        found = self._found.get(some.tobytes())
        if found is None:
            self._found[some.tobytes()] = found = self._on(some)
        return found

    def _on(self, some: I64) -> I64:
        parts = [self._order[self._begin[i] : self._begin[i + 1]] for i in some]
        parts = [part for part in parts if len(part)]
        if len(parts) < 2:
            return parts[0] if parts else np.empty(0, np.int64)
        return np.sort(np.concatenate(parts))


class PaintedPoints:
    """Points that one side of an edit may touch, sorted by the face that its mask has texels for."""

    def __init__(self, selection: BoundSelection, points: SurfacePoints) -> None:
        assert selection.mask is not None
        #: (n,) weights but for the mask
        self._unpainted = replace(selection, mask=None).at(points)
        instance = np.maximum(points.instance, 0)
        first = np.where(points.instance >= 0, selection.mask.first_face[instance], -1)
        here = np.flatnonzero((first >= 0) & (self._unpainted != 0))
        row = first[here] + points.face[here]
        order = np.argsort(row, kind="stable")
        self._points = here[order].astype(np.int64)
        self._row = row[order].astype(np.int64)
        self._uv = np.ascontiguousarray(points.face_uv[self._points])
        self._begin = np.searchsorted(self._row, np.arange(len(selection.mask.texels) + 1)).astype(np.int64)

    def repainted(self, before: F32, now: F32) -> tuple[I64, F32]:
        """Points, ascending, whose weight depends on texels that differ, and their weights now.

        Parameters
        ----------
        before, now : (n_faces, resolution, resolution)
        """
        changed = before != now
        faces = np.flatnonzero(changed.any(axis=(1, 2)))
        parts = [np.arange(self._begin[face], self._begin[face + 1]) for face in faces]
        places = np.concatenate([np.empty(0, np.int64), *parts])
        touched = np.zeros(len(places), np.bool_)
        touched_places(places, self._row, self._uv, changed, touched)
        places = places[touched]
        points = np.take(self._points, places)
        weights = self._unpainted[points] * texel_weights(now, np.take(self._row, places), self._uv[places])
        order = np.argsort(points, kind="stable")
        return points[order], weights[order]
