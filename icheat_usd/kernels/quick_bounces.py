"""Products of bounce rows that are small enough to stay in cache."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel
from icheat_usd.kernels.simd import address_of, black, load_color, scale_add, store_color

BLOCK = 256  # cells of a task
LANES = 64  # rows of a block of a dense matrix


@parallel_kernel
def shorten(indices: np.ndarray, weights: np.ndarray, column_bits: int, out: np.ndarray) -> None:
    """Entries in one word each: weights rounded to the leading bits of a float32, columns in the others.

    `indices` (n,) int32 below ``2 ** column_bits``, `weights` (n,) float32, `out` (n,) uint32.
    """
    words = weights.view(np.uint32)
    half = np.int64(1) << (column_bits - 1)
    for chunk in prange((len(indices) + 65535) // 65536):
        for e in range(chunk * 65536, min(len(indices), (chunk + 1) * 65536)):
            column = np.int64(indices[e])
            # rounded so that the number read with the column in its last bits is the nearest
            kept = (np.int64(words[e]) - column + half) >> column_bits
            out[e] = np.uint32((max(kept, 0) << column_bits) | column)


@parallel_kernel
def find_residual(
    indptr: np.ndarray,
    entries: np.ndarray,
    column_bits: int,
    direct: np.ndarray,
    light: np.ndarray,
    albedo: np.ndarray,
    out: np.ndarray,
) -> None:
    """``out = direct - light + albedo * (rows @ light)``.

    Parameters
    ----------
    indptr : (n_gather + 1,) int64
    entries : (n_entries,) uint32, of `shorten`
    direct, albedo : (n_gather, 3) float32
    light, out : (n_gather, 4) float32, 16-byte rows
        The fourth column is 0 in `light`, and means nothing in `out`.
    """
    mask = np.uint32((1 << column_bits) - 1)
    weights = entries.view(np.float32)
    start, target = address_of(light), address_of(out)
    for block in prange((len(albedo) + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min(len(albedo), (block + 1) * BLOCK)):
            # four sums, so that an addition need not wait for the one before
            s0, s1, s2, s3 = black(), black(), black(), black()
            e, end = indptr[i], indptr[i + 1]
            while e + 4 <= end:
                s0 = scale_add(load_color(start + np.int64(entries[e] & mask) * 16), weights[e], s0)
                s1 = scale_add(load_color(start + np.int64(entries[e + 1] & mask) * 16), weights[e + 1], s1)
                s2 = scale_add(load_color(start + np.int64(entries[e + 2] & mask) * 16), weights[e + 2], s2)
                s3 = scale_add(load_color(start + np.int64(entries[e + 3] & mask) * 16), weights[e + 3], s3)
                e += 4
            while e < end:
                s0 = scale_add(load_color(start + np.int64(entries[e] & mask) * 16), weights[e], s0)
                e += 1
            one = np.float32(1.0)
            store_color(target + i * 16, scale_add(scale_add(s0, one, s1), one, scale_add(s2, one, s3)))
            for c in range(3):
                out[i, c] = direct[i, c] - light[i, c] + albedo[i, c] * out[i, c]


@parallel_kernel
def cluster_means(begin: np.ndarray, weight: np.ndarray, light: np.ndarray, out: np.ndarray) -> None:
    """Weighted mean over each cluster, whose cells follow one another.

    `begin` (n_clusters + 1,) int64; `weight` (n_gather,) float32, summing to 1 in a cluster;
    `light` (n_gather, 3 or more) and `out` (3, n_clusters) float32.
    """
    for c in prange(len(begin) - 1):
        r = np.float32(0.0)
        g = np.float32(0.0)
        b = np.float32(0.0)
        for i in range(begin[c], begin[c + 1]):
            r += weight[i] * light[i, 0]
            g += weight[i] * light[i, 1]
            b += weight[i] * light[i, 2]
        out[0, c] = r
        out[1, c] = g
        out[2, c] = b


@parallel_kernel
def add_clusters(
    begin: np.ndarray, albedo: np.ndarray, light: np.ndarray, arriving: np.ndarray, out: np.ndarray
) -> None:
    """Add to `out` the `light` of each cell, and what it reflects of the light that arrives at its cluster.

    `begin` (n_clusters + 1,) int64; `albedo` (n_gather, 3), `light` and `out` (n_gather, 4), and
    `arriving` (n_clusters, 3) float32.
    """
    for c in prange(len(begin) - 1):
        for i in range(begin[c], begin[c + 1]):
            for k in range(3):
                out[i, k] += light[i, k] + albedo[i, k] * arriving[c, k]


@parallel_kernel
def reach_clusters(blocks: np.ndarray, leaves: np.ndarray, out: np.ndarray) -> None:
    """Products of dense matrices, one per colour.

    `blocks` (n_blocks, 3, n, LANES) float32 hold LANES rows each, transposed; `leaves` (3, n) and `out` (n, 3) float32.
    """
    n = leaves.shape[1]
    for task in prange(len(blocks) * 3):
        block, channel = task // 3, task % 3
        sums = np.zeros(LANES, np.float32)
        for j in range(n):
            value = leaves[channel, j]
            for k in range(LANES):
                sums[k] += blocks[block, channel, j, k] * value
        for k in range(min(LANES, n - block * LANES)):
            out[block * LANES + k, channel] = sums[k]


@parallel_kernel
def merge_rows(
    begin: np.ndarray, weight: np.ndarray, cluster: np.ndarray, indptr: np.ndarray, indices: np.ndarray,
    weights: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Add to `out` weighted means of the rows of each cluster, columns summed by cluster.

    `begin` (n_clusters + 1,) int64; `weight` (n_gather,) float32 and `cluster` (n_gather,) int32 of each cell;
    `indptr` (n_gather + 1,) int64, `indices` int32 and `weights` float32 of the rows; `out` (n_clusters, n_clusters)
    float32.
    """
    for c in prange(len(begin) - 1):
        for i in range(begin[c], begin[c + 1]):
            for e in range(indptr[i], indptr[i + 1]):
                out[c, cluster[indices[e]]] += weight[i] * weights[e]
