"""From view samples to pixels."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.pixels import sum_samples
from icheat_usd.samples.view import ViewSamples
from icheat_usd.scene import F32, F64, I64

_NO_THROUGHPUT = np.empty((0, 3), np.float32)


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
        Summed in the order of the samples.
    """
    return _sums(view, view.throughput, radiance, pixels)[0]


def average(view: ViewSamples, values: F32, pixels: tuple[int, int] | I64 | None = None) -> F64:
    """Mean of an attribute (n_view, k) over each pixel's view samples, 0 where there are none: (n_pixels, k)."""
    sums, begin, place = _sums(view, _NO_THROUGHPUT, values, pixels)
    sums[place] /= np.diff(begin)[:, None]
    return sums


def _sums(
    view: ViewSamples, throughput: F32, values: F32, pixels: tuple[int, int] | I64 | None
) -> tuple[F64, I64, I64]:
    """Sums of the pixels; where the samples of each that has some begin, and which it is."""
    begin = np.flatnonzero(np.diff(view.pixel, prepend=-1, append=-1)) if view.n else np.zeros(1, np.int64)
    shown = view.pixel[begin[:-1]].astype(np.int64)
    if isinstance(pixels, np.ndarray):
        place, n = np.searchsorted(pixels, shown), len(pixels)
    else:
        first, end = pixels or (0, view.width * view.height)
        place, n = shown - first, end - first
    out = np.zeros((n, values.shape[1]))
    rows, weights = (np.require(x, np.float32, ["C", "W"]) for x in (values, throughput))
    sum_samples(begin, weights, rows, place, out)
    return out, begin, place
