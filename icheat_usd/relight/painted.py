"""Where on a painted mask points lie, so that a dab finds the points that it touches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icheat_usd.edits.masks import texel_weights
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.kernels.texels import touched_places
from icheat_usd.scene import F32, I64, Bool, SurfacePoints


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

    def touched(self, changed: Bool) -> I64:
        """Places in the sorted points whose weight depends on `changed` texels (n_faces, resolution, resolution)."""
        faces = np.flatnonzero(changed.any(axis=(1, 2)))
        parts = [np.arange(self._begin[face], self._begin[face + 1]) for face in faces]
        places = np.concatenate([np.empty(0, np.int64), *parts])
        found = np.zeros(len(places), np.bool_)
        touched_places(places, self._row, self._uv, changed, found)
        return places[found]

    def weights(self, places: I64, texels: F32) -> tuple[I64, F32]:
        """The points at some of the places and their weights under the mask; ascending points."""
        points = self._points[places]
        weights = self._unpainted[points] * texel_weights(texels, self._row[places], self._uv[places])
        order = np.argsort(points, kind="stable")
        return points[order], weights[order]
