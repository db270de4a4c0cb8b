"""Colours of 8 bytes against the same in NumPy: rounding, and sums of weighted colours by four and one by one."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.kernels.lanes import add_short, add_short_fours, load_short, store_short, sum_of_fours
from icheat_usd.kernels.simd import address_of, black, load_color, store, store_color, zeros

RNG = np.random.default_rng(5)
BITS = 5  #: of a word that number a colour


def shortened(colors: np.ndarray) -> np.ndarray:
    from numba import njit

    @njit
    def shorten(source, target):
        for i in range(len(target)):
            store_short(address_of(target) + i * 8, load_color(address_of(source) + i * 16))

    short = np.zeros(len(colors), np.uint64)
    shorten(colors, short)
    return short


def as_float32(short: np.ndarray) -> np.ndarray:
    """What short colours say, (n, 4)."""
    return (short.view(np.uint16).astype(np.uint32) << 16).view(np.float32).reshape(-1, 4)


def test_colours_are_rounded_to_the_nearest_of_eight_bits():
    colors = (RNG.normal(size=(500, 4)) * 10.0 ** RNG.integers(-6, 7, (500, 1))).astype(np.float32)
    read = as_float32(shortened(colors))
    step = 2.0 ** (np.floor(np.log2(np.abs(colors.astype(np.float64)))) - 7)
    assert np.all(np.abs(read - colors.astype(np.float64)) <= step / 2)
    exact = np.float32([[0.0, 1.0, -2.5, 0.0]])
    assert np.array_equal(as_float32(shortened(exact)), exact)


def test_sixteen_short_numbers_are_read_as_they_are():
    from numba import njit

    @njit
    def read(source, target):
        store(address_of(target), load_short(address_of(source)))

    short = RNG.integers(0, 0x7F80, 16).astype(np.uint16) | (RNG.integers(0, 2, 16) << 15).astype(np.uint16)
    found = np.empty(16, np.float32)
    read(short, found)
    assert np.array_equal(found.view(np.uint32), short.astype(np.uint32) << 16)


@pytest.mark.parametrize("n", [0, 1, 3, 4, 5, 12])
def test_weighted_colours_add_up(n: int):
    from numba import njit

    @njit
    def added(words, weights, colors, mask, n, out):
        total = zeros()
        for first in range(0, n - 3, 4):
            total = add_short_fours(address_of(words) + first * 4, address_of(colors), mask, total)
        store_color(address_of(out[0]), sum_of_fours(total))
        single = black()
        for k in range(n):
            single = add_short(address_of(colors) + np.int64(words[k] & np.uint32(mask)) * 8, weights[k], single)
        store_color(address_of(out[1]), single)

    short = shortened(RNG.uniform(0, 4, (1 << BITS, 4)).astype(np.float32))
    mask = (1 << BITS) - 1
    column = RNG.integers(0, 1 << BITS, n).astype(np.uint32)
    words = (RNG.uniform(0, 1, n).astype(np.float32).view(np.uint32) & ~np.uint32(mask)) | column
    weights, out = words.view(np.float32), np.empty((2, 4), np.float32)
    added(words, weights, short, mask, n, out)
    terms = weights[:, None].astype(np.float64) * as_float32(short)[column]
    assert np.allclose(out[0], terms[: n // 4 * 4].sum(axis=0), rtol=1e-6)
    assert np.allclose(out[1], terms.sum(axis=0), rtol=1e-6)
