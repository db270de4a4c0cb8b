"""Scores of interpolation beside their formulas, written out in numpy."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.outliers import score_errors


def test_scores_are_the_weighted_squares_of_two_sets() -> None:
    rng = np.random.default_rng(5)
    wrong = rng.normal(0.2, 1, (300, 2, 17)).astype(np.float32)
    weight = rng.random(17, np.float32)
    sure, mean, noise = np.empty((3, 300))
    score_errors(wrong, weight, sure, mean, noise)
    one, two = wrong.astype(np.float64).transpose(1, 0, 2)
    least = np.where(np.sign(one) == np.sign(two), np.minimum(np.abs(one), np.abs(two)), 0)
    np.testing.assert_allclose(sure, least**2 @ weight, rtol=1e-12)
    np.testing.assert_allclose(mean, (one * two) @ weight, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(noise, (one - two) ** 2 @ weight / 2, rtol=1e-12)
