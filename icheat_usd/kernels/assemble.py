"""From products at records to view samples and pixels: interpolation, tints and direct light in one pass."""

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
    load_rgb,
    scale_add,
    store_rgb,
    weighted_sum,
)

ENTRIES = 4  # of a group
_CHUNK = 2048  # pixels or view samples: their products stay in the cache


class InterpolationTable(NamedTuple):
    """Which products each view sample is the weighted sum of, four at a time.

    Entries that a sample does not need have weight 0 and a row that is read
    anyway. A row is one of the flat products ``out.reshape(-1, 4)``: 64 times
    the tile (or the pair of tile and version) plus the lane.
    """

    row: NDArray[np.int32]  #: (n_view, 4)
    weight: NDArray[np.float32]  #: (n_view, 4)
    more_view: NDArray[np.int32]  #: (n_more,) samples with more entries, ascending; once for each four
    more_row: NDArray[np.int32]  #: (n_more, 4)
    more_weight: NDArray[np.float32]  #: (n_more, 4)


def interpolation_table(
    indptr: NDArray[np.int64], indices: NDArray[np.int32], weights: NDArray[np.float32]
) -> InterpolationTable:
    """The table of a sparse matrix (n_view x n_rows) in compressed rows."""
    counts = np.diff(indptr)
    row, weight = _entries(indptr, counts, indices, weights, np.arange(len(counts)), 0)
    groups = np.maximum(-(-counts // ENTRIES) - 1, 0)
    view = np.repeat(np.arange(len(counts)), groups)
    rank = np.arange(len(view)) - np.repeat(np.cumsum(groups) - groups, groups)
    more_row, more_weight = _entries(indptr, counts, indices, weights, view, ENTRIES * (rank + 1))
    return InterpolationTable(row, weight, view.astype(np.int32), more_row, more_weight)


def _entries(
    indptr: NDArray[np.int64],
    counts: NDArray[np.int64],
    indices: NDArray[np.int32],
    weights: NDArray[np.float32],
    view: NDArray[np.int64],
    skipped: NDArray[np.int64] | int,
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Four entries of each of some samples, behind those `skipped`."""
    row, weight = np.zeros((len(view), ENTRIES), np.int32), np.zeros((len(view), ENTRIES), np.float32)
    for k in range(ENTRIES):
        has = np.flatnonzero(counts[view] > skipped + k)
        place = (indptr[view] + skipped + k)[has]
        row[:, k] = row[:, 0]  # already read: a row elsewhere would cost a cache line
        row[has, k], weight[has, k] = indices[place], weights[place]
    return row, weight


class _Places(NamedTuple):
    """Addresses and their steps: handed on, arrays would cost more than the work."""

    row: int
    weight: int
    products: int
    tint: int
    n_lobes: int
    products_step: int  # from lobe to lobe
    tint_step: int


@kernel
def _places(row, weight, products, tint):  # type: ignore[no-untyped-def]
    return _Places(
        address_of(row),
        address_of(weight),
        address_of(products),
        address_of(tint),
        len(products),
        16 * products.shape[1],
        12 * tint.shape[1],
    )


@kernel
def _indirect(at, i, view, total):  # type: ignore[no-untyped-def]
    """`total` plus what group `i` adds to a view sample."""
    row, weight, tint = at.row + 16 * i, at.weight + 16 * i, at.tint + 12 * view
    total = color_add(weighted_sum(at.products, row, weight), load_rgb(tint), total)
    for lobe in range(1, at.n_lobes):
        color = load_rgb(tint + lobe * at.tint_step)
        if not is_black(color):
            total = color_add(weighted_sum(at.products + lobe * at.products_step, row, weight), color, total)
    return total


@kernel
def _view_chunk(begin, end, row, weight, more_view, more_row, more_weight, products, tint, out):  # type: ignore[no-untyped-def]
    base = address_of(out)
    at = _places(row, weight, products, tint)
    for v in range(begin, end):
        store_rgb(base + 12 * v, _indirect(at, v, v, black()))
    more = _places(more_row, more_weight, products, tint)
    for m in range(np.searchsorted(more_view, begin), np.searchsorted(more_view, end)):
        v = np.int64(more_view[m])
        place = base + 12 * v
        store_rgb(place, _indirect(more, m, v, load_rgb(place)))


@parallel_kernel
def assemble_view(row, weight, more_view, more_row, more_weight, products, tint, out):  # type: ignore[no-untyped-def]
    """Indirect light of view samples.

    Parameters
    ----------
    row, weight, more_view, more_row, more_weight
        An `InterpolationTable`.
    products : (n_lobes, n_rows, 4) float32
        Products of each lobe's rows, and a pad.
    tint : (n_lobes, n_view, 3) float32
        Factor of each lobe; a lobe costs little where it is 0.
    out : (n_view, 3) float32
    """
    n = len(out)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        begin, end = chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)
        _view_chunk(begin, end, row, weight, more_view, more_row, more_weight, products, tint, out)


@kernel
def _direct(direct, step, gains, n_lights, total):  # type: ignore[no-untyped-def]
    """`total` plus the direct light of a view sample; addresses of the first light's, and from light to light."""
    for light in range(n_lights):
        total = color_add(load_rgb(direct + light * step), load_rgb(gains + 12 * light), total)
    return total


@kernel
def _film_chunk(  # type: ignore[no-untyped-def]
    begin,
    end,
    row,
    weight,
    more_view,
    more_row,
    more_weight,
    products,
    tint,
    direct,
    gains,
    throughput,
    sample_begin,
    pixel,
    still_pixel,
    still,
    film,
):
    base, factor = address_of(film), address_of(throughput)
    lit, lit_step, light_gains, n_lights = address_of(direct), 12 * direct.shape[1], address_of(gains), len(direct)
    weighted = len(throughput) > 0
    at = _places(row, weight, products, tint)
    for p in range(begin, end):
        total = black()
        for sample in range(sample_begin[p], sample_begin[p + 1]):
            v = np.int64(sample)
            sent = _direct(lit + 12 * v, lit_step, light_gains, n_lights, _indirect(at, v, v, black()))
            total = color_add(sent, load_rgb(factor + 12 * v), total) if weighted else sent
        store_rgb(base + 12 * p, total)
    more = _places(more_row, more_weight, products, tint)
    first, last = sample_begin[begin], sample_begin[end]
    for m in range(np.searchsorted(more_view, first), np.searchsorted(more_view, last)):
        v = np.int64(more_view[m])
        place = base + 12 * np.int64(pixel[v])
        if weighted:
            sent = color_add(_indirect(more, m, v, black()), load_rgb(factor + 12 * v), load_rgb(place))
        else:
            sent = _indirect(more, m, v, load_rgb(place))
        store_rgb(place, sent)
    for s in range(np.searchsorted(still_pixel, begin), np.searchsorted(still_pixel, end)):
        place = base + 12 * np.int64(still_pixel[s])
        store_rgb(place, scale_add(load_rgb(address_of(still) + 12 * s), np.float32(1.0), load_rgb(place)))


@parallel_kernel
def assemble_film(  # type: ignore[no-untyped-def]
    row,
    weight,
    more_view,
    more_row,
    more_weight,
    products,
    tint,
    direct,
    gains,
    throughput,
    sample_begin,
    pixel,
    still_pixel,
    still,
    film,
):
    """Image of direct and indirect light; the first seven arguments are those of `assemble_view`.

    Parameters
    ----------
    direct : (n_lights, n_view, 3) float32
        Reflected direct light of each light at gain 1.
    gains : (n_lights, 3) float32
    throughput : (n_view, 3) or (0, 3) float32
        Of the view samples; without rows all are 1 and no pixel has more than one sample.
    sample_begin : (n_pixels + 1,) int32
        First view sample of each pixel.
    pixel : (n_view,) int32
        Of the view samples, ascending.
    still_pixel : (n_still,) int32
        Pixels that emit or show the background, ascending, each once.
    still : (n_still, 3) float32
        What they add.
    film : (n_pixels, 3) float32

    Notes
    -----
    A pixel's sums run in one order: the same bits for any number of threads.
    """
    n = len(film)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        _film_chunk(
            chunk * _CHUNK,
            min(n, (chunk + 1) * _CHUNK),
            row,
            weight,
            more_view,
            more_row,
            more_weight,
            products,
            tint,
            direct,
            gains,
            throughput,
            sample_begin,
            pixel,
            still_pixel,
            still,
            film,
        )
