"""What view samples make of products: which terms they need, their sums, and samples that receive alike."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import (
    address_of,
    black,
    color_add,
    color_of,
    color_product,
    is_black,
    load_color,
    load_rgb,
    scale_add,
    scaled,
    store_rgb,
)

_CHUNK = 256  # samples


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
    n = len(samples)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        _add_terms_run(
            chunk * _CHUNK,
            min(n, chunk * _CHUNK + _CHUNK),
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
        )


@kernel
def _add_terms_run(  # type: ignore[no-untyped-def]
    first,
    end,
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
    """`add_terms` for some of the samples."""
    product_0, tint_0, albedo_0 = address_of(products), address_of(tints), address_of(albedo)
    own_0, out_0 = address_of(own), address_of(out)
    product_step, tint_step = 1024 * products.shape[1], 12 * tints.shape[1]
    one = np.float32(1)
    for k in range(first, end):
        s = samples[k]
        total = load_rgb(out_0 + 12 * k)
        for term in range(term_begin[group[s]], term_begin[group[s] + 1]):
            version = term_version[term]
            factor = color_of(one, one, one)
            for f in range(term_factor_begin[term], term_factor_begin[term + 1]):
                row = term_factor[f]
                if row < n_rows:
                    factor = scaled(factor, masks[row, s])
                else:
                    factor = color_product(factor, load_rgb(own_0 + 12 * (k * own.shape[1] + row - n_rows)))
            o = offsets[version]
            reflected = color_of(np.float32(o[0]), np.float32(o[1]), np.float32(o[2]))
            emitted = color_of(np.float32(o[3]), np.float32(o[4]), np.float32(o[5]))
            light = color_add(reflected, load_rgb(albedo_0 + 12 * s), emitted)
            for lobe in range(len(products)):
                tint = load_rgb(tint_0 + lobe * tint_step + 12 * s)
                if is_black(tint):
                    continue
                of_lobe = product_0 + lobe * product_step
                if sparse == 0:
                    pair = np.int64(pair_of[version, s >> 6])
                    sent = load_color(of_lobe + 1024 * pair + 16 * (s & 63))
                else:
                    sent = black()
                    for entry in range(indptr[s], indptr[s + 1]):
                        pair = np.int64(pair_of[version, indices[entry] >> 6])
                        place = of_lobe + 1024 * pair + 16 * np.int64(indices[entry] & 63)
                        sent = scale_add(load_color(place), weights[entry], sent)
                light = color_add(sent, tint, light)
            total = color_add(factor, light, total)
        store_rgb(out_0 + 12 * k, total)


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
        # Next to each other are often rows that are the same.
        same = k > 0
        for w in range(keys.shape[1]):
            same = same and keys[k, w] == keys[k - 1, w]
        if same:
            out[k] = out[k - 1]
            continue
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
