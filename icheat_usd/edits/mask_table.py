"""Selections of all rows of a stack as one table, which compiled loops look places up in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icheat_usd.edits.mask_sheets import EntrySheets
from icheat_usd.edits.masks import BoundMask
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.kernels.mask_table import MaskTable, weights_at
from icheat_usd.scene import F32, I64, SurfacePoints


def mask_table(selections: Sequence[BoundSelection], n_instances: int) -> MaskTable | None:
    """Selections by row; None if one is limited by more than instances and a painted mask.

    What is selected nowhere has no entries.
    """
    if any(selection.within for selection in selections):
        return None
    instance, row, mask, first_face, n_faces = ([np.zeros(0, np.int64)] for _ in range(5))
    weight, texels = [np.zeros(0, np.float32)], [np.zeros(0, np.float32)]
    n_texels, n_masks, resolution = [0], 0, []
    for number, selection in enumerate(selections):
        here = np.flatnonzero(selection.on_instances)
        painted = selection.mask
        if painted is not None:
            here = here[painted.first_face[here] >= 0]
            texels.append(painted.texels.reshape(-1))
            n_texels.append(painted.texels.size)
            resolution.append(painted.texels.shape[1])
        instance.append(here)
        row.append(np.full(len(here), number))
        weight.append(selection.on_instances[here])
        mask.append(np.full(len(here), -1 if painted is None else n_masks))
        first_face.append(np.zeros(len(here), np.int64) if painted is None else painted.first_face[here])
        n_faces.append(np.zeros(len(here), np.int64) if painted is None else _faces(painted)[here])
        n_masks += painted is not None
    owner = np.concatenate(instance)
    order = np.argsort(owner, kind="stable")
    return MaskTable(
        np.searchsorted(owner[order], np.arange(n_instances + 1)),
        np.concatenate(row)[order].astype(np.int32),
        np.concatenate(weight)[order].astype(np.float32),
        np.concatenate(mask)[order].astype(np.int32),
        np.concatenate(first_face)[order].astype(np.int64),
        np.concatenate(n_faces)[order].astype(np.int64),
        np.concatenate(texels),
        np.cumsum(n_texels, dtype=np.int64)[:-1],
        np.array(resolution, np.int64),
    )


def _faces(mask: BoundMask) -> I64:
    """(n_instances,) how many faces of a mask may be an instance's: all up to those of the next."""
    begins = np.append(np.unique(mask.first_face[mask.first_face >= 0]), len(mask.texels))
    return np.asarray(begins[np.searchsorted(begins, mask.first_face, side="right")] - mask.first_face)


def weights_of(table: MaskTable, sheets: EntrySheets, n_rows: int, points: SurfacePoints) -> F32:
    """Weights of points, (n, n_rows); `sheets` are those of `sheets_of_many`."""
    out = np.empty((len(points.instance), n_rows), np.float32)
    weights_at(table, *sheets, sheets.width, points.instance, points.face, points.face_uv, out)
    return out
