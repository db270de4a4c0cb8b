"""View samples: the visible points whose indirect light is shown."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.scene import F32, I32, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer


@dataclass(frozen=True)
class ViewSamples:
    """First non-delta vertices of camera paths; zero to many per pixel.

    The image is ``background + sum over the samples of a pixel of throughput * radiance``,
    radiance being what a sample sends along `to_eye`.
    """

    width: int
    height: int
    samples_per_pixel: int
    pixel: I32  #: (n,) row-major from the top left, ascending
    throughput: F32  #: (n, 3) of the delta vertices before it; 1 / samples_per_pixel is in it
    points: SurfacePoints  #: (n,)
    to_eye: F32  #: (n, 3) unit, back along the last segment of the path
    depth: F32  #: (n,) length of the path from the eye, metres
    background: F32  #: (width * height, 3) radiance of the paths that left the scene, already weighted

    @property
    def n(self) -> int:
        return len(self.pixel)


def view_samples(
    snapshot: SceneSnapshot, tracer: Tracer, *, samples_per_pixel: int = 1, seed: int = 0, max_splits: int = 2
) -> ViewSamples:
    """Trace the camera's rays to the points that it sees."""
    raise NotImplementedError
