"""Rays to a dome with an image, 16 side by side: its tables are large, and most of what a ray needs is not in a cache.

In steps over the rays: what one loads next is on its way to the cache while the others take the same step.
"""

from __future__ import annotations

import math

import numpy as np

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.environment import image_bilinear, latlong_coordinates, place_in_texel
from icheat_usd.kernels.fetch import fetch
from icheat_usd.kernels.guide import warp
from icheat_usd.kernels.light_geometry import FAR, direction_scale, linear_map, normalized
from icheat_usd.kernels.vector import dot, row3

DISTANCE, PDF, RADIANCE = 3, 4, 5  #: columns of a ray, which begins with its direction and has three of radiance
_ROW, _COLUMN = 0, 1  # of the whole numbers that are kept between steps
_S, _T, _FACTOR = 8, 9, 10  # and of the others, beside a ray


@kernel
def make_dome_rays():  # type: ignore[no-untyped-def]
    """Room for `dome_rays`: rays, and whole numbers."""
    return np.zeros((16, 11), np.float64), np.empty((2, 16), np.int64)


@kernel
def guided_dome_rays(  # type: ignore[no-untyped-def]
    n, point, guided, number, normal, shading_normal, m, determinant, image, texels, rows_cdf, columns_cdf, bands,
    columns, ray, texel,
):  # fmt: skip
    """Rays of `light_rays.find_rays` to a dome with an image.

    Parameters
    ----------
    n : int
        At most 16.
    point, guided : (16,) int64
        Where rays start, and the rows of the guide, -1 for none.
    number : (16, 2) float64
        Random numbers, which become those of the dome's own sampler.
    normal, shading_normal : (n_points, 3) float32
    others
        As of `dome_rays`, and the guide's columns.
    """
    for k in range(n):
        ray[k, _FACTOR] = 1.0
        if guided[k] >= 0:
            v1, v2, ray[k, _FACTOR] = warp(bands, columns, guided[k], number[k, 0], number[k, 1])
            number[k, 0], number[k, 1] = v1, v2
        number[k, 0] = min(number[k, 0], 1.0)
    dome_rays(n, number, m, determinant, image, texels, rows_cdf, columns_cdf, ray, texel)
    for k in range(n):
        ray[k, PDF] *= ray[k, _FACTOR]
        above, about = row3(normal, point[k]), row3(shading_normal, point[k])
        towards = (ray[k, 0], ray[k, 1], ray[k, 2])
        if dot(about, towards) <= 0.0 or dot(above, towards) <= 0.0:
            ray[k, PDF] = 0.0


@kernel
def dome_rays(n, number, m, determinant, image, texels, rows_cdf, columns_cdf, ray, texel):  # type: ignore[no-untyped-def]
    """Rays of `lights.sample_shape` to a dome with an image, for n <= 16 pairs of random numbers.

    Parameters
    ----------
    number : (16, 2) float64
    m, determinant, image
        Of `lights.light_shape`.
    ray, texel
        Of `make_dome_rays`. The density is 0 where the dome does not shine.
    """
    begin, width, height, rows_begin, columns_begin = image
    for k in range(n):
        texel[_ROW, k] = rows_begin
    _search(n, rows_cdf, number[:, 1], texel[_ROW], height)
    for k in range(n):
        texel[_ROW, k] -= rows_begin
        texel[_COLUMN, k] = columns_begin + texel[_ROW, k] * width
    _search(n, columns_cdf, number[:, 0], texel[_COLUMN], width)
    for k in range(n):
        row = texel[_ROW, k]
        column = texel[_COLUMN, k] - columns_begin - row * width
        x, y, z, pdf = place_in_texel(
            rows_cdf, rows_begin, columns_cdf, columns_begin, width, height, row, column, number[k, 0], number[k, 1]
        )
        ray[k, PDF] = pdf
        if pdf <= 0.0 or determinant == 0.0:
            ray[k, PDF] = 0.0
            continue
        s, t = latlong_coordinates(x, y, z)
        ray[k, 0], ray[k, 1], ray[k, 2], ray[k, _S], ray[k, _T] = x, y, z, s, t
        # The rows around, of which the one above may be that below, at the left one of two columns.
        left = max(0, int(math.floor(s * width - 0.5)))
        above = max(0, int(math.floor(t * height - 0.5)))
        fetch(texels, begin + above * width + left)
        fetch(texels, begin + min(above + 1, height - 1) * width + left)
    for k in range(n):
        if ray[k, PDF] == 0.0:
            continue
        x, y, z = ray[k, 0], ray[k, 1], ray[k, 2]
        red, green, blue = image_bilinear(texels, begin, width, height, ray[k, _S], ray[k, _T], True)
        ray[k, PDF] *= direction_scale(m, determinant, x, y, z)
        wx, wy, wz = linear_map(m, x, y, z)
        ray[k, 0], ray[k, 1], ray[k, 2] = normalized(wx, wy, wz)
        ray[k, DISTANCE] = FAR
        ray[k, RADIANCE], ray[k, RADIANCE + 1], ray[k, RADIANCE + 2] = red, green, blue


@kernel
def _search(n, cdf, number, found, length):  # type: ignore[no-untyped-def]
    """`environment.search_cdf` of n numbers, each in a row of so many entries that begins at `found`."""
    left = length
    while left > 1:
        half = left // 2
        for k in range(n):
            found[k] += 0 if cdf[found[k] + half - 1] > number[k] else half
        left -= half
