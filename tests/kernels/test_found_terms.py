"""Large terms found by coefficient, listed or marked, against a look at all terms of each tile."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np
import pytest

from icheat_usd.kernels.found_terms import find_of_jobs, multiply_found, order_terms
from icheat_usd.kernels.large_terms import multiply_terms
from icheat_usd.kernels.marked_terms import WORD, mark_terms, multiply_marked
from icheat_usd.kernels.paired_tiles import PairedTiles, QuantisedTiles, pair_tiles

N_COEFFICIENTS, N_VERSIONS = 400, 5


def some_tiles() -> PairedTiles:
    """Tiles with hundreds of coefficients, an odd number of them, one, and none; the mean is the first of each."""
    rng = np.random.default_rng(3)
    counts = [380, 37, 1, 0, 150]
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    index = np.concatenate([np.append(0, 1 + rng.permutation(N_COEFFICIENTS - 1)[: n - 1])[:n] for n in counts])
    scale = (rng.random(begin[-1]) ** 6).astype(np.float32)
    value = rng.integers(-127, 128, (begin[-1], 64)).astype(np.int8)
    worth = (scale * rng.uniform(0.5, 1, len(scale))).astype(np.float32)
    return pair_tiles([QuantisedTiles(begin, index.astype(np.int32), scale, worth, value)])


def some_light() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Versions with from all to few coefficients, their sizes, and what is large; of one only the mean is."""
    rng = np.random.default_rng(4)
    light = np.zeros((N_VERSIONS, N_COEFFICIENTS, 4), np.float32)
    light[..., :3] = rng.normal(size=(N_VERSIONS, N_COEFFICIENTS, 3))
    for version, share in enumerate((1.0, 0.5, 0.1, 0.02, 0.3)):
        light[version, rng.random(N_COEFFICIENTS) >= share] = 0
    light[:, 0, :3] = 1
    size = np.abs(light).max(axis=2)
    size[:, 0] = np.inf
    return light, size, np.array([1e-4, 0.01, 0.0003, np.finfo(np.float32).tiny, np.inf], np.float32)


def some_jobs() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of tile and version in no order, each once and not all there are; and where they go."""
    rng = np.random.default_rng(5)
    pairs = rng.permutation(np.argwhere(rng.random((5, N_VERSIONS)) < 0.8)).astype(np.int32)
    return pairs[:, 0].copy(), pairs[:, 1].copy(), rng.permutation(len(pairs)).astype(np.int32)


def test_terms_of_a_coefficient_lie_in_order_of_their_worth() -> None:
    tiles = some_tiles()
    columns = order_terms(tiles, N_COEFFICIENTS)
    tile_of = np.repeat(np.arange(5), np.diff(tiles.tile_begin))
    assert columns.begin[-1] == np.count_nonzero(tiles.worth)
    for k in range(N_COEFFICIENTS):
        some = slice(columns.begin[k], columns.begin[k + 1])
        assert (np.diff(columns.worth[some]) <= 0).all()
        mine = np.flatnonzero((tiles.index == k) & (tiles.worth > 0))
        expected = sorted(zip(tiles.worth[mine], tile_of[mine], mine // 2, strict=True))
        assert sorted(zip(*(part[some] for part in columns[2:]), strict=True)) == expected
        assert columns.most[k] == max(tiles.worth[mine], default=0)


def multiplied_by_marks() -> np.ndarray:
    """All jobs by terms that are marked; (n, 64, 4)."""
    tiles, (light, size, least), (tile, version, place) = some_tiles(), some_light(), some_jobs()
    columns = order_terms(tiles, N_COEFFICIENTS)
    marks = np.zeros((N_VERSIONS, len(tiles.value) + WORD), np.uint8)
    row = N_VERSIONS - 1 - version  # marks may stand in another order than versions
    for v in range(N_VERSIONS):
        terms = columns.begin, columns.most, columns.worth, columns.pair
        mark_terms(*terms, size[v], least[v], marks[N_VERSIONS - 1 - v])
    out = np.zeros((len(tile), 64, 4), np.float32)
    multiply_marked(
        tiles.tile_begin, tiles.index, tiles.scale, tiles.value, light, marks, tile, version, row, place, out
    )
    return out


def multiplied() -> np.ndarray:
    """All jobs by terms that are listed; (n, 64, 4)."""
    tiles, (light, size, least), (tile, version, place) = some_tiles(), some_light(), some_jobs()
    columns = order_terms(tiles, N_COEFFICIENTS)
    begin, found = find_of_jobs(columns, 5, size, least, tile, version)
    out = np.zeros((len(tile), 64, 4), np.float32)
    multiply_found(tiles.index, tiles.scale, tiles.value, light, begin, found, version, place, out)
    return out


@pytest.mark.parametrize("found", [multiplied, multiplied_by_marks])
def test_products_have_the_bits_of_those_that_look_at_all_terms(found: Callable[[], np.ndarray]) -> None:
    tiles, (light, size, least), (tile, version, place) = some_tiles(), some_light(), some_jobs()
    expected = np.zeros((len(tile), 64, 4), np.float32)
    multiply_terms(*tiles, light, size, least, tile, version, place, expected)
    assert set(version) == set(range(N_VERSIONS)) and {0, 3} <= set(tile)
    assert all(expected[place[version == v]].any() for v in range(N_VERSIONS))
    assert np.array_equal(found(), expected)


@pytest.mark.parametrize("found", [multiplied, multiplied_by_marks])
@pytest.mark.parametrize("threads", [1, 2])
def test_the_bits_do_not_depend_on_the_number_of_threads(threads: int, found: Callable[[], np.ndarray]) -> None:
    expected = found()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    again = found()
    numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
    assert np.array_equal(again, expected)
