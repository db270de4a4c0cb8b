"""Products of bounce rows that are small enough to stay in cache."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.lanes import add_short, add_short_fours, load_short, store_short, sum_of_fours
from icheat_usd.kernels.simd import (
    address_of,
    black,
    channel,
    color_add,
    color_product,
    difference,
    fetch,
    load_color,
    load_rgb,
    multiply_add,
    plus,
    plus_size,
    ratios,
    scale_add,
    scaled,
    spread,
    store,
    store_color,
    store_rgb,
    zeros,
)

_LEAST = 4  # cells of a part of a cluster
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
    light: np.ndarray, short: np.ndarray, leaves: np.ndarray, sizes: np.ndarray,
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
    short : (n_gather,) uint64, the same as `lanes.store_short` shortens it
    leaves : (3, n_clusters) float32, mean change
    sizes : (n_clusters, 2) float32, sums of the sizes of the changes and of the direct light
    """
    for c in prange(len(begin) - 1):
        _take_change(begin[c], begin[c + 1], np.int64(c), share, radiance, before, direct, light, short, leaves, sizes)


@kernel
def _take_change(
    first: int, last: int, c: int, share: np.ndarray, radiance: np.ndarray, before: np.ndarray, direct: np.ndarray,
    light: np.ndarray, short: np.ndarray, leaves: np.ndarray, sizes: np.ndarray,
) -> None:  # fmt: skip
    """`take_change` for cluster `c`, the cells from `first` up to `last`."""
    from_black = len(before) == 0
    radiance_0, before_0, direct_0 = address_of(radiance), address_of(before), address_of(direct)
    light_0, short_0 = address_of(light), address_of(short)
    mean, changed, all_of_it = black(), black(), black()
    for i in range(first, last):
        change = load_rgb(direct_0 + 12 * i)
        now = change
        all_of_it = plus_size(all_of_it, change)
        if not from_black:
            change = difference(change, load_rgb(before_0 + 12 * i))
            now = scale_add(change, np.float32(1.0), load_rgb(radiance_0 + 12 * i))
        store_color(light_0 + 16 * i, now)
        store_short(short_0 + 8 * i, now)
        changed = plus_size(changed, change)
        mean = scale_add(change, share[i], mean)
    _put_leaf(mean, leaves, c)
    sizes[c, 0], sizes[c, 1] = _total(changed), _total(all_of_it)


@kernel
def _put_leaf(value: Any, leaves: np.ndarray, c: int) -> None:
    """A colour to a column of `leaves` (3, n_clusters)."""
    for k in range(3):
        leaves[k, c] = channel(value, k)


@kernel
def _total(value: Any) -> Any:
    """Sum of a colour's channels."""
    return channel(value, 0) + channel(value, 1) + channel(value, 2)


@kernel
def _part_of(begin: int, end: int, part: int, parts: int) -> tuple[int, int]:
    """First cell of a part of a cluster, and the step to the next; small clusters are one part."""
    if end - begin < _LEAST * parts:
        return begin, 1
    return begin + part, parts


