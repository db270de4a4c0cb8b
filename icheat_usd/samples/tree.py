"""The hierarchy over gather samples: scene structure first, then space."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.scene import F64, I32


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
    digest: str  #: hexadecimal SHA-256 of what identifies the leaves, their weights and the shape

    @property
    def n_leaves(self) -> int:
        return len(self.weight)
