"""Versions: edited copies of the casters' radiance, kept as differences.

A version is a signed sum, over sets of edits, of what the casters send under
each set. Its work is cut into pieces of casters, so that one large version
still uses all cores; every piece owns its output.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

CONSTANT, HSV, AGGREGATE = 0, 1, 2  #: kinds of rows of the stack
COMPOSE, OVER, ADD = 0, 1, 2  #: blends

_EPSILON = 1e-4  # as `edits.operations.division`: of the largest channel
_MAX_RATIO = 64.0


@kernel
def adjust_hsv(color, numbers, scale, emission):  # type: ignore[no-untyped-def]
    """Scale and emission that turn hue, saturation and value of one colour; see `operations.hsv`."""
    r, g, b = max(color[0], 0.0), max(color[1], 0.0), max(color[2], 0.0)
    v = max(r, g, b)
    chroma = v - min(r, g, b)
    sector = 0.0
    if chroma > 0:
        if v == r:
            sector = (g - b) / chroma
        elif v == g:
            sector = (b - r) / chroma + 2.0
        else:
            sector = (r - g) / chroma + 4.0
    sector += numbers[0] / 60.0
    saturation = chroma / v if v > 0 else 0.0
    new_v = v * numbers[2]
    new_chroma = min(saturation * numbers[1], 1.0) * new_v
    for c in range(3):
        k = np.mod(sector + 5.0 - 2.0 * c, 6.0)
        wanted = new_v - new_chroma * min(max(min(k, 4.0 - k), 0.0), 1.0)
        given = max(color[c], 0.0)
        ratio = 1.0
        if given > _EPSILON * v:
            ratio = min(wanted, _MAX_RATIO * given) / given
        scale[c] = ratio
        emission[c] = wanted - ratio * given


@kernel
def compose(  # type: ignore[no-untyped-def]
    member, first, end, entry_row, entry_weight, entry_slot, slots, row_table, row_amount, groups, b, cell, out
):
    """Compose the edits of one set at one caster into `out` (G, 4, 3): scale, [0] emission, diffuse and paint offset.

    Entries `first` to `end` are the caster's rows, weakest first. `row_table`
    (n_rows, 5) holds edit, kind, blend, whether the offset is paint, and the
    row that stands for an aggregate's emission.
    """
    n_groups = len(b)
    delta, added, offset = np.empty(3), np.empty(3), np.empty(3)
    scale, emission, seen = np.empty(3), np.empty(3), np.empty(3)
    for g in range(n_groups):
        for c in range(3):
            out[g, 0, c] = 1.0
            out[g, 1, c] = 0.0
            out[g, 2, c] = 0.0
            out[g, 3, c] = 0.0
    entry = first
    while entry < end:
        edit = row_table[entry_row[entry], 0]
        blend = row_table[entry_row[entry], 2]
        paint = row_table[entry_row[entry], 3]
        whole = True
        for g in range(n_groups):
            whole = whole and groups[edit, g] != 0
        delta[:] = 0.0
        added[:] = 0.0
        offset[:] = 0.0
        kept = 0.0
        acts = False
        looked = False
        while entry < end and row_table[entry_row[entry], 0] == edit:
            row = entry_row[entry]
            kind = row_table[row, 1]
            weight = np.float64(entry_weight[entry])
            slot = entry_slot[entry]
            entry += 1
            if weight == 0.0:
                continue
            if kind == AGGREGATE:
                if member[row] != 0:
                    acts = True
                    for c in range(3):
                        delta[c] += weight
                if member[row_table[row, 4]] != 0:
                    acts = True
                    for c in range(3):
                        added[c] += weight
                continue
            if member[row] == 0:
                continue
            weight *= row_amount[row]
            if weight == 0.0:
                continue
            acts = True
            kept += weight
            if kind == HSV:
                if not looked:
                    looked = True
                    for c in range(3):
                        seen[c] = out[0, 1, c] if whole and blend == COMPOSE else 0.0
                        for g in range(n_groups):
                            if groups[edit, g] != 0:
                                seen[c] += (out[g, 0, c] if blend == COMPOSE else 1.0) * b[g, cell, c]
                adjust_hsv(seen, slots[slot], scale, emission)
                for c in range(3):
                    delta[c] += weight * (scale[c] - 1.0)
                    added[c] += weight * emission[c]
            else:
                for c in range(3):
                    delta[c] += weight * (slots[slot, c] - 1.0)
                    added[c] += weight * slots[slot, 3 + c]
                    offset[c] += weight * slots[slot, 6 + c]
        if not acts:
            continue
        for c in range(3):
            carried, plus = 1.0, 0.0
            if blend == COMPOSE:
                carried = 1.0 + delta[c]
            elif blend == OVER:
                carried = 1.0 - kept
                plus = kept + delta[c]
            else:
                plus = delta[c]
            for g in range(n_groups):
                if groups[edit, g] == 0:
                    continue
                out[g, 0, c] = carried * out[g, 0, c] + plus
                out[g, 2, c] *= carried
                out[g, 3, c] *= carried
                if paint != 0:
                    out[g, 3, c] += offset[c]
                else:
                    out[g, 2, c] += offset[c]
            out[0, 1, c] = (carried if whole else 1.0) * out[0, 1, c] + added[c]


@kernel
def _piece_deltas(  # type: ignore[no-untyped-def]
    piece,
    row_changed,
    version_sets,
    set_sign,
    sets,
    version_restrict,
    run_of,
    looks,
    cell_begin,
    entry_row,
    entry_weight,
    entry_slot,
    slots,
    row_table,
    row_amount,
    groups,
    b,
    area,
    cells,
    deltas,
    total,
):
    """One piece of `version_deltas`."""
    version = piece[0]
    restrict = version_restrict[version, 0]
    unedited = version_restrict[version, 1]
    reach = version_restrict[version, 2]
    # Offsets are sums over all cells, those too that none of the rows acts on.
    all_cells = row_changed[0] != 0 or version_restrict[version, 3] != 0
    n_groups = len(b)
    found = np.empty((n_groups, 4, 3))
    total_found = np.zeros((n_groups, 4, 3))
    known = -1
    edit = row_table[restrict, 0] if restrict >= 0 else 0
    whole = True
    for g in range(n_groups):
        whole = whole and (restrict < 0 or groups[edit, g] != 0)
    total[:] = 0.0
    # Without offsets and weights of one row's casters, neighbours under the same rows differ in their light alone.
    is_plain = reach == 0 and restrict < 0 and n_groups == 1 and version_restrict[version, 3] == 0
    k = piece[1]
    while k < piece[2]:
        cell = cells[k]
        first, end = cell_begin[cell], cell_begin[cell + 1]
        if not all_cells and not _concerned(row_changed, entry_row, first, end):
            k += 1
            continue
        share = 1.0
        if restrict >= 0:
            share = 0.0
            for entry in range(first, end):
                if entry_row[entry] == restrict:
                    share = np.float64(entry_weight[entry])
        if reach != 0:
            for c in range(3):
                deltas[k, c] = share
            k += 1
            continue
        if run_of[cell] != known or looks[cell] != 0:
            known = run_of[cell]
            total_found[:] = 0.0
            for s in range(version_sets[version], version_sets[version + 1]):
                compose(
                    sets[s],
                    first,
                    end,
                    entry_row,
                    entry_weight,
                    entry_slot,
                    slots,
                    row_table,
                    row_amount,
                    groups,
                    b,
                    cell,
                    found,
                )
                for g in range(n_groups):
                    for c in range(3):
                        scale = found[g, 0, c] - 1.0 if unedited != 0 else found[g, 0, c]
                        total_found[g, 0, c] += set_sign[s] * scale
                        for kind in range(1, 4):
                            total_found[g, kind, c] += set_sign[s] * found[g, kind, c]
        if is_plain and looks[cell] == 0:
            k = _scale_run(k, piece[2], cells, run_of, b[0], total_found[0], deltas)
            continue
        for c in range(3):
            light = total_found[0, 1, c] if whole else 0.0
            for g in range(n_groups):
                if restrict >= 0 and groups[edit, g] == 0:
                    continue
                light += total_found[g, 0, c] * b[g, cell, c]
                radiance = share * area[cell] * b[g, cell, c]
                total[c] += total_found[g, 2, c] * radiance
                total[3 + c] += total_found[g, 3, c] * radiance
            deltas[k, c] = share * light
        k += 1


@kernel
def _scale_run(k, end, cells, run_of, b, found, deltas):  # type: ignore[no-untyped-def]
    """Differences at the cells from `k` on that belong to one run, and where it ends."""
    r0, r1, r2 = found[0, 0], found[0, 1], found[0, 2]
    e0, e1, e2 = found[1, 0], found[1, 1], found[1, 2]
    run = run_of[cells[k]]
    while k < end and run_of[cells[k]] == run:
        cell = cells[k]
        deltas[k, 0] = e0 + r0 * b[cell, 0]
        deltas[k, 1] = e1 + r1 * b[cell, 1]
        deltas[k, 2] = e2 + r2 * b[cell, 2]
        k += 1
    return k


@kernel
def _concerned(row_changed, entry_row, first, end):  # type: ignore[no-untyped-def]
    for entry in range(first, end):
        if row_changed[1 + entry_row[entry]] != 0:
            return True
    return False


@kernel
def find_runs(cell_begin, entry_row, entry_weight, entry_slot, row_table, run_of, looks):  # type: ignore[no-untyped-def]
    """Number runs of cells that the same rows act on alike; mark cells that a row acts on which looks at light."""
    run = 0
    for cell in range(len(run_of)):
        first, end = cell_begin[cell], cell_begin[cell + 1]
        same = cell > 0 and first - cell_begin[cell - 1] == end - first
        looks[cell] = 0
        for k in range(first, end):
            if row_table[entry_row[k], 1] == HSV:
                looks[cell] = 1
            if same:
                other = k - (end - first)
                same = (
                    entry_row[k] == entry_row[other]
                    and entry_weight[k] == entry_weight[other]
                    and entry_slot[k] == entry_slot[other]
                )
        if not same:
            run += 1
        run_of[cell] = run


@parallel_kernel
def version_deltas(  # type: ignore[no-untyped-def]
    pieces,
    row_changed,
    version_sets,
    set_sign,
    sets,
    version_restrict,
    run_of,
    looks,
    cell_begin,
    entry_row,
    entry_weight,
    entry_slot,
    slots,
    row_table,
    row_amount,
    groups,
    b,
    area,
    cells,
    deltas,
    offsets,
):
    """Differences that versions make, at their cells, and sums of their offsets by piece.

    Parameters
    ----------
    pieces : (n, 3) int64, version and range of `cells`
    row_changed : (1 + n_rows,) uint8
        Cells that none of the marked rows acts on keep what they have; all are evaluated if the first is set, or
        the version has offsets.
    version_sets : (n_versions + 1,) ranges of `set_sign` and `sets`
    sets : (n_sets, n_members) uint8, rows of the stack that act
    version_restrict : (n_versions, 4) int64
        Row whose casters and lights alone count, or -1; 1 to subtract the unedited light; 1 for the casters'
        weights instead of light; 1 if some row may give an offset.
    run_of, looks : (n_gather,)
        Cells of one number that follow each other are acted on alike, unless an edit looks at their light.
    cells, deltas : (n_cells,), (n_cells, 3)
    offsets : (n, 6) float64
    """
    for p in prange(len(pieces)):
        _piece_deltas(
            pieces[p],
            row_changed,
            version_sets,
            set_sign,
            sets,
            version_restrict,
            run_of,
            looks,
            cell_begin,
            entry_row,
            entry_weight,
            entry_slot,
            slots,
            row_table,
            row_amount,
            groups,
            b,
            area,
            cells,
            deltas,
            offsets[p],
        )
