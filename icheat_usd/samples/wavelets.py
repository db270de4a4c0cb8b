"""Weighted Haar wavelets on the cluster tree, for any number of leaves.

The basis is orthonormal in ``<f, g> = sum of weight * f * g``: with all
coefficients a dot product of coefficients is that of the functions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels import wavelets as kernels
from icheat_usd.kernels.haar import transform_versions
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


_SUBTREE = 1024  # leaves: its means fit the first-level cache
_RUNS = 32  # that threads take equal shares of


@dataclass(frozen=True, eq=False)
class HaarPlan:
    """What the transform of many functions on one tree needs, found once.

    The tree is cut into subtrees that threads work on alone and a top above
    them. A place is where a child's mean is put: in a subtree its leaves come
    first, then its nodes; above, the subtrees come first, then the top's nodes.
    """

    subtree_leaf: I64  #: (n_subtrees + 1,) first leaf
    subtree_node: I64  #: (n_subtrees,) first node, the subtree's root unless it is a leaf
    run_begin: I64  #: (n_runs + 1,) first subtree of runs with about equal numbers of leaves
    top_node: I64  #: (n_top,) nodes above the subtrees, ascending
    left: I32  #: (n_leaves - 1,) place of the left child
    right: I32  #: (n_leaves - 1,) place of the right child
    share: F32  #: (n_leaves - 1,) of the node's weight that lies in the left child
    detail: F32  #: (n_leaves - 1,) coefficient for a difference of 1 between the children's means
    root: np.float32  #: coefficient 0 for a mean of 1

    @property
    def n_leaves(self) -> int:
        return int(self.subtree_leaf[-1])


def plan_haar(tree: ClusterTree) -> HaarPlan:
    """Prepare `haar_of_versions`."""
    roots, top, stack = [], [], [(0, 0, tree.n_leaves)]
    while stack:
        node, begin, end = stack.pop()
        if end - begin <= _SUBTREE:
            roots.append((begin, node))
            continue
        middle = int(tree.mid[node])
        top.append(node)
        stack.append((node + middle - begin, middle, end))
        stack.append((node + 1, begin, middle))
    leaf = np.array([begin for begin, _ in roots] + [tree.n_leaves], np.int64)
    first = np.array([node for _, node in roots], np.int64)
    left, right = _subtree_places(tree, leaf, first)
    _set_top_places(tree, leaf, np.array(top, np.int64), left, right)
    a, b = _child_weights(tree)
    runs = np.searchsorted(leaf, np.linspace(0, tree.n_leaves, _RUNS + 1))
    return HaarPlan(
        leaf,
        first,
        runs.astype(np.int64),
        np.array(top, np.int64),
        left,
        right,
        (a / (a + b)).astype(np.float32),
        np.sqrt(a * b / (a + b)).astype(np.float32),
        np.float32(np.sqrt(tree.weight.sum())),
    )


def haar_of_versions(plan: HaarPlan, values: F32, out: F32 | None = None, slots: I64 | None = None) -> F32:
    """`haar_forward` of several colour functions in float32: the same to about 1e-6 of a function's size.

    Parameters
    ----------
    values : (n_versions, n_leaves, 3) float32
    out : (n_slots, n_leaves, 4) float32, optional
        Receives the result.
    slots : (n_versions,), optional
        Where in `out` each version goes, in order by default.

    Returns
    -------
    (n_versions, n_leaves, 4) float32; the last channel is 0.

    Notes
    -----
    The same bits for any number of threads or versions.
    """
    if values.ndim != 3 or values.shape[1:] != (plan.n_leaves, 3):
        raise ValueError(f"values of shape {values.shape} for a tree of {plan.n_leaves} leaves")
    if out is None:
        out = np.empty((len(values), plan.n_leaves, 4), np.float32)
    transform_versions(
        np.require(values, np.float32, ["C", "W"]),
        plan.subtree_leaf,
        plan.subtree_node,
        plan.run_begin,
        plan.left,
        plan.right,
        plan.share,
        plan.detail,
        plan.top_node,
        plan.root,
        np.empty((len(values), len(plan.subtree_node) + len(plan.top_node), 4), np.float32),
        np.arange(len(values)) if slots is None else slots,
        out,
    )
    return out


def _subtree_places(tree: ClusterTree, leaf: I64, first: I64) -> tuple[I32, I32]:
    """Places of all nodes' children, as if every node were in a subtree."""
    size = np.diff(leaf)
    subtree = np.clip(np.searchsorted(leaf, tree.lo, side="right") - 1, 0, len(size) - 1)

    def places(child: I32) -> I32:
        of_leaf = -1 - child - leaf[subtree]
        of_node = size[subtree] + child - first[subtree]
        return np.where(child < 0, of_leaf, of_node).astype(np.int32)

    return places(tree.left), places(tree.right)


def _set_top_places(tree: ClusterTree, leaf: I64, top: I64, left: I32, right: I32) -> None:
    """Correct the places of the children of `top`."""
    n_subtrees = len(leaf) - 1
    for side, first_leaf, child in ((left, tree.lo, tree.left), (right, tree.mid, tree.right)):
        rank = np.minimum(np.searchsorted(top, child[top]), len(top) - 1)
        is_top = (child[top] >= 0) & (top[rank] == child[top]) if len(top) else np.zeros(0, bool)
        side[top] = np.where(is_top, n_subtrees + rank, np.searchsorted(leaf, first_leaf[top]))


def _child_weights(tree: ClusterTree) -> tuple[F64, F64]:
    def weights(child: I32) -> F64:
        of_leaf = tree.weight[np.where(child < 0, -1 - child, 0)]
        return np.where(child < 0, of_leaf, tree.node_weight[np.maximum(child, 0)]) if len(child) else np.empty(0)

    return weights(tree.left), weights(tree.right)


def _columns(tree: ClusterTree, values: F32 | F64) -> F32 | F64:
    if len(values) != tree.n_leaves:
        raise ValueError(f"{len(values)} values for a tree of {tree.n_leaves} leaves")
    return np.require(values.reshape(len(values), -1), requirements=["C", "W"])
