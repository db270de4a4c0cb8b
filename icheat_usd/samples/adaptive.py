"""Adaptive camera sampling: which pixels deserve more samples than a first pass gave them.

What is compared is what box-filtered antialiasing is for, edges of the
picture: which surface is seen, which way it faces, where it lies, what colour
it has. Light is not looked at, so that neither edits nor noise change what is sampled.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.kernels import adaptive
from icheat_usd.samples.view import ViewSamples
from icheat_usd.scene import F32, I32, I64, U8, Camera


class Tolerances(NamedTuple):
    """What two camera samples may differ in and still count as of one thing."""

    angle: float = 10.0  #: between shading normals, degrees
    off_plane: float = 1.0  #: distance of one from the other's plane, in widths of a pixel there
    colour: float = 0.05  #: of reflectance and emission, relative to the brighter one's largest channel


class PixelLooks(NamedTuple):
    """What the samples of each of n pixels show; bands of an image are looked over one by one and joined."""

    kind: U8  #: (n,) EMPTY, EVEN or MIXED, as in `kernels.adaptive`
    instance: I32  #: (n,) of the first view sample; any value where there is none
    seen: F32  #: (n, 16) what it sees, columns as in `kernels.adaptive`


def look_over(
    view: ViewSamples, camera: Camera, pixels: tuple[int, int] | None = None, tolerances: Tolerances | None = None
) -> PixelLooks:
    """Compare the samples of each pixel with each other.

    Parameters
    ----------
    pixels
        The first pixel and the one behind the last of what `view` was traced for; the whole image by default.
    """
    first, end = pixels or (0, view.width * view.height)
    begin = np.searchsorted(view.pixel, np.arange(first, end + 1, dtype=np.int64))
    escaped = np.bincount(view.sky.pixel - first, minlength=end - first)
    kind = np.empty(end - first, np.uint8)
    instance, seen = view.points.instance, _seen(view, camera)
    adaptive.kinds_of_pixels(instance, seen, begin, escaped, _limits(tolerances), kind)
    if view.n == 0:  # Then nothing will be compared.
        return PixelLooks(kind, np.zeros(end - first, np.int32), np.zeros((end - first, seen.shape[1]), np.float32))
    shown = np.minimum(begin[:-1], view.n - 1)
    return PixelLooks(kind, instance[shown], np.take(seen, shown, axis=0))


def _seen(view: ViewSamples, camera: Camera) -> F32:
    points = view.points
    width = (camera.window[1] - camera.window[0]) / camera.width
    seen = np.empty((view.n, adaptive.N_COLUMNS), np.float32)
    for begin, values in (
        (adaptive.POSITION, points.position),
        (adaptive.NORMAL, points.normal),
        (adaptive.SHADING_NORMAL, points.shading_normal),
        (adaptive.TINT, view.throughput * np.float32(view.samples_per_pixel) * (points.albedo + points.specular)),
        (adaptive.EMISSION, points.emission),
    ):
        seen[:, begin : begin + 3] = values
    seen[:, adaptive.REACH] = width if camera.orthographic else view.depth * width
    return seen


def join_looks(*bands: PixelLooks) -> PixelLooks:
    """Looks of an image from those of its bands, from top to bottom."""
    columns: list[Any] = [np.concatenate(column) for column in zip(*bands, strict=True)]
    return PixelLooks(*columns)


def edge_pixels(looks: PixelLooks, width: int, tolerances: Tolerances | None = None) -> I64:
    """Pixels of an image `width` wide whose samples show several things, or one that one of their neighbours does not.

    Returns
    -------
    (n,) int64, ascending
        Also the neighbours of pixels that hold several things, whose own part of the edge may have slipped between
        their samples. Pixels that show nothing but background are not looked at for its colours.
    """
    edge = np.empty(len(looks.kind), np.bool_)
    adaptive.edges(looks.instance, looks.seen, looks.kind, width, _limits(tolerances), edge)
    return np.flatnonzero(edge)


def needs_more(view: ViewSamples, camera: Camera, tolerances: Tolerances | None = None) -> I64:
    """Pixels of a whole image that a second pass should sample again, ascending (n,) int64: `edge_pixels`."""
    return edge_pixels(look_over(view, camera, None, tolerances), view.width, tolerances)


def _limits(tolerances: Tolerances | None) -> tuple[float, float, float]:
    angle, off_plane, colour = tolerances or Tolerances()
    return math.cos(math.radians(angle)), float(off_plane), float(colour)
