"""Versions in the basis of the rows, and their products with rows: for every pair of tile and version."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def _haar_of_one(deltas, nodes, child, share, root, out, size):  # type: ignore[no-untyped-def]
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
        size[1 + node] = max(abs(out[1 + node, 0]), abs(out[1 + node, 1]), abs(out[1 + node, 2]))
    for c in range(3):
        if len(nodes) > 0:
            out[0, c] = mean[len(nodes) - 1, c] * root
        elif len(deltas) > 0 and len(share) == 0:
            out[0, c] = np.float64(deltas[0, c]) * root


@parallel_kernel
def haar_of_cells(  # type: ignore[no-untyped-def]
    versions, version_cells, deltas, version_nodes, nodes, child, share, root, out, size
):
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
    size : (n_slots, n_leaves) float32
        Largest sizes of the channels; the mean's is left alone.
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
            size[version],
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
def sum_atoms(pairs, which, pair_tile, begin, atom, factor, pair_of, values):  # type: ignore[no-untyped-def]
    """``values[:, pair] = sum over the atoms of its version of factor * their products`` with its tile, in order.

    Parameters
    ----------
    pairs, which : (n,) int64, pair of tile and version, and the version's place in `begin`
    pair_tile : (n_pairs,) int32
    begin : (n_versions + 1,) int64, ranges of `atom` and `factor`
    atom : (n_terms,) int64, version that an atom is
    factor : (n_terms, 64) float32, colour and pad, 16 times
    pair_of : (all versions, n_tiles) int32
    values : (n_lobes, n_pairs or more, 64, 4) float32
    """
    n = len(pairs)
    for job in prange(n * len(values)):
        of_lobe, k = values[job // n], job % n
        v = which[k]
        _sum_atoms(
            atom[begin[v] : begin[v + 1]],
            factor[begin[v] : begin[v + 1]],
            pair_of,
            pair_tile[pairs[k]],
            of_lobe,
            pairs[k],
        )


@kernel
def _sum_atoms(atom, factor, pair_of, tile, values, pair):  # type: ignore[no-untyped-def]
    out = values[pair].reshape(-1)
    out[:] = np.float32(0)
    for k in range(len(atom)):
        value = values[pair_of[atom[k], tile]].reshape(-1)
        for part in range(4):
            for i in range(64):
                out[64 * part + i] += value[64 * part + i] * factor[k, i]


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
