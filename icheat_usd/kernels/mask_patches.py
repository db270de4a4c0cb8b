"""Patches of surfaces on which painted masks weigh alike."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.mask_sheets import weights_in_sheet
from icheat_usd.kernels.simd import address_of, black, color_add, difference, load_color, scale_add, store_color

#: Of the patches of an instance, the last few are compared with its next cell: it is often in one of these.
_MOST_LOOKED_AT = 16


class MaskPatches(NamedTuple):
    """Patch of every cell of the instances' faces: of what lies between four texels of the finest sheet of each."""

    number: int  #: how many there are
    first: NDArray[np.int64]  #: (n_instances,) first cell; they are numbered as the texel that they begin at
    patch: NDArray[np.int32]  #: (n_cells,) -1 where masks vary too much within a cell


@parallel_kernel
def find_patches(  # type: ignore[no-untyped-def]
    begin, resolution, first, widths, texels, finest, first_cell, n_faces, least_apart, patch, number
):
    """Cells taken together whose middles are within a distance of that of the first one.

    Parameters
    ----------
    begin, resolution, first, widths, texels : as of `MaskSheets`
        Their columns are the axes of the space that distances are measured in.
    finest : (n_instances,) int64
        Sheet of the highest resolution, -1 for none.
    first_cell : (n_instances,) int64, as of `MaskPatches`
    n_faces : (n_instances,) int64
    least_apart : float
    patch : (n_cells,) int32, out
        Numbered from 0 on in each instance.
    number : (n_instances,) int64, out
        Patches of each instance.
    """
    for i in prange(len(finest)):
        number[i] = 0
        if finest[i] >= 0:
            number[i] = _patches_of(
                np.int64(i),
                begin,
                resolution,
                first,
                widths,
                texels,
                resolution[finest[i]],
                first_cell[i],
                n_faces[i],
                np.float32(least_apart * least_apart),
                patch,
            )


@kernel
def _patches_of(i, begin, resolution, first, widths, texels, size, first_cell, n_faces, apart, patch):  # type: ignore[no-untyped-def]
    width = np.int64(0)
    for k in range(begin[i], begin[i + 1]):
        width += widths[k]
    corners, middle = np.empty((size * size, width), np.float32), np.empty(width, np.float32)
    like, scratch = np.empty((_MOST_LOOKED_AT, width), np.float32), np.empty(4, np.float32)
    corners_0, middle_0, like_0 = address_of(corners), address_of(middle), address_of(like)
    texels_0, scratch_0 = address_of(texels), address_of(scratch)
    quarter = np.float32(0.25)
    step, n_cells = 4 * width, max(size - 1, 1)
    right, below = step * min(size - 1, 1), step * size * min(size - 1, 1)
    n = 0
    for face in range(n_faces):
        for texel in range(size * size):
            s = np.float32((texel % size + 0.5) / size)
            t = np.float32((texel // size + 0.5) / size)
            column = np.int64(0)
            for k in range(begin[i], begin[i + 1]):
                to = corners_0 + step * texel + 4 * column
                if resolution[k] == size:
                    at = texels_0 + 4 * (first[k] + (face * size * size + texel) * widths[k])
                    for q in range(0, 4 * widths[k], 16):
                        store_color(to + q, load_color(at + q))
                else:
                    weights_in_sheet(resolution[k], first[k], widths[k], face, s, t, texels_0, to)
                column += widths[k]
        for y in range(n_cells):
            for x in range(n_cells):
                own = corners_0 + step * (y * size + x)
                for q in range(0, step, 16):
                    total = scale_add(load_color(own + q), quarter, black())
                    total = scale_add(load_color(own + right + q), quarter, total)
                    total = scale_add(load_color(own + below + q), quarter, total)
                    store_color(middle_0 + q, scale_add(load_color(own + below + right + q), quarter, total))
                found = -1
                if _is_even(own, right, below, middle_0, width, scratch_0, scratch, apart):
                    back = 1
                    while found < 0 and back <= min(n, _MOST_LOOKED_AT):
                        at = like_0 + step * ((n - back) % _MOST_LOOKED_AT)
                        if _apart(middle_0, at, width, scratch_0, scratch) <= apart:
                            found = n - back
                        back += 1
                    if found < 0:
                        like[n % _MOST_LOOKED_AT] = middle
                        found = n
                        n += 1
                patch[first_cell + face * size * size + y * size + x] = found
    corners[0, 0] = np.float32(0.0)  # keeps it: Numba may free an array after its last mention
    return n


@kernel
def _is_even(own, right, below, other, n, scratch_0, scratch, apart):  # type: ignore[no-untyped-def]
    """Whether the four corners of a cell at an address are all within reach of its middle."""
    return (
        _apart(own, other, n, scratch_0, scratch) <= apart
        and _apart(own + below + right, other, n, scratch_0, scratch) <= apart
        and _apart(own + right, other, n, scratch_0, scratch) <= apart
        and _apart(own + below, other, n, scratch_0, scratch) <= apart
    )


@kernel
def _apart(a_0, b_0, n, sum_0, sums):  # type: ignore[no-untyped-def]
    """Square of the distance between `n` floats at two addresses; `sums` (4,) at `sum_0` is scratch."""
    total = black()
    for q in range(0, 4 * n, 16):
        step = difference(load_color(a_0 + q), load_color(b_0 + q))
        total = color_add(step, step, total)
    store_color(sum_0, total)
    return (sums[0] + sums[1]) + (sums[2] + sums[3])
