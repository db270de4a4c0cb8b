"""The Haar transform of edited copies of the light, in float32, as fast as it can be read."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import address_of, difference, load_color, scale_add, scaled, store_color


@kernel
def _transform_nodes(first, end, left, right, share, detail, means, node_place, out):  # type: ignore[no-untyped-def]
    """Details of nodes ``first:end``, children before parents; `means` (addressed by place) receives their means.

    `left` and `right` are places, and node `first` lies at `node_place`.
    """
    base, target = address_of(means), address_of(out)
    place = base + 16 * (node_place + end - 1 - first)
    for node in range(end - 1, first - 1, -1):
        a, b = load_color(base + 16 * np.int64(left[node])), load_color(base + 16 * np.int64(right[node]))
        step = difference(a, b)
        store_color(target + 16 * (1 + node), scaled(step, detail[node]))
        store_color(place, scale_add(step, share[node], b))
        place -= 16


@kernel
def _transform_subtrees(  # type: ignore[no-untyped-def]
    first, end, values, subtree_leaf, subtree_node, left, right, share, detail, top_means, out
):
    """Subtrees ``first:end`` of one version; their means go to the places ``first:end`` of `top_means`."""
    most = 0
    for s in range(first, end):
        most = max(most, subtree_leaf[s + 1] - subtree_leaf[s])
    means = np.empty((2 * most, 4), np.float32)  # of the leaves, then of the nodes
    for s in range(first, end):
        leaf, n = subtree_leaf[s], subtree_leaf[s + 1] - subtree_leaf[s]
        for i in range(n):
            means[i, 0] = values[leaf + i, 0]
            means[i, 1] = values[leaf + i, 1]
            means[i, 2] = values[leaf + i, 2]
            means[i, 3] = np.float32(0.0)
        node = subtree_node[s]
        _transform_nodes(node, node + n - 1, left, right, share, detail, means, n, out)
        store_color(address_of(top_means) + 16 * s, load_color(address_of(means) + (16 * n if n > 1 else 0)))


@kernel
def _transform_top(top_node, n_subtrees, left, right, share, detail, root, means, out):  # type: ignore[no-untyped-def]
    """Details above the subtrees, and the mean of everything."""
    base, target = address_of(means), address_of(out)
    place = base + 16 * (n_subtrees + len(top_node) - 1)
    for t in range(len(top_node) - 1, -1, -1):
        node = top_node[t]
        a, b = load_color(base + 16 * np.int64(left[node])), load_color(base + 16 * np.int64(right[node]))
        step = difference(a, b)
        store_color(target + 16 * (1 + node), scaled(step, detail[node]))
        store_color(place, scale_add(step, share[node], b))
        place -= 16
    store_color(target, scaled(load_color(base + (16 * n_subtrees if len(top_node) > 0 else 0)), root))


@parallel_kernel
def transform_versions(  # type: ignore[no-untyped-def]
    values, subtree_leaf, subtree_node, run_begin, left, right, share, detail, top_node, root, top_means, slot, out
):
    """Coefficients of `values` (n_versions, n_leaves, 3) to ``out[slot]`` (n_slots, n_leaves, 4); see `HaarPlan`.

    `top_means` (n_versions, n_subtrees + n_top_nodes, 4) is work space.
    """
    n_versions, n_runs = len(values), len(run_begin) - 1
    for job in prange(n_versions * n_runs):
        q, run = job // n_runs, job % n_runs
        _transform_subtrees(
            run_begin[run],
            run_begin[run + 1],
            values[q],
            subtree_leaf,
            subtree_node,
            left,
            right,
            share,
            detail,
            top_means[q],
            out[slot[q]],
        )
    for q in prange(n_versions):
        _transform_top(top_node, len(subtree_node), left, right, share, detail, root, top_means[q], out[slot[q]])
