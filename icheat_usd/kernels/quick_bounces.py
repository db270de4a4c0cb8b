"""Products of bounce rows that are small enough to stay in cache."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import address_of, black, load_color, scale_add, store_color

_LEAST = 8  # cells of a part of a cluster
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
def take_change(
    begin: np.ndarray, share: np.ndarray, radiance: np.ndarray, before: np.ndarray, direct: np.ndarray,
    light: np.ndarray, leaves: np.ndarray, sizes: np.ndarray,
) -> None:  # fmt: skip
    """Light of cells whose direct light has changed, before bounces have: ``light = radiance + direct - before``.

    Parameters
    ----------
    begin : (n_clusters + 1,) int64
        Cells of a cluster follow one another.
    share : (n_gather,) float32, of the cell in its cluster; they sum to 1
    radiance, before : (n_gather, 3) float32; or no rows: black
    direct : (n_gather, 3) float32
    light : (n_gather, 4) float32
    leaves : (3, n_clusters) float32, mean change
    sizes : (n_clusters, 2) float32, sums of the sizes of the changes and of the direct light
    """
    from_black = len(before) == 0
    for c in prange(len(begin) - 1):
        r, g, b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        changed, all_of_it = np.float32(0.0), np.float32(0.0)
        for i in range(begin[c], begin[c + 1]):
            x, y, z = direct[i, 0], direct[i, 1], direct[i, 2]
            all_of_it += abs(x) + abs(y) + abs(z)
            light[i, 0], light[i, 1], light[i, 2], light[i, 3] = x, y, z, np.float32(0.0)
            if not from_black:
                x -= before[i, 0]
                y -= before[i, 1]
                z -= before[i, 2]
                light[i, 0], light[i, 1], light[i, 2] = radiance[i, 0] + x, radiance[i, 1] + y, radiance[i, 2] + z
            changed += abs(x) + abs(y) + abs(z)
            r += share[i] * x
            g += share[i] * y
            b += share[i] * z
        leaves[0, c], leaves[1, c], leaves[2, c] = r, g, b
        sizes[c, 0], sizes[c, 1] = changed, all_of_it


@kernel
def _part_of(begin: int, end: int, part: int, parts: int) -> tuple[int, int]:
    """First cell of a part of a cluster, and the step to the next; small clusters are one part."""
    if end - begin < _LEAST * parts:
        return begin, 1
    return begin + part, parts


@kernel
def _arrives(entries: np.ndarray, first: int, end: int, mask: int, light: int) -> Any:
    """Light that arrives by the entries from `first` up to `end`; `light` is an address of colours."""
    weights = entries.view(np.float32)
    # four sums, so that an addition need not wait for the one before
    s0, s1, s2, s3 = black(), black(), black(), black()
    e = first
    while e + 4 <= end:
        s0 = scale_add(load_color(light + np.int64(entries[e] & mask) * 16), weights[e], s0)
        s1 = scale_add(load_color(light + np.int64(entries[e + 1] & mask) * 16), weights[e + 1], s1)
        s2 = scale_add(load_color(light + np.int64(entries[e + 2] & mask) * 16), weights[e + 2], s2)
        s3 = scale_add(load_color(light + np.int64(entries[e + 3] & mask) * 16), weights[e + 3], s3)
        e += 4
    while e < end:
        s0 = scale_add(load_color(light + np.int64(entries[e] & mask) * 16), weights[e], s0)
        e += 1
    one = np.float32(1.0)
    return scale_add(scale_add(s0, one, s1), one, scale_add(s2, one, s3))


@parallel_kernel
def find_missing(
    begin: np.ndarray,
    share: np.ndarray,
    indptr: np.ndarray,
    entries: np.ndarray,
    column_bits: int,
    direct: np.ndarray,
    light: np.ndarray,
    albedo: np.ndarray,
    part: int,
    parts: int,
    missing: np.ndarray,
    arriving: np.ndarray,
    leaves: np.ndarray,
    sizes: np.ndarray,
) -> None:
    """What cells lack of their balance: ``direct - light + albedo * (rows @ light)``, at a part of each cluster.

    For other cells the mean of what arrives too little at the part stands: neighbours receive alike.

    Parameters
    ----------
    begin : (n_clusters + 1,) int64; share : (n_gather,) float32
        As for `take_change`.
    indptr : (n_gather + 1,) int64
    entries : (n_entries,) uint32, of `shorten`
    direct, albedo : (n_gather, 3) float32
    light : (n_gather, 4) float32, 16-byte rows; the fourth column is 0
    part, parts : int
        Every `parts`-th cell of a cluster, from number `part` on.
    missing : (n_gather, 4) float32, 16-byte rows
        Set at the part; the fourth column means nothing.
    arriving : (n_clusters, 3) float32
        Mean of the missing light over that of the albedo, at the part.
    leaves : (3, n_clusters) float32
        Mean missing light of all of the cluster.
    sizes : (n_clusters, 2) float32
        Sums of the sizes of the missing light, as far as it was found, and of the light at the same cells.
    """
    mask = np.uint32((1 << column_bits) - 1)
    for c in prange(len(begin) - 1):
        _find_missing(
            begin[c], begin[c + 1], c, share, indptr, entries, mask, direct, light, albedo, part, parts, missing,
            arriving, leaves, sizes,
        )  # fmt: skip


@kernel
def _find_missing(
    first: int, last: int, c: int, share: np.ndarray, indptr: np.ndarray, entries: np.ndarray, mask: int,
    direct: np.ndarray, light: np.ndarray, albedo: np.ndarray, part: int, parts: int, missing: np.ndarray,
    arriving: np.ndarray, leaves: np.ndarray, sizes: np.ndarray,
) -> None:  # fmt: skip
    """`find_missing` for cluster `c`, the cells from `first` up to `last`."""
    start, target = address_of(light), address_of(missing)
    zero = np.float32(0.0)
    r, g, b = zero, zero, zero
    white_r, white_g, white_b = zero, zero, zero
    lacking, here = zero, zero
    begin, step = _part_of(first, last, part, parts)
    for i in range(begin, last, step):
        store_color(target + i * 16, _arrives(entries, indptr[i], indptr[i + 1], mask, start))
        for k in range(3):
            missing[i, k] = direct[i, k] - light[i, k] + albedo[i, k] * missing[i, k]
            lacking += abs(missing[i, k])
            here += abs(light[i, k])
        r += share[i] * missing[i, 0]
        g += share[i] * missing[i, 1]
        b += share[i] * missing[i, 2]
        white_r += share[i] * albedo[i, 0]
        white_g += share[i] * albedo[i, 1]
        white_b += share[i] * albedo[i, 2]
    arriving[c, 0] = r / white_r if white_r > zero else zero
    arriving[c, 1] = g / white_g if white_g > zero else zero
    arriving[c, 2] = b / white_b if white_b > zero else zero
    sizes[c, 0], sizes[c, 1] = lacking, here
    if step > 1:
        r, g, b = zero, zero, zero
        for i in range(first, last):
            r += share[i] * albedo[i, 0]
            g += share[i] * albedo[i, 1]
            b += share[i] * albedo[i, 2]
        r *= arriving[c, 0]
        g *= arriving[c, 1]
        b *= arriving[c, 2]
    leaves[0, c], leaves[1, c], leaves[2, c] = r, g, b


@parallel_kernel
def add_missing(
    begin: np.ndarray, albedo: np.ndarray, missing: np.ndarray, here: np.ndarray, later: np.ndarray, part: int,
    parts: int, light: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Add to `light` what was missing and what cells reflect of its later bounces.

    Parameters
    ----------
    begin, albedo, missing, part, parts
        As for `find_missing`; no rows of `missing`: nothing was, and there are later bounces alone.
    here, later : (n_clusters, 3) float32
        What arrives at other cells than those of the part, and the later bounces that arrive at all.
    light : (n_gather, 4) float32
    out : (n_gather, 3) float32, the new light once more; or no rows
    """
    for c in prange(len(begin) - 1):
        first, step = _part_of(begin[c], begin[c + 1], part, parts)
        for i in range(begin[c], begin[c + 1]):
            found = len(missing) > 0 and (i - first) % step == 0
            for k in range(3):
                arrives = later[c, k]
                value = light[i, k]
                if found:
                    value += missing[i, k]
                elif len(missing) > 0:
                    arrives += here[c, k]
                value += albedo[i, k] * arrives
                light[i, k] = value
                if len(out) > 0:
                    out[i, k] = value


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
