"""How far an image is from its reference; sums are taken in float64 over all pixels and channels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Metric = Callable[[Array, Array], float]


def mean_ratio(image: Array, reference: Array) -> float:
    """Mean of the image over the mean of the reference; 1 is no bias. Two black images have ratio 1."""
    image, reference = _pair(image, reference)
    return _ratio(float(image.mean()), float(reference.mean()), equal=1.0)


def rel_l2(image: Array, reference: Array) -> float:
    """Root-mean-square error over root-mean-square reference: ``|I - R|_2 / |R|_2``; 0 is equal."""
    image, reference = _pair(image, reference)
    return _ratio(float(np.linalg.norm(image - reference)), float(np.linalg.norm(reference)), equal=0.0)


def rel_mse(image: Array, reference: Array, epsilon: float = 1e-2) -> float:
    """Mean of ``(I - R)^2 / (R^2 + epsilon)``; `epsilon` keeps dark pixels from deciding alone.

    References
    ----------
    .. [1] Rousselle, Knaus, Zwicker, Adaptive Sampling and Reconstruction using Greedy Error Minimization,
       SIGGRAPH Asia 2011, section 6: epsilon 1e-2.
    """
    image, reference = _pair(image, reference)
    return float(np.mean((image - reference) ** 2 / (reference**2 + epsilon)))


def smape(image: Array, reference: Array) -> float:
    """Symmetric mean absolute error, the mean of ``2 |I - R| / (|I| + |R|)``, in [0, 2]; where both are 0 it is 0."""
    image, reference = _pair(image, reference)
    total = np.abs(image) + np.abs(reference)
    return float(np.mean(2.0 * np.abs(image - reference) / np.where(total == 0.0, 1.0, total)))


def max_abs(image: Array, reference: Array) -> float:
    """Largest absolute difference of any channel of any pixel."""
    image, reference = _pair(image, reference)
    return float(np.abs(image - reference).max())


def percentile_abs(image: Array, reference: Array, percent: float = 99.9) -> float:
    """The absolute difference that `percent` % of the values do not exceed; like `max_abs`, but deaf to a few."""
    image, reference = _pair(image, reference)
    return float(np.percentile(np.abs(image - reference), percent))


def edit_error(
    edited: Array, unedited: Array, reference_edited: Array, reference_unedited: Array, metric: Metric = rel_l2
) -> float:
    """A metric of the *change* an edit makes: ``I' - I`` against ``R' - R``.

    A wrong edit hides in a good score of the full image: one that changes it by 5 % and is lost altogether costs 5 %.
    """
    change, reference = _pair(edited, unedited), _pair(reference_edited, reference_unedited)
    return metric(change[0] - change[1], reference[0] - reference[1])


def _pair(image: Array, reference: Array) -> tuple[Array, Array]:
    image, reference = np.asarray(image, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if image.shape != reference.shape or image.size == 0:
        raise ValueError(f"images of shape {image.shape} and {reference.shape} cannot be compared")
    return image, reference


def _ratio(above: float, below: float, equal: float) -> float:
    if below == 0.0:
        return equal if above == 0.0 else float("inf")
    return above / below
