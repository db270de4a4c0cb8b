"""Packing of sparse rows into tiles of shared Haar coefficients, and the plain product with them.

A tile holds `lanes` consecutive rows. Every parallel iteration owns one tile.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.wavelets import child_weight


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
def _walk_tile(  # type: ignore[no-untyped-def]
    lo, hi, left, right, of_root, of_left, of_right, depth, begin, lane, entry, square, place, value, score
):
    """Haar coefficients of all rows of a tile at once.

    Coefficient k goes to ``value[place[k]]`` (lanes,) unless ``place[k]`` is
    negative; `score` gets its squares summed with the weights `square` (lanes,),
    and is -1 where no row has any. Walking pre-order backwards meets children before their parent.
    """
    lanes = len(square)
    score[:] = -1.0
    stack, leaves = np.zeros((depth + 2, lanes), np.float32), np.empty((2, lanes), np.float32)
    none, change, term = np.zeros(lanes, np.float32), np.empty(lanes, np.float32), np.empty(lanes, np.float32)
    top = 0
    for step in range(len(left)):
        node = len(left) - 1 - step
        if begin[lo[node]] == begin[hi[node]]:
            continue
        # The left child was walked last, so its sum lies above the right one's; sums of leaves are not on the stack.
        sum_left, sum_right = none, none
        i, j = left[node], right[node]
        if i < 0:
            sum_left = _scatter(begin[-1 - i], begin[-i], lane, entry, leaves[0])
        elif begin[lo[i]] < begin[hi[i]]:
            top -= 1
            sum_left = stack[top]
        if j < 0:
            sum_right = _scatter(begin[-1 - j], begin[-j], lane, entry, leaves[1])
        elif begin[lo[j]] < begin[hi[j]]:
            top -= 1
            sum_right = stack[top]
        _difference(sum_left, sum_right, of_left[node], of_right[node], square, change, term)
        score[1 + node] = _sum_of(term)
        if place[1 + node] >= 0:
            value[place[1 + node], :] = change
        _add_into(stack[top], sum_left, sum_right)
        top += 1
    if len(left) == 0:
        _scatter(begin[0], begin[1], lane, entry, stack[0])
    if begin[0] < begin[-1]:
        _difference(stack[0], none, of_root, np.float32(0), square, change, term)
        score[0] = _sum_of(term)
        if place[0] >= 0:
            value[place[0], :] = change


@kernel
def _scatter(first, last, lane, entry, out):  # type: ignore[no-untyped-def]
    """Entries ``first:last`` in their lanes, zeros elsewhere."""
    out[:] = 0
    for e in range(first, last):
        out[lane[e]] += entry[e]
    return out


@kernel
def _difference(a, b, of_a, of_b, square, change, term):  # type: ignore[no-untyped-def]
    for r in range(len(change)):
        change[r] = of_a * a[r] - of_b * b[r]
        term[r] = square[r] * change[r] * change[r]


@kernel
def _add_into(out, a, b):  # type: ignore[no-untyped-def]
    for r in range(len(out)):
        out[r] = a[r] + b[r]


@kernel
def _sum_of(term):  # type: ignore[no-untyped-def]
    """Sum in halves, which vectors can do; `term`, of a power of two, is overwritten."""
    half = len(term) // 2
    while half > 0:
        for r in range(half):
            term[r] += term[half + r]
        half //= 2
    return term[0]


@parallel_kernel
def choose_coefficients(  # type: ignore[no-untyped-def]
    lo,
    hi,
    left,
    right,
    of_root,
    of_left,
    of_right,
    depth,
    indptr,
    indices,
    weights,
    tile,
    lanes,
    row_weight,
    energy,
    least,
    kept,
):
    """Mark in `kept` (n, m) the coefficients of each tile whose expected squared response is at least `least`.

    The response of coefficient k is the sum over rows of ``(row_weight * t_k)^2
    * energy_k``. The root is always kept.
    """
    for i in prange(len(tile)):
        first = tile[i] * lanes
        last = min(first + lanes, len(indptr) - 1)
        begin, lane, entry = _by_column(indptr, indices, weights, first, last, len(energy))
        square = np.zeros(lanes, np.float32)
        for row in range(first, last):
            square[row - first] = row_weight[row] * row_weight[row]
        score = np.empty(len(energy), np.float32)
        place = np.full(len(energy), -1, np.int32)
        value = np.empty((0, lanes), np.float32)
        _walk_tile(
            lo,
            hi,
            left,
            right,
            of_root,
            of_left,
            of_right,
            depth,
            begin,
            lane,
            entry,
            square,
            place,
            value,
            score,
        )
        for k in range(len(energy)):
            kept[i, k] = 1 if score[k] >= 0 and (k == 0 or score[k] * energy[k] >= least) else 0


@parallel_kernel
def fill_tiles(  # type: ignore[no-untyped-def]
    lo, hi, left, right, of_root, of_left, of_right, depth, indptr, indices, weights, tile, lanes, begin, index, value
):
    """Coefficients ``index[begin[i]:begin[i + 1]]`` of each tile into the same rows of `value` (n, lanes)."""
    for i in prange(len(tile)):
        first = tile[i] * lanes
        last = min(first + lanes, len(indptr) - 1)
        column_begin, lane, entry = _by_column(indptr, indices, weights, first, last, len(left) + 1)
        place = np.full(len(left) + 1, -1, np.int32)
        for e in range(begin[i], begin[i + 1]):
            place[index[e]] = e - begin[i]
        _walk_tile(
            lo,
            hi,
            left,
            right,
            of_root,
            of_left,
            of_right,
            depth,
            column_begin,
            lane,
            entry,
            np.zeros(lanes, np.float32),
            place,
            value[begin[i] : begin[i + 1]],
            np.empty(len(left) + 1, np.float32),
        )


@kernel
def _invert(matrix):  # type: ignore[no-untyped-def]
    """Inverse of a symmetric positive definite matrix, by Cholesky's factors; `matrix` is overwritten."""
    n = len(matrix)
    for j in range(n):
        for i in range(j, n):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(total) if i == j else total / matrix[j, j]
    lower = np.zeros((n, n), np.float64)
    for j in range(n):
        lower[j, j] = 1.0 / matrix[j, j]
        for i in range(j + 1, n):
            total = 0.0
            for k in range(j, i):
                total -= matrix[i, k] * lower[k, j]
            lower[i, j] = total / matrix[i, i]
    inverse = np.zeros((n, n), np.float64)
    for k in range(n):
        for i in range(k + 1):
            for j in range(k + 1):
                inverse[i, j] += lower[k, i] * lower[k, j]
    return inverse


