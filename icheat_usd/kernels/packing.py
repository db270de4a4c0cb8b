"""Packing of sparse rows into tiles of shared Haar coefficients, and the plain product with them.

A tile holds 64 consecutive rows. Every parallel iteration owns one tile.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packed import LANES
from icheat_usd.kernels.simd import (
    address_of,
    larger,
    load,
    load_spread,
    multiply_add,
    peak,
    plus,
    product,
    rounded,
    spread,
    store,
    store_int8,
    total,
    zeros,
)
from icheat_usd.kernels.wavelets import child_weight

_ROW = 4 * LANES  # bytes of a coefficient of all rows
_VECTOR = 64  # bytes of 16 rows of these
_AT_ONCE = 64  # coefficients that stay in the first-level cache while all lights pass


class HaarTables(NamedTuple):
    """What the transform of sparse rows needs of a tree."""

    lo: NDArray[np.int32]
    hi: NDArray[np.int32]
    left: NDArray[np.int32]
    right: NDArray[np.int32]
    of_root: float  #: factor of the sum of all entries in coefficient 0
    of_left: NDArray[np.float32]  #: factors of the sums over a node's children in its coefficient
    of_right: NDArray[np.float32]
    depth: int


class SparseTiles(NamedTuple):
    """Rows in tiles, with what their errors count, and what training lights make of them."""

    indptr: NDArray[np.int64]
    indices: NDArray[np.int32]
    weights: NDArray[np.float32]
    row_weight: NDArray[np.float32]  #: (n_rows,)
    response: NDArray[np.float32]  #: (n_rows, n) exact


class Light(NamedTuple):
    """Training lights in the Haar basis."""

    coefficients: NDArray[np.float32]  #: (m, n)
    energy: NDArray[np.float32]  #: (m,) expected square of a coefficient
    alone: NDArray[np.float32]  #: (m,) share of it that goes together with no other coefficient


@parallel_kernel
def multiply_tiles(tile_begin, index, scale, value, coefficients, out):  # type: ignore[no-untyped-def]
    """Rows (n_tiles * lanes, k) of `out` = tiles times coefficients (m, k)."""
    lanes, k = value.shape[1], coefficients.shape[1]
    for t in prange(len(tile_begin) - 1):
        sums = np.zeros((k, lanes), np.float32)
        for e in range(tile_begin[t], tile_begin[t + 1]):
            for c in range(k):
                factor = scale[e] * coefficients[index[e], c]
                for r in range(lanes):
                    sums[c, r] += factor * np.float32(value[e, r])
        for r in range(lanes):
            for c in range(k):
                out[t * lanes + r, c] = sums[c, r]


@kernel
def smooth_energy(left, right, node_weight, levels, share_of_all, energy, out):  # type: ignore[no-untyped-def]
    """Energy that a coefficient would have if its surroundings set it.

    Per unit of weight, energies are averaged over the subtree below the ancestor
    `levels` up: a light that falls here falls nearby when it is moved. `share_of_all`
    is taken from the average over the whole tree, since light may fall anywhere.
    """
    n_nodes = len(left)
    parent = np.zeros(n_nodes, np.int64)
    total = np.empty(n_nodes, np.float64)
    count = np.ones(n_nodes, np.float64)
    for step in range(n_nodes):
        node = n_nodes - 1 - step
        total[node] = energy[1 + node] / node_weight[node]
        for child in (left[node], right[node]):
            if child >= 0:
                parent[child] = node
                total[node] += total[child] * count[child]
                count[node] += count[child]
        total[node] /= count[node]
    out[0] = energy[0]
    for node in range(n_nodes):
        ancestor = node
        for _ in range(levels):
            ancestor = parent[ancestor]
        density = (1.0 - share_of_all) * total[ancestor] + share_of_all * total[0]
        out[1 + node] = density * node_weight[node]


@kernel
def haar_factors(left, right, weight, node_weight, of_left, of_right):  # type: ignore[no-untyped-def]
    """Factors of the sums over the children in each node's coefficient, for densities ``values / weight``."""
    for node in range(len(left)):
        a = child_weight(left[node], weight, node_weight)
        b = child_weight(right[node], weight, node_weight)
        of_left[node] = np.sqrt(b / (a * (a + b)))
        of_right[node] = np.sqrt(a / (b * (a + b)))


