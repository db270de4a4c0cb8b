"""Whether two renderers agree within their own noise, told from independent renders of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Agreement:
    """Comparison of the means of two sets of renders.

    `pixels` and `blocks` are the mean of z^2, z being a difference over the
    standard error that the spread of the renders predicts. Renderers with the
    same expectation give 1 (a little more, as the spread is an estimate);
    pixels see errors of any shape, blocks of 4 x 4 pixels see smooth ones
    four times sharper.
    """

    ratio: Array  #: (3,) mean of ours over mean of theirs
    error: Array  #: (3,) its standard error
    pixels: float
    blocks: float

    def __str__(self) -> str:
        ratio = " ".join(f"{x:.4f}" for x in self.ratio)
        return f"ratio {ratio} +- {self.error.max():.4f}  z2 pixels {self.pixels:.2f} blocks {self.blocks:.2f}"


def block_means(image: ArrayLike, size: int = 4) -> Array:
    """Means of `size` x `size` pixels of (..., h, w, 3); incomplete blocks are left out."""
    image = np.asarray(image, float)
    *lead, h, w, c = image.shape
    cut = image[..., : h // size * size, : w // size * size, :]
    return cut.reshape(*lead, h // size, size, w // size, size, c).mean(axis=(-4, -2))


def compare(ours: Sequence[ArrayLike], theirs: Sequence[ArrayLike], *, tolerance: float = 0.0) -> Agreement:
    """Compare renders (k, h, w, 3) and (m, h, w, 3) that differ by their seeds.

    `tolerance` is a known systematic difference of single pixels and blocks,
    as a share of the mean image, which z allows for on top of the noise.
    """
    a, b = np.asarray(ours, float), np.asarray(theirs, float)
    mean_a, mean_b = a.mean(axis=(0, 1, 2)), b.mean(axis=(0, 1, 2))
    spread = [x.mean(axis=(1, 2)).std(axis=0, ddof=1) / np.sqrt(len(x)) / x.mean(axis=(0, 1, 2)) for x in (a, b)]
    return Agreement(
        mean_a / mean_b,
        mean_a / mean_b * np.hypot(*spread),
        _mean_square_z(a, b, tolerance),
        _mean_square_z(block_means(a), block_means(b), tolerance),
    )


def _mean_square_z(a: Array, b: Array, tolerance: float) -> float:
    difference = a.mean(axis=0) - b.mean(axis=0)
    variance = a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b)
    # A variance from a few renders is a poor divisor; the neighbours' noise is much the same.
    variance = _over_neighbours(variance) + (tolerance * b.mean(axis=0)) ** 2
    seen = variance > 0
    return float((difference[seen] ** 2 / variance[seen]).mean())


def _over_neighbours(image: Array) -> Array:
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), mode="edge")
    h, w = image.shape[:2]
    return np.mean([padded[y : y + h, x : x + w] for y in range(3) for x in range(3)], axis=0)
