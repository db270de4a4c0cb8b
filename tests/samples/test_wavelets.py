"""The Haar basis on a cluster tree is orthonormal, and follows the scene's surfaces."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.samples.tree import ClusterTree, build_tree, split_samples
from icheat_usd.samples.wavelets import haar_evaluate, haar_forward, haar_inverse, haar_of_versions, plan_haar


def tree_of(sizes: list[int], seed: int = 0, *, equal: bool = False) -> tuple[ClusterTree, NDArray[np.int64]]:
    """Tree over random samples of surfaces ``/a``, ``/b``, ... of the given sizes, and the surface of each leaf."""
    rng = np.random.default_rng(seed)
    n = sum(sizes)
    owner = np.repeat(np.arange(len(sizes)), sizes)
    position = np.zeros((n, 3), np.float32) if equal else rng.normal(size=(n, 3)).astype(np.float32)
    normal = np.tile(np.float32([0, 0, 1]), (n, 1))
    groups = [("world", f"{i:03d}") for i in range(len(sizes))]
    begin = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    shape = split_samples(groups, begin, position, normal)
    weight = rng.uniform(0.01, 3, n)
    return build_tree(shape, weight, b""), owner[shape.order]


@pytest.mark.parametrize("sizes", [[1], [2], [1, 1, 1], [5, 1, 17], [1000, 3, 345]])
def test_inverse_undoes_forward_for_any_number_of_leaves(sizes: list[int]) -> None:
    tree, _ = tree_of(sizes)
    f = np.random.default_rng(1).normal(size=(tree.n_leaves, 4))
    np.testing.assert_allclose(haar_inverse(tree, haar_forward(tree, f)), f, atol=1e-11)


@pytest.mark.parametrize("sizes", [[1], [5, 1, 17], [1000, 345]])
def test_dot_products_of_coefficients_are_those_of_the_functions(sizes: list[int]) -> None:
    tree, _ = tree_of(sizes)
    f, g = np.random.default_rng(2).normal(size=(2, tree.n_leaves))
    expected = np.sum(tree.weight * f * g)
    assert haar_forward(tree, f) @ haar_forward(tree, g) == pytest.approx(expected, rel=1e-11, abs=1e-9)
    assert haar_forward(tree, f) @ haar_forward(tree, f) == pytest.approx(np.sum(tree.weight * f * f), rel=1e-11)


def test_basis_functions_are_orthonormal_by_explicit_matrix() -> None:
    tree, _ = tree_of([3, 4, 2])
    basis = haar_inverse(tree, np.eye(tree.n_leaves))
    np.testing.assert_allclose(basis.T @ (tree.weight[:, None] * basis), np.eye(tree.n_leaves), atol=1e-12)


def test_equal_points_still_make_a_tree() -> None:
    tree, _ = tree_of([7, 6], equal=True)
    f = np.arange(13.0)
    np.testing.assert_allclose(haar_inverse(tree, haar_forward(tree, f)), f, atol=1e-12)


def test_a_leaf_without_area_is_refused() -> None:
    shape = split_samples([("a",)], np.array([0, 2]), np.zeros((2, 3), np.float32), np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="positive weight"):
        build_tree(shape, np.array([1.0, 0.0]), b"")


def test_sparse_evaluation_equals_the_dense_inverse() -> None:
    tree, _ = tree_of([50, 3, 21])
    rng = np.random.default_rng(3)
    dense = np.where(rng.random((5, tree.n_leaves)) < 0.2, rng.normal(size=(5, tree.n_leaves)), 0)
    expected = haar_inverse(tree, np.ascontiguousarray(dense.T)).T
    row, column = np.nonzero(dense)
    indptr = np.searchsorted(row, np.arange(6)).astype(np.int64)
    rows, leaves = (a.ravel().astype(np.int32) for a in np.mgrid[0:5, 0 : tree.n_leaves])
    found = haar_evaluate(tree, indptr, column.astype(np.int32), dense[row, column].astype(np.float32), rows, leaves)
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=1e-5)


def test_the_mask_of_one_surface_needs_no_more_coefficients_than_the_surfaces_above_it() -> None:
    tree, owner = tree_of([400, 300, 200, 500, 100])
    coefficients = haar_forward(tree, (owner == 2).astype(np.float64))
    assert np.count_nonzero(np.abs(coefficients) > 1e-12) <= 5


def test_ranges_of_nodes_nest_and_cover_every_leaf_once() -> None:
    tree, owner = tree_of([9, 1, 30])
    assert (tree.lo[0], tree.hi[0]) == (0, 40)
    for node in range(len(tree.lo)):
        for child, expected in (
            (tree.left[node], (tree.lo[node], tree.mid[node])),
            (tree.right[node], (tree.mid[node], tree.hi[node])),
        ):
            found = (tree.lo[child], tree.hi[child]) if child >= 0 else (-1 - child, -child)
            assert found == expected
    assert np.all(np.diff(owner) >= 0)


def test_the_digest_changes_with_weights_shape_and_names() -> None:
    shape = split_samples([("a",)], np.array([0, 3]), np.eye(3, dtype=np.float32), np.eye(3, dtype=np.float32))
    base = build_tree(shape, np.ones(3), b"x").digest
    assert build_tree(shape, np.ones(3), b"x").digest == base
    assert build_tree(shape, np.array([1, 1, 2.0]), b"x").digest != base
    assert build_tree(shape, np.ones(3), b"y").digest != base


@pytest.mark.parametrize("sizes", [[1], [2], [1, 1, 1], [5, 1, 17], [1000, 3, 345], [1, 1030, 1, 2100, 5]])
def test_versions_in_single_precision_are_the_transform(sizes: list[int]) -> None:
    tree, _ = tree_of(sizes)
    values = np.random.default_rng(4).lognormal(sigma=2, size=(3, tree.n_leaves, 3)).astype(np.float32)
    got = haar_of_versions(plan_haar(tree), values)
    for version in range(3):
        expected = haar_forward(tree, values[version])
        np.testing.assert_allclose(got[version, :, :3], expected, rtol=0, atol=1e-6 * np.linalg.norm(expected))
    assert not got[..., 3].any()


def test_versions_have_the_same_bits_for_any_number_of_threads_and_versions() -> None:
    tree, _ = tree_of([1, 1030, 1, 2100, 5])
    plan = plan_haar(tree)
    values = np.random.default_rng(4).normal(size=(3, tree.n_leaves, 3)).astype(np.float32)
    together = haar_of_versions(plan, values)
    before = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        np.testing.assert_array_equal(haar_of_versions(plan, values), together)
    finally:
        numba.set_num_threads(before)
    np.testing.assert_array_equal(haar_of_versions(plan, values[1:2])[0], together[1])


def test_versions_of_another_tree_are_refused() -> None:
    with pytest.raises(ValueError, match="5 leaves"):
        haar_of_versions(plan_haar(tree_of([5])[0]), np.zeros((1, 4, 3), np.float32))
