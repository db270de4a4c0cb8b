"""Noise that is known of a look, taken from another: against plain least squares and a plain jackknife."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.kernels.known_noise import sum_of_some, take_noise
from icheat_usd.kernels.place_columns import RUN
from icheat_usd.scene import F32, F64


def in_runs(values: F32) -> F32:
    """Colours of whole runs of places, channel after channel."""
    return np.ascontiguousarray(values.reshape(-1, RUN, 3).transpose(0, 2, 1)).reshape(-1, 3 * RUN)


def taken(look: F32, rest: F32, noise: F32, usual: float = 1.0, smooths: bool = False) -> F32:
    """Of places (n, 3) in their order, all runs of which are meant."""
    padded = np.zeros((2, -(-len(look) // RUN) * RUN, 3), np.float32)
    padded[0, : len(look)], padded[1, : len(look)] = rest, noise
    out, row = look.copy(), np.arange(len(look), dtype=np.int32)
    runs = np.arange(padded.shape[1] // RUN, dtype=np.int32)
    take_noise(row, runs, in_runs(padded[0]), in_runs(padded[1]), usual, smooths, out)
    return out


def found(look: F64, rest: F64, noise: F64) -> F64:
    """How often light and noise are in a look."""
    matrix = np.stack([rest.ravel(), noise.ravel()], axis=1)
    return np.linalg.lstsq(matrix, look.ravel(), rcond=None)[0]


def plain(look: F32, rest: F32, noise: F32, usual: float, smooths: bool) -> F64:
    """What `take_noise` makes of one run (n, 3), as its notes have it."""
    look, rest, noise = (values.astype(np.float64) for values in (look, rest, noise))
    light, share = found(look, rest, noise)
    group = np.arange(len(look)) % 16
    others = np.array([found(look[group != g], rest[group != g], noise[group != g]) for g in range(16)])
    of_light, of_share = 15 / 16 * np.square(others - (light, share)).sum(axis=0)
    most, before = max(0, light), rest + noise
    alike = (look * before).sum() ** 2 / (np.square(look).sum() * np.square(before).sum())
    sure = np.clip(share * max(0, 1 - of_share / share**2), 0, most) * alike**4
    off = light - usual
    known = max(0, usual + off * max(0, 1 - of_light / off**2))
    remainder = look - known * rest - sure * noise
    left = np.square(noise).sum() * max(0, most**2 - 2 * sure * share + sure**2)
    kept = max(0, 1 - left / np.square(remainder).sum()) if smooths else 1
    return np.maximum(known * rest + kept * remainder, 0)


@pytest.mark.parametrize("smooths", [False, True])
@pytest.mark.parametrize(
    ("of_light", "of_noise", "of_new"), [(1, 1, 0.05), (0.7, 0.6, 0.3), (3, 2.5, 1), (1, 0, 1), (0, 0, 0.2)]
)
def test_it_is_what_least_squares_and_the_jackknife_say(of_light: float, of_noise: float, of_new: float, smooths: bool):
    rng = np.random.default_rng(5)
    rest = rng.uniform(0.2, 1, (RUN, 3)).astype(np.float32)
    noise, new = rng.normal(0, 0.3, (2, RUN, 3)).astype(np.float32)
    look = np.maximum(of_light * rest + of_noise * noise + of_new * new, 0).astype(np.float32)
    expected = plain(look, rest, noise, 0.9, smooths)
    np.testing.assert_allclose(taken(look, rest, noise, 0.9, smooths), expected, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("smooths", [False, True])
def test_the_same_look_becomes_what_is_known(smooths: bool):
    rng = np.random.default_rng(1)
    known, look = rng.uniform(0, 1, (2, 5 * RUN + 7, 3)).astype(np.float32)
    np.testing.assert_allclose(taken(look, known, look - known, 1.0, smooths), known, atol=1e-5)


def test_noise_of_one_place_says_nothing_of_what_is_there_now():
    """The border of a shadow that has gone: it would stay behind as a ghost."""
    rest, noise, look = np.ones((RUN, 3), np.float32), np.zeros((RUN, 3), np.float32), np.ones((RUN, 3), np.float32)
    rest[20], noise[20] = 0.5, 0.5
    out = taken(look, rest, noise)
    assert (np.abs(out - 1) < 0.05).all()


def test_looks_that_have_no_noise_in_common_stay_nearly_as_they_are():
    rng = np.random.default_rng(8)
    rest = np.full((200 * RUN, 3), 0.6, np.float32)
    look, was = (rest + rng.normal(0, 0.2, rest.shape) for _ in range(2))
    out = taken(look.astype(np.float32), rest, (was - rest).astype(np.float32))
    square = np.square(out - rest).mean() / np.square(look - rest).mean()
    assert square < 1.01


def test_a_pool_of_light_that_has_gone_takes_its_noise_along():
    """Noise that is strongest where the light was is like what the light is less there."""
    distance = np.linalg.norm(np.mgrid[-4:4, -4:4].reshape(2, -1).T, axis=1)
    rest = np.repeat(np.exp(-(distance**2) / 4)[:, None], 3, axis=1).astype(np.float32)
    look = np.full((RUN, 3), 0.2, np.float32)
    assert np.abs(taken(look, rest, -0.3 * rest**2) - look).max() < 0.02


def test_new_noise_is_held_down_where_that_was_asked_for_and_what_is_new_is_kept():
    rng = np.random.default_rng(8)
    rest = np.full((200 * RUN, 3), 0.6, np.float32)
    true = rest.copy()
    true[100 * RUN :] *= np.where(np.arange(100 * RUN) % RUN < 32, 0.1, 1.9)[:, None].astype(np.float32)
    look, was = (true + rng.normal(0, 0.1, rest.shape) for _ in range(2))
    out = taken(look.astype(np.float32), rest, (was - true).astype(np.float32), 1.0, True)
    noise = np.square(look - true).mean()
    still, changed = np.square(out - true).reshape(2, -1).mean(axis=1) / noise
    assert still < 0.15
    assert changed < 1.05


def test_nothing_is_below_0_and_other_runs_and_points_stay():
    rng = np.random.default_rng(4)
    look = rng.uniform(0, 1, (3 * RUN, 3)).astype(np.float32)
    row = rng.permutation(3 * RUN).astype(np.int32)
    rest, noise = rng.uniform(0, 1, (2, 1, 3 * RUN)).astype(np.float32)
    out = look.copy()
    out[row[RUN : 2 * RUN]] = (noise - 0.1).reshape(3, RUN).T
    before = out.copy()
    take_noise(row, np.array([1], np.int32), rest, noise, 1.0, False, out)
    others = np.setdiff1d(row, row[RUN : 2 * RUN])
    np.testing.assert_array_equal(out[others], before[others])
    assert not np.array_equal(out, before) and out.min() >= 0


def test_light_that_noise_cannot_be_told_from_is_left():
    """Where the look at rest had missed all light, its noise is the light; what a look sees now is what is there."""
    rest = np.random.default_rng(2).uniform(0.2, 1, (RUN, 3)).astype(np.float32)
    np.testing.assert_allclose(taken(0.4 * rest, rest, -rest), 0.4 * rest, rtol=1e-6)
    assert not taken(0 * rest, rest, -rest).any()


def test_any_number_of_threads_makes_the_same_bits():
    rng = np.random.default_rng(6)
    look, rest, noise = rng.uniform(0, 1, (3, 40 * RUN, 3)).astype(np.float32)
    most = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        one = taken(look, rest, noise, 1.0, True)
    finally:
        numba.set_num_threads(most)
    np.testing.assert_array_equal(taken(look, rest, noise, 1.0, True), one)


@pytest.mark.parametrize("n", [0, 1, 16, 1000])
def test_some_colours_are_summed(n: int) -> None:
    values = np.random.default_rng(n).random((n, 3), np.float32)
    assert sum_of_some(values, 16) == pytest.approx(values[::16].sum(dtype=np.float64), rel=1e-12)
