"""What places see of the sky, times the sky."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel

ROWS, COLUMNS = 64, 128  #: bins of equal solid angle: bands of equal height, cut by longitude
_BLOCK = 256


@parallel_kernel
def find_bins(directions: np.ndarray, out: np.ndarray) -> None:
    """Bin of each unit direction (n, 3) float32, world space, to `out` (n,) uint16."""
    for block in prange((len(directions) + _BLOCK - 1) // _BLOCK):
        for i in range(block * _BLOCK, min(len(directions), (block + 1) * _BLOCK)):
            x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
            row = min(max(int((1.0 - y) * 0.5 * ROWS), 0), ROWS - 1)
            column = int((math.atan2(x, z) / (2.0 * math.pi) + 0.5) * COLUMNS)
            out[i] = row * COLUMNS + min(max(column, 0), COLUMNS - 1)


@parallel_kernel
def shine(
    begin: np.ndarray,
    bins: np.ndarray,
    diffuse: np.ndarray,
    glossy: np.ndarray,
    sky: np.ndarray,
    tint: np.ndarray,
    gloss_tint: np.ndarray,
    out: np.ndarray,
) -> None:
    """Light of the sky that each place reflects by its two lobes.

    Parameters
    ----------
    begin : (n + 1,) int64
        Entries ``begin[i]:begin[i + 1]`` are of place i.
    bins : (n_entries,) uint16
    diffuse : (n_entries,) float32, irradiance per radiance
    glossy : (n_entries,) float32, reflected radiance per radiance; or empty
    sky : (n_bins, 3) float32, radiance
    tint, gloss_tint : (n, 3) float32
        Albedo over pi; colour of the specular lobe.
    out : (n, 3) float32, reflected radiance
    """
    has_gloss = len(glossy) > 0
    for block in prange((len(out) + _BLOCK - 1) // _BLOCK):
        for i in range(block * _BLOCK, min(len(out), (block + 1) * _BLOCK)):
            r0, g0, b0 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            r1, g1, b1 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for e in range(begin[i], begin[i + 1]):
                j, w = bins[e], diffuse[e]
                r0 += w * sky[j, 0]
                g0 += w * sky[j, 1]
                b0 += w * sky[j, 2]
                if has_gloss:
                    w = glossy[e]
                    r1 += w * sky[j, 0]
                    g1 += w * sky[j, 1]
                    b1 += w * sky[j, 2]
            out[i, 0] = r0 * tint[i, 0]
            out[i, 1] = g0 * tint[i, 1]
            out[i, 2] = b0 * tint[i, 2]
            if has_gloss:
                out[i, 0] += r1 * gloss_tint[i, 0]
                out[i, 1] += g1 * gloss_tint[i, 1]
                out[i, 2] += b1 * gloss_tint[i, 2]
