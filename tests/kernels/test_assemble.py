"""Assembled view samples and pixels against sparse products, tints and sums in double precision."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.kernels.assemble import assemble_film, assemble_view, runs_in_order, sum_films, sum_scaled
from icheat_usd.kernels.film_table import FilmTable, film_table
from icheat_usd.relight.direct_sum import DirectSum
from icheat_usd.scene import F32, F64, I32
from icheat_usd.transport import SparseRows

N_ROWS = 192


def interpolation(counts: I32, seed: int = 0) -> SparseRows:
    """Rows of so many entries whose weights sum to 1."""
    rng = np.random.default_rng(seed)
    indices = [np.sort(rng.choice(N_ROWS, n, replace=False)) for n in counts]
    weights = [w / w.sum() for w in (rng.uniform(0.1, 1, n) for n in counts)]
    indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return SparseRows(
        indptr, np.concatenate(indices).astype(np.int32), np.concatenate(weights).astype(np.float32), N_ROWS
    )


def colors(*shape: int, seed: int = 1) -> F32:
    return np.random.default_rng(seed).uniform(0, 2, shape).astype(np.float32)


def table_of(rows: SparseRows, tint: F32) -> FilmTable:
    return film_table(rows.indptr, rows.indices, rows.weights, tint)


def expected_view(rows: SparseRows, products: F32, tint: F32) -> F64:
    dense = np.zeros(rows.shape)
    dense[np.repeat(np.arange(rows.n_rows), np.diff(rows.indptr)), rows.indices] = rows.weights
    return np.sum([t * (dense @ p[:, :3].astype(np.float64)) for t, p in zip(tint, products, strict=True)], axis=0)


COUNTS = np.random.default_rng(2).integers(0, 10, 5000).astype(np.int32)  # more than one chunk


def test_view_samples_are_interpolated_and_tinted() -> None:
    rows, products, tint = interpolation(COUNTS), colors(3, N_ROWS, 4), colors(3, len(COUNTS), 3)
    tint[1, ::3] = 0
    tint[0, 1::3] = 0
    tint[2, 2::5] = 0
    out = np.full((len(COUNTS), 3), np.nan, np.float32)
    assemble_view(tuple(table_of(rows, tint)), products, out)
    np.testing.assert_allclose(out, expected_view(rows, products, tint), rtol=2e-6, atol=1e-7)


def test_no_lobes_give_no_light() -> None:
    rows = interpolation(COUNTS)
    out = np.full((len(COUNTS), 3), np.nan, np.float32)
    none = np.zeros((0, len(COUNTS), 3), np.float32)
    assemble_view(tuple(table_of(rows, none)), np.zeros((0, N_ROWS, 4), np.float32), out)
    assert not out.any()


@pytest.mark.parametrize("n_kept", [0, 1, 3])
@pytest.mark.parametrize("samples", ["one", "varied"])
def test_film_adds_direct_light_and_what_stays(samples: str, n_kept: int) -> None:
    rng = np.random.default_rng(3)
    n_pixels = 9050
    per_pixel = np.ones(n_pixels, np.int64)
    if samples == "varied":  # single ones at first and, of samples that no longer have their pixels' numbers, behind
        for some in (slice(1030, 3000), slice(7000, None)):
            per_pixel[some] = rng.integers(0, 4, len(per_pixel[some]))
    pixel = np.repeat(np.arange(n_pixels), per_pixel).astype(np.int32)
    n = len(pixel)
    rows = interpolation(rng.integers(1, 9, n).astype(np.int32))
    products, tint, direct, gains = colors(1, N_ROWS, 4), colors(1, n, 3), colors(3, n, 3), colors(3, 3)
    dimmed_view = np.sort(rng.choice(n, 0 if samples == "one" else 1500, replace=False)).astype(np.int32)
    throughput = np.ones((n, 3), np.float32)
    throughput[dimmed_view] = colors(len(dimmed_view), 3)
    still_pixel = np.sort(rng.choice(n_pixels, 100, replace=False)).astype(np.int32)
    still = colors(100, 3)
    begin = np.concatenate([[0], np.cumsum(per_pixel)]).astype(np.int32)

    own_view = np.sort(rng.choice(n, 200, replace=False)).astype(np.int32)
    own = colors(n, 3) - np.float32(0.5)
    indirect = expected_view(rows, products, tint)
    indirect[own_view] = own[own_view]
    added_view = np.setdiff1d(rng.choice(n, 300, replace=False), own_view).astype(np.int32)
    indirect[added_view] += own[added_view]
    indirect = np.maximum(indirect, 0)
    sent = indirect + (gains[:, None].astype(np.float64) * direct).sum(axis=0)
    expected = np.zeros((n_pixels, 3))
    np.add.at(expected, pixel, sent * throughput)
    expected[still_pixel] += still
    kept = np.empty((n if n_kept else 0, 3), np.float32)
    sum_scaled(direct[:n_kept], gains[:n_kept], kept)
    summed = (kept, direct[n_kept:], np.tile(gains[n_kept:], (1, 16)))
    films = []
    before = numba.get_num_threads()
    try:
        for n_threads in (1, before):
            numba.set_num_threads(n_threads)
            film = np.full((n_pixels, 3), np.nan, np.float32)
            edited = (own_view, added_view, own)
            seen = (dimmed_view, throughput[dimmed_view], begin, runs_in_order(begin), still_pixel, still)
            assemble_film(tuple(table_of(rows, tint)), products, edited, summed, seen, film)
            films.append(film)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_allclose(films[0], expected, rtol=2e-6, atol=1e-7)
    np.testing.assert_array_equal(films[0], films[1])


def test_sum_of_lights() -> None:
    values, gains = colors(3, 2500, 3), colors(3, 3)
    out = np.full((2500, 3), np.nan, np.float32)
    sum_scaled(values, gains, out)
    np.testing.assert_allclose(out, (values.astype(np.float64) * gains[:, None]).sum(axis=0), rtol=1e-6)


@pytest.mark.parametrize("n_kept", [0, 2, 3])
def test_sum_of_images_of_lights(n_kept: int) -> None:
    values, gains, n = colors(3, 2503, 3), colors(3, 3), 2503  # more than one chunk, and no whole number of vectors
    still_pixel, still = np.arange(0, n, 7, dtype=np.int32), colors(len(range(0, n, 7)), 3, seed=5)
    expected = (values.astype(np.float64) * gains[:, None]).sum(axis=0)
    expected[still_pixel] += still
    kept = np.empty((n if n_kept else 0, 3), np.float32)
    sum_scaled(values[:n_kept], gains[:n_kept], kept)
    out = np.full((n, 3), np.nan, np.float32)
    sum_films((kept, values[n_kept:], np.tile(gains[n_kept:], (1, 16))), still_pixel, still, out)
    np.testing.assert_allclose(out, expected, rtol=1e-6)


def test_what_is_kept_of_direct_light_does_not_show_in_the_bits() -> None:
    direct, gains = colors(4, 2500, 3), colors(4, 3)
    nothing = np.zeros(0, np.int32)
    begin = np.arange(2501, dtype=np.int32)
    seen = (nothing, np.zeros((0, 3), np.float32), begin, runs_in_order(begin), nothing, np.zeros((0, 3), np.float32))
    own = (nothing, nothing, np.zeros((0, 3), np.float32))
    rows, tint = interpolation(np.full(2500, 3, np.int32)), colors(1, 2500, 3)
    table, products = tuple(table_of(rows, tint)), colors(1, N_ROWS, 4)
    expected = np.empty((2500, 3), np.float32)
    whole = (np.zeros((0, 3), np.float32), direct, np.tile(gains, (1, 16)))
    assemble_film(table, products, own, whole, seen, expected)
    sums, moves = DirectSum(), [0, 0, 0, 0]
    for changed in (None, None, 2, 2, None, 0, 3, None):
        if changed is not None:
            gains[changed] += np.float32(0.25)
            moves[changed] += changed % 2
            whole = (whole[0], direct, np.tile(gains, (1, 16)))
            assemble_film(table, products, own, whole, seen, expected)
        found = np.empty((2500, 3), np.float32)
        assemble_film(table, products, own, tuple(sums.now(direct, gains, moves)), seen, found)
        np.testing.assert_array_equal(found, expected)


def test_a_light_that_moved_is_not_kept() -> None:
    direct, gains, sums = colors(3, 100, 3), colors(3, 3), DirectSum()
    assert [len(sums.now(direct, gains, [1, 1, 1]).gains) for _ in range(3)] == [3, 0, 0]
    direct[1] *= 2
    now = sums.now(direct, gains, [1, 5, 1])
    assert len(now.gains) == 2
    np.testing.assert_allclose(now.kept, direct[0] * gains[0], rtol=1e-6)
    assert len(sums.now(direct, gains, None).gains) == 3


def test_weights_of_the_table_are_those_of_the_matrix() -> None:
    rows, tint = interpolation(COUNTS), np.ones((1, len(COUNTS), 3), np.float32)
    table = table_of(rows, tint)
    total = table.weight.sum(axis=1, dtype=np.float64)
    np.add.at(total, table.more_view, table.more_weight.sum(axis=1, dtype=np.float64))
    np.testing.assert_allclose(total, np.where(COUNTS > 0, 1, 0), atol=1e-6)
    assert len(table.more_view) == np.sum(np.maximum((COUNTS + 3) // 4 - 1, 0))
