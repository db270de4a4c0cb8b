"""Rows kept as their largest wavelet coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels import wavelets as kernels
from icheat_usd.kernels.rows import pack_rows
from icheat_usd.samples import ClusterTree
from icheat_usd.samples.wavelets import haar_forward
from icheat_usd.scene import F32
from icheat_usd.transport.sparse import SparseRows

_ROWS_AT_ONCE = 16384


@dataclass(frozen=True)
class CompressedRows:
    """Haar coefficients of rows on a cluster tree; multiplies like the rows, up to what was left out."""

    tree: ClusterTree
    coefficients: SparseRows  #: (n_rows x n_leaves) in the basis of `haar_forward`

    def matmul(self, b: F32) -> F32:
        """Product with `b` (n_leaves, k), given as leaf values: (n_rows, k)."""
        return self.coefficients.matmul(haar_forward(self.tree, b).astype(np.float32))


def compress_rows(rows: SparseRows, tree: ClusterTree, areas: F32, k: int) -> CompressedRows:
    """Keep the `k` largest coefficients of every row.

    A row t is transformed as the density ``t / area``: then its product with
    leaf values is a dot product of coefficients, exact when all are kept.

    Parameters
    ----------
    rows : (n_rows x n_leaves)
    areas : (n_leaves,)
        Of the leaves; must be the tree's weights.
    k
        Coefficients per row.

    Raises
    ------
    ValueError
        `rows` or `areas` do not belong to `tree`.

    References
    ----------
    .. [1] Hasan, Pellacini, Bala: Direct-to-Indirect Transfer for Cinematic Relighting, SIGGRAPH 2006.
    """
    if rows.n_columns != tree.n_leaves or not np.allclose(areas, tree.weight, rtol=1e-5):
        raise ValueError("the rows or areas belong to another cluster tree than the one given")
    k = min(k, tree.n_leaves)
    counts = np.empty(rows.n_rows, np.int64)
    parts_index, parts_value = [], []
    for first in range(0, rows.n_rows, _ROWS_AT_ONCE):
        part = rows.rows(first, min(first + _ROWS_AT_ONCE, rows.n_rows))
        index = np.empty((part.n_rows, k), np.int32)
        value = np.empty((part.n_rows, k), np.float32)
        count = counts[first : first + part.n_rows]
        kernels.haar_top_k(
            tree.mid,
            tree.left,
            tree.right,
            tree.weight,
            tree.node_weight,
            tree.depth,
            part.indptr,
            part.indices,
            part.weights,
            k,
            count,
            index,
            value,
        )
        begin = np.concatenate([[0], np.cumsum(count)])
        parts_index.append(np.empty(begin[-1], np.int32))
        parts_value.append(np.empty(begin[-1], np.float32))
        pack_rows(count, begin, index, value, parts_index[-1], parts_value[-1])
    indptr = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    indices = np.concatenate([np.empty(0, np.int32), *parts_index])
    weights = np.concatenate([np.empty(0, np.float32), *parts_value])
    return CompressedRows(tree, SparseRows(indptr, indices, weights, tree.n_leaves))
