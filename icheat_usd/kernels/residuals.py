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
def _proportion(now, before, factor):  # type: ignore[no-untyped-def]
    for c in range(3):
        both, size = 0.0, 0.0
        for k in range(len(now)):
            both += np.float64(now[k, c]) * np.float64(before[k, c])
            size += np.float64(before[k, c]) * np.float64(before[k, c])
        value = np.float32(both / size) if size > 0.0 else np.float32(0.0)
        for i in range(16):
            factor[4 * i + c] = value


@parallel_kernel
def proportions(versions, cell_begin, now, before, factors):  # type: ignore[no-untyped-def]
    """The factors, channel by channel, that bring the values of some versions nearest to what they are now.

    Parameters
    ----------
    cell_begin : (n_versions + 1,) ranges of `now` and `before` (n_cells, 3)
    factors : (n_versions, 64) float32
        Receives a colour and pad, 16 times.
    """
    for k in prange(len(versions)):
        v = versions[k]
        _proportion(now[cell_begin[v] : cell_begin[v + 1]], before[cell_begin[v] : cell_begin[v + 1]], factors[v])


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
