"""Painted masks of instances texel by texel: what all of them weigh at a place lies next to each other."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import add_corners, load_color, scale_add, scaled, store_color, weights_of_corners
from icheat_usd.kernels.texels import corner_texels


class MaskSheets(NamedTuple):
    """Sheets of each instance, ``begin[i]:begin[i + 1]``: one for each resolution among its masks."""

    begin: NDArray[np.int64]  #: (n_instances + 1,)
    resolution: NDArray[np.int64]  #: (n_sheets,)
    first: NDArray[np.int64]  #: (n_sheets,) first float of each
    width: NDArray[np.int64]  #: (n_sheets,) floats of each texel, a multiple of 4
    texels: NDArray[np.float32]  #: of all sheets


@parallel_kernel
def add_mask(source, first, factor, column, lines, width, sheet):  # type: ignore[no-untyped-def]
    """Put a mask times a factor into a column of a sheet, and add it times `lines` to the first columns.

    Parameters
    ----------
    source : (n,) float32
        Texels of masks; those of the sheet begin at `first`.
    lines : (k,) float32
    sheet : (n_texels * width,) float32, out
    """
    for texel in prange(len(sheet) // width):
        own = source[first + texel]
        sheet[texel * width + column] = factor * own
        for c in range(len(lines)):
            sheet[texel * width + c] += lines[c] * own


@kernel
def weights_in_sheets(begin, resolution, first, widths, i, face, s, t, texels_0, out_0):  # type: ignore[no-untyped-def]
    """Columns of all sheets of instance `i` at a place of a face, to an address; how many they are.

    The arrays are those of `MaskSheets`, which it takes loops long to look into; `texels_0` is the address of its
    texels.
    """
    n = np.int64(0)
    for k in range(begin[i], begin[i + 1]):
        weights_in_sheet(resolution[k], first[k], widths[k], face, s, t, texels_0, out_0 + 4 * n)
        n += widths[k]
    return n


@kernel
def weights_in_sheet(size, first, width, face, s, t, texels_0, out_0):  # type: ignore[no-untyped-def]
    """The same of one sheet, whose floats begin at `first`."""
    one = np.float32(1.0)
    top_left, top_right, left, right, x, y = corner_texels(size, s, t)
    at = texels_0 + 4 * (first + face * size * size * width)
    a, b = at + 4 * width * top_left, at + 4 * width * top_right
    c, d = at + 4 * width * left, at + 4 * width * right
    for q in range(0, 4 * width, 16):
        # As `texels.texel_weight`, to the bit.
        top = scale_add(scaled(load_color(b + q), x), one, scaled(load_color(a + q), one - x))
        bottom = scale_add(scaled(load_color(d + q), x), one, scaled(load_color(c + q), one - x))
        store_color(out_0 + q, scale_add(scaled(bottom, y), one, scaled(top, one - y)))


@kernel
def add_weights_in_sheet(size, first, width, face, s, t, factor, texels_0, out_0):  # type: ignore[no-untyped-def]
    """Columns of one sheet times a factor, added to those at an address."""
    top_left, top_right, left, _, x, y = corner_texels(size, s, t)
    corners = scaled(weights_of_corners(x, y), factor)
    at = texels_0 + 4 * width * (face * size * size + top_left) + 4 * first
    right, below = 4 * width * (top_right - top_left), 4 * width * (left - top_left)
    for q in range(at, at + 4 * width, 16):
        to = out_0 + q - at
        store_color(
            to,
            add_corners(
                corners,
                load_color(q),
                load_color(q + right),
                load_color(q + below),
                load_color(q + below + right),
                load_color(to),
            ),
        )


@kernel
def add_texel(first, width, texel, factor, texels_0, out_0):  # type: ignore[no-untyped-def]
    """Columns of one texel of a sheet times a factor, added to those at an address."""
    at = texels_0 + 4 * (first + texel * width)
    for q in range(0, 4 * width, 16):
        store_color(out_0 + q, scale_add(load_color(at + q), factor, load_color(out_0 + q)))
