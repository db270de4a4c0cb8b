"""Some terms of one quantised tile times one version of the light, as integers.

Light is rounded to 16 bits and products are summed exactly, some hundred terms at a time. There are thousands of tiles
in a frame, of which many have a dozen terms: all is handed on as addresses, as arrays would cost more than these.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.packed import LANES
from icheat_usd.kernels.simd import (
    add_dot,
    address_of,
    as_floats,
    black,
    channel,
    color_of,
    fetch,
    four_times,
    larger,
    largest_of_fours,
    load,
    load_color,
    load_number,
    load_one,
    no_sum,
    plus,
    product,
    ratios,
    rounded_pairs,
    scaled,
    spread_pair,
    store,
    store_color,
    store_colors,
    store_words,
    widen,
    zeros,
)

QUANTA = 2 * LANES  #: bytes of a pair of coefficients
_PRODUCT = 16 * LANES  # bytes of a product
# Pairs of coefficients, whose quanta are in the second-level cache before they are multiplied: 48 took a tenth less
# time than 128, and less than 32 and 64. Sums of twice as many products of a word and a quantum, 32767 * 128 each,
# would stay within 32 bits for 256.
_AT_ONCE = 48
_COLORS = 16 * (_AT_ONCE + 4)  # bytes of a colour for each, and what is beyond the last as vectors are whole
_SUMS = 12 * 64  # bytes
_WORD_STEPS = 1.0 / 32767.0


class Tables(NamedTuple):
    """Addresses of what products are made of, and where they go."""

    index: int  #: of the columns of `paired_tiles.PairedTiles`
    scale: int
    value: int
    light: int  #: of (n_versions, m, 4) float32 coefficients
    light_step: int  #: bytes of a version
    out: int  #: of (n_out, 64, 4) float32


@kernel
def tables_of(
    index: np.ndarray, scale: np.ndarray, value: np.ndarray, coefficients: np.ndarray, out: np.ndarray
) -> Tables:
    """Tables of arrays, which outlive them."""
    return Tables(
        address_of(index),
        address_of(scale),
        address_of(value),
        address_of(coefficients),
        16 * coefficients.shape[1],
        address_of(out),
    )


@kernel
def new_room() -> np.ndarray:
    """Work space of `multiply_tile`, which whoever has it must mention behind the last product, or Numba frees it."""
    return np.empty((3 * _COLORS + _SUMS) // 4, np.float32)


@kernel
def _scale_pair(pair: int, tables: Tables, light: int, even: int, odd: int) -> None:
    """The two colours that the quanta of a pair multiply; meanwhile the quanta come into the cache."""
    quanta, where, size = tables.value + QUANTA * pair, tables.index + 8 * pair, tables.scale + 8 * pair
    fetch(quanta)
    fetch(quanta + 64)
    store_color(even, scaled(load_color(light + 16 * load_number(where)), load_one(size)))
    store_color(odd, scaled(load_color(light + 16 * load_number(where + 4)), load_one(size + 4)))


@kernel
def _scale_pairs(number: int, first: int, n: int, tables: Tables, light: int, even: int, odd: int) -> None:
    """Colours of pairs `first` to `n`; whole vectors, so up to three pairs more."""
    for i in range(first, n):
        _scale_pair(load_number(number + 4 * i), tables, light, even + 16 * i, odd + 16 * i)
    for i in range(n, n + -n % 4):
        store_color(even + 16 * i, black())
        store_color(odd + 16 * i, black())


@kernel
def _largest(n: int, even: int, odd: int) -> Any:
    """Largest size of each channel of `n` pairs of colours."""
    a = b = zeros()
    for offset in range(0, 16 * n, 64):
        a, b = larger(a, load(even + offset)), larger(b, load(odd + offset))
    return largest_of_fours(larger(a, b))


@kernel
def _round_pairs(n: int, even: int, odd: int, per_step: Any, words: int) -> None:
    """`n` pairs of colours in steps, as int16; whole vectors, too."""
    factor = four_times(per_step)
    for offset in range(0, 16 * n, 64):
        a, b = load(even + offset), load(odd + offset)
        store_words(words + offset, rounded_pairs(product(a, factor), product(b, factor)))


@kernel
def _add(place: int, sums: Any, step: float) -> None:
    store(place, plus(load(place), as_floats(sums, step)))


@kernel
def _multiply_pairs(
    number: int, n: int, tables: Tables, words: int, step: Any, sums: int,
    ahead: int, n_ahead: int, light: int, even: int, odd: int,
) -> None:  # fmt: skip
    """Add `n` pairs times words to 12 vectors of sums.

    Meanwhile as many of the pairs `ahead`, of which is one, are prepared: sums wait for the multipliers alone, and one
    after the other both took a twentieth longer.
    """
    r0 = r1 = r2 = r3 = g0 = g1 = g2 = g3 = b0 = b1 = b2 = b3 = no_sum()
    last, last_even = ahead + 4 * (n_ahead - 1), even + 16 * (n_ahead - 1)
    apart = odd - even
    for _ in range(n):
        _scale_pair(load_number(ahead), tables, light, even, even + apart)
        ahead, even = min(ahead + 4, last), min(even + 16, last_even)
        quanta = tables.value + QUANTA * load_number(number)
        r, g, b = spread_pair(words), spread_pair(words + 4), spread_pair(words + 8)
        x = widen(quanta)
        r0, g0, b0 = add_dot(x, r, r0), add_dot(x, g, g0), add_dot(x, b, b0)
        x = widen(quanta + 32)
        r1, g1, b1 = add_dot(x, r, r1), add_dot(x, g, g1), add_dot(x, b, b1)
        x = widen(quanta + 64)
        r2, g2, b2 = add_dot(x, r, r2), add_dot(x, g, g2), add_dot(x, b, b2)
        x = widen(quanta + 96)
        r3, g3, b3 = add_dot(x, r, r3), add_dot(x, g, g3), add_dot(x, b, b3)
        words += 16
        number += 4
    r, g, b = channel(step, 0), channel(step, 1), channel(step, 2)
    _add(sums, r0, r)
    _add(sums + 64, r1, r)
    _add(sums + 128, r2, r)
    _add(sums + 192, r3, r)
    _add(sums + 256, g0, g)
    _add(sums + 320, g1, g)
    _add(sums + 384, g2, g)
    _add(sums + 448, g3, g)
    _add(sums + 512, b0, b)
    _add(sums + 576, b1, b)
    _add(sums + 640, b2, b)
    _add(sums + 704, b3, b)


@kernel
def multiply_tile(
    tables: Tables, version: int, to: int, number: int, n: int, n_ready: int, following: int, n_following: int,
    version_following: int, room: int,
) -> int:  # fmt: skip
    """Some pairs of coefficients of one tile times one version.

    Parameters
    ----------
    version, to : number of the light, and of the product
    number, n : address of int32 numbers of the pairs, and how many they are
    n_ready : how many of the first of these were prepared with the product before, in the same room
    following, n_following, version_following
        The same of the next product, of which some pairs are prepared meanwhile; there may be none.
    room : address of a `new_room`

    Returns
    -------
    int
        How many of the first pairs that follow are prepared.
    """
    light, out = tables.light + tables.light_step * np.int64(version), tables.out + _PRODUCT * np.int64(to)
    even, odd, words, sums = room, room + _COLORS, room + 2 * _COLORS, room + 3 * _COLORS
    for k in range(12):
        store(sums + 64 * k, zeros())
    one = color_of(np.float32(1.0), np.float32(1.0), np.float32(1.0))
    while n > 0:
        some, rest = min(n, _AT_ONCE), n - min(n, _AT_ONCE)
        end = number + 4 * some
        _scale_pairs(number, n_ready, some, tables, light, even, odd)
        step = scaled(_largest(some, even, odd), np.float32(_WORD_STEPS))
        _round_pairs(some, even, odd, ratios(one, step), words)
        ahead, n_ahead, light_ahead = number, some, light
        if rest > 0:
            ahead, n_ahead = end, min(rest, _AT_ONCE)
        elif n_following > 0:
            ahead, n_ahead = following, min(n_following, _AT_ONCE)
            light_ahead = tables.light + tables.light_step * np.int64(version_following)
        _multiply_pairs(number, some, tables, words, step, sums, ahead, n_ahead, light_ahead, even, odd)
        number, n, n_ready = end, rest, min(some, n_ahead)
    for k in range(4):
        store_colors(out + 256 * k, load(sums + 64 * k), load(sums + 256 + 64 * k), load(sums + 512 + 64 * k))
    return n_ready if n_following > 0 else 0
