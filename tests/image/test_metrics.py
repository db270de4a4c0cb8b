from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.image import metrics

IMAGE = np.array([[1.0, 2.0], [3.0, 0.0]], np.float32)
REFERENCE = np.array([[1.0, 1.0], [4.0, 0.0]], np.float32)


def test_metrics_have_the_values_worked_out_by_hand() -> None:
    assert metrics.mean_ratio(IMAGE, REFERENCE) == pytest.approx(6 / 6)
    assert metrics.mean_ratio(1.1 * REFERENCE.astype(float), REFERENCE) == pytest.approx(1.1)
    assert metrics.rel_l2(IMAGE, REFERENCE) == pytest.approx(np.sqrt(2 / 18))
    assert metrics.rel_mse(IMAGE, REFERENCE) == pytest.approx((1 / 1.01 + 1 / 16.01) / 4)
    assert metrics.smape(IMAGE, REFERENCE) == pytest.approx((0 + 2 / 3 + 2 / 7 + 0) / 4)
    assert metrics.max_abs(IMAGE, REFERENCE) == 1.0


def test_the_percentile_ignores_a_few_wild_pixels() -> None:
    reference = np.zeros((100, 100))
    image = reference.copy()
    image[0, 0] = 1e6
    assert metrics.percentile_abs(image, reference) == 0.0
    assert metrics.max_abs(image, reference) == 1e6


def test_a_lost_edit_is_a_whole_error_of_the_difference_and_a_small_one_of_the_image() -> None:
    base = np.ones((4, 4, 3))
    edited = 1.05 * base
    assert metrics.rel_l2(base, edited) == pytest.approx(0.05 / 1.05)
    assert metrics.edit_error(base, base, edited, base) == pytest.approx(1.0)
    assert metrics.edit_error(edited, base, edited, base, metric=metrics.max_abs) == 0.0


def test_black_references_and_differing_shapes_have_defined_answers() -> None:
    black = np.zeros((2, 2))
    assert metrics.rel_l2(black, black) == 0.0
    assert metrics.rel_l2(black + 1, black) == np.inf
    assert metrics.mean_ratio(black, black) == 1.0
    with pytest.raises(ValueError, match="cannot be compared"):
        metrics.max_abs(black, np.zeros((2, 3)))


def test_sums_of_large_float32_images_do_not_lose_digits() -> None:
    image = np.full(4_000_000, 0.1, np.float32)
    assert metrics.mean_ratio(image, np.full(4_000_000, 0.1)) == pytest.approx(float(np.float32(0.1)) / 0.1, rel=1e-12)
