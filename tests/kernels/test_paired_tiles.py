"""Paired tiles hold what the tiles of all lobes hold, two coefficients side by side."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.packed import LANES
from icheat_usd.kernels.paired_tiles import PairedTiles, QuantisedTiles, pair_tiles

COUNTS = ([5, 0, 2, 1], [0, 0, 0, 0], [4, 3, 0, 7])


def lobe(counts: list[int], seed: int) -> QuantisedTiles:
    rng = np.random.default_rng(seed)
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    n = int(begin[-1])
    scale, worth = rng.uniform(0.1, 1, (2, n)).astype(np.float32)
    value = rng.integers(-127, 128, (n, LANES)).astype(np.int8)
    return QuantisedTiles(begin, rng.integers(0, 99, n).astype(np.int32), scale, worth, value)


def some_lobes() -> list[QuantisedTiles]:
    return [lobe(counts, seed) for seed, counts in enumerate(COUNTS)]


def coefficient(tiles: PairedTiles, place: int) -> tuple[int, float, float, list[int]]:
    quanta = tiles.value[place // 2, :, place % 2]
    return int(tiles.index[place]), float(tiles.scale[place]), float(tiles.worth[place]), quanta.tolist()


def test_every_coefficient_is_there_and_odd_tiles_are_filled_up_with_nothing() -> None:
    lobes = some_lobes()
    paired = pair_tiles(lobes)
    assert len(paired.tile_begin) == 1 + sum(map(len, COUNTS))
    filled, tile = 0, 0
    for one in lobes:
        for first, last in zip(one.tile_begin[:-1], one.tile_begin[1:], strict=True):
            begin, end = paired.tile_begin[tile : tile + 2]
            assert begin % 2 == 0
            for k in range(first, last):
                expected = int(one.index[k]), float(one.scale[k]), float(one.worth[k]), one.value[k].tolist()
                assert coefficient(paired, begin + k - first) == expected
            for place in range(begin + last - first, end):
                assert coefficient(paired, place) == (0, 0.0, 0.0, [0] * LANES)
                filled += 1
            tile += 1
    assert filled == sum(count % 2 for counts in COUNTS for count in counts)
    assert end == len(paired.index) == 2 * len(paired.value)
