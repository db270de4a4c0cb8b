"""Transport laid out for frames against the plain product of the same packed rows."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.samples import ClusterTree
from icheat_usd.samples.tree import build_tree, split_samples
from icheat_usd.scene import F32
from icheat_usd.transport import PackedLobe, PackedRows, PackedTransport, SparseRows
from icheat_usd.transport.prepared import prepare_transport

N_LEAVES, N_ROWS, N_VIEW = 500, 150, 700  # two tiles and a part of one


def tree() -> ClusterTree:
    rng = np.random.default_rng(1)
    position = rng.random((N_LEAVES, 3)).astype(np.float32)
    shape = split_samples([("a",)], np.array([0, N_LEAVES]), position, np.zeros((N_LEAVES, 3), np.float32))
    return build_tree(shape, rng.uniform(0.5, 2, N_LEAVES), b"")


def rows(on: ClusterTree, kind: type, counts: tuple[int, ...], seed: int) -> PackedRows:
    rng = np.random.default_rng(seed)
    index = np.concatenate([np.sort(rng.choice(N_LEAVES, n, replace=False)) for n in counts]).astype(np.int32)
    value = rng.integers(-127, 128, (len(index), 64)).astype(kind)
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return PackedRows(on, N_ROWS, begin, index, rng.uniform(0.1, 1, len(index)).astype(np.float32), value)


def packed(kind: type) -> PackedTransport:
    on, rng = tree(), np.random.default_rng(2)
    tint = rng.uniform(0, 1, (3, N_VIEW, 3)).astype(np.float32)
    tint[1, ::2] = 0
    lobes = (
        PackedLobe("diffuse", rows(on, kind, (31, 200, 64), 3), tint[0]),
        PackedLobe("specular_base", rows(on, kind, (0, 17, 5), 4), tint[1]),
        PackedLobe("specular_edge", rows(on, kind, (0, 0, 0), 5), tint[2]),
    )
    counts = rng.integers(1, 7, N_VIEW)
    indices = np.concatenate([np.sort(rng.choice(N_ROWS, n, replace=False)) for n in counts]).astype(np.int32)
    weights = np.repeat(1 / counts, counts).astype(np.float32)
    spread = SparseRows(np.concatenate([[0], np.cumsum(counts)]), indices, weights, N_ROWS)
    return PackedTransport(lobes, np.arange(N_ROWS, dtype=np.int32), spread)


def light() -> F32:
    return np.random.default_rng(6).lognormal(size=(N_LEAVES, 3)).astype(np.float32)


@pytest.mark.parametrize(("kind", "tolerance"), [(np.int8, 1e-4), (np.float32, 2e-6)])
@pytest.mark.parametrize("interpolated", [True, False])
def test_is_the_plain_product(kind: type, tolerance: float, interpolated: bool) -> None:
    transport = packed(kind)
    if not interpolated:
        lobes = tuple(replace(lobe, tint=lobe.tint[:N_ROWS].copy()) for lobe in transport.lobes)
        transport = replace(transport, lobes=lobes, interpolation=None)
    expected = transport.to_view(light())
    got = prepare_transport(transport).to_view(light())
    assert np.linalg.norm(got - expected) <= tolerance * np.linalg.norm(expected)


def test_same_bits_for_any_number_of_threads() -> None:
    prepared = prepare_transport(packed(np.int8))
    together = prepared.to_view(light())
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(prepared.to_view(light()), together)
    finally:
        numba.set_num_threads(before)
