"""The least term that stays, against terms that are sorted and added up."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.least_term import least_term

N, M = 1003, 300


def sample(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    size = np.exp(rng.normal(0, 4, M)).astype(np.float32)
    return rng.integers(M, size=N).astype(np.int32), rng.exponential(size=N).astype(np.float32), size


@pytest.mark.parametrize("share", [1e-4, 0.01, 0.3, 0.999])
def test_squares_of_what_is_left_out_sum_up_to_a_share(share: float) -> None:
    index, worth, size = sample(1)
    terms = np.sort(worth * size[index])
    squares = np.cumsum(terms.astype(np.float64) ** 2)
    n_left_out = int(np.searchsorted(squares, share * squares[-1], side="right"))
    for error, of_all in ((share * squares[-1], 1.0), (np.inf, share)):
        least = least_term(index, worth, size, N + 1, error, of_all)
        assert terms[n_left_out - 1] < least <= terms[n_left_out]


@pytest.mark.parametrize("n_most", [1, 17, 500, N])
def test_no_more_stay_than_there_is_room_for(n_most: int) -> None:
    index, worth, size = sample(2)
    terms = worth * size[index]
    assert np.count_nonzero(terms >= least_term(index, worth, size, n_most, 0.0, 1.0)) == n_most
    # nor where the error alone would leave out fewer
    error = 1.0001 * float(np.sum(np.sort(terms)[:4].astype(np.float64) ** 2))
    assert np.count_nonzero(terms >= least_term(index, worth, size, n_most, error, 1.0)) == min(n_most, N - 4)


def test_all_may_be_left_out_and_nothing_need_be() -> None:
    index, worth, size = sample(3)
    terms = worth * size[index]
    assert least_term(index, worth, size, 0, 0.0, 1.0) == np.inf
    assert least_term(index, worth, size, N, np.inf, 2.0) == np.inf
    assert least_term(index[:0], worth[:0], size, 5, 0.0, 1.0) == np.inf
    assert least_term(index, worth, size, N + 1, 0.0, 1.0) <= terms.min()
    dark = np.zeros_like(size)
    assert least_term(index, worth, dark, N, 0.0, 1.0) == np.inf  # what is 0 is nothing
