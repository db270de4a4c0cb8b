"""How far a render is from its reference, without what the reference's own noise would add."""

from __future__ import annotations

from typing import Any

import numpy as np

from icheat_usd.scene import F64, Bool
from tools.benchmarking.references import Reference
from tools.benchmarking.statistics import smoothed

#: Share of the pixels that a trimmed error leaves out.
TRIMMED = 0.001

#: Keeps dark pixels from deciding alone, as a share of the mean reference, squared.
_EPSILON = 0.01


def squared_errors(image: F64, half_a: F64, half_b: F64) -> F64:
    """Relative squared error of every pixel, mean over channels, (height, width); single ones may be below 0.

    Parameters
    ----------
    image, half_a, half_b : (height, width, 3)

    Notes
    -----
    ``(I - A) (I - B) / (S^2 + 0.01 mean(S)^2)`` with S the mean of the halves A and B, smoothed over 5 x 5 pixels. The
    mean of the product is that of ``(I - R)^2`` for R without noise, if the weight does not know the pixel's own
    noise: not smoothed, exact images had an error of 6 s^4, s^2 being the relative variance of (A + B) / 2.
    """
    smooth = smoothed((half_a + half_b) / 2)
    weight = 1 / (smooth**2 + _EPSILON * smooth.mean() ** 2)
    return np.asarray(((image - half_a) * (image - half_b) * weight).mean(axis=2))


def rel_mse(squares: F64) -> float:
    """Relative mean square error of n pixels from `squared_errors`."""
    return float(squares.mean())


def trimmed_rel_mse(squares: F64, share: float = TRIMMED) -> float:
    """The same without the `share` of pixels that is farthest from 0, to either side.

    Taken on one side alone, what is left of the reference's noise would pull the mean below the error.
    """
    kept = len(squares) - int(np.ceil(share * len(squares)))
    return float(squares[np.argpartition(np.abs(squares), kept - 1)[:kept]].mean())


def flip(image: F64, reference: F64) -> float | None:
    """Mean HDR-FLIP of two scene-linear images (height, width, 3); None without the package `flip-evaluator`.

    References
    ----------
    .. [1] Andersson et al., Visualizing Errors in Rendered High Dynamic Range Images, Eurographics 2021.
    """
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return None
    pair = [np.ascontiguousarray(np.maximum(x, 0), np.float32) for x in (reference, image)]
    return float(evaluate(*pair, "HDR", applyMagma=False)[1])


def errors(indirect: F64, whole: F64, reference: Reference, seen: Bool) -> dict[str, Any]:
    """What tables and curves show of one render.

    Parameters
    ----------
    indirect, whole : (height, width, 3) float64
    seen : (height, width) bool
        Pixels that show a surface; only these count.
    """
    squares = squared_errors(indirect, *reference.indirect)[seen]
    mean = (reference.indirect[0] + reference.indirect[1]) / 2
    return {
        "rel_mse": rel_mse(squares),
        "rel_mse_trimmed": trimmed_rel_mse(squares),
        "standard_error": float(squares.std() / np.sqrt(len(squares))),
        "mean_ratio": float(indirect[seen].mean() / mean[seen].mean()),
        "flip": flip(whole, (reference.whole[0] + reference.whole[1]) / 2),
    }
