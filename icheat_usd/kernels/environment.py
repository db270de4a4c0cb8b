"""Light from infinitely far away: lat-long images looked up and sampled.

A direction in a dome's own frame has image coordinates ``s = 1/2 - atan2(x, z) / 2 pi``
and ``t = acos(y) / pi`` with t growing downwards: OpenEXR's latitude-longitude map, which
UsdLux adopts [1]_. The centre of the image looks along +Z, its left quarter along +X.

.. [1] https://openusd.org/release/user_guides/schemas/usdLux/DomeLight.html
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel

Array = NDArray[Any]
F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Table = Any  # a named tuple of arrays
Floats = tuple[float, ...]


@kernel
def image_bilinear(
    texels: F32, begin: int, width: int, height: int, s: float, t: float, repeat_s: bool
) -> tuple[float, float, float]:
    """Bilinear lookup with texel centres at half integers; t is clamped, s repeats or is clamped."""
    x = s * width - 0.5
    y = t * height - 0.5
    x_floor = math.floor(x)
    y_floor = math.floor(y)
    fx = x - x_floor
    fy = y - y_floor
    x0 = int(x_floor)
    x1 = x0 + 1
    if repeat_s:
        x0 %= width
        x1 %= width
    else:
        x0 = min(max(x0, 0), width - 1)
        x1 = min(max(x1, 0), width - 1)
    y0 = min(max(int(y_floor), 0), height - 1)
    y1 = min(max(int(y_floor) + 1, 0), height - 1)
    i00 = begin + y0 * width + x0
    i10 = begin + y0 * width + x1
    i01 = begin + y1 * width + x0
    i11 = begin + y1 * width + x1
    w00 = (1.0 - fx) * (1.0 - fy)
    w10 = fx * (1.0 - fy)
    w01 = (1.0 - fx) * fy
    w11 = fx * fy
    red = w00 * texels[i00, 0] + w10 * texels[i10, 0] + w01 * texels[i01, 0] + w11 * texels[i11, 0]
    green = w00 * texels[i00, 1] + w10 * texels[i10, 1] + w01 * texels[i01, 1] + w11 * texels[i11, 1]
    blue = w00 * texels[i00, 2] + w10 * texels[i10, 2] + w01 * texels[i01, 2] + w11 * texels[i11, 2]
    if math.isfinite(red + green + blue):
        return red, green, blue
    # texels that are no number count as black: one of them must not spoil a whole picture
    red = 0.0
    green = 0.0
    blue = 0.0
    for weight, k in ((w00, i00), (w10, i10), (w01, i01), (w11, i11)):
        if math.isfinite(texels[k, 0] + texels[k, 1] + texels[k, 2]):
            red += weight * texels[k, 0]
            green += weight * texels[k, 1]
            blue += weight * texels[k, 2]
    return red, green, blue


@kernel
def latlong_coordinates(x: float, y: float, z: float) -> tuple[float, float]:
    """Image coordinates (s, t) of a unit direction in the dome's frame; t grows downwards."""
    s = 0.5 - math.atan2(x, z) / (2.0 * math.pi)
    t = math.acos(min(max(y, -1.0), 1.0)) / math.pi
    return s, t


