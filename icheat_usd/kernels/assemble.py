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
    color_product,
    load,
    load_byte,
    load_color,
    load_number,
    load_rgb,
    multiply_add,
    plus,
    positive,
    positive_color,
    scale_add,
    store,
    store_color,
    store_rgb,
    weighted_sum,
    zeros,
)

_CHUNK = 1024  # pixels or view samples: what is between two passes over them stays in the first-level cache
_FILM_CHUNK = 4096  # of a film, where what begins a chunk takes longer than a pass that the second-level cache feeds
_RUN = 64  # pixels that are looked at together for whether each has one sample


class _Places(NamedTuple):
    """Addresses: handed on, arrays would cost more than the work."""

    row: int
    weight: int
    tint: int
    lobe: int


class _Again(NamedTuple):
    """The same of what first groups of view samples have again."""

    begin: int
    tint: int
    lobe: int


@kernel
def _places(row, weight, tint, lobe):  # type: ignore[no-untyped-def]
    return _Places(address_of(row), address_of(weight), address_of(tint), address_of(lobe))


@kernel
def _blend_run(at, again, products, step, first, n, out):  # type: ignore[no-untyped-def]
    """Light of the first groups of `n` view samples, three floats each; one more is written."""
    row, weight, tint, lobe = at.row + 16 * first, at.weight + 16 * first, at.tint + 16 * first, at.lobe + first
    begin = again.begin + 4 * first
    k = load_number(begin)
    tint_again, lobe_again = again.tint + 16 * k, again.lobe + k
    for _ in range(n):
        begin += 4
        end, weights = load_number(begin), load_color(weight)
        light = color_product(weighted_sum(products + load_byte(lobe) * step, row, weights), load_color(tint))
        while k < end:
            more = weighted_sum(products + load_byte(lobe_again) * step, row, weights)
            light = color_add(more, load_color(tint_again), light)
            tint_again += 16
            lobe_again += 1
            k += 1
        store_color(out, light)
        row += 16
        weight += 16
        tint += 16
        lobe += 1
        out += 12


@kernel
def _add_group(at, i, products, step, place):  # type: ignore[no-untyped-def]
    """Add the light of group `i` to a view sample's."""
    total = weighted_sum(products + load_byte(at.lobe + i) * step, at.row + 16 * i, load_color(at.weight + 16 * i))
    store_rgb(place, color_add(total, load_color(at.tint + 16 * i), load_rgb(place)))


@kernel
def _indirect_run(first, n, table, products, out):  # type: ignore[no-untyped-def]
    """Indirect light of `n` view samples to an address, three floats each; one more is written."""
    row, weight, tint, lobe, again_begin, again_tint, again_lobe = table[:7]
    more_view, more_row, more_weight, more_tint, more_lobe = table[7:]
    if len(products) == 0:
        for _ in range(n):
            store_rgb(out, black())
            out += 12
        return
    start, step = address_of(products), 16 * products.shape[1]  # from lobe to lobe
    places = _places(row, weight, tint, lobe)
    again = _Again(address_of(again_begin), address_of(again_tint), address_of(again_lobe))
    _blend_run(places, again, start, step, first, n, out)
    more = _places(more_row, more_weight, more_tint, more_lobe)
    for i in range(np.searchsorted(more_view, first), np.searchsorted(more_view, first + n)):
        _add_group(more, i, start, step, out + 12 * (np.int64(more_view[i]) - first))


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
def _view_chunk(first, n, table, products, out):  # type: ignore[no-untyped-def]
    sent = np.empty(3 * n + 1, np.float32)
    _indirect_run(first, n, table, products, address_of(sent))
    values = out.reshape(-1)
    for i in range(3 * n):
        values[3 * first + i] = sent[i]


@parallel_kernel
def assemble_view(table, products, out):  # type: ignore[no-untyped-def]
    """Indirect light of view samples.

    Parameters
    ----------
    table
        The columns of a `FilmTable`.
    products : (n_lobes, n_rows, 4) float32
        Products of each lobe's rows, and a pad.
    out : (n_view, 3) float32
    """
    n = len(out)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        first = chunk * _CHUNK
        _view_chunk(first, min(n - first, _CHUNK), table, products, out)


