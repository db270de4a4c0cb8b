"""Light of view samples under soft masks: many terms, of products at a few records each.

A sample's light is the sum over its records of what each sends, and that a sum over the terms of the sample's group,
each times the product of masks. Terms are many where masks overlap, and each has its product at the same record
elsewhere in memory. Samples of a group share records: their terms can be laid side by side first.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import (
    address_of,
    black,
    color_add,
    is_black,
    load_color,
    load_rgb,
    scale_add,
    store_color,
    store_rgb,
)

_CHUNK = 256  # samples, or records


class SoftTable(NamedTuple):
    """The terms of groups whose factors are masks alone."""

    term_begin: NDArray[np.int64]  #: (n_groups + 1,) ranges of terms
    term_version: NDArray[np.int32]  #: (n_terms,)
    factor_begin: NDArray[np.int64]  #: (n_terms + 1,) ranges of factors
    factor: NDArray[np.int32]  #: rows of `masks` that multiply a term
    masks: NDArray[np.float32]  #: (n_rows, n_view)


@kernel
def _take_factors(s, first, end, factor_begin, factor, masks, out):  # type: ignore[no-untyped-def]
    """Factors of the terms from `first` up to `end` at one sample."""
    for term in range(first, end):
        value = np.float32(1)
        for f in range(factor_begin[term], factor_begin[term + 1]):
            value *= masks[factor[f], s]
        out[term - first] = value


@kernel
def _most_terms(term_begin):  # type: ignore[no-untyped-def]
    most = 0
    for group in range(len(term_begin) - 1):
        most = max(most, term_begin[group + 1] - term_begin[group])
    return most


@parallel_kernel
def soft_terms(samples, group, table, sparse, indptr, indices, weights, pair_of, products, tints, out):  # type: ignore[no-untyped-def]
    """Sum of the terms of each sample into ``out[sample]``.

    Parameters
    ----------
    samples : (n,) int64 view samples
    group : (n_view,) int32 group of each
    table : SoftTable
    sparse : int
        0 where rows are samples; else their records and the weights of these are
        ``indices[indptr[s] : indptr[s + 1]]`` and `weights`.
    pair_of : (n_versions, n_tiles) int32 row of the products
    products : (n_lobes, n_pairs, 64, 4) float32
    tints : (n_lobes, n_view, 3) float32
    out : (n_view, 3) float32
    """
    n = len(samples)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        first = np.int64(chunk) * _CHUNK
        _soft_run(
            first, min(n, first + _CHUNK), samples, group, table, sparse, indptr, indices, weights, pair_of, products,
            tints, out,
        )  # fmt: skip


@kernel
def _soft_run(  # type: ignore[no-untyped-def]
    begin, end, samples, group, table, sparse, indptr, indices, weights, pair_of, products, tints, out
):
    """`soft_terms` for some of the samples."""
    term_begin, version, factor_begin, factor, masks = table
    product_0, tint_0, out_0 = address_of(products), address_of(tints), address_of(out)
    product_step, tint_step = 1024 * products.shape[1], 12 * tints.shape[1]
    factors = np.empty(_most_terms(term_begin), np.float32)
    for k in range(begin, end):
        s = np.int64(samples[k])
        first, last = term_begin[group[s]], term_begin[group[s] + 1]
        _take_factors(s, first, last, factor_begin, factor, masks, factors)
        total = black()
        for lobe in range(len(products)):
            tint = load_rgb(tint_0 + lobe * tint_step + 12 * s)
            if is_black(tint):
                continue
            of_lobe, sent = product_0 + lobe * product_step, black()
            for entry in range(0 if sparse == 0 else indptr[s], 1 if sparse == 0 else indptr[s + 1]):
                row = s if sparse == 0 else np.int64(indices[entry])
                place, here = of_lobe + 16 * (row & 63), black()
                for term in range(first, last):
                    pair = np.int64(pair_of[version[term], row >> 6])
                    here = scale_add(load_color(place + 1024 * pair), factors[term - first], here)
                sent = scale_add(here, np.float32(1) if sparse == 0 else weights[entry], sent)
            total = color_add(sent, tint, total)
        # the light of a sample that begins a line may be written by another thread: three floats, not four
        store_rgb(out_0 + 12 * s, total)


@parallel_kernel
def gather_terms(group, row, begin, table, pair_of, products, out):  # type: ignore[no-untyped-def]
    """The products of all terms of a group at a record side by side.

    Parameters
    ----------
    group, row : (n,) int32
        A group and a record.
    begin : (n + 1,) int64
        Where the terms of each are to lie.
    table, pair_of, products
        As for `soft_terms`.
    out : (n_lobes, begin[-1], 4) float32
    """
    n = len(row)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        first = np.int64(chunk) * _CHUNK
        _gather_run(first, min(n, first + _CHUNK), group, row, begin, table, pair_of, products, out)


@kernel
def _gather_run(first, end, group, row, begin, table, pair_of, products, out):  # type: ignore[no-untyped-def]
    """`gather_terms` for some of the records."""
    product_0, product_step, out_0, out_step = (
        address_of(products),
        1024 * products.shape[1],
        address_of(out),
        16 * out.shape[1],
    )
    for k in range(first, end):
        of_row = np.int64(row[k])
        term = table.term_begin[group[k]]
        for i in range(begin[k], begin[k + 1]):
            pair = np.int64(pair_of[table.term_version[term], of_row >> 6])
            term += 1
            for lobe in range(len(products)):
                color = load_color(product_0 + lobe * product_step + 1024 * pair + 16 * (of_row & 63))
                store_color(out_0 + lobe * out_step + 16 * i, color)


@parallel_kernel
def gathered_terms(samples, group, table, place_begin, place, indptr, weights, gathered, tints, out):  # type: ignore[no-untyped-def]
    """What `soft_terms` says, bit for bit, of products that `gather_terms` has laid side by side.

    Parameters
    ----------
    place_begin : (n,) int64
        The first of the places of each sample, which has as many as records.
    place : (n_places,) int64
        Where the terms of the sample's group at the record begin.
    gathered : (n_lobes, m, 4) float32
    """
    n = len(samples)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        first = np.int64(chunk) * _CHUNK
        _gathered_run(
            first, min(n, first + _CHUNK), samples, group, table, place_begin, place, indptr, weights, gathered, tints,
            out,
        )  # fmt: skip


@kernel
def _gathered_run(  # type: ignore[no-untyped-def]
    begin, end, samples, group, table, place_begin, place, indptr, weights, gathered, tints, out
):
    """`gathered_terms` for some of the samples."""
    term_begin, _, factor_begin, factor, masks = table
    gathered_0, tint_0, out_0 = address_of(gathered), address_of(tints), address_of(out)
    lobe_step, tint_step = 16 * gathered.shape[1], 12 * tints.shape[1]
    factors = np.empty(_most_terms(term_begin), np.float32)
    for k in range(begin, end):
        s = np.int64(samples[k])
        first, last = term_begin[group[s]], term_begin[group[s] + 1]
        n_terms = last - first
        _take_factors(s, first, last, factor_begin, factor, masks, factors)
        total = black()
        for lobe in range(len(gathered)):
            tint = load_rgb(tint_0 + lobe * tint_step + 12 * s)
            if is_black(tint):
                continue
            sent, of_sample = black(), place_begin[k] - indptr[s]
            for entry in range(indptr[s], indptr[s + 1]):
                at, here = gathered_0 + lobe * lobe_step + 16 * place[of_sample + entry], black()
                for term in range(n_terms):
                    here = scale_add(load_color(at + 16 * term), factors[term], here)
                sent = scale_add(here, weights[entry], sent)
            total = color_add(sent, tint, total)
        store_rgb(out_0 + 12 * s, total)
