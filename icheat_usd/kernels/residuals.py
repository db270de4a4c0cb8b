"""What a narrow transport loses of known light, added to products with light that differs from it by a factor."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


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
    """Sums over cells of ``now * before`` and ``before * before``, channel by channel, to `out` (6,)."""
    r = g = b = rr = gg = bb = 0.0
    for k in range(len(now)):
        x, y, z = np.float64(before[k, 0]), np.float64(before[k, 1]), np.float64(before[k, 2])
        r += np.float64(now[k, 0]) * x
        g += np.float64(now[k, 1]) * y
        b += np.float64(now[k, 2]) * z
        rr += x * x
        gg += y * y
        bb += z * z
    out[0], out[1], out[2], out[3], out[4], out[5] = r, g, b, rr, gg, bb


@kernel
def _take_proportional(now, before, factor, rest, size):  # type: ignore[no-untyped-def]
    # Of each channel by itself: one sum of all would wait for every addition.
    left_r = left_g = left_b = whole_r = whole_g = whole_b = np.float32(0)
    of_left_r = of_left_g = of_left_b = of_whole_r = of_whole_g = of_whole_b = 0.0
    fr, fg, fb = factor[0], factor[1], factor[2]
    for k in range(len(now)):
        r, g, b = now[k, 0], now[k, 1], now[k, 2]
        x, y, z = r - fr * before[k, 0], g - fg * before[k, 1], b - fb * before[k, 2]
        rest[k, 0], rest[k, 1], rest[k, 2] = x, y, z
        left_r, left_g, left_b = max(left_r, abs(x)), max(left_g, abs(y)), max(left_b, abs(z))
        whole_r, whole_g, whole_b = max(whole_r, abs(r)), max(whole_g, abs(g)), max(whole_b, abs(b))
        of_left_r += np.float64(x) * np.float64(x)
        of_left_g += np.float64(y) * np.float64(y)
        of_left_b += np.float64(z) * np.float64(z)
        of_whole_r += np.float64(r) * np.float64(r)
        of_whole_g += np.float64(g) * np.float64(g)
        of_whole_b += np.float64(b) * np.float64(b)
    size[0], size[1] = max(left_r, left_g, left_b), max(whole_r, whole_g, whole_b)
    size[2], size[3] = of_left_r + of_left_g + of_left_b, of_whole_r + of_whole_g + of_whole_b


@parallel_kernel
def _find_products(pieces, now, before, sums):  # type: ignore[no-untyped-def]
    for p in prange(len(pieces)):
        some = slice(pieces[p, 1], pieces[p, 2])
        _piece_products(now[some], before[some], sums[p])


@parallel_kernel
def _find_rest(pieces, now, before, factors, rest, sizes):  # type: ignore[no-untyped-def]
    for p in prange(len(pieces)):
        some = slice(pieces[p, 1], pieces[p, 2])
        _take_proportional(now[some], before[some], factors[pieces[p, 0]], rest[some], sizes[p])


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
