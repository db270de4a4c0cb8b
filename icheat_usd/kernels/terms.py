"""What view samples make of products: which terms they need, their sums, and samples that receive alike."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def mark_pairs(samples, group, term_begin, term_version, sparse, indptr, indices, needed):  # type: ignore[no-untyped-def]
    """Set ``needed[version, tile]`` for every term of every sample; `sparse` is 0 where rows are samples."""
    for s in samples:
        for term in range(term_begin[group[s]], term_begin[group[s] + 1]):
            version = term_version[term]
            if sparse == 0:
                needed[version, s >> 6] = 1
            else:
                for entry in range(indptr[s], indptr[s + 1]):
                    needed[version, indices[entry] >> 6] = 1


@parallel_kernel
def add_terms(  # type: ignore[no-untyped-def]
    samples,
    group,
    term_begin,
    term_version,
    term_factor_begin,
    term_factor,
    masks,
    n_rows,
    own,
    sparse,
    indptr,
    indices,
    weights,
    pair_of,
    products,
    tints,
    albedo,
    offsets,
    out,
):
    """Sum of the terms of each sample, added to ``out[k]``.

    Parameters
    ----------
    samples : (n,) view samples
    group : (n_view,) group of each
    term_begin : (n_groups + 1,) ranges of terms
    term_factor : rows of the stack that multiply a term: of `masks` (n_rows, n_view), and from `n_rows` on of `own`
    own : (n, n_own, 3) factors of the samples' own
    pair_of : (n_versions, n_tiles) row of the products
    products : (n_lobes, n_pairs, 64, 4)
    tints : (n_lobes, n_view, 3)
    offsets : (n_versions, 6) light without transport, to be reflected and not
    out : (n, 3) float32
    """
    for k in prange(len(samples)):
        s = samples[k]
        for term in range(term_begin[group[s]], term_begin[group[s] + 1]):
            version = term_version[term]
            red = np.float32(1)
            green = np.float32(1)
            blue = np.float32(1)
            for f in range(term_factor_begin[term], term_factor_begin[term + 1]):
                row = term_factor[f]
                if row < n_rows:
                    red *= masks[row, s]
                    green *= masks[row, s]
                    blue *= masks[row, s]
                else:
                    red *= own[k, row - n_rows, 0]
                    green *= own[k, row - n_rows, 1]
                    blue *= own[k, row - n_rows, 2]
            r = np.float32(offsets[version, 0]) * albedo[s, 0] + np.float32(offsets[version, 3])
            g = np.float32(offsets[version, 1]) * albedo[s, 1] + np.float32(offsets[version, 4])
            b = np.float32(offsets[version, 2]) * albedo[s, 2] + np.float32(offsets[version, 5])
            for lobe in range(len(products)):
                x = np.float32(0)
                y = np.float32(0)
                z = np.float32(0)
                if sparse == 0:
                    pair = pair_of[version, s >> 6]
                    x = products[lobe, pair, s & 63, 0]
                    y = products[lobe, pair, s & 63, 1]
                    z = products[lobe, pair, s & 63, 2]
                else:
                    for entry in range(indptr[s], indptr[s + 1]):
                        pair = pair_of[version, indices[entry] >> 6]
                        lane = indices[entry] & 63
                        x += weights[entry] * products[lobe, pair, lane, 0]
                        y += weights[entry] * products[lobe, pair, lane, 1]
                        z += weights[entry] * products[lobe, pair, lane, 2]
                r += tints[lobe, s, 0] * x
                g += tints[lobe, s, 1] * y
                b += tints[lobe, s, 2] * z
            out[k, 0] += red * r
            out[k, 1] += green * g
            out[k, 2] += blue * b


@parallel_kernel
def signatures(masks, samples, out):  # type: ignore[no-untyped-def]
    """Bits of the rows that touch each sample: whole rows in ``out[:, : n]``, soft ones in ``out[:, n :]``."""
    words = out.shape[1] // 2
    for k in prange(len(samples)):
        for word in range(2 * words):
            out[k, word] = np.uint64(0)
        for row in range(len(masks)):
            u = masks[row, samples[k]]
            if u == 0:
                continue
            bit = np.uint64(1) << np.uint64(row & 63)
            word = (row >> 6) if u == 1 else words + (row >> 6)
            out[k, word] |= bit


@kernel
def group_rows(keys, table, first, out):  # type: ignore[no-untyped-def]
    """Number the different rows of `keys` (n, w) in order of appearance: group of each in `out`; how many there are.

    `table` (a power of two, at least 2 n) must be -1; `first` (n,) gets the first row of each group.
    """
    mask = len(table) - 1
    found = 0
    for k in range(len(keys)):
        h = np.uint64(1469598103934665603)
        for w in range(keys.shape[1]):
            h = (h ^ keys[k, w]) * np.uint64(0x9E3779B97F4A7C15)
            h ^= h >> np.uint64(29)
        place = np.int64(h & np.uint64(mask))
        while True:
            other = table[place]
            if other < 0:
                table[place] = found
                first[found] = k
                out[k] = found
                found += 1
                break
            same = True
            for w in range(keys.shape[1]):
                same = same and keys[first[other], w] == keys[k, w]
            if same:
                out[k] = other
                break
            place = (place + 1) & mask
    return found
