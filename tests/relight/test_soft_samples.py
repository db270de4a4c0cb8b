"""Light under soft masks: both ways of adding terms up, against sums in NumPy and against each other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from icheat_usd.kernels.soft_terms import SoftTable
from icheat_usd.relight import soft_samples
from icheat_usd.relight.products import Products
from icheat_usd.relight.soft_samples import SoftSamples
from icheat_usd.transport.sparse import SparseRows

N_VIEW, N_RECORDS, N_VERSIONS, N_LOBES = 700, 300, 9, 2


class Case:
    """Samples of five groups, of none to eight terms, that share records."""

    def __init__(self, *, sparse: bool = True, seed: int = 3) -> None:
        rng = np.random.default_rng(seed)
        n_rows = N_RECORDS if sparse else N_VIEW
        n_tiles = -(-n_rows // 64)
        counts = rng.integers(0, 6, N_VIEW)
        indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        near = np.repeat(np.arange(N_VIEW) * N_RECORDS // N_VIEW, counts)
        indices = ((near + rng.integers(0, 9, len(near))) % N_RECORDS).astype(np.int32)
        weights = rng.uniform(0, 1, len(near)).astype(np.float32)
        spread = SparseRows(indptr, indices, weights, N_RECORDS) if sparse else SparseRows.empty(0, 0)
        tints = rng.uniform(0, 1, (N_LOBES, N_VIEW, 3)).astype(np.float32)
        tints[1, ::3] = 0
        self.products = cast(Products, SimpleNamespace(interpolation=spread, is_sparse=int(sparse), tints=tints))
        term_begin = np.cumsum([0, 0, 3, 8, 1, 4]).astype(np.int64)
        n_terms = int(term_begin[-1])
        factor_begin = np.concatenate([[0], np.cumsum(rng.integers(0, 4, n_terms))]).astype(np.int64)
        self.table = SoftTable(
            term_begin,
            rng.integers(0, N_VERSIONS, n_terms).astype(np.int32),
            factor_begin,
            rng.integers(0, 4, factor_begin[-1]).astype(np.int32),
            rng.uniform(0, 1, (4, N_VIEW)).astype(np.float32),
        )
        self.group = rng.integers(0, 5, N_VIEW).astype(np.int32)
        self.samples = np.sort(rng.choice(N_VIEW, 450, replace=False)).astype(np.int64)
        self.pair_of = rng.permutation(N_VERSIONS * n_tiles).reshape(N_VERSIONS, n_tiles).astype(np.int32)
        self.values = rng.normal(size=(N_LOBES, self.pair_of.size, 64, 4)).astype(np.float32)

    def found(self, by: SoftSamples) -> np.ndarray:
        out = np.full((N_VIEW, 3), 7, np.float32)
        by.light(self.samples, self.group, self.table, self.pair_of, self.values, self.products, out)
        return out

    def expected(self) -> np.ndarray:
        out, spread, table = np.full((N_VIEW, 3), 7.0), self.products.interpolation, self.table
        for s in self.samples:
            out[s] = 0
            records: list[tuple[int, Any]] = [(int(s), 1.0)]
            if self.products.is_sparse:
                some = slice(spread.indptr[s], spread.indptr[s + 1])
                records = list(zip(spread.indices[some].tolist(), spread.weights[some], strict=True))
            for term in range(table.term_begin[self.group[s]], table.term_begin[self.group[s] + 1]):
                factors = table.factor[table.factor_begin[term] : table.factor_begin[term + 1]]
                factor = np.prod(table.masks[factors, s].astype(np.float64))
                for row, weight in records:
                    sent = self.values[:, self.pair_of[table.term_version[term], row >> 6], row & 63, :3]
                    out[s] += (sent.astype(np.float64) * self.products.tints[:, s] * factor * weight).sum(axis=0)
        return out


@pytest.mark.parametrize("sparse", [True, False])
def test_every_way_finds_the_sum_of_the_terms_and_leaves_other_samples_alone(sparse: bool) -> None:
    case, by = Case(sparse=sparse), SoftSamples()
    first, second, third = (case.found(by) for _ in range(3))
    np.testing.assert_allclose(first, case.expected(), rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(first.view(np.uint32), second.view(np.uint32))
    np.testing.assert_array_equal(first.view(np.uint32), third.view(np.uint32))


def test_what_is_kept_of_samples_follows_masks_products_and_groups() -> None:
    case, by = Case(), SoftSamples()
    case.found(by)
    case.found(by)
    case.table.masks[:] *= np.float32(0.5)
    case.values[:] += np.float32(1)
    np.testing.assert_array_equal(case.found(by), case.found(SoftSamples()))
    case.group[:] = (case.group + 1) % 5
    for _ in range(2):
        np.testing.assert_array_equal(case.found(by), case.found(SoftSamples()))
    case.samples = case.samples[::2].copy()
    for _ in range(2):
        np.testing.assert_array_equal(case.found(by), case.found(SoftSamples()))


def test_too_many_products_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    case, by = Case(), SoftSamples()
    monkeypatch.setattr(soft_samples, "_MOST_BYTES", 1000)
    images = [case.found(by) for _ in range(3)]
    np.testing.assert_array_equal(images[0], images[2])
    np.testing.assert_allclose(images[2], case.expected(), rtol=1e-4, atol=1e-4)