@kernel
def dome_lookup(textures: Table, texture: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Radiance of a lat-long image in a unit direction of the dome's frame."""
    s, t = latlong_coordinates(x, y, z)
    return image_bilinear(
        textures.texels, textures.begin[texture], textures.width[texture], textures.height[texture], s, t, True
    )


@kernel
def _mean_over_texel(texels: F32, begin: int, width: int, height: int, column: int, row: int) -> float:
    """Luminance of the bilinear image averaged over one texel: a (1 6 1)/8 filter per axis."""
    total = 0.0
    for j in range(-1, 2):
        y = min(max(row + j, 0), height - 1)
        wy = 0.75 if j == 0 else 0.125
        for i in range(-1, 2):
            x = (column + i) % width
            k = begin + y * width + x
            luminance = 0.2126 * texels[k, 0] + 0.7152 * texels[k, 1] + 0.0722 * texels[k, 2]
            if math.isfinite(luminance):
                total += wy * (0.75 if i == 0 else 0.125) * max(luminance, 0.0)
    return total


@parallel_kernel
def dome_columns_cdf(texels: F32, begin: int, width: int, height: int, cdf: F32, row_weight: F64) -> None:
    """Cumulative probability along each row, normalised, and the weight of each row.

    Texel weight = luminance of the *bilinear* image averaged over the texel x its solid angle,
    so that no direction with light has probability zero.
    """
    for row in prange(height):
        band = math.cos(math.pi * row / height) - math.cos(math.pi * (row + 1) / height)
        total = 0.0
        for column in range(width):
            total += _mean_over_texel(texels, begin, width, height, column, np.int64(row))
            cdf[row * width + column] = total
        if total > 0.0:
            for column in range(width):
                cdf[row * width + column] /= total
        row_weight[row] = total * band / width


@kernel
def search_cdf(cdf: F64, begin: int, end: int, u: float) -> int:
    """First row k in [begin, end) with cdf[k] > u; a row of zero probability is never found."""
    low = begin
    high = end - 1
    while low < high:
        middle = (low + high) // 2
        if cdf[middle] > u:
            high = middle
        else:
            low = middle + 1
    return low


@kernel
def sample_dome_image(
    rows_cdf: F64, rows_begin: int, columns_cdf: F32, columns_begin: int, width: int, height: int, u1: float, u2: float
) -> Floats:
    """Direction in the dome's frame and its probability per solid angle.

    A texel is chosen in proportion to its weight, then a direction uniform in solid angle in it.
    """
    row = search_cdf(rows_cdf, rows_begin, rows_begin + height, u2) - rows_begin
    first = columns_begin + row * width
    column = search_cdf(columns_cdf, first, first + width, u1) - first
    return place_in_texel(rows_cdf, rows_begin, columns_cdf, columns_begin, width, height, row, column, u1, u2)


@kernel
def place_in_texel(
    rows_cdf: F64, rows_begin: int, columns_cdf: F32, columns_begin: int, width: int, height: int,
    row: int, column: int, u1: float, u2: float,
) -> Floats:  # fmt: skip
    """What `sample_dome_image` returns in the texel that it has chosen."""
    below = rows_cdf[rows_begin + row - 1] if row > 0 else 0.0
    p_row = rows_cdf[rows_begin + row] - below
    first = columns_begin + row * width
    left = columns_cdf[first + column - 1] if column > 0 else 0.0
    p_column = columns_cdf[first + column] - left
    if p_row <= 0.0 or p_column <= 0.0:
        return 0.0, 1.0, 0.0, 0.0
    fraction_y = min(max((u2 - below) / p_row, 0.0), 1.0)
    fraction_x = min(max((u1 - left) / p_column, 0.0), 1.0)
    top = math.cos(math.pi * row / height)
    bottom = math.cos(math.pi * (row + 1) / height)
    y = top + (bottom - top) * fraction_y
    longitude = 2.0 * math.pi * (0.5 - (column + fraction_x) / width)
    r = math.sqrt(max(0.0, 1.0 - y * y))
    pdf = p_row * p_column * width / (2.0 * math.pi * (top - bottom))
    return r * math.sin(longitude), y, r * math.cos(longitude), pdf


@kernel
def dome_image_pdf(
    rows_cdf: F64,
    rows_begin: int,
    columns_cdf: F32,
    columns_begin: int,
    width: int,
    height: int,
    x: float,
    y: float,
    z: float,
) -> float:
    """Probability per solid angle with which `sample_dome_image` returns a unit direction."""
    s, t = latlong_coordinates(x, y, z)
    row = min(max(int(t * height), 0), height - 1)
    column = min(max(int(s * width), 0), width - 1)
    p_row = rows_cdf[rows_begin + row] - (rows_cdf[rows_begin + row - 1] if row > 0 else 0.0)
    k = columns_begin + row * width + column
    p_column = columns_cdf[k] - (columns_cdf[k - 1] if column > 0 else 0.0)
    band = math.cos(math.pi * row / height) - math.cos(math.pi * (row + 1) / height)
    return p_row * p_column * width / (2.0 * math.pi * band)


@kernel
def dome_image_numbers(
    rows_cdf: F64, rows_begin: int, columns_cdf: F32, columns_begin: int, width: int, height: int,
    x: float, y: float, z: float,
) -> tuple[float, float]:  # fmt: skip
    """Random numbers (u1, u2) for which `sample_dome_image` returns a unit direction."""
    s, t = latlong_coordinates(x, y, z)
    row = min(max(int(t * height), 0), height - 1)
    column = min(max(int(s * width), 0), width - 1)
    below = rows_cdf[rows_begin + row - 1] if row > 0 else 0.0
    k = columns_begin + row * width + column
    left = columns_cdf[k - 1] if column > 0 else 0.0
    top = math.cos(math.pi * row / height)
    bottom = math.cos(math.pi * (row + 1) / height)
    fraction_y = min(max((top - y) / (top - bottom), 0.0), 1.0)
    fraction_x = min(max(s * width - column, 0.0), 1.0)
    return left + fraction_x * (columns_cdf[k] - left), below + fraction_y * (rows_cdf[rows_begin + row] - below)


@parallel_kernel
def dome_radiance(textures: Table, texture: int, radiance: F32, to_local: F64, directions: F32, out: F32) -> None:
    """Add one dome's radiance in world directions (any length) to `out` (n, 3)."""
    for i in prange(directions.shape[0]):
        dx = float(directions[i, 0])
        dy = float(directions[i, 1])
        dz = float(directions[i, 2])
        x = to_local[0, 0] * dx + to_local[0, 1] * dy + to_local[0, 2] * dz
        y = to_local[1, 0] * dx + to_local[1, 1] * dy + to_local[1, 2] * dz
        z = to_local[2, 0] * dx + to_local[2, 1] * dy + to_local[2, 2] * dz
        length = math.sqrt(x * x + y * y + z * z)
        if length == 0.0:
            continue
        r, g, b = 1.0, 1.0, 1.0
        if texture >= 0:
            r, g, b = dome_lookup(textures, texture, x / length, y / length, z / length)
        out[i, 0] += np.float32(r * radiance[0])
        out[i, 1] += np.float32(g * radiance[1])
        out[i, 2] += np.float32(b * radiance[2])