@kernel
def _by_column(indptr, indices, weights, first, last, n_columns):  # type: ignore[no-untyped-def]
    """Entries of rows ``first:last`` sorted by column: where each column begins, and lanes and weights."""
    begin = np.zeros(n_columns + 1, np.int64)
    for e in range(indptr[first], indptr[last]):
        begin[indices[e] + 1] += 1
    for j in range(n_columns):
        begin[j + 1] += begin[j]
    place = begin[:-1].copy()
    lane = np.empty(begin[-1], np.int32)
    entry = np.empty(begin[-1], np.float32)
    for row in range(first, last):
        for e in range(indptr[row], indptr[row + 1]):
            j = indices[e]
            lane[place[j]] = row - first
            entry[place[j]] = weights[e]
            place[j] += 1
    return begin, lane, entry


@kernel
def _transform_tile(tables, begin, lane, entry, square, energy, least, stack, index, value):  # type: ignore[no-untyped-def]
    """Haar coefficients of all rows of a tile at once, those whose expected squared response is at least `least`.

    The response of coefficient k is the sum over rows of ``square * t_k^2 *
    energy_k``. The root is always kept. Indices and values are filled from the end, ascending;
    returns their number, which may be more than there is room for.
    `stack` (depth + 6, 64) is scratch. Walking pre-order backwards meets children before their parent.
    """
    left, right, lo, hi = tables.left, tables.right, tables.lo, tables.hi
    room = len(index)
    scratch = address_of(stack)  # rows of a leaf on either side, one of zeros, one for what has no room; then sums
    leaf, none, spare, bottom = (scratch, scratch + _ROW), scratch + 2 * _ROW, scratch + 3 * _ROW, scratch + 4 * _ROW
    squares, values = address_of(square), address_of(value)
    for offset in range(0, _ROW, _VECTOR):
        store(none + offset, zeros())
    top, count = 0, 0
    for step in range(len(left)):
        node = len(left) - 1 - step
        if begin[lo[node]] == begin[hi[node]]:
            continue
        # The left child was walked last, so its sum lies above the right one's; sums of leaves are not on the stack.
        sum_left, sum_right = none, none
        i, j = left[node], right[node]
        if i < 0:
            sum_left = leaf[0]
            _scatter(begin[-1 - i], begin[-i], lane, entry, stack[0])
        elif begin[lo[i]] < begin[hi[i]]:
            top -= 1
            sum_left = bottom + _ROW * top
        if j < 0:
            sum_right = leaf[1]
            _scatter(begin[-1 - j], begin[-j], lane, entry, stack[1])
        elif begin[lo[j]] < begin[hi[j]]:
            top -= 1
            sum_right = bottom + _ROW * top
        place = values + _ROW * (room - 1 - count) if count < room else spare
        of_left, of_right = tables.of_left[node], tables.of_right[node]
        score = _difference(sum_left, sum_right, of_left, of_right, squares, place, bottom + _ROW * top)
        if score * energy[1 + node] >= least:
            if count < room:
                index[room - 1 - count] = 1 + node
            count += 1
        top += 1
    if begin[0] < begin[-1]:
        if len(left) == 0:
            _scatter(begin[0], begin[1], lane, entry, stack[4])
        place = values + _ROW * (room - 1 - count) if count < room else spare
        _difference(bottom, none, np.float32(tables.of_root), np.float32(0), squares, place, none)
        if count < room:
            index[room - 1 - count] = 0
        count += 1
    return count


@kernel
def _scatter(first, last, lane, entry, out):  # type: ignore[no-untyped-def]
    """Entries ``first:last`` in their lanes, zeros elsewhere."""
    out[:] = 0
    for e in range(first, last):
        out[lane[e]] += entry[e]