@kernel
def _replace_run(first, n, own_view, own, sent):  # type: ignore[no-untyped-def]
    """Put the indirect light that some of `n` view samples have of their own."""
    for k in range(np.searchsorted(own_view, first), np.searchsorted(own_view, first + n)):
        v = np.int64(own_view[k])
        for c in range(3):
            sent[v - first, c] = own[v, c]


@kernel
def _add_run(first, n, added_view, own, sent):  # type: ignore[no-untyped-def]
    """Add the indirect light that some of `n` view samples have besides."""
    for k in range(np.searchsorted(added_view, first), np.searchsorted(added_view, first + n)):
        v = np.int64(added_view[k])
        for c in range(3):
            sent[v - first, c] += own[v, c]


@kernel
def _add_direct(first, n, direct, indirect, out):  # type: ignore[no-untyped-def]
    """Indirect light, from its address, held at 0 or above, and direct light of `n` view samples to `out`.

    It may be the same address.
    """
    kept, lights, gains = direct
    some = address_of(kept) + 12 * first
    light_0 = address_of(lights) + 12 * first
    step = 12 * lights.shape[1]
    gain_0 = address_of(gains)
    is_kept = len(kept) > 0
    for _ in range(n // 16):
        for third in range(3):
            total = load(some + 64 * third) if is_kept else zeros()
            light, gain = light_0 + 64 * third, gain_0 + 64 * third
            for _ in range(len(gains)):
                total = multiply_add(load(light), load(gain), total)
                light += step
                gain += 192
            store(out + 64 * third, plus(positive(load(indirect + 64 * third)), total))
        some += 192
        light_0 += 192
        indirect += 192
        out += 192
    for _ in range(n % 16):
        one = load_rgb(some) if is_kept else black()
        light, gain = light_0, gain_0
        for _ in range(len(gains)):
            one = color_add(load_rgb(light), load_rgb(gain), one)
            light += step
            gain += 192
        store_rgb(out, scale_add(positive_color(load_rgb(indirect)), np.float32(1.0), one))
        some += 12
        light_0 += 12
        indirect += 12
        out += 12


@kernel
def _dim(first, n, dimmed_view, throughput, sent):  # type: ignore[no-untyped-def]
    """Multiply the light of `n` view samples, at an address, with their throughput."""
    for k in range(np.searchsorted(dimmed_view, first), np.searchsorted(dimmed_view, first + n)):
        place = sent + 12 * (np.int64(dimmed_view[k]) - first)
        store_rgb(place, color_product(load_rgb(place), load_rgb(address_of(throughput) + 12 * k)))


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
    gain[0] = np.float32(0.0)  # Numba may free an array after its last mention, and addresses do not count.


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
    """Pixels ``begin:end`` as sums of their samples; `sent` and `film` are addresses, of the first of each."""
    for p in range(begin, end):
        total = black()
        for _ in range(sample_begin[p], sample_begin[p + 1]):
            total = scale_add(load_rgb(sent), np.float32(1.0), total)
            sent += 12
        store_rgb(film, total)
        film += 12


@kernel
def _film_chunk(begin, end, table, products, own, direct, seen, film):  # type: ignore[no-untyped-def]
    own_view, added_view, own_light = own
    dimmed_view, throughput, sample_begin, in_order, still_pixel, still = seen
    first = np.int64(sample_begin[begin])
    n = np.int64(sample_begin[end]) - first
    buffer = np.empty(3 * n + 1, np.float32)
    indirect, place = address_of(buffer), address_of(film) + 12 * begin
    _indirect_run(first, n, table, products, indirect)
    _replace_run(first, n, own_view, own_light, buffer[: 3 * n].reshape(n, 3))
    _add_run(first, n, added_view, own_light, buffer[: 3 * n].reshape(n, 3))
    is_dimmed = np.searchsorted(dimmed_view, first) < np.searchsorted(dimmed_view, first + n)
    for p in range(begin, end, _RUN):
        last, v = min(p + _RUN, end), np.int64(sample_begin[p])
        n_run = np.int64(sample_begin[last]) - v
        some = place if in_order[p // _RUN] else indirect
        _add_direct(v, n_run, direct, indirect, some)
        if is_dimmed:
            _dim(v, n_run, dimmed_view, throughput, some)
        if not in_order[p // _RUN]:
            _sum_samples(p, last, sample_begin, indirect, place)
        place += 12 * _RUN
        indirect += 12 * n_run
    buffer[0] = np.float32(0.0)  # keeps it, see `_sum_run`
    _add_still(begin, end, still_pixel, still, film)


@kernel
def _add_still(begin, end, still_pixel, still, film):  # type: ignore[no-untyped-def]
    """Add what some of the pixels ``begin:end`` emit or show behind."""
    base = address_of(film)
    for s in range(np.searchsorted(still_pixel, begin), np.searchsorted(still_pixel, end)):
        place = base + 12 * np.int64(still_pixel[s])
        store_rgb(place, scale_add(load_rgb(address_of(still) + 12 * s), np.float32(1.0), load_rgb(place)))


def runs_in_order(sample_begin: NDArray[np.int32]) -> NDArray[np.bool_]:
    """In which runs of `_RUN` pixels each has one view sample, whose light goes straight to the film."""
    single = np.diff(sample_begin) == 1
    return np.array([single[begin : begin + _RUN].all() for begin in range(0, len(single), _RUN)], np.bool_)


@parallel_kernel
def assemble_film(table, products, own, direct, seen, film):  # type: ignore[no-untyped-def]
    """Image of direct and indirect light; `table` and `products` are those of `assemble_view`.

    Parameters
    ----------
    own
        ``(own_view, added_view, own_light)``: (n_own,) int32 view samples, ascending, whose indirect light is not
        interpolated; (n_added,) the same that have some besides; and the light of both, (n_view, 3) float32.
    direct
        ``(kept, lights, gains)``: the sum of the first lights' reflected direct light, (n_view, 3) or (0, 3);
        that of each of the others at gain 1, (n_lights, n_view, 3); and their gains, each 16 times, (n_lights, 48).
    seen
        ``(dimmed_view, throughput, sample_begin, in_order, still_pixel, still)``: (n_dimmed,) int32 view samples,
        ascending, whose throughput is not 1, and theirs, (n_dimmed, 3); the first view sample of each pixel,
        (n_pixels + 1,) int32; `runs_in_order`; and pixels that emit or show the background, (n_still,) int32
        ascending, each once, with what they add, (n_still, 3).
    film : (n_pixels, 3) float32

    Notes
    -----
    A pixel's sums run in one order: the same bits for any number of threads. Indirect light is held at 0 or above,
    once, at the end: packed rows and edits that take light away may say less.
    """
    n = len(film)
    for chunk in prange((n + _FILM_CHUNK - 1) // _FILM_CHUNK):
        begin = chunk * _FILM_CHUNK
        _film_chunk(begin, min(n, begin + _FILM_CHUNK), table, products, own, direct, seen, film)


@kernel
def _sum_films_run(first, n, direct, out):  # type: ignore[no-untyped-def]
    kept, lights, gains = direct
    some, light_0, gain_0 = address_of(kept) + 12 * first, address_of(lights) + 12 * first, address_of(gains)
    step, is_kept = 12 * lights.shape[1], len(kept) > 0
    for _ in range(n // 16):
        for third in range(3):
            total = load(some + 64 * third) if is_kept else zeros()
            light, gain = light_0 + 64 * third, gain_0 + 64 * third
            for _ in range(len(gains)):
                total = multiply_add(load(light), load(gain), total)
                light += step
                gain += 192
            store(out + 64 * third, total)
        some += 192
        light_0 += 192
        out += 192
    for _ in range(n % 16):
        one = load_rgb(some) if is_kept else black()
        light, gain = light_0, gain_0
        for _ in range(len(gains)):
            one = color_add(load_rgb(light), load_rgb(gain), one)
            light += step
            gain += 192
        store_rgb(out, one)
        some += 12
        light_0 += 12
        out += 12


@parallel_kernel
def sum_films(direct, still_pixel, still, film):  # type: ignore[no-untyped-def]
    """Image of images of lights: `direct` as for `assemble_film`, but of pixels; `still_pixel`, `still` the same."""
    n = len(film)
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        first = chunk * _CHUNK
        end = min(n, first + _CHUNK)
        _sum_films_run(first, end - first, direct, address_of(film) + 12 * first)
        _add_still(first, end, still_pixel, still, film)
