"""Nearest gather sample on one side of one instance, by walking boxes of the cluster tree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel

BUCKET = 8  # leaves scanned one by one: a box test costs about as much as two of them
_BLOCK = 2048  # queries that share a stack
AGREE = np.float32(0.5)  # normals at least 60 degrees apart belong to different sheets of a surface


class LocatorTable(NamedTuple):
    """Everything a look-up reads, laid out so that a step down the tree touches one cache line."""

    sample: NDArray[np.float32]  #: (n, 6) position and normal, in tree order
    record: NDArray[np.float32]  #: (n_records, 16) of nodes with more than `BUCKET` samples: for the left child
    #: lowest corner, highest corner, what it is, how many; the same for the right. What it is: the
    #: row of its own record, or -1 - its first sample. Integers below 2^24 are exact in float32.
    slot: NDArray[np.int32]  #: (n_instances * 2,) group of samples of ``2 * instance + side``
    slot_begin: NDArray[np.int32]  #: (n_slots + 1,) its samples
    slot_record: NDArray[np.int32]  #: (n_slots,) its record, or -1 where it has none
    slot_detour: NDArray[np.float32]  #: (n_slots,) squared metres added to the distance of a disagreeing normal


@kernel
def number_records(lo, hi, out):  # type: ignore[no-untyped-def]
    """Rows of the records of nodes (-1 for those without), in pre-order; returns how many there are."""
    count = 0
    for node in range(len(lo)):
        out[node] = -1
        if hi[node] - lo[node] > BUCKET:
            out[node] = count
            count += 1
    return count


@kernel
def build_records(position, lo, mid, hi, row, box, record):  # type: ignore[no-untyped-def]
    """Fill the records; `box` (n_nodes, 6) receives the bounds of every node's samples."""
    for step in range(len(lo)):
        node = len(lo) - 1 - step
        for c in range(3):
            box[node, c] = np.inf
            box[node, c + 3] = -np.inf
        for side in range(2):
            begin = lo[node] if side == 0 else mid[node]
            end = mid[node] if side == 0 else hi[node]
            child = node + 1 if side == 0 else node + mid[node] - lo[node]
            for c in range(3):
                low = position[begin, c] if end - begin == 1 else box[child, c]
                high = position[begin, c] if end - begin == 1 else box[child, c + 3]
                box[node, c] = min(box[node, c], low)
                box[node, c + 3] = max(box[node, c + 3], high)
                if row[node] >= 0:
                    record[row[node], 8 * side + c] = low
                    record[row[node], 8 * side + 3 + c] = high
            if row[node] >= 0:
                inner = end - begin > BUCKET
                record[row[node], 8 * side + 6] = row[child] if inner else -1 - begin
                record[row[node], 8 * side + 7] = end - begin


@kernel
def _box_distance(record, r, first, x, y, z):  # type: ignore[no-untyped-def]
    zero = np.float32(0.0)
    dx = max(max(record[r, first] - x, x - record[r, first + 3]), zero)
    dy = max(max(record[r, first + 1] - y, y - record[r, first + 4]), zero)
    dz = max(max(record[r, first + 2] - z, z - record[r, first + 5]), zero)
    return dx * dx + dy * dy + dz * dz


@kernel
def _nearest(table, begin, end, root, x, y, z, nx, ny, nz, detour, stack, bound):  # type: ignore[no-untyped-def]
    """Nearest sample of ``begin:end``, those whose normal disagrees being further away by `detour`."""
    record, sample = table.record, table.sample
    best = np.int64(begin)
    best_distance = np.float32(np.inf)
    depth = 0
    # What is to be visited: a record, or -1 - the first of `count` samples.
    what, count = (np.int64(root), np.int64(0)) if root >= 0 else (np.int64(-1 - begin), np.int64(end - begin))
    while True:
        while what >= 0:
            r = what
            d_left = _box_distance(record, r, 0, x, y, z)
            d_right = _box_distance(record, r, 8, x, y, z)
            # Equal distances are still visited: the lower index wins a tie, wherever it lies.
            near, far = (0, 8) if d_left <= d_right else (8, 0)
            d_far = max(d_left, d_right)
            if d_far <= best_distance:
                stack[depth, 0] = np.int64(record[r, far + 6])
                stack[depth, 1] = np.int64(record[r, far + 7])
                bound[depth] = d_far
                depth += 1
            if min(d_left, d_right) <= best_distance:
                what = np.int64(record[r, near + 6])
                count = np.int64(record[r, near + 7])
            else:
                what, count = np.int64(-1), np.int64(0)
        for j in range(-1 - what, -1 - what + count):
            dx = sample[j, 0] - x
            dy = sample[j, 1] - y
            dz = sample[j, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < best_distance or (d == best_distance and j < best):
                if sample[j, 3] * nx + sample[j, 4] * ny + sample[j, 5] * nz <= AGREE:
                    d += detour
                if d < best_distance or (d == best_distance and j < best):
                    best_distance = d
                    best = np.int64(j)
        found = False
        while depth > 0:
            depth -= 1
            if bound[depth] <= best_distance:
                what, count = stack[depth, 0], stack[depth, 1]
                found = True
                break
        if not found:
            return best


@kernel
def nearest_sample(table, instance, side, x, y, z, nx, ny, nz, stack, bound):  # type: ignore[no-untyped-def]
    """Sample of a place: the nearest on its side of its instance, preferably with an agreeing normal."""
    slot = table.slot[2 * instance + side]
    begin, end = table.slot_begin[slot], table.slot_begin[slot + 1]
    if end - begin == 1:
        return np.int64(begin)
    root = table.slot_record[slot]
    return _nearest(table, begin, end, root, x, y, z, nx, ny, nz, table.slot_detour[slot], stack, bound)


@parallel_kernel
def locate(table, depth, position, normal, instance, side, out):  # type: ignore[no-untyped-def]
    """Sample of each place; -1 where ``instance`` is."""
    n = len(instance)
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        stack = np.empty((depth + 1, 2), np.int64)
        bound = np.empty(depth + 1, np.float32)
        for q in range(block * _BLOCK, min(n, (block + 1) * _BLOCK)):
            if instance[q] < 0:
                out[q] = -1
            else:
                out[q] = nearest_sample(
                    table,
                    instance[q],
                    side[q],
                    position[q, 0],
                    position[q, 1],
                    position[q, 2],
                    normal[q, 0],
                    normal[q, 1],
                    normal[q, 2],
                    stack,
                    bound,
                )
