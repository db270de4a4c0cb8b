"""Bounces between gather cells at interactive rates: the first exact, later ones between clusters of cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels import quick_bounces as kernels
from icheat_usd.samples import ClusterTree
from icheat_usd.scene import F32, I64
from icheat_usd.transport.bounces import Bounces

_CLUSTERS = 1024  # at most: their matrices take 12 MB


@dataclass(frozen=True, eq=False)
class QuickBounces:
    """Bounce rows in a word per entry, and the mean rows of clusters of neighbouring cells.

    The first bounce is exact up to the rounding of weights (by at most 0.4 % each at 65,536 cells, of
    either sign); light after it is the mean of its cluster.
    """

    indptr: I64  #: (n_gather + 1,)
    entries: np.ndarray  #: (n_entries,) uint32: column in the last `column_bits`, weight's leading bits in the others
    column_bits: int
    albedo: F32  #: (n_gather, 3)
    begin: I64  #: (n_clusters + 1,) first cell of each cluster
    share: F32  #: (n_gather,) of the cell in its cluster's area
    blocks: F32  #: later bounces, between clusters and per colour: see `kernels.quick_bounces.reach_clusters`
    scratch: F32  #: (2, n_gather, 4) for `solve`, which thus serves one thread at a time

    def solve(self, direct: F32) -> F32:
        """Approximation of `solve_bounces` for one light: (n_gather, 3) to (n_gather, 3)."""
        n_clusters = len(self.begin) - 1
        padded, out = self.scratch
        padded[:, :3] = direct
        kernels.first_bounce(self.indptr, self.entries, self.column_bits, padded, self.albedo, out)
        leaves, arriving = np.empty((3, n_clusters), np.float32), np.empty((n_clusters, 3), np.float32)
        kernels.cluster_means(self.begin, self.share, out, padded, leaves)
        kernels.reach_clusters(self.blocks, leaves, arriving)
        kernels.add_clusters(self.begin, self.albedo, arriving, out)
        return np.ascontiguousarray(out[:, :3])


def build_quick_bounces(
    bounces: Bounces, tree: ClusterTree, n_bounces: int = 16, most_clusters: int = _CLUSTERS
) -> QuickBounces:
    """Shorten the rows, merge them over nodes of the tree and add up all bounces after the first between those.

    Parameters
    ----------
    n_bounces : int
        Diffuse reflections before the last one, as for `solve_bounces`; at least 2.
    """
    rows = bounces.rows
    bits = max(1, int(tree.n_leaves - 1).bit_length())
    entries = np.empty(rows.n_entries, np.uint32)
    kernels.shorten(rows.indices, rows.weights, bits, entries)
    begin = _clusters(tree, most_clusters)
    size = np.diff(begin)
    cluster = np.repeat(np.arange(len(size), dtype=np.int32), size)
    area = np.add.reduceat(tree.weight, begin[:-1])
    share = (tree.weight / area[cluster]).astype(np.float32)
    factors = np.zeros((len(size), len(size)), np.float32)
    kernels.merge_rows(begin, share, cluster, rows.indptr, rows.indices, rows.weights, factors)
    albedo = np.add.reduceat(bounces.albedo * share[:, None], begin[:-1], axis=0)
    matrices = [_all_bounces(factors, channel, n_bounces - 2) for channel in albedo.T]
    return QuickBounces(
        rows.indptr,
        entries,
        bits,
        bounces.albedo,
        begin,
        share,
        _in_blocks(matrices),
        np.zeros((2, tree.n_leaves, 4), np.float32),
    )


def _all_bounces(factors: F32, albedo: F32, n: int) -> F32:
    """Sum of ``(F A)^k F`` for k below `n`: light that arrives after 1 to n bounces, F form factors, A albedo."""
    step = factors * albedo
    total, power = np.zeros_like(factors), np.eye(len(factors), dtype=np.float32)
    reached = 0  # total = sum of step^k for k < reached, power = step^reached
    for bit in bin(n)[2:] if n > 0 else "":
        total, power = total + power @ total, power @ power
        reached *= 2
        if bit == "1":
            total, power = total + power, power @ step
            reached += 1
    return total @ factors


def _in_blocks(matrices: list[F32]) -> F32:
    n = len(matrices[0])
    blocks = np.zeros((-(-n // kernels.LANES), 3, n, kernels.LANES), np.float32)
    for channel, matrix in enumerate(matrices):
        for block, first in enumerate(range(0, n, kernels.LANES)):
            rows = matrix[first : first + kernels.LANES]
            blocks[block, channel, :, : len(rows)] = rows.T
    return blocks


def _clusters(tree: ClusterTree, most: int) -> I64:
    """Clusters of at most so many cells that there are no more than `most`."""
    cells = max(1, tree.n_leaves // most)
    while len(begin := cluster_begins(tree, cells)) - 1 > most:
        cells += max(1, cells // 4)
    return begin


def cluster_begins(tree: ClusterTree, most: int) -> I64:
    """First leaves of the largest nodes with at most `most` leaves, and the number of leaves: (n_clusters + 1,)."""
    if tree.n_leaves <= most:
        return np.array([0, tree.n_leaves], np.int64)
    small = tree.hi - tree.lo <= most
    inner = np.flatnonzero(~small)
    children = np.concatenate([tree.left[inner], tree.right[inner]]).astype(np.int64)
    leaf = children < 0
    first = np.where(leaf, -1 - children, tree.lo[np.maximum(children, 0)])
    kept = leaf | small[np.maximum(children, 0)]
    return np.append(np.sort(first[kept]), tree.n_leaves).astype(np.int64)
