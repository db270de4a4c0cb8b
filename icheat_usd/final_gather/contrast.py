"""Pixels whose cached light changes so fast that a few camera samples do not tell their mean: contacts, narrow gaps."""

from __future__ import annotations

import numpy as np

from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Places
from icheat_usd.scene import F32, I32, I64

#: Difference of two pixels, over the brighter one, from which both deserve more samples.
TOLERANCE = 0.15

_DARK = 0.01  # of the mean irradiance: differences below do not show
_AT_ONCE = 1 << 17


def light_edges(cache: IrradianceCache, places: Places, pixel: I32, width: int, n_pixels: int) -> I64:
    """Pixels whose irradiance differs from that of a neighbour, or within themselves.

    Edits play no part: what is sampled is the same under all of them.

    Parameters
    ----------
    places : of m view samples
    pixel : (m,)
        Their pixels, row-major in an image of `n_pixels`, `width` wide.

    Returns
    -------
    (n,) int64, ascending
    """
    light = np.empty(len(pixel), np.float32)
    for begin in range(0, len(pixel), _AT_ONCE):
        some = places.take(np.arange(begin, min(begin + _AT_ONCE, len(pixel))))
        found = cache.find(some)
        values = cache.interpolate(found, some.points.position, some.points.shading_normal)
        # Places without records are gathered by themselves, and look like nothing else.
        light[begin : begin + len(values)] = np.where(found.number > 0, np.maximum(values, 0).sum(axis=1), np.nan)
    known = np.isfinite(light)
    floor = _DARK * float(light[known].mean()) if known.any() else 0.0
    least, most = _range(light[known], pixel[known], n_pixels)
    low, high = (image.reshape(-1, width) for image in (least, most))
    edge = _differ(low, high, floor)
    for axis in (0, 1):
        first = tuple(slice(None, -1) if a == axis else slice(None) for a in (0, 1))
        second = tuple(slice(1, None) if a == axis else slice(None) for a in (0, 1))
        apart = _differ(np.minimum(low[first], low[second]), np.maximum(high[first], high[second]), floor)
        edge[first] |= apart
        edge[second] |= apart
    flat = edge.reshape(-1)
    flat[pixel[~known]] = True
    return np.flatnonzero(flat)


def _range(light: F32, pixel: I32, n_pixels: int) -> tuple[F32, F32]:
    """Least and most light of each pixel, (n_pixels,) each; inf and -inf where nothing is seen."""
    least, most = np.full(n_pixels, np.inf, np.float32), np.full(n_pixels, -np.inf, np.float32)
    np.minimum.at(least, pixel, light)
    np.maximum.at(most, pixel, light)
    return least, most


def _differ(low: F32, high: F32, floor: float) -> np.ndarray:
    """Where the highest of some values is too far above the lowest; never where there are none."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.isfinite(high) & np.isfinite(low) & (high - low > TOLERANCE * (high + floor)))
