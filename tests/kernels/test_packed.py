"""Products of quantised tiles against the same product in double precision."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.kernels.large_terms import multiply_terms
from icheat_usd.kernels.packed import LANES, multiply_tiles
from icheat_usd.kernels.paired_tiles import QuantisedTiles, pair_tiles
from icheat_usd.scene import F32, F64, I32, I64


class Tiles(NamedTuple):
    tile_begin: I64
    index: I32
    scale: F32
    value: NDArray[np.int8]


def tiles_of(counts: list[int], m: int, seed: int = 0) -> Tiles:
    rng = np.random.default_rng(seed)
    index = np.concatenate([np.sort(rng.choice(m, k, replace=False)) for k in counts]).astype(np.int32)
    n = len(index)
    value = rng.integers(-127, 128, (n, LANES)).astype(np.int8)
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Tiles(begin, index, rng.uniform(0.001, 2, n).astype(np.float32), value)


def product(tiles: Tiles, coefficients: F32, pair_tile: I32, pair_version: I32, *, integers: bool = False) -> F32:
    out = np.full((len(pair_tile), LANES, 4), np.nan, np.float32)
    if integers:
        begin, index, scale, value = tiles
        paired = pair_tiles([QuantisedTiles(begin, index, scale, scale, value)])
        none, place = np.zeros((1, 0), np.float32), np.arange(len(out), dtype=np.int32)
        multiply_terms(*paired, coefficients, none, none[0], pair_tile, pair_version, place, out)
    else:
        multiply_tiles(*tiles, coefficients, pair_tile, pair_version, out)
    return out


def naive_product(tiles: Tiles, coefficients: F32, pair_tile: I32, pair_version: I32) -> F64:
    out = np.zeros((len(pair_tile), LANES, 4))
    for p, (tile, version) in enumerate(zip(pair_tile, pair_version, strict=True)):
        part = slice(tiles.tile_begin[tile], tiles.tile_begin[tile + 1])
        rows = tiles.value[part].astype(np.float64) * tiles.scale[part, None]
        out[p, :, :3] = rows.T @ coefficients[version, tiles.index[part], :3].astype(np.float64)
    return out


def pairs(*of: tuple[int, int]) -> tuple[I32, I32]:
    tile, version = np.array(of, np.int32).reshape(-1, 2).T
    return np.ascontiguousarray(tile), np.ascontiguousarray(version)


def coefficients_of(n_versions: int, m: int) -> F32:
    return np.random.default_rng(5).normal(size=(n_versions, m, 4)).astype(np.float32)


COUNTS = [[1], [2, 7, 300], [64, 65, 1, 33], [0, 5, 0]]


def all_pairs(n_tiles: int, versions: tuple[int, ...]) -> tuple[I32, I32]:
    return pairs(*((tile, version) for tile in range(n_tiles) for version in versions))


@pytest.mark.parametrize("counts", COUNTS)
def test_equals_the_product_in_double_precision(counts: list[int]) -> None:
    tiles, coefficients = tiles_of(counts, 400), coefficients_of(3, 400)
    chosen = all_pairs(len(counts), (2, 0))
    expected = naive_product(tiles, coefficients, *chosen)
    got = product(tiles, coefficients, *chosen)
    error = np.abs(got - expected).max(axis=(1, 2))
    assert np.all(error <= 1e-6 * np.linalg.norm(expected, axis=(1, 2)))
    assert not got[..., 3].any()


@pytest.mark.parametrize("counts", COUNTS)
def test_integers_stay_within_half_a_step_for_each_coefficient(counts: list[int]) -> None:
    tiles, coefficients = tiles_of(counts, 400), coefficients_of(3, 400)
    chosen = all_pairs(len(counts), (2, 0))
    expected = naive_product(tiles, coefficients, *chosen)
    got = product(tiles, coefficients, *chosen, integers=True)
    for p, (tile, version) in enumerate(zip(*chosen, strict=True)):
        part = slice(tiles.tile_begin[tile], tiles.tile_begin[tile + 1])
        light = np.abs(coefficients[version, tiles.index[part], :3] * tiles.scale[part, None])
        half_step = 0.5001 * light.max(axis=0, initial=0) / 32767
        bound = np.abs(tiles.value[part].astype(np.float64)).sum(axis=0)[:, None] * half_step
        assert np.all(np.abs(got[p, :, :3] - expected[p, :, :3]) <= bound + 1e-6 * np.abs(expected[p]).max())
    assert not got[..., 3].any()


def test_integers_do_not_overflow_where_everything_adds_up() -> None:
    n = 3001
    tiles = tiles_of([n], n)._replace(value=np.full((n, LANES), -128, np.int8), scale=np.ones(n, np.float32))
    light = np.ones((1, n, 4), np.float32)
    np.testing.assert_allclose(product(tiles, light, *pairs((0, 0)), integers=True)[..., :3], -128.0 * n, rtol=1e-4)


@pytest.mark.parametrize("integers", [False, True])
def test_darkness_is_exactly_dark(integers: bool) -> None:
    tiles = tiles_of([5, 64], 100)
    out = product(tiles, np.zeros((1, 100, 4), np.float32), *all_pairs(2, (0,)), integers=integers)
    np.testing.assert_array_equal(out, 0)


@pytest.mark.parametrize("integers", [False, True])
def test_a_product_has_the_same_bits_whatever_else_is_computed(integers: bool) -> None:
    tiles, coefficients = tiles_of([31, 64, 200, 5], 256), coefficients_of(2, 256)
    everything = all_pairs(4, (0, 1))
    results = []
    before = numba.get_num_threads()
    try:
        for n_threads in {1, min(2, numba.config.NUMBA_NUM_THREADS)}:
            numba.set_num_threads(n_threads)
            results.append(product(tiles, coefficients, *everything, integers=integers))
    finally:
        numba.set_num_threads(before)
    for p in (1, 4):
        chosen = everything[0][p : p + 1], everything[1][p : p + 1]
        alone = product(tiles, coefficients, *chosen, integers=integers)
        results.append(np.concatenate([results[0][:p], alone, results[0][p + 1 :]]))
    for other in results[1:]:
        np.testing.assert_array_equal(other, results[0])


def test_no_pairs_no_products() -> None:
    tiles, coefficients = tiles_of([3], 10), coefficients_of(1, 10)
    assert product(tiles, coefficients, *pairs()).shape == (0, LANES, 4)
