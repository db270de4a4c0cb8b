"""Painted masks of a table as sheets, in which compiled loops find the weights of all masks at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.kernels.mask_sheets import MaskSheets, add_mask
from icheat_usd.kernels.mask_table import MaskTable
from icheat_usd.scene import F32, I64, Bool

#: Painted masks on one instance, from which on it is faster to find all of them at once.
_MANY = 4


class EntrySheets(NamedTuple):
    """Sheets of some instances of a table."""

    sheets: MaskSheets
    column: I64  #: (n_entries,) of each entry of the table among those of its instance, -1 for none

    @property
    def width(self) -> int:
        """Most columns of any instance."""
        columns = np.concatenate([[0], np.cumsum(self.sheets.width)])[self.sheets.begin]
        return int(np.diff(columns).max(initial=0))


def sheets_of_many(table: MaskTable) -> EntrySheets:
    """Sheets of instances with many painted masks, with what the masks hold."""
    before = np.concatenate([[0], np.cumsum(table.mask >= 0)])
    number = np.diff(before[table.begin])
    return mask_sheets(
        table, number >= _MANY, np.ones(len(table.row), np.float32), np.zeros((len(table.row), 0), np.float32)
    )


def mask_sheets(table: MaskTable, on_instances: Bool, scale: F32, lines: F32) -> EntrySheets:
    """Sheets of some instances.

    Parameters
    ----------
    on_instances : (n_instances,)
        Those that get sheets.
    scale : (n_entries,)
        What masks are multiplied by.
    lines : (n_entries, k)
        Every sheet begins with k columns, a multiple of 4, of the sum of masks times these.
    """
    n_lines = lines.shape[1]
    column = np.full(len(table.row), -1, np.int64)
    begin, n_sheets = np.zeros(len(on_instances) + 1, np.int64), 0
    resolution, width, sheets = [], [], [np.zeros(0, np.float32)]
    for i, is_wanted in enumerate(on_instances.tolist()):
        entries = np.arange(table.begin[i], table.begin[i + 1]) if is_wanted else np.zeros(0, np.int64)
        entries = entries[table.mask[entries] >= 0]
        sizes = table.resolution[table.mask[entries]]
        n_columns = 0
        for size in np.unique(sizes).tolist():
            some = entries[sizes == size]
            wide = -(-len(some) // 4) * 4 + n_lines
            # Of one instance all masks have the same faces, where they may seem to have more.
            sheet = np.zeros(int(table.n_faces[some].min()) * size * size * wide, np.float32)
            for k, e in enumerate(some.tolist()):
                first = table.texel_begin[table.mask[e]] + table.first_face[e] * size * size
                add_mask(table.texels, first, scale[e], n_lines + k, lines[e], wide, sheet)
            column[some] = n_columns + n_lines + np.arange(len(some))
            resolution.append(size)
            width.append(wide)
            sheets.append(sheet)
            n_columns += wide
            n_sheets += 1
        begin[i + 1] = n_sheets
    first = np.cumsum([0, *(sheet.size for sheet in sheets[1:])], dtype=np.int64)[:-1]
    found = MaskSheets(begin, np.array(resolution, np.int64), first, np.array(width, np.int64), np.concatenate(sheets))
    return EntrySheets(found, column)
