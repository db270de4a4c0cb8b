"""What places see of the sky, times the sky."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel
from icheat_usd.kernels.environment import Table, dome_lookup
from icheat_usd.kernels.simd import address_of, black, color_of, color_product, load_color, scale_add, store_rgb

ROWS, COLUMNS = 64, 128  #: bins of equal solid angle: bands of equal height, cut by longitude
_BLOCK, _BINS = 256, 64  # of a task


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
def bin_sky(
    textures: Table, texture: int, radiance: np.ndarray, to_local: np.ndarray, directions: np.ndarray, out: np.ndarray
) -> None:
    """Mean radiance of one dome over the directions of each bin.

    Parameters
    ----------
    texture : int
        Row of its image; -1: none.
    radiance : (3,) float32
    to_local : (3, 3) float64, from the world to the dome
    directions : (n_bins, n_looks, 3) float32, world space, any length
    out : (n_bins, 4) float32, set but for the pad
    """
    for block in prange((len(out) + _BINS - 1) // _BINS):
        for i in range(block * _BINS, min(len(out), (block + 1) * _BINS)):
            red, green, blue = 0.0, 0.0, 0.0
            for look in range(directions.shape[1]):
                dx, dy, dz = directions[i, look, 0], directions[i, look, 1], directions[i, look, 2]
                x = to_local[0, 0] * dx + to_local[0, 1] * dy + to_local[0, 2] * dz
                y = to_local[1, 0] * dx + to_local[1, 1] * dy + to_local[1, 2] * dz
                z = to_local[2, 0] * dx + to_local[2, 1] * dy + to_local[2, 2] * dz
                length = math.sqrt(x * x + y * y + z * z)
                r, g, b = 1.0, 1.0, 1.0
                if texture >= 0:
                    r, g, b = dome_lookup(textures, texture, x / length, y / length, z / length)
                red += r
                green += g
                blue += b
            out[i, 0] = red / directions.shape[1] * radiance[0]
            out[i, 1] = green / directions.shape[1] * radiance[1]
            out[i, 2] = blue / directions.shape[1] * radiance[2]


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
    sky : (n_bins, 4) float32, radiance and a pad
    tint, gloss_tint : (n, 3) float32
        Albedo over pi; colour of the specular lobe.
    out : (n, 3) float32, contiguous, reflected radiance
    """
    has_gloss, colors, light = len(glossy) > 0, address_of(sky), address_of(out)
    for block in prange((len(out) + _BLOCK - 1) // _BLOCK):
        for i in range(block * _BLOCK, min(len(out), (block + 1) * _BLOCK)):
            matte, shiny = black(), black()
            for e in range(begin[i], begin[i + 1]):
                color = load_color(colors + np.int64(bins[e]) * 16)
                matte = scale_add(color, diffuse[e], matte)
                if has_gloss:
                    shiny = scale_add(color, glossy[e], shiny)
            matte = color_product(matte, color_of(tint[i, 0], tint[i, 1], tint[i, 2]))
            if has_gloss:
                shiny = color_product(shiny, color_of(gloss_tint[i, 0], gloss_tint[i, 1], gloss_tint[i, 2]))
                matte = scale_add(shiny, np.float32(1.0), matte)
            store_rgb(light + i * 12, matte)
