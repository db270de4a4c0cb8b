"""Light as a factor of what it was and a rest, against least squares in double precision."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.residuals import in_lanes, proportions


def test_factors_are_those_of_least_squares_and_sizes_those_of_the_rest() -> None:
    rng = np.random.default_rng(3)
    before = rng.uniform(-1, 2, (5000, 3)).astype(np.float32)
    now = (before * np.float32([0.5, 1.5, -2]) + rng.normal(0, 0.05, before.shape)).astype(np.float32)
    ends = {0: (0, 1800), 2: (1800, 5000)}  # of three functions the second is not meant
    pieces = np.array([(0, 0, 1000), (2, 1800, 3000), (0, 1000, 1800), (2, 3000, 5000)], np.int64)
    factors, rest = np.full((3, 64), 7, np.float32), np.empty_like(now)
    size = np.full((3, 4), 7.0)
    proportions(pieces, now, before, factors, rest, size)
    for function, (begin, end) in ends.items():
        x, y = before[begin:end].astype(np.float64), now[begin:end].astype(np.float64)
        factor = (x * y).sum(axis=0) / (x * x).sum(axis=0)
        np.testing.assert_allclose(factors[function], in_lanes(factor[None])[0], rtol=1e-6)
        left = y - factor * x
        np.testing.assert_allclose(rest[begin:end], left, atol=1e-6)
        expected = abs(left).max(), abs(y).max(), (left**2).sum(), (y**2).sum()
        np.testing.assert_allclose(size[function], expected, rtol=1e-4)
    assert (factors[1] == 7).all() and (size[1] == 7).all()


def test_what_was_black_has_no_factor() -> None:
    now = np.ones((10, 3), np.float32)
    factors, rest, size = np.ones((1, 64), np.float32), np.empty_like(now), np.empty((1, 4))
    proportions(np.array([(0, 0, 10)], np.int64), now, np.zeros_like(now), factors, rest, size)
    assert not factors.any()
    np.testing.assert_array_equal(rest, now)
    np.testing.assert_array_equal(size, [[1, 1, 30, 30]])
