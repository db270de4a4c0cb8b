"""From view samples to pixels."""

from __future__ import annotations

import numpy as np

from icheat_usd.samples.view import ViewSamples
from icheat_usd.scene import F32, F64, I32, I64


def develop(view: ViewSamples, radiance: F32, pixels: tuple[int, int] | I64 | None = None) -> F64:
    """Sum what the view samples send to the eye into pixels.

    Parameters
    ----------
    radiance : (n_view, 3) float32, scene-linear
    pixels : (first, behind the last) or (n_pixels,) int64, optional
        Part of the image, row-major, that holds all the samples, or an ascending list of such pixels; the whole
        image by default.

    Returns
    -------
    (n_pixels, 3) float64
        Summed serially in the order of the samples.
    """
    return _sums(view, view.throughput * radiance, pixels)


def average(view: ViewSamples, values: F32, pixels: tuple[int, int] | I64 | None = None) -> F64:
    """Mean of an attribute (n_view, k) over each pixel's view samples, 0 where there are none: (n_pixels, k)."""
    counts = _sums(view, np.ones((view.n, 1), np.float32), pixels)
    return _sums(view, values, pixels) / np.maximum(counts, 1)


def _sums(view: ViewSamples, values: F32, pixels: tuple[int, int] | I64 | None) -> F64:
    if isinstance(pixels, np.ndarray):
        place: I32 | I64 = np.searchsorted(pixels, view.pixel)
        n = len(pixels)
    else:
        first, end = pixels or (0, view.width * view.height)
        place, n = view.pixel - first, end - first
    # Of no samples at all, NumPy counts in whole numbers.
    return np.stack([np.bincount(place, column, n) for column in values.T], axis=1).astype(np.float64, copy=False)
