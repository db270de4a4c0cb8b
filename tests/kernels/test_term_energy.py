"""How small terms must be not to count, against sums over all terms."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.term_energy import STEPS, least_of_versions, sum_energies

N_LEAVES, N_TERMS = 200, 20_000


def some_terms() -> tuple[np.ndarray, np.ndarray]:
    """Index and worth; worths of a coefficient are within some powers of ten."""
    rng = np.random.default_rng(5)
    index = rng.integers(N_LEAVES, size=N_TERMS).astype(np.int32)
    return index, np.exp(rng.normal(0, 2.5, N_TERMS) - 0.02 * index).astype(np.float32)


def some_sizes() -> np.ndarray:
    """Of three versions: few coefficients, many, and none but the mean."""
    sizes = np.zeros((3, N_LEAVES), np.float32)
    rng = np.random.default_rng(6)
    few = rng.choice(N_LEAVES, 12, replace=False)
    sizes[0, few] = np.exp(rng.normal(0, 3, 12))
    sizes[1] = np.exp(rng.normal(-2, 1, N_LEAVES))
    sizes[:, 0] = np.inf
    return sizes


def least_of(squared_error: float, versions: tuple[int, ...] = (0, 1, 2), share: float = 1.0) -> np.ndarray:
    index, worth = some_terms()
    energy = np.zeros((N_LEAVES, STEPS), np.float32)
    largest = float(worth.max())
    sum_energies(index, worth, largest, energy)
    np.testing.assert_allclose(energy.sum(axis=1), np.bincount(index, worth.astype(np.float64) ** 2), rtol=1e-5)
    least = np.full(3, -1, np.float32)
    shares = np.full(3, share)
    least_of_versions(np.array(versions, np.int64), some_sizes(), energy, largest, squared_error, shares, least)
    return least


def squares_below(version: int, least: float) -> float:
    """Sum of squares of a version's terms below `least`, but those of the mean."""
    index, worth = some_terms()
    terms = (worth * some_sizes()[version][index])[index > 0].astype(np.float64)
    return float(np.sum(terms[terms < least] ** 2))


@pytest.mark.parametrize("share", [1e-7, 1e-4, 1e-2, 0.3])
@pytest.mark.parametrize("version", [0, 1])
def test_what_is_left_out_is_at_most_the_error_and_not_much_less(version: int, share: float) -> None:
    squared_error = share * squares_below(version, np.inf)
    least = float(least_of(squared_error)[version])
    assert np.finfo(np.float32).tiny < least < np.inf
    assert squares_below(version, least) <= squared_error * (1 + 1e-5)
    assert least_of(np.inf, share=share)[version] == pytest.approx(least, rel=0.5)
    # A class counts as a whole, and ends at twice its beginning; so do the steps of what is found.
    assert squares_below(version, 4 * least) > squared_error


def test_a_version_keeps_its_own_shape_however_dark_it_is_beside_the_image() -> None:
    for version in (0, 1):
        least = float(least_of(1e12, share=1e-3)[version])
        assert 0 < squares_below(version, least) <= 1.001e-3 * squares_below(version, np.inf)


def test_where_all_of_it_is_small_the_mean_alone_stays() -> None:
    assert np.isposinf(least_of(1e12)).all() and np.isposinf(least_of(1e-9)[2])


def test_no_error_leaves_out_nothing_and_other_versions_keep_theirs() -> None:
    found = least_of(0.0, versions=(1,))
    assert squares_below(1, float(found[1])) == 0.0 and found[0] == found[2] == -1