@kernel
def _arrives(entries: np.ndarray, first: int, end: int, mask: int, short: int) -> Any:
    """Light that arrives by the entries from `first` up to `end`; `short` is an address of short colours."""
    place, n, weights = address_of(entries) + first * 4, end - first, entries.view(np.float32)
    # two sums, so that an addition need not wait for the one before
    s0, s1 = zeros(), zeros()
    for _ in range(n // 8):
        s0 = add_short_fours(place, short, mask, s0)
        s1 = add_short_fours(place + 16, short, mask, s1)
        place += 32
    if n & 4:
        s0 = add_short_fours(place, short, mask, s0)
    total = sum_of_fours(plus(s0, s1))
    for e in range(end - (n & 3), end):
        total = add_short(short + np.int64(entries[e] & np.uint32(mask)) * 8, weights[e], total)
    return total


@kernel
def _mean_for_others(total: Any, squares: Any, n: int) -> tuple[float, float]:
    """Share of the mean of `n` noisy values that best stands for others, and how far these are from it.

    With a mean m and a variance v that share is ``k = m^2 / (m^2 + v / n)``, a Wiener filter, and others differ from it
    by ``v (1 + k / n)`` in the mean square. The square of the sum `total` less the sum of `squares` has the products of
    all pairs of different values, which are ``m^2`` each in the mean.
    """
    all_products, own_products = _total(color_product(total, total)), _total(squares)
    other_products = max(all_products - own_products, np.float32(0.0)) / np.float32(n - 1)
    share = min(n * other_products / max(all_products, np.float32(1e-30)), np.float32(1.0))
    variance = (own_products - all_products / np.float32(n)) / np.float32(n - 1)
    return share, max(variance, np.float32(0.0)) * (np.float32(1.0) + share / np.float32(n))


@parallel_kernel
def find_missing(
    begin: np.ndarray,
    share: np.ndarray,
    indptr: np.ndarray,
    entries: np.ndarray,
    column_bits: int,
    direct: np.ndarray,
    light: np.ndarray,
    short: np.ndarray,
    albedo: np.ndarray,
    mean_albedo: np.ndarray,
    part: int,
    parts: int,
    missing: np.ndarray,
    arriving: np.ndarray,
    leaves: np.ndarray,
    sizes: np.ndarray,
) -> None:
    """What cells lack of their balance: ``direct - light + albedo * (rows @ light)``, at a part of each cluster.

    For other cells the mean of what arrives too little at the part stands, as neighbours receive alike: as much of it
    as is no noise, which would disturb cells that are in balance.

    Parameters
    ----------
    begin : (n_clusters + 1,) int64; share : (n_gather,) float32
        As for `take_change`.
    indptr : (n_gather + 1,) int64
    entries : (n_entries,) uint32, of `shorten`
    direct, albedo : (n_gather, 3) float32
    light : (n_gather, 4) float32, 16-byte rows; the fourth column is 0
    mean_albedo : (n_clusters, 3) float32
    short : (n_gather,) uint64, of `take_change`
        What the rows reach: half as long, it stays in the cache of a core.
    part, parts : int
        Every `parts`-th cell of a cluster, from number `part` on.
    missing : (n_gather, 4) float32, 16-byte rows
        Set at the part; the fourth column means nothing.
    arriving : (n_clusters, 3) float32
        What arrives too little at cells beside the part.
    leaves : (3, n_clusters) float32
        Mean missing light of all of the cluster.
    sizes : (n_clusters, 4) float32
        Sums of the sizes of the missing light, as far as it was found, and of the light at the same cells; the squares
        of what is probably still missing at all other cells, summed; and the light of all cells, by these.
    """
    mask = (1 << column_bits) - 1
    for c in prange(len(begin) - 1):
        _find_missing(
            begin[c], begin[c + 1], np.int64(c), share, indptr, entries, mask, direct, light, short, albedo,
            mean_albedo, part, parts, missing, arriving, leaves, sizes,
        )  # fmt: skip


@kernel
def _find_missing(
    first: int, last: int, c: int, share: np.ndarray, indptr: np.ndarray, entries: np.ndarray, mask: int,
    direct: np.ndarray, light: np.ndarray, short: np.ndarray, albedo: np.ndarray, mean_albedo: np.ndarray, part: int,
    parts: int, missing: np.ndarray, arriving: np.ndarray, leaves: np.ndarray, sizes: np.ndarray,
) -> None:  # fmt: skip
    """`find_missing` for cluster `c`, the cells from `first` up to `last`."""
    start, target = address_of(short), address_of(missing)
    direct_0, light_0, albedo_0 = address_of(direct), address_of(light), address_of(albedo)
    mean, white, lacking, here, squares = black(), black(), black(), black(), black()
    begin, step = _part_of(first, last, part, parts)
    for i in range(begin, last, step):
        if step > 1 and i + step < last:
            # of a part the machine does not see which rows come next
            for e in range(indptr[i + step], indptr[i + step + 1], 16):
                fetch(address_of(entries) + e * 4)
        now, reflected = load_color(light_0 + 16 * i), load_rgb(albedo_0 + 12 * i)
        arrives = _arrives(entries, indptr[i], indptr[i + 1], mask, start)
        lacks = color_add(reflected, arrives, difference(load_rgb(direct_0 + 12 * i), now))
        store_color(target + 16 * i, lacks)
        lacking, here = plus_size(lacking, lacks), plus_size(here, now)
        mean, white = scale_add(lacks, share[i], mean), scale_add(reflected, share[i], white)
        weighted = scaled(lacks, share[i])
        squares = color_add(weighted, weighted, squares)
    n = (last - begin + step - 1) // step
    share_of_light, left = ratios(mean, white), np.float32(0.0)
    if step > 1:
        of_mean, left = _mean_for_others(mean, squares, n)
        share_of_light = scaled(share_of_light, of_mean)
        # shares are about one over the number of cells
        left *= np.float32((last - first - n) * (last - first) ** 2)
        mean = color_product(load_rgb(address_of(mean_albedo) + 12 * c), share_of_light)
    store_rgb(address_of(arriving) + 12 * c, share_of_light)
    light_here = _total(here)
    sizes[c, 0], sizes[c, 1], sizes[c, 2] = _total(lacking), light_here, left
    sizes[c, 3] = light_here * np.float32((last - first) / n)
    _put_leaf(mean, leaves, c)


@parallel_kernel
def add_missing(
    begin: np.ndarray, albedo: np.ndarray, missing: np.ndarray, here: np.ndarray, later: np.ndarray, part: int,
    parts: int, light: np.ndarray, short: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Add to `light` what was missing and what cells reflect of its later bounces.

    Parameters
    ----------
    begin, albedo, missing, part, parts
        As for `find_missing`; no rows of `missing`: nothing was, and there are later bounces alone.
    here, later : (n_clusters, 3) float32
        What arrives at other cells than those of the part, and the later bounces that arrive at all.
    light : (n_gather, 4) float32
    short : (n_gather,) uint64, set to the same
    out : (n_gather, 3) float32, the new light once more; or no rows
    """
    for c in prange(len(begin) - 1):
        _add_missing(begin[c], begin[c + 1], np.int64(c), albedo, missing, here, later, part, parts, light, short, out)


@kernel
def _add_missing(
    first: int, last: int, c: int, albedo: np.ndarray, missing: np.ndarray, here: np.ndarray, later: np.ndarray,
    part: int, parts: int, light: np.ndarray, short: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """`add_missing` for cluster `c`, the cells from `first` up to `last`."""
    albedo_0, light_0, short_0 = address_of(albedo), address_of(light), address_of(short)
    missing_0, out_0 = address_of(missing), address_of(out)
    has_missing, has_out = len(missing) > 0, len(out) > 0
    arrives = load_rgb(address_of(later) + 12 * c)
    elsewhere = arrives
    if has_missing:
        elsewhere = scale_add(load_rgb(address_of(here) + 12 * c), np.float32(1.0), arrives)
    found, step = _part_of(first, last, part, parts)
    for i in range(first, last):
        reflected, now = load_rgb(albedo_0 + 12 * i), load_color(light_0 + 16 * i)
        if has_missing and i == found:
            now = scale_add(load_rgb(missing_0 + 16 * i), np.float32(1.0), now)
            now = color_add(reflected, arrives, now)
            found += step
        else:
            now = color_add(reflected, elsewhere, now)
        store_color(light_0 + 16 * i, now)
        store_short(short_0 + 8 * i, now)
        if has_out:
            store_rgb(out_0 + 12 * i, now)


@parallel_kernel
def balance_clusters(
    clusters: np.ndarray, begin: np.ndarray, indptr: np.ndarray, entries: np.ndarray, column_bits: int,
    direct: np.ndarray, short: np.ndarray, albedo: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Give all cells of some clusters the light of their balance: ``direct + albedo * (rows @ light)``.

    `clusters` (n,) int32; all else is as `find_missing` has it. `short` is that light, and `out` (n_gather, 3) float32
    another array.
    """
    mask = (1 << column_bits) - 1
    for k in prange(len(clusters)):
        first, last = begin[clusters[k]], begin[clusters[k] + 1]
        _balance_cells(first, last, indptr, entries, mask, direct, short, albedo, out)


@kernel
def _balance_cells(
    first: int, last: int, indptr: np.ndarray, entries: np.ndarray, mask: int, direct: np.ndarray, short: np.ndarray,
    albedo: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """`balance_clusters` for the cells from `first` up to `last`."""
    direct_0, albedo_0, out_0 = address_of(direct), address_of(albedo), address_of(out)
    for i in range(first, last):
        arrives = _arrives(entries, indptr[i], indptr[i + 1], mask, address_of(short))
        sent = color_add(load_rgb(albedo_0 + 12 * i), arrives, load_rgb(direct_0 + 12 * i))
        store_rgb(out_0 + 12 * i, sent)


@parallel_kernel
def reach_clusters(blocks: np.ndarray, leaves: np.ndarray, out: np.ndarray) -> None:
    """Products of dense matrices, one per colour.

    `blocks` (n_blocks, 3, n, LANES) uint16 hold LANES rows each, transposed, as bfloat16: half as much to be read.
    `leaves` (3, n) and `out` (n, 3) are float32.
    """
    n = leaves.shape[1]
    for task in prange(len(blocks) * 3):
        block, channel = task // 3, task % 3
        place = address_of(blocks) + task * (n * LANES * 2)
        s0, s1, s2, s3 = zeros(), zeros(), zeros(), zeros()
        for j in range(n):
            value = spread(leaves[channel, j])
            s0 = multiply_add(load_short(place), value, s0)
            s1 = multiply_add(load_short(place + 32), value, s1)
            s2 = multiply_add(load_short(place + 64), value, s2)
            s3 = multiply_add(load_short(place + 96), value, s3)
            place += LANES * 2
        sums = np.empty(LANES, np.float32)
        target = address_of(sums)
        store(target, s0)
        store(target + 64, s1)
        store(target + 128, s2)
        store(target + 192, s3)
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
