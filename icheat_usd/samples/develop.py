"""From view samples to pixels."""

from __future__ import annotations

import numpy as np

from icheat_usd.samples.view import ViewSamples
from icheat_usd.scene import F32, F64


def develop(view: ViewSamples, radiance: F32) -> F64:
    """Sum what the view samples send to the eye into pixels.

    Parameters
    ----------
    radiance : (n_view, 3) float32, scene-linear

    Returns
    -------
    (height, width, 3) float64
        Summed serially in the order of the samples.
    """
    seen = view.throughput * radiance
    n = view.width * view.height
    channels = [np.bincount(view.pixel, seen[:, channel], n) for channel in range(3)]
    return np.stack(channels, axis=1).reshape(view.height, view.width, 3)


def average(view: ViewSamples, values: F32) -> F64:
    """Mean of an attribute (n_view, k) over each pixel's view samples, 0 where there are none: (height, width, k)."""
    n = view.width * view.height
    counts = np.maximum(np.bincount(view.pixel, minlength=n), 1)
    channels = [np.bincount(view.pixel, values[:, channel], n) / counts for channel in range(values.shape[1])]
    return np.stack(channels, axis=1).reshape(view.height, view.width, -1)
