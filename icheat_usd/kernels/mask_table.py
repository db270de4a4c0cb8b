"""Weights of selections that are instances times painted masks, of all rows of a stack at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.mask_sheets import weights_in_sheets
from icheat_usd.kernels.simd import address_of
from icheat_usd.kernels.texels import corner_texels, texel_weight

_CHUNK = 256  # places


class MaskTable(NamedTuple):
    """Rows that select each instance, ``begin[i]:begin[i + 1]`` of the entries, in ascending order."""

    begin: NDArray[np.int64]  #: (n_instances + 1,)
    row: NDArray[np.int32]  #: (n_entries,)
    weight: NDArray[np.float32]  #: (n_entries,) all over the instance
    mask: NDArray[np.int32]  #: (n_entries,) painted mask that multiplies it, -1 for none
    first_face: NDArray[np.int64]  #: (n_entries,) first face of the instance in the mask
    n_faces: NDArray[np.int64]  #: (n_entries,) faces from there on that are no other instance's
    texels: NDArray[np.float32]  #: of all masks
    texel_begin: NDArray[np.int64]  #: (n_masks,)
    resolution: NDArray[np.int64]  #: (n_masks,)


@parallel_kernel
def any_positive(weights, out):  # type: ignore[no-untyped-def]
    """Whether any of the weights (n, n_rows) of each place is above 0, (n,) uint8, out."""
    for chunk in prange((len(weights) + _CHUNK - 1) // _CHUNK):
        _any_of_some(chunk * _CHUNK, weights, out)


@kernel
def _any_of_some(begin, weights, out):  # type: ignore[no-untyped-def]
    for p in range(begin, min(begin + _CHUNK, len(weights))):
        found = False
        for row in range(weights.shape[1]):
            found |= weights[p, row] > np.float32(0.0)
        out[p] = found


@parallel_kernel
def weights_at(table, sheets, column, width, instance, face, face_uv, out):  # type: ignore[no-untyped-def]
    """Weights of all rows at n places.

    Parameters
    ----------
    sheets : MaskSheets
        Of the instances with many masks, or of none.
    column : (n_entries,) int64
        Of each entry of the table in these, -1 where it is not painted.
    width : int
        Most columns of any instance.
    instance, face : (n,) int32
        Instance -1: no surface.
    face_uv : (n, 2) float32
    out : (n, n_rows) float32, out
    """
    for chunk in prange((len(instance) + _CHUNK - 1) // _CHUNK):
        _weights_of_places(chunk * _CHUNK, table, sheets, column, width, instance, face, face_uv, out)


@kernel
def _weights_of_places(first, table, sheets, column, width, instance, face, face_uv, out):  # type: ignore[no-untyped-def]
    begin, mask, weight, texels, resolution = table.begin, table.mask, table.weight, table.texels, table.resolution
    row, first_face, texel_begin = table.row, table.first_face, table.texel_begin
    here = np.empty(width + 4, np.float32)
    here_0, texels_0, sheet_begin = address_of(here), address_of(sheets.texels), sheets.begin
    sizes, sheet_first, sheet_width = sheets.resolution, sheets.first, sheets.width
    for p in range(first, min(first + _CHUNK, len(instance))):
        i = np.int64(instance[p])
        out[p] = np.float32(0.0)
        if i < 0:
            continue
        own_face, s, t = np.int64(face[p]), face_uv[p, 0], face_uv[p, 1]
        if sheet_begin[i] < sheet_begin[i + 1]:
            weights_in_sheets(sheet_begin, sizes, sheet_first, sheet_width, i, own_face, s, t, texels_0, here_0)
            for e in range(begin[i], begin[i + 1]):
                out[p, row[e]] = weight[e] * here[column[e]] if column[e] >= 0 else weight[e]
            continue
        last, corners = np.int64(1), corner_texels(np.int64(1), s, t)
        for e in range(begin[i], begin[i + 1]):
            own = weight[e]
            if mask[e] >= 0:
                size = resolution[mask[e]]
                if size != last:
                    last, corners = size, corner_texels(size, s, t)
                own *= texel_weight(texels, texel_begin[mask[e]] + (first_face[e] + own_face) * size * size, corners)
            out[p, row[e]] = own
