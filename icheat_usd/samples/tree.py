"""The hierarchy over gather samples: scene structure first, then space.

Edits select whole surfaces more often than anything else; with subtrees that
follow the scene, such a selection needs a handful of wavelet coefficients.
"""

from __future__ import annotations

import hashlib
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels import samples as kernels
from icheat_usd.kernels.wavelets import sum_weights
from icheat_usd.scene import F32, F64, I32, I64

NORMAL_WEIGHT = 0.4  # of a group's extent: how far apart a turn by one radian puts two samples


@dataclass(frozen=True)
class ClusterTree:
    """A binary tree whose leaves are the gather samples in order.

    Nodes are numbered in pre-order, so node 0 is the root and the children of
    a node follow from its range. A tree of one leaf has no nodes.
    """

    lo: I32  #: (n_leaves - 1,) first leaf of the node
    mid: I32  #: (n_leaves - 1,) first leaf of its right child
    hi: I32  #: (n_leaves - 1,) one past its last leaf
    left: I32  #: (n_leaves - 1,) node, or -1 - leaf
    right: I32  #: (n_leaves - 1,) node, or -1 - leaf
    weight: F64  #: (n_leaves,) of the leaves, positive: areas in square metres
    node_weight: F64  #: (n_leaves - 1,) sums of them
    depth: int  #: nodes on the longest way from the root to a leaf
    digest: str  #: hexadecimal SHA-256 of what identifies the leaves, their weights and the shape

    @property
    def n_leaves(self) -> int:
        return len(self.weight)


@dataclass(frozen=True)
class TreeShape:
    """Splits of a tree, and the samples in the order of its leaves."""

    order: I64  #: (n,) sample of each leaf
    lo: I32
    mid: I32
    hi: I32
    group_node: I32  #: (n_groups,) node of each group, or -1 where the group has one sample


def split_samples(groups: Sequence[tuple[str, ...]], group_begin: I64, position: F32, normal: F32) -> TreeShape:
    """Split samples by the names of their groups, then by place within each group.

    Parameters
    ----------
    groups
        Names of the levels above each group, sorted and without repetition.
    group_begin : (n_groups + 1,)
        Samples of each group; none is empty.
    position, normal : (n, 3)
        Of the samples, metres.
    """
    n = int(group_begin[-1])
    lo, mid, hi = (np.empty(max(n - 1, 0), np.int32) for _ in range(3))
    group_node = np.full(len(groups), -1, np.int32)
    begin = group_begin.tolist()
    # A task is a run of units (a unit: groups with the same names down to `level`), and the node that it becomes.
    tasks: list[tuple[list[int], int, int, int]] = [([0, len(groups)], -1, 0, 0)]
    while tasks:
        units, level, node, leaf = tasks.pop()
        first, last = units[0], units[-1]
        if last - first == 1:
            if begin[last] - begin[first] > 1:
                group_node[first] = node
            continue
        while len(units) == 2:
            level += 1
            units = _runs(groups, first, last, level)
        half = 0.5 * (begin[first] + begin[last])
        cut = bisect_left(units, half, 1, len(units) - 1, key=lambda group: begin[group])
        if cut == len(units) - 1 or (cut > 1 and half - begin[units[cut - 1]] < begin[units[cut]] - half):
            cut -= 1
        middle = begin[units[cut]]
        lo[node], mid[node], hi[node] = leaf, middle, begin[last]
        tasks.append((units[: cut + 1], level, node + 1, leaf))
        tasks.append((units[cut:], level, node + middle - leaf, middle))
    turn = np.empty(len(groups), np.float32)
    if n:
        extent = np.maximum.reduceat(position, group_begin[:-1]) - np.minimum.reduceat(position, group_begin[:-1])
        turn[:] = NORMAL_WEIGHT * extent.max(axis=1)
    order = np.arange(n)
    kernels.split_groups(position, normal, turn, group_begin, group_node, order, lo, mid, hi)
    return TreeShape(order, lo, mid, hi, group_node)


def _runs(groups: Sequence[tuple[str, ...]], first: int, last: int, level: int) -> list[int]:
    """Where the name at `level` changes between groups ``first:last``, both ends included."""
    cuts = [first]
    for g in range(first + 1, last):
        if groups[g][level : level + 1] != groups[g - 1][level : level + 1]:
            cuts.append(g)
    cuts.append(last)
    return cuts


def build_tree(shape: TreeShape, weight: F64, identity: bytes) -> ClusterTree:
    """Complete a tree with the weights of its leaves.

    Parameters
    ----------
    weight : (n,) positive
        In the order of the leaves.
    identity
        What names the leaves from one session to the next; goes into the digest.

    Raises
    ------
    ValueError
        A weight is not positive: such a leaf would divide by zero, and must be dropped before.
    """
    weight = np.ascontiguousarray(weight, np.float64)
    if not (len(weight) and np.all(weight > 0) and np.all(np.isfinite(weight))):
        raise ValueError("a cluster tree needs leaves, all of positive weight")
    lo, mid, hi = shape.lo, shape.mid, shape.hi
    node = np.arange(len(mid), dtype=np.int32)
    left = np.where(mid - lo == 1, -1 - lo, node + 1).astype(np.int32)
    right = np.where(hi - mid == 1, -1 - mid, node + mid - lo).astype(np.int32)
    node_weight = np.empty(len(mid), np.float64)
    sum_weights(left, right, weight, node_weight)
    digest = hashlib.sha256(identity)
    digest.update(weight.astype("<f4").tobytes())
    digest.update(mid.astype("<i4").tobytes())
    return ClusterTree(lo, mid, hi, left, right, weight, node_weight, _depth(left, right), digest.hexdigest())


def _depth(left: I32, right: I32) -> int:
    level = np.array([0] if len(left) else [], np.int64)
    depth = 0
    while len(level):
        depth += 1
        children = np.concatenate([left[level], right[level]])
        level = children[children >= 0].astype(np.int64)
    return depth
