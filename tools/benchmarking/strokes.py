"""Dabs of a brush of 40 pixels, as someone paints a receiver mask."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.model import EditStack, SurfaceMask
from icheat_usd.edits.painting import paint_mask, soft_sphere
from tools.benchmarking.made_up_edits import one_edit, painted, ranked_paths
from tools.benchmarking.parts import Parts

_PIXELS = 40  # across


class Stroke:
    """An edit with a painted mask, and dabs along a line over the surface that is seen most."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        seen, sending = ranked_paths(parts)
        self._paths = seen[:1]
        self._centres, self._radius = _path(parts, seen[0])
        edit = one_edit("stroke", "scale", {"gain": 2.0, "color": (1.0, 0.7, 0.5)}, seen[:1], sending[:3])
        edit = painted(parts, edit, "receiver_mask", self._centres[0], self._radius)
        self.stack = EditStack("/Stroke", (edit,))
        #: what each dab adds, made beforehand: the brush is no part of the frame
        self._masks = [self._mask(i) for i in range(len(self._centres))]

    def dab(self, i: int) -> None:
        """The mask as it is after dab i."""
        self._parts.live.dab("/stroke", "receivers", self._masks[i % len(self._masks)])

    def _mask(self, i: int) -> SurfaceMask:
        """All dabs up to number i."""
        some = self._centres[: i + 1]

        def brush(positions: np.ndarray) -> np.ndarray:
            weight = np.zeros(len(positions), np.float32)
            for centre in some:
                dab = soft_sphere(tuple(float(x) for x in centre), 0.5 * self._radius, self._radius)
                weight = np.maximum(weight, dab(positions))
            return weight

        return paint_mask(self._parts.snapshot, self._paths, brush)


def _path(parts: Parts, path: str) -> tuple[np.ndarray, float]:
    """Places on a surface along a line of pixels, and the radius there of a brush of 40 pixels."""
    view, snapshot = parts.view, parts.snapshot
    rows = [i for i, surface in enumerate(snapshot.surfaces) if surface.path == path]
    on = np.flatnonzero(np.isin(snapshot.geometry.instance_surface[view.points.instance], rows))
    x, y = view.pixel[on] % view.width, view.pixel[on] // view.width
    middle = np.argmin(np.hypot(x - np.median(x), y - np.median(y)))
    near = on[np.argsort(np.abs(y - y[middle]) * view.width + np.abs(x - x[middle]))][: max(24, view.width // 4)]
    along = near[np.argsort(view.pixel[near] % view.width)]
    chosen = along[np.linspace(0, len(along) - 1, 24).astype(int)]
    left, right = snapshot.camera.window[:2]
    pixel = (right - left) / view.width * float(np.median(view.depth[chosen]))
    return view.points.position[chosen].astype(np.float64), _PIXELS / 2 * pixel
