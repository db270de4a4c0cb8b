"""Indirect light, and all reflected light, from Mitsuba's path tracer."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

from icheat_usd.scene import F64, SceneSnapshot
from tools.peers import mitsuba_peer as peer

#: Depth at which paths may be ended at random: Mitsuba's own default.
_ROULETTE = 5

#: Paths in flight: more would not be faster, and take memory.
_PATHS_AT_ONCE = 5_000_000


def _samples_at_once(variant: str, n_pixels: int) -> int:
    """One where a pixel's samples share one stream of random numbers: after the first, shorter paths get others."""
    return max(1, _PATHS_AT_ONCE // n_pixels) if variant.startswith("llvm") else 1


class Layers(NamedTuple):
    """One render."""

    indirect: F64  #: (height, width, 3)
    whole: F64  #: direct and indirect, without sources that the camera sees
    seconds: float  #: of the render of all light; what is taken away from it is not timed


class MitsubaLayers:
    """A scene in Mitsuba, ready to be rendered with passes of so many samples.

    Light of sources and direct light are rendered with the same random numbers as all light, and subtracted. Paths
    are the same up to where the shorter ones end, so that what is left has the noise of indirect light alone, as from
    an integrator that leaves them out.
    """

    def __init__(self, snapshot: SceneSnapshot, depth: int, variant: str) -> None:
        self.mi: Any = peer.load(variant)
        self.variant: str = self.mi.variant()
        self.snapshot = snapshot
        self.most_samples = _samples_at_once(self.variant, snapshot.camera.width * snapshot.camera.height)
        self._scene = peer.mitsuba_scene(self.mi, snapshot)
        self._depth = depth

    def warm(self, passes: list[int]) -> float:
        """Seconds that the first renders of each size take over the second: what compiling costs."""
        seconds = [sum(self._all_light(n, 0)[1] for n in passes) for _ in range(2)]
        return max(seconds[0] - seconds[1], 0.0)

    def layers(self, samples: int, seed: int) -> Layers:
        """One pass of `samples` per pixel, at most `most_samples`."""
        image, seconds = self._all_light(samples, seed)
        sources, direct = (self._render(depth, samples, seed) for depth in (peer.EMISSION, peer.DIRECT))
        return Layers(image - direct, image - sources, seconds)

    def _all_light(self, samples: int, seed: int) -> tuple[F64, float]:
        start = time.perf_counter()
        image = self._render(self._depth, samples, seed)
        return image, time.perf_counter() - start

    def _render(self, depth: int, samples: int, seed: int) -> F64:
        return peer.render(
            self.mi, self._scene, self.snapshot, depth=depth, samples=samples, seed=seed, roulette=_ROULETTE
        )
