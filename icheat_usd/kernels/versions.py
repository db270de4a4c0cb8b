"""Versions: edited copies of the casters' radiance, kept as differences, and what receivers make of them.

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


@kernel
def _haar_of_one(deltas, nodes, child, share, root, out):  # type: ignore[no-untyped-def]
    mean = np.empty((len(nodes), 3))
    for k in range(len(nodes)):
        node = nodes[k]
        for c in range(3):
            left, right = 0.0, 0.0
            place = child[k, 0]
            if place >= 0:
                left = mean[place >> 1, c] if place & 1 else np.float64(deltas[place >> 1, c])
            place = child[k, 1]
            if place >= 0:
                right = mean[place >> 1, c] if place & 1 else np.float64(deltas[place >> 1, c])
            mean[k, c] = share[node, 0] * left + share[node, 1] * right
            out[1 + node, c] = (left - right) * share[node, 2]
    for c in range(3):
        if len(nodes) > 0:
            out[0, c] = mean[len(nodes) - 1, c] * root
        elif len(deltas) > 0 and len(share) == 0:
            out[0, c] = np.float64(deltas[0, c]) * root


@parallel_kernel
def haar_of_cells(versions, version_cells, deltas, version_nodes, nodes, child, share, root, out):  # type: ignore[no-untyped-def]
    """Haar coefficients of values that are 0 but at some cells.

    Parameters
    ----------
    versions : (n,) to transform
    version_nodes : (n_versions + 1,) ranges of `nodes`, of each version children before parents
    child : (n_nodes, 2) int32
        Place of each child: -1 where all below is 0, an even number 2 k for the version's k-th cell, 2 k + 1 for its
        k-th node.
    share : (n_tree_nodes, 3) float64
        Weights of the left and the right mean in the node's, and the factor on their difference.
    root : square root of the total weight
    out : (n_slots, n_leaves, 4) float32
    """
    for index in prange(len(versions)):
        version = versions[index]
        cell, first = version_cells[version], version_nodes[version]
        _haar_of_one(
            deltas[cell : version_cells[version + 1]],
            nodes[first : version_nodes[version + 1]],
            child[first : version_nodes[version + 1]],
            share,
            root,
            out[version],
        )


@kernel
def _fill_one(cells, deltas, out):  # type: ignore[no-untyped-def]
    out[:] = np.float32(0)
    for k in range(len(cells)):
        for c in range(3):
            out[cells[k], c] = deltas[k, c]


@parallel_kernel
def fill_versions(versions, version_cells, cells, deltas, out):  # type: ignore[no-untyped-def]
    """Values of versions, one after the other, into `out` (n, n_leaves, 3), 0 but at their cells."""
    for index in prange(len(versions)):
        first, end = version_cells[versions[index]], version_cells[versions[index] + 1]
        _fill_one(cells[first:end], deltas[first:end], out[index])


@parallel_kernel
def spread_cells(versions, version_cells, cells, deltas, out):  # type: ignore[no-untyped-def]
    """Values of versions at their cells into `out` (n_slots, n_leaves, 4)."""
    for index in prange(len(versions)):
        version = versions[index]
        for k in range(version_cells[version], version_cells[version + 1]):
            for c in range(3):
                out[version, cells[k], c] = deltas[k, c]


@kernel
def nodes_above(cells, parent_of_leaf, parent, left, right, count, nodes, child):  # type: ignore[no-untyped-def]
    """Nodes above some cells, children first; how many goes to ``count[0]``, and if `nodes` is empty that is all.

    Nodes are in pre-order, so that descending numbers meet children before parents. See `haar_of_cells`.
    """
    n_nodes = len(parent)
    place = np.full(n_nodes, -1, np.int32)
    count[0] = 0
    for cell in cells:
        node = parent_of_leaf[cell]
        while node >= 0 and place[node] < 0:
            place[node] = 0
            count[0] += 1
            node = parent[node]
    if len(nodes) == 0:
        return
    of_leaf = np.full(len(parent_of_leaf), -1, np.int32)
    for k in range(len(cells)):
        of_leaf[cells[k]] = k
    k = 0
    for step in range(n_nodes):
        node = n_nodes - 1 - step
        if place[node] < 0:
            continue
        place[node] = k
        nodes[k] = node
        for side in range(2):
            below = left[node] if side == 0 else right[node]
            if below < 0:
                leaf = of_leaf[-1 - below]
                child[k, side] = 2 * leaf if leaf >= 0 else -1
            else:
                child[k, side] = 2 * place[below] + 1 if place[below] >= 0 else -1
        k += 1


@kernel
def _multiply_pair(first, end, index, scale, value, coefficients, out):  # type: ignore[no-untyped-def]
    sums = np.zeros((3, 64), np.float32)
    for entry in range(first, end):
        color = coefficients[index[entry]]
        r, g, b = color[0], color[1], color[2]
        if r == 0 and g == 0 and b == 0:
            continue
        r *= scale[entry]
        g *= scale[entry]
        b *= scale[entry]
        for lane in range(64):
            weight = np.float32(value[entry, lane])
            sums[0, lane] += weight * r
            sums[1, lane] += weight * g
            sums[2, lane] += weight * b
    for lane in range(64):
        for c in range(3):
            out[lane, c] = sums[c, lane]


@parallel_kernel
def multiply_pairs(tile_begin, index, scale, value, coefficients, pair_tile, pair_version, out):  # type: ignore[no-untyped-def]
    """``out[p] = tile @ coefficients[version]`` for pairs p; coefficients of 0 cost nothing."""
    for p in prange(len(pair_tile)):
        tile = pair_tile[p]
        _multiply_pair(
            tile_begin[tile], tile_begin[tile + 1], index, scale, value, coefficients[pair_version[p]], out[p]
        )


@parallel_kernel
def multiply_sparse_pairs(indptr, indices, weights, leaves, pair_tile, pair_version, out):  # type: ignore[no-untyped-def]
    """As `multiply_pairs` for 64 rows at once of a sparse matrix and values of leaves (n_slots, n_leaves, 4)."""
    n_rows = len(indptr) - 1
    for p in prange(len(pair_tile)):
        first = pair_tile[p] * 64
        version = pair_version[p]
        for lane in range(64):
            red = np.float32(0)
            green = np.float32(0)
            blue = np.float32(0)
            if first + lane < n_rows:
                for entry in range(indptr[first + lane], indptr[first + lane + 1]):
                    weight = weights[entry]
                    column = indices[entry]
                    red += weight * leaves[version, column, 0]
                    green += weight * leaves[version, column, 1]
                    blue += weight * leaves[version, column, 2]
            out[p, lane, 0] = red
            out[p, lane, 1] = green
            out[p, lane, 2] = blue


@parallel_kernel
def sum_products(tile, group, term_begin, term_version, pair_of, values, n_tiles, sums):  # type: ignore[no-untyped-def]
    """Products of a group's terms on top of a tile's unedited ones.

    Parameters
    ----------
    tile, group : (n,) of each sum
    pair_of : (n_versions, n_tiles) row of `values` (n_lobes, n_pairs, 64, 4)
    sums : (n_lobes, n_tiles + n, 64, 4) the unedited products come first
    """
    n = len(tile)
    for job in prange(n * len(sums)):
        lobe, k = job // n, job % n
        _sum_terms(
            sums[lobe, tile[k]].reshape(-1),
            term_version[term_begin[group[k]] : term_begin[group[k] + 1]],
            pair_of,
            tile[k],
            values[lobe],
            sums[lobe, n_tiles + k].reshape(-1),
        )


@kernel
def _sum_terms(unedited, versions, pair_of, tile, values, out):  # type: ignore[no-untyped-def]
    out[:] = unedited
    for version in versions:
        value = values[pair_of[version, tile]].reshape(-1)
        for i in range(len(out)):
            out[i] += value[i]


@parallel_kernel
def multiply_edited_rows(begin, cell, weight, factor, emission, b, out):  # type: ignore[no-untyped-def]
    """``out[row] = sum of weight (sum_g factor_g b_g + emission)`` over the entries of each row, (n_rows, 4)."""
    for row in prange(len(out)):
        _multiply_edited_row(begin[row], begin[row + 1], cell, weight, factor, emission, b, out[row])


@kernel
def _multiply_edited_row(first, end, cell, weight, factor, emission, b, out):  # type: ignore[no-untyped-def]
    for c in range(3):
        total = np.float32(0)
        for k in range(first, end):
            light = emission[k, c]
            for g in range(len(b)):
                light += factor[g, k, c] * b[g, cell[k], c]
            total += weight[k] * light
        out[c] = total
    out[3] = np.float32(0)


@kernel
def mark_pairs(samples, group, term_begin, term_version, sparse, indptr, indices, needed):  # type: ignore[no-untyped-def]
    """Set ``needed[version, tile]`` for every term of every sample; `sparse` is 0 where rows are samples."""
    for s in samples:
        for term in range(term_begin[group[s]], term_begin[group[s] + 1]):
            version = term_version[term]
            if sparse == 0:
                needed[version, s >> 6] = 1
            else:
                for entry in range(indptr[s], indptr[s + 1]):
                    needed[version, indices[entry] >> 6] = 1


@parallel_kernel
def add_terms(  # type: ignore[no-untyped-def]
    samples,
    group,
    term_begin,
    term_version,
    term_factor_begin,
    term_factor,
    masks,
    n_rows,
    own,
    sparse,
    indptr,
    indices,
    weights,
    pair_of,
    products,
    tints,
    albedo,
    offsets,
    out,
):
    """Sum of the terms of each sample, added to ``out[k]``.

    Parameters
    ----------
    samples : (n,) view samples
    group : (n_view,) group of each
    term_begin : (n_groups + 1,) ranges of terms
    term_factor : rows of the stack that multiply a term: of `masks` (n_rows, n_view), and from `n_rows` on of `own`
    own : (n, n_own, 3) factors of the samples' own
    pair_of : (n_versions, n_tiles) row of the products
    products : (n_lobes, n_pairs, 64, 4)
    tints : (n_lobes, n_view, 3)
    offsets : (n_versions, 6) light without transport, to be reflected and not
    out : (n, 3) float32
    """
    for k in prange(len(samples)):
        s = samples[k]
        for term in range(term_begin[group[s]], term_begin[group[s] + 1]):
            version = term_version[term]
            red = np.float32(1)
            green = np.float32(1)
            blue = np.float32(1)
            for f in range(term_factor_begin[term], term_factor_begin[term + 1]):
                row = term_factor[f]
                if row < n_rows:
                    red *= masks[row, s]
                    green *= masks[row, s]
                    blue *= masks[row, s]
                else:
                    red *= own[k, row - n_rows, 0]
                    green *= own[k, row - n_rows, 1]
                    blue *= own[k, row - n_rows, 2]
            r = np.float32(offsets[version, 0]) * albedo[s, 0] + np.float32(offsets[version, 3])
            g = np.float32(offsets[version, 1]) * albedo[s, 1] + np.float32(offsets[version, 4])
            b = np.float32(offsets[version, 2]) * albedo[s, 2] + np.float32(offsets[version, 5])
            for lobe in range(len(products)):
                x = np.float32(0)
                y = np.float32(0)
                z = np.float32(0)
                if sparse == 0:
                    pair = pair_of[version, s >> 6]
                    x = products[lobe, pair, s & 63, 0]
                    y = products[lobe, pair, s & 63, 1]
                    z = products[lobe, pair, s & 63, 2]
                else:
                    for entry in range(indptr[s], indptr[s + 1]):
                        pair = pair_of[version, indices[entry] >> 6]
                        lane = indices[entry] & 63
                        x += weights[entry] * products[lobe, pair, lane, 0]
                        y += weights[entry] * products[lobe, pair, lane, 1]
                        z += weights[entry] * products[lobe, pair, lane, 2]
                r += tints[lobe, s, 0] * x
                g += tints[lobe, s, 1] * y
                b += tints[lobe, s, 2] * z
            out[k, 0] += red * r
            out[k, 1] += green * g
            out[k, 2] += blue * b


@parallel_kernel
def signatures(masks, samples, out):  # type: ignore[no-untyped-def]
    """Bits of the rows that touch each sample: whole rows in ``out[:, : n]``, soft ones in ``out[:, n :]``."""
    words = out.shape[1] // 2
    for k in prange(len(samples)):
        for word in range(2 * words):
            out[k, word] = np.uint64(0)
        for row in range(len(masks)):
            u = masks[row, samples[k]]
            if u == 0:
                continue
            bit = np.uint64(1) << np.uint64(row & 63)
            word = (row >> 6) if u == 1 else words + (row >> 6)
            out[k, word] |= bit


@kernel
def group_rows(keys, table, first, out):  # type: ignore[no-untyped-def]
    """Number the different rows of `keys` (n, w) in order of appearance: group of each in `out`; how many there are.

    `table` (a power of two, at least 2 n) must be -1; `first` (n,) gets the first row of each group.
    """
    mask = len(table) - 1
    found = 0
    for k in range(len(keys)):
        h = np.uint64(1469598103934665603)
        for w in range(keys.shape[1]):
            h = (h ^ keys[k, w]) * np.uint64(0x9E3779B97F4A7C15)
            h ^= h >> np.uint64(29)
        place = np.int64(h & np.uint64(mask))
        while True:
            other = table[place]
            if other < 0:
                table[place] = found
                first[found] = k
                out[k] = found
                found += 1
                break
            same = True
            for w in range(keys.shape[1]):
                same = same and keys[first[other], w] == keys[k, w]
            if same:
                out[k] = other
                break
            place = (place + 1) & mask
    return found
