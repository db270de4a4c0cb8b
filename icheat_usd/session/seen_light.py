"""Light that the camera sees by itself, the sky and glowing surfaces, while lights are changed."""

from __future__ import annotations

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
        self._key = self._key_of(snapshot)
        self._known = self._key
        self.view = view  #: with the sky and the glow as they are now
        self.difference: F32 | None = None  #: (height, width, 3) that they add to the stage's own; None is none

    def update(self, now: SceneSnapshot) -> None:
        """Look at lights that may have changed."""
        key = self._key_of(now)
        if key == self._known:
            return
        self._known = key
        if key == self._key:
            self.view, self.difference = self._own, None
            return
        own = self._own
        glow = self._glow(now)
        background = own.background
        if own.sky is not None:
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

    def _key_of(self, now: SceneSnapshot) -> tuple[tuple[str, int], ...]:
        """What the lights that are seen are; new images are told apart by where their texels lie, not by their row."""
        lights, textures = now.lights, now.textures
        found = []
        for row in np.flatnonzero(np.isin(lights.kind, (LightKind.DOME, LightKind.MESH))).tolist():
            image, place = int(lights.texture[row]), -1
            if image >= len(self._snapshot.textures.begin):
                place = textures.texels.ctypes.data + int(textures.begin[image]) * textures.texels.strides[0]
            found.append((light_digest(lights, row), place))
        return tuple(found)
