"""Products and rearrangements of matrices in compressed rows."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel


@parallel_kernel
def rows_times_3(indptr, indices, weights, b, out):  # type: ignore[no-untyped-def]
    """``out = rows @ b`` for three columns: one pass over the entries, no temporary."""
    for r in prange(len(indptr) - 1):
        red = np.float32(0.0)
        green = np.float32(0.0)
        blue = np.float32(0.0)
        for e in range(indptr[r], indptr[r + 1]):
            j, w = indices[e], weights[e]
            red += w * b[j, 0]
            green += w * b[j, 1]
            blue += w * b[j, 2]
        out[r, 0] = red
        out[r, 1] = green
        out[r, 2] = blue


@parallel_kernel
def rows_times(indptr, indices, weights, b, out):  # type: ignore[no-untyped-def]
    """``out = rows @ b`` for any number of columns."""
    for r in prange(len(indptr) - 1):
        for c in range(b.shape[1]):
            out[r, c] = np.float32(0.0)
        for e in range(indptr[r], indptr[r + 1]):
            j, w = indices[e], weights[e]
            for c in range(b.shape[1]):
                out[r, c] += w * b[j, c]


@parallel_kernel
def row_sums(indptr, weights, out):  # type: ignore[no-untyped-def]
    """Sum of each row's weights."""
    for r in prange(len(indptr) - 1):
        total = 0.0
        for e in range(indptr[r], indptr[r + 1]):
            total += weights[e]
        out[r] = total


@parallel_kernel
def pack_rows(counts, begin, index, weight, out_index, out_weight):  # type: ignore[no-untyped-def]
    """Copy the first ``counts[r]`` entries of each padded row to ``begin[r]`` of the packed arrays."""
    for r in prange(len(counts)):
        for e in range(counts[r]):
            out_index[begin[r] + e] = index[r, e]
            out_weight[begin[r] + e] = weight[r, e]


@parallel_kernel
def copy_rows(source, count, begin, index, weight, out_index, out_weight):  # type: ignore[no-untyped-def]
    """Copy ``count[r]`` entries from ``source[r]`` of a packed matrix to ``begin[r]`` of another."""
    for r in prange(len(begin)):
        for e in range(count[r]):
            out_index[begin[r] + e] = index[source[r] + e]
            out_weight[begin[r] + e] = weight[source[r] + e]


@parallel_kernel
def mean_over_segments(begin, values, out):  # type: ignore[no-untyped-def]
    """Mean of ``values[begin[i]:begin[i + 1]]`` (p, k) into ``out[i]`` (n, k); segments are not empty."""
    for i in prange(len(begin) - 1):
        for c in range(values.shape[1]):
            total = 0.0
            for q in range(begin[i], begin[i + 1]):
                total += values[q, c]
            out[i, c] = total / (begin[i + 1] - begin[i])


@parallel_kernel
def pack_ints(counts, begin, values, out):  # type: ignore[no-untyped-def]
    """Copy the first ``counts[r]`` entries of each padded row to ``begin[r]`` of the packed array."""
    for r in prange(len(counts)):
        for e in range(counts[r]):
            out[begin[r] + e] = values[r, e]


@parallel_kernel
def count_union(indptr_a, index_a, indptr_b, index_b, out):  # type: ignore[no-untyped-def]
    """Number of distinct columns of each row of two matrices together."""
    for r in prange(len(out)):
        a, b, count = indptr_a[r], indptr_b[r], 0
        while a < indptr_a[r + 1] and b < indptr_b[r + 1]:
            i, j = index_a[a], index_b[b]
            if i <= j:
                a += 1
            if j <= i:
                b += 1
            count += 1
        out[r] = count + indptr_a[r + 1] - a + indptr_b[r + 1] - b


@parallel_kernel
def add_shares(  # type: ignore[no-untyped-def]
    indptr_a, index_a, weight_a, of_a, indptr_b, index_b, weight_b, of_b, of_out, indptr, index, weight
):
    """Sum of two matrices of shares: weights times `of_a` and `of_b` are whole numbers, added as such."""
    for r in prange(len(indptr) - 1):
        a, b = indptr_a[r], indptr_b[r]
        last_a, last_b = indptr_a[r + 1], indptr_b[r + 1]
        for e in range(indptr[r], indptr[r + 1]):
            total = 0.0
            from_a = a < last_a and (b == last_b or index_a[a] <= index_b[b])
            from_b = b < last_b and (a == last_a or index_b[b] <= index_a[a])
            if from_a:
                index[e] = index_a[a]
                total += np.rint(np.float64(weight_a[a]) * of_a)
                a += 1
            if from_b:
                index[e] = index_b[b]
                total += np.rint(np.float64(weight_b[b]) * of_b)
                b += 1
            weight[e] = total / of_out