@kernel
def _difference(a, b, of_a, of_b, square, difference, both):  # type: ignore[no-untyped-def]
    """``of_a a - of_b b`` and ``a + b`` of rows at addresses; the sum of the first's squares times `square`."""
    factor_a, factor_b, score = spread(of_a), spread(-of_b), zeros()
    for offset in range(0, _ROW, _VECTOR):
        x, y = load(a + offset), load(b + offset)
        change = multiply_add(factor_a, x, product(factor_b, y))
        store(difference + offset, change)
        store(both + offset, plus(x, y))
        score = multiply_add(product(load(square + offset), change), change, score)
    return total(score)


@kernel
def _add_to_gram(light, scaled, gram, sums):  # type: ignore[no-untyped-def]
    """Add ``scaled^T light``, both (m, width), to `gram` (width, width): its blocks on the diagonal and above.

    Four rows by 16 columns stay in registers, in single precision: m is small. `sums` (4, 16) is scratch.
    """
    m, width = light.shape
    step = 4 * width
    for a in range(0, width, 4):
        for b in range(a // 16 * 16, width, 16):
            s0, s1, s2, s3 = zeros(), zeros(), zeros(), zeros()
            place, factors = address_of(light) + 4 * b, address_of(scaled) + 4 * a
            for _ in range(m):
                x = load(place)
                s0 = multiply_add(load_spread(factors), x, s0)
                s1 = multiply_add(load_spread(factors + 4), x, s1)
                s2 = multiply_add(load_spread(factors + 8), x, s2)
                s3 = multiply_add(load_spread(factors + 12), x, s3)
                place += step
                factors += step
            out = address_of(sums)
            store(out, s0)
            store(out + 64, s1)
            store(out + 128, s2)
            store(out + 192, s3)
            for i in range(4):
                for j in range(16):
                    gram[a + i, b + j] += sums[i, j]


@kernel
def _solve(matrix, right):  # type: ignore[no-untyped-def]
    """Solve a symmetric positive definite system for `right` (n, k) by Cholesky's factors, in place.

    Reads the upper triangle of `matrix` (n, n), which is overwritten. All inner loops go along rows.
    """
    n, k = right.shape
    for j in range(n):
        diagonal = np.sqrt(matrix[j, j])
        for i in range(j, n):
            matrix[j, i] /= diagonal
        for i in range(j + 1, n):
            factor = matrix[j, i]
            for c in range(i, n):
                matrix[i, c] -= factor * matrix[j, c]
    for i in range(n):
        for j in range(i):
            factor = matrix[j, i]
            for c in range(k):
                right[i, c] -= factor * right[j, c]
        for c in range(k):
            right[i, c] /= matrix[i, i]
    for step in range(n):
        i = n - 1 - step
        for j in range(i + 1, n):
            factor = matrix[i, j]
            for c in range(k):
                right[i, c] -= factor * right[j, c]
        for c in range(k):
            right[i, c] /= matrix[i, i]


@kernel
def _take_lost(first, last, value, light, lost):  # type: ignore[no-untyped-def]
    """Subtract from `lost` (n, 64) what coefficients ``first:last`` make of each light (n_kept, n or more)."""
    for a in range(len(lost)):
        sums = address_of(lost) + _ROW * a
        s0, s1, s2, s3 = load(sums), load(sums + 64), load(sums + 128), load(sums + 192)
        place = address_of(value) + _ROW * first
        for e in range(first, last):
            factor = spread(-light[e, a])
            s0 = multiply_add(factor, load(place), s0)
            s1 = multiply_add(factor, load(place + 64), s1)
            s2 = multiply_add(factor, load(place + 128), s2)
            s3 = multiply_add(factor, load(place + 192), s3)
            place += _ROW
        store(sums, s0)
        store(sums + 64, s1)
        store(sums + 128, s2)
        store(sums + 192, s3)


@kernel
def _add_change(light, share, value):  # type: ignore[no-untyped-def]
    """Add to `value` (n_kept, 64) the sum over lights of ``light (n_kept, n) share (n, 64)``."""
    place, shares, factors = address_of(value), address_of(share), address_of(light)
    for _ in range(len(light)):
        s0, s1, s2, s3 = load(place), load(place + 64), load(place + 128), load(place + 192)
        other = shares
        for _ in range(light.shape[1]):
            factor = load_spread(factors)
            s0 = multiply_add(factor, load(other), s0)
            s1 = multiply_add(factor, load(other + 64), s1)
            s2 = multiply_add(factor, load(other + 128), s2)
            s3 = multiply_add(factor, load(other + 192), s3)
            factors += 4
            other += _ROW
        store(place, s0)
        store(place + 64, s1)
        store(place + 128, s2)
        store(place + 192, s3)
        place += _ROW


@kernel
def _refit_tile(light, index, value, lost):  # type: ignore[no-untyped-def]
    """Let the kept coefficients stand in for the others, as far as lights excite both together.

    With coefficients of light of covariance ``L L^T / n + D``, L the training
    lights (m, n) and D their `alone`, the response that is lost is
    expected to be ``E[lost | kept] = e (G + n I)^-1 L_kept^T D^-1 b_kept``, where
    e is what is lost of the training lights and G = L_kept^T D^-1 L_kept: a ridge
    regression. The root stays as it is, so that uniform light is right.
    `lost` (n, 64) is the exact response, and is overwritten.
    """
    n = light.coefficients.shape[1]
    width = (n + 15) // 16 * 16  # of whole vectors; what is added is 0
    kept, gram = np.zeros((len(index), width), np.float32), np.zeros((width, width), np.float64)
    for e in range(len(index)):
        for a in range(n):
            kept[e, a] = light.coefficients[index[e], a]
    scaled, sums = np.empty((_AT_ONCE, width), np.float32), np.empty((4, 16), np.float32)
    for first in range(0, len(index), _AT_ONCE):
        last = min(first + _AT_ONCE, len(index))
        _take_lost(first, last, value, kept, lost)
        for e in range(first, last):
            alone = light.alone[index[e]]
            inverse = np.float32(1.0) / alone if index[e] > 0 and alone > np.float32(0) else np.float32(0)
            for a in range(width):
                scaled[e - first, a] = kept[e, a] * inverse
        _add_to_gram(kept[first:last], scaled, gram, sums)
        kept[first:last] = scaled[: last - first]
    for a in range(width):
        gram[a, a] += n
    right, share = np.zeros((width, LANES), np.float64), np.empty((width, LANES), np.float32)
    right[:n] = lost
    _solve(gram, right)
    share[:] = right
    _add_change(kept, share, value)


@kernel
def _quantise(value, square, quanta, rest):  # type: ignore[no-untyped-def]
    """Round a coefficient (64,) to quanta at an address, and leave the rest at another.

    Returns the value of a quantum, and the sums of squares times `square` of the rest and of what was rounded.
    """
    largest, left, kept = zeros(), zeros(), zeros()
    for offset in range(0, _ROW, _VECTOR):
        largest = larger(largest, load(value + offset))
    scale = peak(largest) / np.float32(127)
    if scale < np.float32(1e-36):  # whose inverse might be infinite
        return np.float32(0), np.float32(0), np.float32(0)
    inverse, one = spread(np.float32(1) / scale), spread(-scale)
    for offset in range(0, _ROW, _VECTOR):
        x = load(value + offset)
        whole = rounded(product(x, inverse))
        store_int8(quanta + offset // 4, whole)
        difference = multiply_add(one, whole, x)
        store(rest + offset, difference)
        left = multiply_add(product(load(square + offset), difference), difference, left)
        kept = multiply_add(product(load(square + offset), x), x, kept)
    return scale, total(left), total(kept)


@kernel
def _round_tile(index, value, square, energy, least, rest, out_index, out_scale, out_worth, out_value):  # type: ignore[no-untyped-def]
    """Round coefficients to quanta, and what that leaves to quanta of its own where it counts; their number.

    What is left counts as a coefficient does in `_transform_tile`, and at the root always.
    """
    count = 0
    values, squares, left, quanta = address_of(value), address_of(square), address_of(rest), address_of(out_value)
    for e in range(len(index)):
        scale, lost, kept = _quantise(values + _ROW * e, squares, quanta + LANES * count, left)
        if scale == np.float32(0):
            continue
        out_index[count], out_scale[count], out_worth[count] = index[e], scale, np.sqrt(kept)
        count += 1
        if index[e] == 0 or lost * energy[index[e]] >= least:
            scale, _, kept = _quantise(left, squares, quanta + LANES * count, left)
            if scale > np.float32(0):
                out_index[count], out_scale[count], out_worth[count] = index[e], scale, np.sqrt(kept)
                count += 1
    return count


@kernel
def _squares(tiles, first):  # type: ignore[no-untyped-def]
    """Squared weights of the rows of a tile, 0 where there are none."""
    square = np.zeros(LANES, np.float32)
    for row in range(first, min(first + LANES, len(tiles.row_weight))):
        square[row - first] = tiles.row_weight[row] * tiles.row_weight[row]
    return square


@kernel
def _transform(tables, tiles, tile, energy, least, index, value):  # type: ignore[no-untyped-def]
    """`_transform_tile` of a tile by its number."""
    first = tile * LANES
    last = min(first + LANES, len(tiles.indptr) - 1)
    columns = _by_column(tiles.indptr, tiles.indices, tiles.weights, first, last, len(energy))
    stack = np.empty((tables.depth + 6, LANES), np.float32)
    return _transform_tile(tables, *columns, _squares(tiles, first), energy, least, stack, index, value)


@parallel_kernel
def transform_tiles(tables, tiles, tile, energy, least, index, value, count):  # type: ignore[no-untyped-def]
    """Coefficients of some tiles that are worth at least `least`, at the end of `index` (n, room) and `value`.

    `count` (n,) is their number, which may be more than there is room for.
    """
    for i in prange(len(tile)):
        count[i] = _transform(tables, tiles, tile[i], energy, least, index[i], value[i])


@kernel
def _pack_tile(tables, tiles, tile, light, least, index, value, out_index, out_scale, out_worth, out_value):  # type: ignore[no-untyped-def]
    """Coefficients of a tile, refitted and rounded: how many there are, and how many are kept before rounding."""
    n_kept = _transform(tables, tiles, tile, light.energy, least, index, value)
    if n_kept > len(index):
        return 0, n_kept
    first = tile * LANES
    some = slice(len(index) - n_kept, len(index))
    lost = np.zeros((light.coefficients.shape[1], LANES), np.float32)
    for row in range(first, min(first + LANES, len(tiles.response))):
        for a in range(len(lost)):
            lost[a, row - first] = tiles.response[row, a]
    _refit_tile(light, index[some], value[some], lost)
    square, rest = _squares(tiles, first), np.zeros(LANES, np.float32)
    outputs = out_index, out_scale, out_worth, out_value
    count = _round_tile(index[some], value[some], square, light.energy, least, rest, *outputs)
    return count, n_kept


@parallel_kernel
def pack_tiles(  # type: ignore[no-untyped-def]
    tables, tiles, tile, light, least, index, value, out_index, out_scale, out_worth, out_value, count, n_kept
):
    """Pack some tiles.

    Parameters
    ----------
    tile : (n,) int64
    least : float32
        Expected squared response from which on a coefficient is kept.
    index : (n, room) int32
    value : (n, room, 64) float32
        Scratch.
    out_index : (n, 2 room) int32
    out_scale, out_worth : (n, 2 room) float32
    out_value : (n, 2 room, 64) int8
        Coefficients as in `PackedRows`.
    count : (n,) int64
        How many there are.
    n_kept : (n,) int64
        Of how many. Where that is more than `room`, there is no result.
    """
    for i in prange(len(tile)):
        outputs = out_index[i], out_scale[i], out_worth[i], out_value[i]
        count[i], n_kept[i] = _pack_tile(tables, tiles, tile[i], light, least, index[i], value[i], *outputs)
