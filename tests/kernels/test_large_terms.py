"""Products without the terms that are small in a light, against products with all."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.kernels.large_terms import multiply_terms
from icheat_usd.kernels.packed import multiply_tiles
from icheat_usd.kernels.paired_tiles import QuantisedTiles, pair_tiles

N_COEFFICIENTS = 300


def some_tiles() -> tuple[np.ndarray, ...]:
    """Four tiles: with many coefficients, an odd number of them, one, and none."""
    rng = np.random.default_rng(3)
    counts = [130, 37, 1, 0]
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    index = np.concatenate([np.sort(rng.choice(N_COEFFICIENTS, n, replace=False)) for n in counts]).astype(np.int32)
    scale = (rng.random(begin[-1]) ** 6).astype(np.float32)
    value = rng.integers(-127, 128, (begin[-1], 64)).astype(np.int8)
    return begin, index, scale, (scale * rng.uniform(0.5, 1, len(scale))).astype(np.float32), value


def some_light() -> np.ndarray:
    light = np.zeros((2, N_COEFFICIENTS, 4), np.float32)
    light[..., :3] = np.random.default_rng(4).normal(size=(2, N_COEFFICIENTS, 3))
    return light


PAIR_TILE, PAIR_VERSION = np.array([0, 0, 1, 2, 3, 1], np.int32), np.array([0, 1, 1, 0, 0, 0], np.int32)


PLACE = np.arange(len(PAIR_TILE), dtype=np.int32)


def beside(large: np.ndarray) -> np.ndarray:
    """With the other one of each two coefficients that are multiplied together."""
    padded = np.append(large, np.zeros(len(large) % 2, np.bool_)).reshape(-1, 2)
    return np.repeat(padded.any(axis=1), 2)[: len(large)]


@pytest.mark.parametrize("least", [0.0, 0.01, 0.3, 1e6])
def test_the_product_is_that_of_the_large_terms(least: float) -> None:
    begin, index, scale, worth, value = some_tiles()
    light = some_light()
    size = np.abs(light).max(axis=2)
    expected, found = np.zeros((2, len(PAIR_TILE), 64, 4), np.float32)
    leasts = np.full(2, least, np.float32)
    multiply_terms(
        *pair_tiles([QuantisedTiles(begin, index, scale, worth, value)]),
        light,
        size,
        leasts,
        PAIR_TILE,
        PAIR_VERSION,
        PLACE[::-1].copy(),
        found,
    )
    found = found[::-1]
    for p, (tile, version) in enumerate(zip(PAIR_TILE, PAIR_VERSION, strict=True)):
        entries = slice(begin[tile], begin[tile + 1])
        large = beside(size[version, index[entries]] * worth[entries] >= np.float32(least))
        some = np.array([0, large.sum()], np.int64)
        one = np.zeros(1, np.int32)
        multiply_tiles(
            some,
            index[entries][large],
            scale[entries][large],
            value[entries][large],
            light[version : version + 1],
            one,
            one,
            expected[p : p + 1],
        )
    assert expected.any() == (least < 1e6)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * max(np.abs(expected).max(), 1e-6))
    if 0 < least < 1e6:
        whole = np.zeros_like(expected)
        multiply_tiles(begin, index, scale, value, light, PAIR_TILE, PAIR_VERSION, whole)
        assert np.abs(whole - expected).max() > 0


def test_the_bits_do_not_depend_on_the_number_of_threads() -> None:
    begin, index, scale, worth, value = some_tiles()
    light = some_light()
    size, least = np.abs(light).max(axis=2), np.full(2, 0.01, np.float32)
    paired = pair_tiles([QuantisedTiles(begin, index, scale, worth, value)])
    found = np.zeros((2, len(PAIR_TILE), 64, 4), np.float32)
    for threads, out in zip((1, 2), found, strict=True):
        numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
        multiply_terms(*paired, light, size, least, PAIR_TILE, PAIR_VERSION, PLACE, out)
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert np.array_equal(found[0], found[1])


def test_tiles_of_two_lobes_are_those_of_each() -> None:
    begin, index, scale, worth, value = some_tiles()
    light = some_light()
    lobes = [
        QuantisedTiles(begin, index, scale, worth, value),
        QuantisedTiles(begin, index[::-1].copy(), 2 * scale, worth, value),
    ]
    one, other = (pair_tiles([lobe]) for lobe in lobes)
    none, n = np.zeros((1, 0), np.float32), len(PAIR_TILE)
    joined, apart = np.zeros((2, 2 * n, 64, 4), np.float32)
    tile, version = np.concatenate([PAIR_TILE, PAIR_TILE + 4]), np.tile(PAIR_VERSION, 2)
    place = np.arange(2 * n, dtype=np.int32)
    multiply_terms(*pair_tiles(lobes), light, none, none[0], tile, version, place, joined)
    for part, tiles in ((apart[:n], one), (apart[n:], other)):
        multiply_terms(*tiles, light, none, none[0], PAIR_TILE, PAIR_VERSION, PLACE, part)
    assert apart[n:].any()
    assert np.array_equal(joined, apart)
