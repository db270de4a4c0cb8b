"""Patches of surfaces on which painted masks of a table weigh alike."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.mask_patches import MaskPatches, find_patches
from icheat_usd.kernels.mask_sheets import MaskSheets


def mask_patches(sheets: MaskSheets, least_apart: float) -> MaskPatches:
    """Patches within which the columns of sheets differ little, of all instances with sheets.

    Parameters
    ----------
    least_apart : float
        Of all columns together: between the middle of a cell and that of the first one of its patch, and between its
        corners and its middle, else it is in no patch. Two places in one are at most four times as far apart; with 0
        all of a patch is the same.
    """
    n_instances = len(sheets.begin) - 1
    # The sheets of an instance are in the order of their resolutions.
    finest = np.where(np.diff(sheets.begin) > 0, sheets.begin[1:] - 1, -1)
    size = np.diff(np.append(sheets.first, len(sheets.texels)))
    n_faces, n_cells = np.zeros(n_instances, np.int64), np.zeros(n_instances, np.int64)
    some = finest >= 0
    n_cells[some] = (size // np.maximum(sheets.width, 1))[finest[some]]
    n_faces[some] = n_cells[some] // sheets.resolution[finest[some]] ** 2
    first = np.cumsum(n_cells) - n_cells
    patch, number = np.full(int(n_cells.sum()), -1, np.int32), np.zeros(n_instances, np.int64)
    find_patches(*sheets, finest, first, n_faces, least_apart, patch, number)
    before = np.repeat(np.cumsum(number) - number, n_cells)
    return MaskPatches(int(number.sum()), first, np.where(patch < 0, patch, patch + before).astype(np.int32))
