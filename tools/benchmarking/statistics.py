"""Errors against a reference that is itself noisy, without the reference's noise in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.scene import F32, F64


class RelativeError(NamedTuple):
    """Root mean square error over root mean square reference, over pixels and channels."""

    rms: float  #: the reference's noise is not in it; 0 where the square came out below 0
    standard_error: float  #: of `rms`, from the spread over the pixels
    plain: float  #: against the mean of the halves: the reference's noise counts as error
    noise: float  #: of the mean of the reference's halves
    largest: float  #: largest pixel, over the root mean square reference; noise of the reference is in it
    percentile_99: float  #: the pixel that 99 % do not exceed, the same way

    def as_dict(self) -> dict[str, float]:
        return {name: float(value) for name, value in self._asdict().items()}


def relative_error(image: F32, half_a: F32, half_b: F32) -> RelativeError:
    """Error of an image against two independent, unbiased estimates of its reference.

    Parameters
    ----------
    image, half_a, half_b : (n_pixels, 3)

    Notes
    -----
    With independent noise, the mean of ``(I - A) (I - B)`` is that of ``(I - R)^2``, and the mean of ``A B``
    that of ``R^2``: what a single reference adds to the squares, its variance, cancels.
    """
    return relative_error_of_halves(image, image, half_a, half_b)


def relative_error_of_halves(image_a: F32, image_b: F32, half_a: F32, half_b: F32) -> RelativeError:
    """As `relative_error`, for an image that is known by two independent estimates of its own.

    Notes
    -----
    The noise of `image_a` must be independent of `image_b` and `half_b`, and that of `image_b` of `half_a`.
    """
    off_a, off_b = _wide(image_a) - _wide(half_a), _wide(image_b) - _wide(half_b)
    squares = (off_a * off_b).sum(axis=1)
    energy = (_wide(half_a) * _wide(half_b)).sum(axis=1)
    plain = ((off_a + off_b) / 2) ** 2
    reference_noise = ((_wide(half_a) - _wide(half_b)) / 2) ** 2
    mean_energy = energy.mean()
    if mean_energy <= 0:
        # No light: any light at all is an error without bound.
        off = float(np.sqrt(plain.sum(axis=1).mean()))
        worst = 0.0 if off == 0 else float("inf")
        return RelativeError(worst, 0.0, worst, 0.0, worst, worst)
    share = squares.mean() / mean_energy
    rms = float(np.sqrt(max(share, 0.0)))
    # Delta method for the ratio of two means over pixels.
    spread = float(np.std(squares - share * energy) / np.sqrt(len(squares)) / mean_energy)
    root = float(np.sqrt(mean_energy))
    pixel = np.sqrt(plain.sum(axis=1)) / root
    return RelativeError(
        rms,
        spread / (2 * rms) if rms > 0 else float(np.sqrt(spread)),
        float(np.sqrt(plain.sum(axis=1).mean())) / root,
        float(np.sqrt(reference_noise.sum(axis=1).mean())) / root,
        float(pixel.max()),
        float(np.percentile(pixel, 99)),
    )


def relative_difference(image: F32, reference: F32) -> RelativeError:
    """As `relative_error`, against a reference without noise."""
    return relative_error(image, reference, reference)


def smoothed(image: F64, reach: int = 2) -> F64:
    """Mean over squares of `reach` pixels to either side, at the border over what there is of them.

    Parameters
    ----------
    image : (height, width, ...)
    """
    for axis in (0, 1):
        n = image.shape[axis]
        total = np.concatenate([np.zeros_like(image.take([0], axis)), np.cumsum(image, axis)], axis)
        low, high = np.maximum(np.arange(n) - reach, 0), np.minimum(np.arange(n) + reach + 1, n)
        count = (high - low).reshape([-1 if k == axis else 1 for k in range(image.ndim)])
        image = (total.take(high, axis) - total.take(low, axis)) / count
    return image


def _wide(values: F32) -> F64:
    return np.asarray(values, np.float64)
