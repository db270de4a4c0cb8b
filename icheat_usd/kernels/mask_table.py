"""Weights of selections that are instances times painted masks, of all rows of a stack at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.texels import corner_texels, texel_weight


class MaskTable(NamedTuple):
    """Rows that select each instance, ``begin[i]:begin[i + 1]`` of the entries, in ascending order."""

    begin: NDArray[np.int64]  #: (n_instances + 1,)
    row: NDArray[np.int32]  #: (n_entries,)
    weight: NDArray[np.float32]  #: (n_entries,) all over the instance
    mask: NDArray[np.int32]  #: (n_entries,) painted mask that multiplies it, -1 for none
    first_face: NDArray[np.int64]  #: (n_entries,) first face of the instance in the mask
    texels: NDArray[np.float32]  #: of all masks
    texel_begin: NDArray[np.int64]  #: (n_masks,)
    resolution: NDArray[np.int64]  #: (n_masks,)


@parallel_kernel
def weights_at(table, instance, face, face_uv, out):  # type: ignore[no-untyped-def]
    """Weights of all rows at n places.

    Parameters
    ----------
    instance, face : (n,) int32
        Instance -1: no surface.
    face_uv : (n, 2) float32
    out : (n, n_rows) float32, out, zero before
    """
    for p in prange(len(instance)):
        _weights_of_place(p, table, instance, face, face_uv, out)


@kernel
def _weights_of_place(p, table, instance, face, face_uv, out):  # type: ignore[no-untyped-def]
    i = instance[p]
    if i < 0:
        return
    mask, weight, texels, resolution = table.mask, table.weight, table.texels, table.resolution
    row, first_face, texel_begin = table.row, table.first_face, table.texel_begin
    own_face, s, t = np.int64(face[p]), face_uv[p, 0], face_uv[p, 1]
    last, corners = np.int64(1), corner_texels(np.int64(1), s, t)
    for e in range(table.begin[i], table.begin[i + 1]):
        own = weight[e]
        if mask[e] >= 0:
            size = resolution[mask[e]]
            if size != last:
                last, corners = size, corner_texels(size, s, t)
            own *= texel_weight(texels, texel_begin[mask[e]] + (first_face[e] + own_face) * size * size, corners)
        out[p, row[e]] = own
