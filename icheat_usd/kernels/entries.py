"""Rows of a stack turned round: for every cell the rows that act on it."""

from __future__ import annotations

from icheat_usd.kernels._jit import kernel


@kernel
def entries_by_cell(cells, row_begin, weights, slot_begin, own_slots, begin, row, weight, slot):  # type: ignore[no-untyped-def]
    """Entries of each cell, in the order of rows.

    Parameters
    ----------
    cells, weights : (n,) one row after the other
    row_begin : (n_rows + 1,) ranges of these
    slot_begin : (n_rows,) first slot of each row
    own_slots : (n_rows,) uint8
        Whether each of a row's cells has a slot of its own; they have the first one else.
    begin : (n_cells + 1,) ranges of what follows, written
    row, weight, slot : (n,) written
    """
    begin[:] = 0
    for cell in cells:
        begin[cell + 1] += 1
    for cell in range(len(begin) - 1):
        begin[cell + 1] += begin[cell]
    for r in range(len(row_begin) - 1):
        for k in range(row_begin[r], row_begin[r + 1]):
            place = begin[cells[k]]
            begin[cells[k]] += 1
            row[place] = r
            weight[place] = weights[k]
            slot[place] = slot_begin[r] + (k - row_begin[r] if own_slots[r] else 0)
    # Each begin is where the next cell's was.
    for cell in range(len(begin) - 1, 0, -1):
        begin[cell] = begin[cell - 1]
    begin[0] = 0
