"""Light that the camera sees by itself, the sky and glowing surfaces, while lights are changed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.samples.view import sky_behind
from icheat_usd.scene import F32, LightKind, SceneSnapshot
from icheat_usd.session.content_keys import light_digest


class SeenLight:
    """What a view shows of domes and of meshes that glow, apart from what they light.

    Parameters
    ----------
    snapshot, view
        As the stage says.
    """

    def __init__(self, snapshot: SceneSnapshot, view: ViewSamples) -> None:
        self._snapshot, self._own = snapshot, view
        self._key = self._key_of(snapshot, (0,) * len(snapshot.light_paths))
        self._known = self._key
        self.view = view  #: with the sky and the glow as they are now
        self.difference: F32 | None = None  #: (height, width, 3) that they add to the stage's own; None is none

    def update(self, now: SceneSnapshot, images: Sequence[int]) -> None:
        """Look at lights that may have changed.

        Parameters
        ----------
        now, images
            `LiveLights.snapshot` and `LiveLights.images`.
        """
        key = self._key_of(now, images)
        if key == self._known:
            return
        self._known = key
        if key == self._key:
            self.view, self.difference = self._own, None
            return
        own = self._own
        glow = self._glow(now)
        background = sky_behind(now, own.sky, own.width * own.height)
        self.view = replace(own, background=background, points=own.points._replace(emission=glow))
        before = own.background + develop(own, own.points.emission)
        after = background + develop(own, glow)
        self.difference = (after - before).astype(np.float32).reshape(own.height, own.width, 3)

    def _glow(self, now: SceneSnapshot) -> F32:
        """Emission of the view samples, (n_view, 3)."""
        points, geometry = self._own.points, self._snapshot.geometry
        emission = points.emission
        surface = geometry.instance_surface[points.instance]
        own = self._snapshot.lights
        for row in np.flatnonzero(own.kind == LightKind.MESH):
            was, becomes = own.radiance[row], now.lights.radiance[row]
            if not np.array_equal(was, becomes):
                factor = np.divide(becomes, was, out=np.zeros(3, np.float32), where=was > 0)
                emission = np.where((surface == own.surface[row])[:, None], emission * factor, emission)
        return np.ascontiguousarray(emission, np.float32)

    @staticmethod
    def _key_of(now: SceneSnapshot, images: Sequence[int]) -> tuple[tuple[str, int], ...]:
        """What the lights that are seen are; images are told apart by their numbers, as rows are used again."""
        lights = now.lights
        seen = np.flatnonzero(np.isin(lights.kind, (LightKind.DOME, LightKind.MESH))).tolist()
        return tuple((light_digest(lights, row), images[row]) for row in seen)
