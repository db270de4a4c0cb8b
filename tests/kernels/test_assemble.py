"""Assembled view samples and pixels against sparse products, tints and sums in double precision."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from icheat_usd.kernels.assemble import (
    InterpolationTable,
    assemble_film,
    assemble_view,
    chunks_in_order,
    interpolation_table,
    sum_scaled,
)
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


def table_of(rows: SparseRows) -> InterpolationTable:
    return interpolation_table(rows.indptr, rows.indices, rows.weights)


def expected_view(rows: SparseRows, products: F32, tint: F32) -> F64:
    dense = np.zeros(rows.shape)
    dense[np.repeat(np.arange(rows.n_rows), np.diff(rows.indptr)), rows.indices] = rows.weights
    return np.sum([t * (dense @ p[:, :3].astype(np.float64)) for t, p in zip(tint, products, strict=True)], axis=0)


COUNTS = np.random.default_rng(2).integers(0, 10, 5000).astype(np.int32)  # more than one chunk


def test_view_samples_are_interpolated_and_tinted() -> None:
    rows, products, tint = interpolation(COUNTS), colors(2, N_ROWS, 4), colors(2, len(COUNTS), 3)
    tint[1, ::3] = 0
    out = np.full((len(COUNTS), 3), np.nan, np.float32)
    assemble_view(*table_of(rows), products, tint, out)
    np.testing.assert_allclose(out, expected_view(rows, products, tint), rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize("samples", ["one", "varied"])
def test_film_adds_direct_light_and_what_stays(samples: str) -> None:
    rng = np.random.default_rng(3)
    n_pixels = 4500
    per_pixel = np.ones(n_pixels, np.int64)
    if samples == "varied":
        per_pixel[1024:] = rng.integers(0, 4, n_pixels - 1024)
    pixel = np.repeat(np.arange(n_pixels), per_pixel).astype(np.int32)
    n = len(pixel)
    rows = interpolation(rng.integers(1, 9, n).astype(np.int32))
    products, tint, direct, gains = colors(1, N_ROWS, 4), colors(1, n, 3), colors(2, n, 3), colors(2, 3)
    dimmed_view = np.sort(rng.choice(n, 0 if samples == "one" else 1500, replace=False)).astype(np.int32)
    throughput = np.ones((n, 3), np.float32)
    throughput[dimmed_view] = colors(len(dimmed_view), 3)
    still_pixel = np.sort(rng.choice(n_pixels, 100, replace=False)).astype(np.int32)
    still = colors(100, 3)
    begin = np.concatenate([[0], np.cumsum(per_pixel)]).astype(np.int32)

    own_view = np.sort(rng.choice(n, 200, replace=False)).astype(np.int32)
    own, touched = colors(n, 3) - np.float32(0.5), rng.uniform(size=n) < 0.4
    indirect = expected_view(rows, products, tint)
    indirect[own_view] = own[own_view]
    indirect[touched] = np.maximum(indirect[touched], 0)
    sent = indirect + (gains[:, None].astype(np.float64) * direct).sum(axis=0)
    expected = np.zeros((n_pixels, 3))
    np.add.at(expected, pixel, sent * throughput)
    expected[still_pixel] += still
    films = []
    before = numba.get_num_threads()
    try:
        for n_threads in (1, before):
            numba.set_num_threads(n_threads)
            film = np.full((n_pixels, 3), np.nan, np.float32)
            edited = (own_view, own, touched)
            seen = (dimmed_view, throughput[dimmed_view], begin, chunks_in_order(begin), still_pixel, still)
            assemble_film(*table_of(rows), products, tint, *edited, direct, gains, *seen, film)
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


def test_weights_of_the_table_are_those_of_the_matrix() -> None:
    rows = interpolation(COUNTS)
    table = table_of(rows)
    total = table.weight.sum(axis=1, dtype=np.float64)
    np.add.at(total, table.more_view, table.more_weight.sum(axis=1, dtype=np.float64))
    np.testing.assert_allclose(total, np.where(COUNTS > 0, 1, 0), atol=1e-6)
    assert len(table.more_view) == np.sum(np.maximum((COUNTS + 3) // 4 - 1, 0))
