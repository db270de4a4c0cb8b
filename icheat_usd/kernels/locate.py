"""Nearest gather sample on one side of one instance, by walking boxes of the cluster tree."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel

BUCKET = 8  # leaves scanned one by one: a box test costs about as much as two of them
_BLOCK = 2048  # queries that share a stack
_AGREE = np.float32(0.5)  # normals at least 60 degrees apart belong to different sheets of a surface


class LocatorTable(NamedTuple):
    """Everything a look-up reads."""

    position: NDArray[np.float32]  #: (n, 3) of the samples, in tree order
    normal: NDArray[np.float32]  #: (n, 3)
    lo: NDArray[np.int32]  #: (n_nodes,)
    mid: NDArray[np.int32]
    hi: NDArray[np.int32]
    box: NDArray[np.float32]  #: (n_nodes, 6) lowest and highest corner
    slot: NDArray[np.int32]  #: (n_instances * 2,) group of samples of ``2 * instance + side``
    slot_begin: NDArray[np.int32]  #: (n_slots + 1,) its samples
    slot_node: NDArray[np.int32]  #: (n_slots,) its node, or -1 where it has one sample


@kernel
def build_boxes(position, lo, mid, hi, box):  # type: ignore[no-untyped-def]
    """Bounds of every node's samples."""
    for step in range(len(lo)):
        node = len(lo) - 1 - step
        for c in range(3):
            low = np.float32(np.inf)
            high = np.float32(-np.inf)
            for side in range(2):
                begin = lo[node] if side == 0 else mid[node]
                end = mid[node] if side == 0 else hi[node]
                if end - begin == 1:
                    low = min(low, position[begin, c])
                    high = max(high, position[begin, c])
                else:
                    child = node + 1 if side == 0 else node + mid[node] - lo[node]
                    low = min(low, box[child, c])
                    high = max(high, box[child, c + 3])
            box[node, c] = low
            box[node, c + 3] = high


@kernel
def _box_distance(box, node, x, y, z):  # type: ignore[no-untyped-def]
    zero = np.float32(0.0)
    dx = max(max(box[node, 0] - x, x - box[node, 3]), zero)
    dy = max(max(box[node, 1] - y, y - box[node, 4]), zero)
    dz = max(max(box[node, 2] - z, z - box[node, 5]), zero)
    return dx * dx + dy * dy + dz * dz


@kernel
def _nearest(table, begin, end, root, x, y, z, nx, ny, nz, agree, stack, bound):  # type: ignore[no-untyped-def]
    """Nearest sample of ``begin:end`` whose normal agrees by more than `agree`; -1 if none does."""
    best = np.int64(-1)
    best_distance = np.float32(np.inf)
    depth = 0
    if end - begin <= BUCKET:
        scan_lo, scan_hi = np.int64(begin), np.int64(end)
        node = np.int64(-1)
    else:
        scan_lo, scan_hi = np.int64(0), np.int64(0)
        node = np.int64(root)
    while True:
        while node >= 0:
            lo, mid, hi = np.int64(table.lo[node]), np.int64(table.mid[node]), np.int64(table.hi[node])
            if hi - lo <= BUCKET:
                scan_lo, scan_hi = lo, hi
                break
            left = node + 1
            right = node + mid - lo
            d_left = _box_distance(table.box, left, x, y, z)
            d_right = _box_distance(table.box, right, x, y, z)
            # Equal distances are still visited: the lower index wins a tie, wherever it lies.
            if d_left <= d_right:
                near, far, d_near, d_far = left, right, d_left, d_right
            else:
                near, far, d_near, d_far = right, left, d_right, d_left
            if d_far <= best_distance:
                stack[depth] = far
                bound[depth] = d_far
                depth += 1
            node = near if d_near <= best_distance else np.int64(-1)
        for j in range(scan_lo, scan_hi):
            dx = table.position[j, 0] - x
            dy = table.position[j, 1] - y
            dz = table.position[j, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < best_distance or (d == best_distance and j < best):
                if table.normal[j, 0] * nx + table.normal[j, 1] * ny + table.normal[j, 2] * nz > agree:
                    best_distance = d
                    best = j
        scan_lo, scan_hi = np.int64(0), np.int64(0)
        node = np.int64(-1)
        while depth > 0:
            depth -= 1
            if bound[depth] <= best_distance:
                node = stack[depth]
                break
        if node < 0:
            return best


@kernel
def nearest_sample(table, instance, side, x, y, z, nx, ny, nz, stack, bound):  # type: ignore[no-untyped-def]
    """Sample of a place: the nearest on its side of its instance, with an agreeing normal if there is one."""
    slot = table.slot[2 * instance + side]
    begin, end = table.slot_begin[slot], table.slot_begin[slot + 1]
    if end - begin == 1:
        return np.int64(begin)
    root = table.slot_node[slot]
    best = _nearest(table, begin, end, root, x, y, z, nx, ny, nz, _AGREE, stack, bound)
    if best < 0:
        best = _nearest(table, begin, end, root, x, y, z, nx, ny, nz, np.float32(-2.0), stack, bound)
    return best


@parallel_kernel
def locate(table, depth, position, normal, instance, side, out):  # type: ignore[no-untyped-def]
    """Sample of each place; -1 where ``instance`` is."""
    n = len(instance)
    for block in prange((n + _BLOCK - 1) // _BLOCK):
        stack = np.empty(depth + 1, np.int64)
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