@parallel_kernel
def refit_tiles(begin, index, value, tile, lanes, light, energy, response):  # type: ignore[no-untyped-def]
    """Let the kept coefficients stand in for the others, as far as lights excite both together.

    With coefficients of light of covariance ``L L^T / n + D``, L the training
    lights `light` (m, n) and D = `energy`, the response that is lost is
    expected to be ``E[lost | kept] = e (G + n I)^-1 L_kept^T D^-1 b_kept``, where
    e is what is lost of the training lights and G = L_kept^T D^-1 L_kept: a ridge
    regression. The root stays as it is, so that uniform light is right.
    `response` (n_rows, n) is exact.
    """
    n = light.shape[1]
    for i in prange(len(tile)):
        first = tile[i] * lanes
        n_rows = min(lanes, len(response) - first)
        lost = np.zeros((n, lanes), np.float64)
        for r in range(n_rows):
            for a in range(n):
                lost[a, r] = response[first + r, a]
        gram = np.zeros((n, n), np.float64)
        for e in range(begin[i], begin[i + 1]):
            k = index[e]
            inverse = 1.0 / energy[k] if k > 0 and energy[k] > 0.0 else 0.0
            for a in range(n):
                factor = np.float64(light[k, a])
                for r in range(lanes):
                    lost[a, r] -= factor * value[e, r]
                factor *= inverse
                for b in range(n):
                    gram[a, b] += factor * light[k, b]
        for a in range(n):
            gram[a, a] += n
        solver = _invert(gram)
        share = np.zeros((n, lanes), np.float64)
        for a in range(n):
            for b in range(n):
                for r in range(lanes):
                    share[a, r] += solver[a, b] * lost[b, r]
        change = np.empty(lanes, np.float64)
        for e in range(begin[i], begin[i + 1]):
            k = index[e]
            if k > 0 and energy[k] > 0.0:
                change[:] = 0.0
                for a in range(n):
                    factor = light[k, a] / energy[k]
                    for r in range(lanes):
                        change[r] += factor * share[a, r]
                for r in range(n_rows):
                    value[e, r] += change[r]


@parallel_kernel
def quantise(begin, index, value, tile, row_weight, energy, least, scale, quanta, rest_scale, rest):  # type: ignore[no-untyped-def]
    """Round each coefficient (n, lanes) to quanta, and what that leaves to quanta of its own where it counts.

    What is left counts as a coefficient does in `choose_coefficients`, and at
    the root always. Elsewhere `rest_scale` is 0.
    """
    lanes = value.shape[1]
    for i in prange(len(tile)):
        first = tile[i] * lanes
        for e in range(begin[i], begin[i + 1]):
            largest = np.float32(0)
            for r in range(lanes):
                largest = max(largest, abs(value[e, r]))
            scale[e] = largest / np.float32(127)
            rest_scale[e] = 0
            for r in range(lanes):
                quanta[e, r] = 0
            if scale[e] == 0:
                continue
            over = np.float32(0)
            left = 0.0
            for r in range(lanes):
                quanta[e, r] = np.int8(np.rint(value[e, r] / scale[e]))
                difference = value[e, r] - scale[e] * np.float32(quanta[e, r])
                over = max(over, abs(difference))
                if first + r < len(row_weight):
                    left += (row_weight[first + r] * difference) ** 2
            if over / np.float32(127) > 0 and (index[e] == 0 or left * energy[index[e]] >= least):
                rest_scale[e] = over / np.float32(127)
                for r in range(lanes):
                    difference = value[e, r] - scale[e] * np.float32(quanta[e, r])
                    rest[e, r] = np.int8(np.rint(difference / rest_scale[e]))
