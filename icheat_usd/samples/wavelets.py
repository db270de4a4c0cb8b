"""Weighted Haar wavelets on the cluster tree, for any number of leaves.

The basis is orthonormal in ``<f, g> = sum of weight * f * g``: with all
coefficients a dot product of coefficients is that of the functions.
"""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels import wavelets as kernels
from icheat_usd.samples.tree import ClusterTree
from icheat_usd.scene import F32, F64, I32, I64


def haar_forward(tree: ClusterTree, values: F32 | F64) -> F64:
    """Coefficients of leaf functions.

    Parameters
    ----------
    values : (n_leaves,) or (n_leaves, k) floating

    Returns
    -------
    Same shape, float64; row 0 is the mean's coefficient, row ``1 + node`` the node's detail.
    """
    columns = _columns(tree, values)
    out = np.empty(columns.shape, np.float64)
    kernels.haar_forward(tree.left, tree.right, tree.weight, tree.node_weight, columns, out)
    return out.reshape(values.shape)


def haar_inverse(tree: ClusterTree, coefficients: F32 | F64) -> F64:
    """Leaf functions of coefficients; undoes `haar_forward`."""
    columns = _columns(tree, coefficients)
    out = np.empty(columns.shape, np.float64)
    kernels.haar_inverse(tree.left, tree.right, tree.weight, tree.node_weight, columns, out)
    return out.reshape(coefficients.shape)


def haar_evaluate(tree: ClusterTree, indptr: I64, indices: I32, values: F32, row: I32, leaf: I32) -> F64:
    """Values of sparse coefficient rows at single leaves: (n,) for queries `row` (n,), `leaf` (n,)."""
    out = np.empty(len(leaf), np.float64)
    kernels.haar_evaluate(
        tree.mid, tree.left, tree.right, tree.weight, tree.node_weight, indptr, indices, values, row, leaf, out
    )
    return out


def _columns(tree: ClusterTree, values: F32 | F64) -> F32 | F64:
    if len(values) != tree.n_leaves:
        raise ValueError(f"{len(values)} values for a tree of {tree.n_leaves} leaves")
    return np.require(values.reshape(len(values), -1), requirements=["C", "W"])
