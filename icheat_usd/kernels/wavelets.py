"""Weighted Haar transform on a binary tree of leaves.

Coefficient 0 is the root's mean times the square root of the total weight;
coefficient ``1 + node`` is the node's detail ``(m_L - m_R) sqrt(a c / (a + c))``
with children of means m_L, m_R and weights a, c. The basis is orthonormal in
``<f, g> = sum of weight * f * g``. Nodes are in pre-order: walking them
backwards meets children before their parent.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def child_weight(child, weight, node_weight):  # type: ignore[no-untyped-def]
    """Weight below a child: a node, or the leaf ``-1 - child``."""
    return weight[-1 - child] if child < 0 else node_weight[child]


@kernel
def sum_weights(left, right, weight, out):  # type: ignore[no-untyped-def]
    """Weight of every node."""
    for step in range(len(left)):
        node = len(left) - 1 - step
        out[node] = child_weight(left[node], weight, out) + child_weight(right[node], weight, out)


@parallel_kernel
def haar_forward(left, right, weight, node_weight, values, out):  # type: ignore[no-untyped-def]
    """Coefficients of each column of `values` (n_leaves, k) into `out` (n_leaves, k)."""
    n_nodes = len(left)
    for c in prange(values.shape[1]):
        mean = np.empty(n_nodes, np.float64)
        for step in range(n_nodes):
            node = n_nodes - 1 - step
            i, j = left[node], right[node]
            a = child_weight(i, weight, node_weight)
            b = child_weight(j, weight, node_weight)
            m_i = np.float64(values[-1 - i, c]) if i < 0 else mean[i]
            m_j = np.float64(values[-1 - j, c]) if j < 0 else mean[j]
            mean[node] = (a * m_i + b * m_j) / (a + b)
            out[1 + node, c] = (m_i - m_j) * np.sqrt(a * b / (a + b))
        if n_nodes > 0:
            out[0, c] = mean[0] * np.sqrt(node_weight[0])
        else:
            out[0, c] = values[0, c] * np.sqrt(weight[0])


@parallel_kernel
def haar_inverse(left, right, weight, node_weight, coefficients, out):  # type: ignore[no-untyped-def]
    """Leaf values of each column of `coefficients` (n_leaves, k) into `out` (n_leaves, k)."""
    n_nodes = len(left)
    for c in prange(coefficients.shape[1]):
        mean = np.empty(n_nodes, np.float64)
        if n_nodes > 0:
            mean[0] = coefficients[0, c] / np.sqrt(node_weight[0])
        else:
            out[0, c] = coefficients[0, c] / np.sqrt(weight[0])
        for node in range(n_nodes):
            i, j = left[node], right[node]
            a = child_weight(i, weight, node_weight)
            b = child_weight(j, weight, node_weight)
            difference = coefficients[1 + node, c] / np.sqrt(a * b / (a + b))
            m_i = mean[node] + b / (a + b) * difference
            m_j = mean[node] - a / (a + b) * difference
            if i < 0:
                out[-1 - i, c] = m_i
            else:
                mean[i] = m_i
            if j < 0:
                out[-1 - j, c] = m_j
            else:
                mean[j] = m_j


@parallel_kernel
def haar_evaluate(mid, left, right, weight, node_weight, indptr, indices, values, row, leaf, out):  # type: ignore[no-untyped-def]
    """Value at `leaf[q]` of the sparse coefficient row `row[q]`, for each query q."""
    for q in prange(len(leaf)):
        begin, end = indptr[row[q]], indptr[row[q] + 1]
        total = 0.0
        if begin < end and indices[begin] == 0:
            root = node_weight[0] if len(left) > 0 else weight[0]
            total = values[begin] / np.sqrt(root)
        node = 0 if len(left) > 0 else -1
        while node >= 0:
            i, j = left[node], right[node]
            a = child_weight(i, weight, node_weight)
            b = child_weight(j, weight, node_weight)
            place = begin + np.searchsorted(indices[begin:end], 1 + node)
            to_left = leaf[q] < mid[node]
            if place < end and indices[place] == 1 + node:
                difference = values[place] / np.sqrt(a * b / (a + b))
                total += b / (a + b) * difference if to_left else -a / (a + b) * difference
            node = i if to_left else j
        out[q] = total
