"""What a narrow transport loses of known light, added to products with light that differs from it by a factor."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

#: Sums that are made side by side, of 16 colours: one of all would wait for every addition.
_SUMS = 48


@kernel
def _add_scaled(lost, factor, out):  # type: ignore[no-untyped-def]
    """``out += lost * factor`` for 64 colours and pads, flat; `factor` holds one colour and pad 16 times."""
    for part in range(4):
        for i in range(64):
            out[64 * part + i] += lost[64 * part + i] * factor[i]


@kernel
def _add_lights(lost, factors, job, out):  # type: ignore[no-untyped-def]
    for light in range(len(lost)):
        _add_scaled(lost[light, job], factors[light], out)


@kernel
def _sizes_run(first, end, colors, out):  # type: ignore[no-untyped-def]
    for k in range(first, end):
        out[k] = max(abs(colors[k, 0]), abs(colors[k, 1]), abs(colors[k, 2]))


@parallel_kernel
def largest_channels(versions, colors, out):  # type: ignore[no-untyped-def]
    """Largest sizes of the channels of some versions, from colours (n_versions, n, 4) to `out` (n_versions, n)."""
    n = colors.shape[1]
    parts = (n + 8191) // 8192
    for job in prange(len(versions) * parts):
        first = job % parts * 8192
        _sizes_run(first, min(n, first + 8192), colors[versions[job // parts]], out[versions[job // parts]])


@parallel_kernel
def add_light_residuals(lost, factors, n_tiles, out):  # type: ignore[no-untyped-def]
    """Add ``sum over lights of lost * factor`` to products.

    Parameters
    ----------
    lost : (n_lights, n_lobes * n_tiles, 256) float32
        64 colours and pads of each tile.
    factors : (n_lights, 64) float32
        Gain of each light and a pad, 16 times.
    out : (n_lobes, at least n_tiles, 256) float32
    """
    for job in prange(len(out) * n_tiles):
        _add_lights(lost, factors, job, out[job // n_tiles, job % n_tiles])


@kernel
def _piece_products(now, before, out):  # type: ignore[no-untyped-def]
    """Sums over cells of ``now * before`` and ``before * before``, channel by channel, to `out` (6,).

    Colours come one after the other, flat.
    """
    both, squared = np.zeros((2, _SUMS))
    whole = len(now) // _SUMS * _SUMS
    for first in range(0, whole, _SUMS):
        a, b = now[first : first + _SUMS], before[first : first + _SUMS]
        for i in range(_SUMS):
            both[i] += np.float64(a[i]) * np.float64(b[i])
            squared[i] += np.float64(b[i]) * np.float64(b[i])
    for k in range(whole, len(now)):
        both[k - whole] += np.float64(now[k]) * np.float64(before[k])
        squared[k - whole] += np.float64(before[k]) * np.float64(before[k])
    out[:] = 0.0
    for i in range(_SUMS):
        out[i % 3] += both[i]
        out[3 + i % 3] += squared[i]


@kernel
def _take_proportional(now, before, factor, rest, size):  # type: ignore[no-untyped-def]
    """What is left of colours, which come one after the other, flat, and how large it is."""
    factors, (left, whole) = np.empty(_SUMS, np.float32), np.zeros((2, _SUMS), np.float32)
    of_left, of_whole = np.zeros((2, _SUMS))
    for i in range(_SUMS):
        factors[i] = factor[i % 3]
    for first in range(0, len(now), _SUMS):
        n = min(_SUMS, len(now) - first)
        a, b, c = now[first : first + n], before[first : first + n], rest[first : first + n]
        for i in range(n):
            c[i] = a[i] - factors[i] * b[i]
        for i in range(n):
            left[i], whole[i] = max(left[i], abs(c[i])), max(whole[i], abs(a[i]))
            of_left[i] += np.float64(c[i]) * np.float64(c[i])
            of_whole[i] += np.float64(a[i]) * np.float64(a[i])
    size[0], size[1], size[2], size[3] = left.max(), whole.max(), of_left.sum(), of_whole.sum()


@parallel_kernel
def _find_products(pieces, now, before, sums):  # type: ignore[no-untyped-def]
    for p in prange(len(pieces)):
        some = slice(pieces[p, 1], pieces[p, 2])
        _piece_products(now[some].reshape(-1), before[some].reshape(-1), sums[p])


@parallel_kernel
def _find_rest(pieces, now, before, factors, rest, sizes):  # type: ignore[no-untyped-def]
    for p in prange(len(pieces)):
        some = slice(pieces[p, 1], pieces[p, 2])
        colors = now[some].reshape(-1), before[some].reshape(-1)
        _take_proportional(*colors, factors[pieces[p, 0]], rest[some].reshape(-1), sizes[p])


def in_lanes(colors):  # type: ignore[no-untyped-def]
    """Each of some colours (n, 3) and a pad of 0, 16 times: (n, 64) float32."""
    lanes = np.zeros((len(colors), 16, 4), np.float32)
    lanes[:, :, :3] = colors[:, None]
    return lanes.reshape(len(colors), 64)


def proportions(pieces, now, before, factors, rest, size):  # type: ignore[no-untyped-def]
    """The factors, channel by channel, that bring earlier values nearest to what they are now, and what is left.

    Parameters
    ----------
    pieces : (n, 3) int64
        Number of a function, and a range of its cells; those of one function in any number of pieces.
    now, before : (n_cells, 3) float32
    factors : (n_functions, 64) float32
        Receives a colour and pad, 16 times, of those that have pieces.
    rest : (n_cells, 3) float32
        Receives ``now - factor * before``.
    size : (n_functions, 4) float64
        Receives the largest size of that and of `now`, and the sums of their squares, of those that have pieces.
    """
    sums = np.empty((len(pieces), 6))
    _find_products(pieces, now, before, sums)
    total = np.zeros((len(factors), 6))
    np.add.at(total, pieces[:, 0], sums)
    both, squared = total[:, :3], total[:, 3:]
    found = np.divide(both, squared, out=np.zeros_like(both), where=squared > 0)
    some = np.unique(pieces[:, 0])
    factors[some] = in_lanes(found[some])
    sizes = np.empty((len(pieces), 4))
    _find_rest(pieces, now, before, factors, rest, sizes)
    size[some] = 0
    np.maximum.at(size[:, :2], pieces[:, 0], sizes[:, :2])
    np.add.at(size[:, 2:], pieces[:, 0], sizes[:, 2:])


@kernel
def _weighted_square(colors, weight):  # type: ignore[no-untyped-def]
    total = np.float32(0)
    for r in range(len(weight)):
        for c in range(3):
            total += weight[r] * colors[4 * r + c] * colors[4 * r + c]
    return total


@parallel_kernel
def squares_of_tiles(products, weight, out):  # type: ignore[no-untyped-def]
    """Sums over the rows of each tile of squared products times a weight.

    Parameters
    ----------
    products : (n_lobes, at least n_tiles, 256) float32
        64 colours and pads.
    weight : (n_lobes, n_tiles, 64) float32
    out : (n_lobes * n_tiles,) float64
    """
    n = weight.shape[1]
    for job in prange(len(out)):
        out[job] = _weighted_square(products[job // n, job % n], weight[job // n, job % n])


@parallel_kernel
def add_version_residuals(pairs, pair_version, lost, factors, out):  # type: ignore[no-untyped-def]
    """``out[:, pair] += lost[:, pair] * factors[version]`` for some pairs of tile and version.

    Parameters
    ----------
    lost, out : (n_lobes, n_pairs, 256) float32
    factors : as in `proportions`
    """
    n = len(pairs)
    for job in prange(n * len(out)):
        pair = pairs[job % n]
        _add_scaled(lost[job // n, pair], factors[pair_version[pair]], out[job // n, pair])
