"""Errors against noisy references: the estimator finds a known error, and none where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from tools.benchmarking.meter import repeat, summary
from tools.benchmarking.statistics import relative_difference, relative_error, relative_error_of_halves


def noisy_halves(rng: np.random.Generator, truth: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Two independent, unbiased estimates; noise grows with brightness, as in a gather."""
    return tuple((truth * (1 + noise * rng.normal(size=truth.shape))).astype(np.float32) for _ in range(2))  # type: ignore[return-value]


def test_noise_of_the_reference_is_no_error_of_the_image() -> None:
    rng = np.random.default_rng(1)
    truth = rng.gamma(2.0, 1.0, (4000, 3))
    a, b = noisy_halves(rng, truth, 0.2)
    off = 0.01 * truth * rng.choice([-1, 1], truth.shape)
    found = relative_error((truth + off).astype(np.float32), a, b)
    assert found.plain > 0.1  # a plain comparison would drown in the noise of the reference
    assert found.rms == pytest.approx(0.01, abs=4 * found.standard_error)
    small = relative_error((truth + off).astype(np.float32), *noisy_halves(rng, truth, 0.005))
    assert small.rms == pytest.approx(0.01, rel=0.05)


def test_stated_standard_error_is_the_spread_over_repetitions() -> None:
    rng = np.random.default_rng(2)
    found = []
    for _ in range(200):
        truth = rng.gamma(2.0, 1.0, (500, 3))
        image = (truth * (1 + 0.05 * rng.normal(size=truth.shape))).astype(np.float32)
        found.append(relative_error(image, *noisy_halves(rng, truth, 0.05)))
    rms = np.array([one.rms for one in found])
    stated = np.mean([one.standard_error for one in found])
    assert rms.mean() == pytest.approx(0.05, rel=0.02)
    assert stated == pytest.approx(rms.std(), rel=0.25)


def test_image_known_by_two_halves_of_its_own() -> None:
    rng = np.random.default_rng(3)
    truth = rng.gamma(2.0, 1.0, (4000, 3))
    image = 1.03 * truth
    found = relative_error_of_halves(*noisy_halves(rng, image, 0.1), *noisy_halves(rng, truth, 0.1))
    assert found.rms == pytest.approx(0.03, abs=5 * found.standard_error)
    # Halves that share their noise would not cancel it.
    same = noisy_halves(rng, image, 0.1)[0]
    assert relative_error_of_halves(same, same, truth, truth).rms > 0.09


def test_without_noise_it_is_the_plain_relative_error() -> None:
    rng = np.random.default_rng(4)
    truth, image = rng.random((100, 3)), rng.random((100, 3))
    found = relative_difference(image.astype(np.float32), truth.astype(np.float32))
    expected = np.linalg.norm(image - truth) / np.linalg.norm(truth)
    assert found.rms == pytest.approx(expected, rel=1e-5)
    assert found.plain == pytest.approx(expected, rel=1e-5)
    assert found.noise == 0
    assert found.largest >= found.percentile_99 > 0


def test_black_references_make_any_light_an_unbounded_error() -> None:
    black = np.zeros((4, 3), np.float32)
    assert relative_difference(black, black).rms == 0
    assert relative_difference(black + 1, black).rms == np.inf


def test_repeated_times_have_median_and_quartiles() -> None:
    found = summary([5.0, 1.0, 3.0, 2.0, 4.0])
    assert (found["min"], found["quartile_1"], found["median"], found["quartile_3"], found["max"]) == (1, 2, 3, 4, 5)
    calls: list[int] = []
    assert len(repeat(calls.append, least=3, most=3)) == 3
    assert calls == [0, 1, 2, 3, 4]  # two to warm up, and a new argument each time
