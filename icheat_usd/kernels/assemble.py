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
    load,
    load_rgb,
    multiply_add,
    product,
    scale_add,
    store,
    store_color,
    store_rgb,
    weighted_sum,
)

ENTRIES = 4  # of a group
_CHUNK = 1024  # pixels or view samples: what is between two passes over them stays in the first-level cache


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
def _blend_first_lobe(at, first, n, blend):  # type: ignore[no-untyped-def]
    """Interpolated products of `n` view samples, three floats each; one more is written."""
    row, weight = at.row + 16 * first, at.weight + 16 * first
    for _ in range(n):
        store_color(blend, weighted_sum(at.products, row, weight))
        row += 16
        weight += 16
        blend += 12


@kernel
def _multiply_run(n, a, b, out):  # type: ignore[no-untyped-def]
    """``out = a * b`` for `n` colours of three floats."""
    for _ in range(n // 16):
        store(out, product(load(a), load(b)))
        store(out + 64, product(load(a + 64), load(b + 64)))
        store(out + 128, product(load(a + 128), load(b + 128)))
        a += 192
        b += 192
        out += 192
    for _ in range(n % 16):
        store_rgb(out, color_add(load_rgb(a), load_rgb(b), black()))
        a += 12
        b += 12
        out += 12


@kernel
def _add_scaled_run(n, a, gain, out):  # type: ignore[no-untyped-def]
    """``out += a * gain`` for `n` colours of three floats; at `gain` stands one colour 16 times."""
    g0, g1, g2 = load(gain), load(gain + 64), load(gain + 128)
    for _ in range(n // 16):
        store(out, multiply_add(load(a), g0, load(out)))
        store(out + 64, multiply_add(load(a + 64), g1, load(out + 64)))
        store(out + 128, multiply_add(load(a + 128), g2, load(out + 128)))
        a += 192
        out += 192
    for _ in range(n % 16):
        store_rgb(out, color_add(load_rgb(a), load_rgb(gain), load_rgb(out)))
        a += 12
        out += 12


@kernel
def _add_group(at, i, view, first_lobe, place):  # type: ignore[no-untyped-def]
    """Add what group `i` gives to a view sample in the lobes from `first_lobe` on, where they are not 0."""
    row, weight, tint = at.row + 16 * i, at.weight + 16 * i, at.tint + 12 * view
    total = load_rgb(place)
    for lobe in range(first_lobe, at.n_lobes):
        color = load_rgb(tint + lobe * at.tint_step)
        if not is_black(color):
            total = color_add(weighted_sum(at.products + lobe * at.products_step, row, weight), color, total)
    store_rgb(place, total)


@kernel
def _indirect_run(first, n, row, weight, more_view, more_row, more_weight, products, tint, out):  # type: ignore[no-untyped-def]
    """Indirect light of `n` view samples to an address, three floats each."""
    at = _places(row, weight, products, tint)
    blend = np.empty(3 * n + 1, np.float32)
    _blend_first_lobe(at, first, n, address_of(blend))
    _multiply_run(n, address_of(blend), at.tint + 12 * first, out)
    if at.n_lobes > 1:
        for v in range(first, first + n):
            _add_group(at, v, v, 1, out + 12 * (v - first))
    more = _places(more_row, more_weight, products, tint)
    for m in range(np.searchsorted(more_view, first), np.searchsorted(more_view, first + n)):
        v = np.int64(more_view[m])
        _add_group(more, m, v, 0, out + 12 * (v - first))
    # Numba may free an array after its last mention, and addresses do not count.
    blend[0] = np.float32(0.0)


@kernel
def _view_chunk(first, n, row, weight, more_view, more_row, more_weight, products, tint, out):  # type: ignore[no-untyped-def]
    place = address_of(out) + 12 * first
    _indirect_run(first, n, row, weight, more_view, more_row, more_weight, products, tint, place)


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
        first = chunk * _CHUNK
        count = min(n - first, _CHUNK)
        _view_chunk(first, count, row, weight, more_view, more_row, more_weight, products, tint, out)


@kernel
def _replace_run(first, n, own_view, own, touched, sent):  # type: ignore[no-untyped-def]
    """Put the indirect light that some of `n` view samples have of their own, and hold that of edited ones at 0."""
    for k in range(np.searchsorted(own_view, first), np.searchsorted(own_view, first + n)):
        v = np.int64(own_view[k])
        for c in range(3):
            sent[v - first, c] = own[v, c]
    if len(touched) == 0:
        return
    n_touched = 0
    for i in range(n):
        n_touched += touched[first + i]
    if n_touched == n:
        values = sent.reshape(-1)
        for i in range(3 * n):
            values[i] = values[i] if values[i] > 0 else np.float32(0.0)
    elif n_touched > 0:
        for i in range(n):
            if touched[first + i]:
                for c in range(3):
                    sent[i, c] = sent[i, c] if sent[i, c] > 0 else np.float32(0.0)


@kernel
def _sent_run(  # type: ignore[no-untyped-def]
    first,
    n,
    row,
    weight,
    more_view,
    more_row,
    more_weight,
    products,
    tint,
    own_view,
    own,
    touched,
    direct,
    gains,
    dimmed_view,
    throughput,
    sent,
):
    """Direct and indirect light of `n` view samples times their throughput to `sent` (n, 3)."""
    out = address_of(sent)
    _indirect_run(first, n, row, weight, more_view, more_row, more_weight, products, tint, out)
    _replace_run(first, n, own_view, own, touched, sent)
    gain = np.empty(48, np.float32)
    for light in range(len(direct)):
        for i in range(48):
            gain[i] = gains[light, i % 3]
        place = address_of(direct) + 12 * (light * direct.shape[1] + first)
        _add_scaled_run(n, place, address_of(gain), out)
    for k in range(np.searchsorted(dimmed_view, first), np.searchsorted(dimmed_view, first + n)):
        for c in range(3):
            sent[dimmed_view[k] - first, c] *= throughput[k, c]
    gain[0] = np.float32(0.0)  # keeps it, see `_indirect_run`


@kernel
def _sum_run(first, n, values, gains, out):  # type: ignore[no-untyped-def]
    """`n` rows of a weighted sum."""
    gain = np.empty(48, np.float32)
    place = address_of(out) + 12 * first
    out[first : first + n] = np.float32(0.0)
    for light in range(len(values)):
        for i in range(48):
            gain[i] = gains[light, i % 3]
        _add_scaled_run(n, address_of(values) + 12 * (light * values.shape[1] + first), address_of(gain), place)
    gain[0] = np.float32(0.0)  # keeps it, see `_indirect_run`


@parallel_kernel
def sum_scaled(values, gains, out):  # type: ignore[no-untyped-def]
    """``out = sum of values[light] * gains[light]`` in the lights' order.

    Parameters
    ----------
    values : (n_lights, n, 3) float32
    gains : (n_lights, 3) float32
    out : (n, 3) float32
    """
    n = len(out)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        _sum_run(chunk * _CHUNK, min(n - chunk * _CHUNK, _CHUNK), values, gains, out)


@kernel
def _sum_samples(begin, end, sample_begin, sent, film):  # type: ignore[no-untyped-def]
    """Pixels ``begin:end`` as sums of their samples, at addresses; `sent` is that of the first one's."""
    for p in range(begin, end):
        total = black()
        for _ in range(sample_begin[p], sample_begin[p + 1]):
            total = scale_add(load_rgb(sent), np.float32(1.0), total)
            sent += 12
        store_rgb(film + 12 * p, total)


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
    own_view,
    own,
    touched,
    direct,
    gains,
    dimmed_view,
    throughput,
    sample_begin,
    in_order,
    still_pixel,
    still,
    film,
):
    base = address_of(film)
    first = np.int64(sample_begin[begin])
    n = np.int64(sample_begin[end]) - first
    sent = film[begin:end] if in_order else np.empty((n, 3), np.float32)
    _sent_run(
        first,
        n,
        row,
        weight,
        more_view,
        more_row,
        more_weight,
        products,
        tint,
        own_view,
        own,
        touched,
        direct,
        gains,
        dimmed_view,
        throughput,
        sent,
    )
    if not in_order:
        _sum_samples(begin, end, sample_begin, address_of(sent), base)
        sent[:1] = np.float32(0.0)  # keeps it, see `_indirect_run`
    for s in range(np.searchsorted(still_pixel, begin), np.searchsorted(still_pixel, end)):
        place = base + 12 * np.int64(still_pixel[s])
        store_rgb(place, scale_add(load_rgb(address_of(still) + 12 * s), np.float32(1.0), load_rgb(place)))


def chunks_in_order(sample_begin: NDArray[np.int32]) -> NDArray[np.bool_]:
    """In which of the pieces that `assemble_film` makes of an image each pixel has one view sample."""
    single = np.diff(sample_begin) == 1
    return np.array([single[first : first + _CHUNK].all() for first in range(0, len(single), _CHUNK)], np.bool_)


@parallel_kernel
def assemble_film(  # type: ignore[no-untyped-def]
    row,
    weight,
    more_view,
    more_row,
    more_weight,
    products,
    tint,
    own_view,
    own,
    touched,
    direct,
    gains,
    dimmed_view,
    throughput,
    sample_begin,
    in_order,
    still_pixel,
    still,
    film,
):
    """Image of direct and indirect light; the first seven arguments are those of `assemble_view`.

    Parameters
    ----------
    own_view : (n_own,) int32
        View samples, ascending, whose indirect light is not interpolated.
    own : (n_view, 3) float32
        Theirs.
    touched : (n_view,) or (0,) bool
        View samples whose indirect light is held at 0 or above.
    direct : (n_lights, n_view, 3) float32
        Reflected direct light of each light at gain 1.
    gains : (n_lights, 3) float32
    dimmed_view : (n_dimmed,) int32
        View samples, ascending, whose throughput is not 1.
    throughput : (n_dimmed, 3) float32
    sample_begin : (n_pixels + 1,) int32
        First view sample of each pixel.
    in_order : (n_chunks,) bool
        Of `chunks_in_order`.
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
            own_view,
            own,
            touched,
            direct,
            gains,
            dimmed_view,
            throughput,
            sample_begin,
            in_order[chunk],
            still_pixel,
            still,
            film,
        )
