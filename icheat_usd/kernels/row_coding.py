"""Sparse Haar rows of several columns: coded under a bound, decoded, evaluated.

Coefficient 0 of a column is its mean by weight, coefficient ``1 + node`` the
difference of the means of the node's two children. (They are the coefficients
of `kernels.wavelets`, each divided by the norm of its wavelet, so that one step
of quantisation suits all levels.) Nodes are in pre-order.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.wavelets import child_weight


@kernel
def _statistics(left, right, weight, node_weight, values, mean, low, high):  # type: ignore[no-untyped-def]
    """Mean, smallest and largest value below every node, by column."""
    n_nodes, k = len(left), values.shape[1]
    for step in range(n_nodes):
        node = n_nodes - 1 - step
        i, j = left[node], right[node]
        a = child_weight(i, weight, node_weight)
        b = child_weight(j, weight, node_weight)
        for c in range(k):
            m_i = np.float64(values[-1 - i, c]) if i < 0 else mean[i, c]
            m_j = np.float64(values[-1 - j, c]) if j < 0 else mean[j, c]
            l_i = m_i if i < 0 else low[i, c]
            l_j = m_j if j < 0 else low[j, c]
            h_i = m_i if i < 0 else high[i, c]
            h_j = m_j if j < 0 else high[j, c]
            mean[node, c] = (a * m_i + b * m_j) / (a + b)
            low[node, c] = min(l_i, l_j)
            high[node, c] = max(h_i, h_j)


@kernel
def _child_mean(child, c, values, mean):  # type: ignore[no-untyped-def]
    return np.float64(values[-1 - child, c]) if child < 0 else mean[child, c]


@kernel
def _keep_largest(left, right, weight, node_weight, values, mean, unit, n_kept, kept):  # type: ignore[no-untyped-def]
    """Flag the `n_kept` coefficients of largest norm over the columns, each column in its unit."""
    n_nodes, k = len(left), values.shape[1]
    norm = np.zeros(n_nodes + 1, np.float64)
    for c in range(k):
        if unit[c] > 0:
            root = mean[0, c] if n_nodes > 0 else np.float64(values[0, c])
            total = node_weight[0] if n_nodes > 0 else weight[0]
            norm[0] += (root / unit[c]) ** 2 * total
    for node in range(n_nodes):
        a = child_weight(left[node], weight, node_weight)
        b = child_weight(right[node], weight, node_weight)
        for c in range(k):
            if unit[c] > 0:
                difference = _child_mean(left[node], c, values, mean) - _child_mean(right[node], c, values, mean)
                norm[1 + node] += (difference / unit[c]) ** 2 * (a * b / (a + b))
    order = np.argsort(-norm, kind="mergesort")
    for e in range(min(n_kept, n_nodes + 1)):
        if norm[order[e]] > 0:
            kept[order[e]] = 1


@kernel
def _quantised(value, step, largest):  # type: ignore[no-untyped-def]
    if step == 0.0:
        return 0.0
    return min(max(np.rint(value / step), -largest), largest)


@parallel_kernel
def encode_rows(  # type: ignore[no-untyped-def]
    lo,
    hi,
    left,
    right,
    weight,
    node_weight,
    depth,
    values,
    tolerance,
    n_kept,
    largest,
    count,
    index,
    number,
    step,
    error,
):
    """Code every row of `values` (n_rows, n_leaves, k).

    With `n_kept` < 0, nodes are divided from the root down until every leaf
    below is within `tolerance` (k,) of what is decoded there, quantisation
    included; else the `n_kept` largest coefficients are kept, in units of it. Row r gets
    ``count[r]`` entries ``index[r]``, ascending, and ``number[r]``
    (., k), integers of at most `largest` that multiply ``step[r]`` (k,).
    ``error[r]`` (k,) is the largest difference at any leaf.
    """
    n_nodes, k = len(left), values.shape[2]
    for r in prange(values.shape[0]):
        row = values[r]
        mean = np.empty((max(n_nodes, 1), k), np.float64)
        low = np.empty((max(n_nodes, 1), k), np.float64)
        high = np.empty((max(n_nodes, 1), k), np.float64)
        _statistics(left, right, weight, node_weight, row, mean, low, high)
        if n_nodes == 0:
            for c in range(k):
                mean[0, c] = row[0, c]
                low[0, c] = row[0, c]
                high[0, c] = row[0, c]
        peak = np.zeros(k, np.float64)
        for c in range(k):
            peak[c] = abs(mean[0, c])
            error[r, c] = 0.0
        for node in range(n_nodes):
            for c in range(k):
                difference = _child_mean(left[node], c, row, mean) - _child_mean(right[node], c, row, mean)
                peak[c] = max(peak[c], abs(difference))
        for c in range(k):
            # What a reader multiplies with: the step as float32.
            step[r, c] = np.float32(peak[c] / largest)
        count[r] = 0
        below = True
        for c in range(k):
            if max(high[0, c], -low[0, c]) > tolerance[c]:
                below = False
        if below and n_kept < 0:
            for c in range(k):
                error[r, c] = max(high[0, c], -low[0, c], 0.0)
            continue

        kept = np.zeros(n_nodes + 1, np.uint8)
        kept_before = np.zeros(n_nodes + 2, np.int64)
        if n_kept >= 0:
            unit = np.empty(k, np.float64)
            for c in range(k):
                unit[c] = tolerance[c] if tolerance[c] > 0.0 else peak[c]
            _keep_largest(left, right, weight, node_weight, row, mean, unit, n_kept, kept)
            for e in range(n_nodes + 1):
                kept_before[e + 1] = kept_before[e] + kept[e]

        n = 0
        stack = np.empty(depth + 2, np.int64)
        decoded = np.empty((depth + 2, k), np.float64)
        nonzero = False
        for c in range(k):
            q = 0.0
            if n_kept < 0 or kept[0] == 1:
                q = _quantised(mean[0, c], np.float64(step[r, c]), largest)
            number[r, 0, c] = q
            nonzero = nonzero or q != 0.0
            decoded[0, c] = q * np.float64(step[r, c])
        if nonzero:
            index[r, 0] = 0
            n = 1
        top = 1
        stack[0] = 0 if n_nodes > 0 else -1
        while top > 0:
            top -= 1
            node = stack[top]
            if node < 0:
                for c in range(k):
                    error[r, c] = max(error[r, c], abs(np.float64(row[-1 - node, c]) - decoded[top, c]))
                continue
            stop = True
            if n_kept < 0:
                for c in range(k):
                    if max(high[node, c] - decoded[top, c], decoded[top, c] - low[node, c]) > tolerance[c]:
                        stop = False
            else:
                stop = kept_before[node + hi[node] - lo[node]] == kept_before[node + 1]
            if stop:
                for c in range(k):
                    off = max(high[node, c] - decoded[top, c], decoded[top, c] - low[node, c])
                    error[r, c] = max(error[r, c], off)
                continue
            i, j = left[node], right[node]
            a = child_weight(i, weight, node_weight)
            b = child_weight(j, weight, node_weight)
            nonzero = False
            for c in range(k):
                q = 0.0
                if n_kept < 0 or kept[1 + node] == 1:
                    difference = _child_mean(i, c, row, mean) - _child_mean(j, c, row, mean)
                    q = _quantised(difference, np.float64(step[r, c]), largest)
                number[r, n, c] = q
                nonzero = nonzero or q != 0.0
                difference = q * np.float64(step[r, c])
                here = decoded[top, c]
                decoded[top, c] = here - a / (a + b) * difference
                decoded[top + 1, c] = here + b / (a + b) * difference
            if nonzero:
                index[r, n] = 1 + node
                n += 1
            # The left child is visited first: indices come out ascending.
            stack[top], stack[top + 1] = j, i
            top += 2
        count[r] = n


@parallel_kernel
def decode_rows(left, right, weight, node_weight, indptr, indices, numbers, steps, pattern, out):  # type: ignore[no-untyped-def]
    """Leaf values of rows, (n_rows, n_leaves, k): entries of ``pattern[r]`` times ``steps[r]`` (k,)."""
    n_nodes, k = len(left), numbers.shape[1]
    for r in prange(len(pattern)):
        begin, end = indptr[pattern[r]], indptr[pattern[r] + 1]
        for c in range(k):
            step = np.float64(steps[r, c])
            mean = np.zeros(max(n_nodes, 1), np.float64)
            e = begin
            if e < end and indices[e] == 0:
                mean[0] = numbers[e, c] * step
                e += 1
            if n_nodes == 0:
                out[r, 0, c] = mean[0]
            for node in range(n_nodes):
                difference = 0.0
                if e < end and indices[e] == 1 + node:
                    difference = numbers[e, c] * step
                    e += 1
                i, j = left[node], right[node]
                a = child_weight(i, weight, node_weight)
                b = child_weight(j, weight, node_weight)
                m_i = mean[node] + b / (a + b) * difference
                m_j = mean[node] - a / (a + b) * difference
                if i < 0:
                    out[r, -1 - i, c] = m_i
                else:
                    mean[i] = m_i
                if j < 0:
                    out[r, -1 - j, c] = m_j
                else:
                    mean[j] = m_j


@parallel_kernel
def decode_columns(left, right, left_share, right_share, indptr, indices, numbers, columns, steps, pattern, out):  # type: ignore[no-untyped-def]
    """`decode_rows` of some columns, one after another: (n_rows, n_columns, n_leaves).

    Parameters
    ----------
    left_share, right_share : (n_nodes,) float64
        Of each node's weight, that of its children.
    columns : (c,) int64, steps : (n_rows, c) float32
    """
    for r in prange(len(pattern)):
        _decode_columns(
            np.int64(r),
            left,
            right,
            left_share,
            right_share,
            indptr,
            indices,
            numbers,
            columns,
            steps,
            pattern,
            out,
        )


@kernel
def _decode_columns(r, left, right, left_share, right_share, indptr, indices, numbers, columns, steps, pattern, out):  # type: ignore[no-untyped-def]
    n_nodes = len(left)
    mean = np.empty(max(n_nodes, 1), np.float64)
    begin, end = indptr[pattern[r]], indptr[pattern[r] + 1]
    for k in range(len(columns)):
        c = columns[k]
        step = np.float64(steps[r, k])
        e = begin
        mean[0] = 0.0
        if e < end and indices[e] == 0:
            mean[0] = numbers[e, c] * step
            e += 1
        if n_nodes == 0:
            out[r, k, 0] = mean[0]
        for node in range(n_nodes):
            m_i = mean[node]
            m_j = m_i
            if e < end and indices[e] == 1 + node:
                difference = numbers[e, c] * step
                m_i += right_share[node] * difference
                m_j -= left_share[node] * difference
                e += 1
            i, j = left[node], right[node]
            if i < 0:
                out[r, k, -1 - i] = m_i
            else:
                mean[i] = m_i
            if j < 0:
                out[r, k, -1 - j] = m_j
            else:
                mean[j] = m_j


@parallel_kernel
def mix_decoded(table, rows, weights, leaf, out):  # type: ignore[no-untyped-def]
    """Mixtures of decoded rows at leaves: ``out[q] = sum of weights[q, s] * table[rows[q, s], leaf[q]]``.

    `rows`, `weights` (1 or n, m) and `leaf` (1 or n,); row or leaf -1 gives 0.
    """
    shared, one_leaf = len(rows) == 1, len(leaf) == 1
    for q in prange(len(out)):
        m = np.int64(0) if shared else np.int64(q)
        j = leaf[np.int64(0) if one_leaf else np.int64(q)]
        for c in range(out.shape[1]):
            total = np.float32(0.0)
            if j >= 0:
                for s in range(rows.shape[1]):
                    if rows[m, s] >= 0:
                        total += weights[m, s] * table[rows[m, s], j, c]
            out[q, c] = total


@parallel_kernel
def mix_coded(  # type: ignore[no-untyped-def]
    mid, left, right, weight, node_weight, indptr, indices, numbers, steps, pattern, rows, weights, leaf, out
):
    """`mix_decoded` for rows that are walked from the root to the leaf; the same values."""
    shared, one_leaf = len(rows) == 1, len(leaf) == 1
    k = out.shape[1]
    for q in prange(len(out)):
        m = np.int64(0) if shared else np.int64(q)
        j = leaf[np.int64(0) if one_leaf else np.int64(q)]
        for c in range(k):
            out[q, c] = np.float32(0.0)
        if j < 0:
            continue
        value = np.empty(k, np.float64)
        for s in range(rows.shape[1]):
            row = rows[m, s]
            if row < 0:
                continue
            begin, end = indptr[pattern[row]], indptr[pattern[row] + 1]
            for c in range(k):
                value[c] = 0.0
            e = begin
            if e < end and indices[e] == 0:
                for c in range(k):
                    value[c] = numbers[e, c] * np.float64(steps[row, c])
                e += 1
            node = 0 if len(left) > 0 else -1
            while node >= 0 and e < end:
                i, j2 = left[node], right[node]
                to_left = j < mid[node]
                e += np.searchsorted(indices[e:end], 1 + node)
                if e < end and indices[e] == 1 + node:
                    a = child_weight(i, weight, node_weight)
                    b = child_weight(j2, weight, node_weight)
                    share = b / (a + b) if to_left else -(a / (a + b))
                    for c in range(k):
                        value[c] += share * (numbers[e, c] * np.float64(steps[row, c]))
                node = i if to_left else j2
            for c in range(k):
                out[q, c] += weights[m, s] * np.float32(value[c])


@kernel
def unfold_splits(left_size, n_leaves, lo, mid, hi):  # type: ignore[no-untyped-def]
    """Nodes of a tree from how many leaves the left child of each has, in pre-order.

    Returns the number of levels, -1 if that is no tree of `n_leaves` leaves.
    """
    n_nodes = len(left_size)
    if n_leaves < 1 or n_nodes != n_leaves - 1:
        return -1
    if n_nodes == 0:
        return 0
    stack = np.empty((n_nodes + 1, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, n_leaves, 1
    top, deepest = 1, 0
    for node in range(n_nodes):
        if top == 0:
            return -1
        top -= 1
        begin, end, level = stack[top, 0], stack[top, 1], stack[top, 2]
        middle = begin + np.int64(left_size[node])
        if not begin < middle < end:
            return -1
        lo[node], mid[node], hi[node] = begin, middle, end
        deepest = max(deepest, level)
        # Right first onto the stack, so that the left child is the next node; leaves are no nodes.
        if end - middle > 1:
            stack[top, 0], stack[top, 1], stack[top, 2] = middle, end, level + 1
            top += 1
        if middle - begin > 1:
            stack[top, 0], stack[top, 1], stack[top, 2] = begin, middle, level + 1
            top += 1
    return deepest if top == 0 else -1


@kernel
def with_ancestors(left, right, flag):  # type: ignore[no-untyped-def]
    """Flag every node that has a flagged node below it."""
    for step in range(len(left)):
        node = len(left) - 1 - step
        if (left[node] >= 0 and flag[left[node]]) or (right[node] >= 0 and flag[right[node]]):
            flag[node] = True
