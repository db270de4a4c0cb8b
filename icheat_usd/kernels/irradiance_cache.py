"""Records of irradiance: their reach, a hash of the space that they reach, and interpolation.

Ward and Heckbert 1992, Irradiance Gradients; Krivanek, Bouatouch, Pattanaik, Zara 2006, Making Radiance and
Irradiance Caching Practical: Adaptive Caching and Neighbor Clamping.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel

MAX_ENTRIES = 12  # records of one point; the lightest beyond them are left out
#: Height of a place over the plane of a record, as a share of its reach, from which it lies on another sheet.
_STEP = np.float32(0.25)
_EMPTY = np.int64(-1)


class RecordTable(NamedTuple):
    """Records in the order in which they were made."""

    position: NDArray[np.float32]  #: (n, 3)
    normal: NDArray[np.float32]  #: (n, 3) shading normal, unit
    reach: NDArray[np.float32]  #: (n,) metres
    turn: NDArray[np.float32]  #: (n,) turn of the normal, as ``1 - cos``, at which a record ends
    trust: NDArray[np.float32]  #: (n,) 1, or less in a crease, where rays may start behind the next wall


class RecordHash(NamedTuple):
    """Which records reach into each cell of grids of many sizes."""

    level: NDArray[np.int64]  #: sizes in use, log2 of metres
    slot: NDArray[
        np.int64
    ]  #: (size, 3) key, and its list ``record[begin:end]``; key -1 is empty; size is a power of two
    record: NDArray[np.int32]
    row: NDArray[np.float32]  #: (n, `ROW`) position, normal, reach, turn, trust of each record, in one cache line


#: Width of the rows of `RecordHash`.
ROW = 12


@parallel_kernel
def clamp_to_neighbours(position, reach, old, out):  # type: ignore[no-untyped-def]
    """Reach of records, no more than that of any other and the distance to it (Krivanek 2006, 4.2).

    What is near one record is near another beside it.

    Parameters
    ----------
    position : (n, 3) float32
        Ascending in x.
    reach : (n,) float32
    old : (n,) uint8
        1 for records that were compared with each other already.
    out : (n,) float32
    """
    for i in prange(len(reach)):
        out[i] = _clamped(np.int64(i), position, reach, old)


@kernel
def _clamped(i, position, reach, old):  # type: ignore[no-untyped-def]
    least = reach[i]
    px, py, pz = position[i, 0], position[i, 1], position[i, 2]
    for step in (-1, 1):
        j = i + step
        # Whatever is further than `least` cannot limit it.
        while 0 <= j < len(reach) and abs(position[j, 0] - px) < least:
            if reach[j] < least and not (old[i] and old[j]):
                x, y, z = position[j, 0] - px, position[j, 1] - py, position[j, 2] - pz
                d2 = x * x + y * y + z * z
                left = least - reach[j]
                if d2 < left * left:
                    least = reach[j] + np.float32(np.sqrt(d2))
            j += step
    return least


@kernel
def cell_key(level, x, y, z):  # type: ignore[no-untyped-def]
    """Cell of a place in the grid of one size. Far cells may share a key, which costs time only."""
    return _key_in(np.int64(level), 2.0**-level, x, y, z)


@kernel
def _key_in(level, scale, x, y, z):  # type: ignore[no-untyped-def]
    """`cell_key`; `scale` is one over the size of a cell, a power of two."""
    i, j, k = np.int64(np.floor(x * scale)), np.int64(np.floor(y * scale)), np.int64(np.floor(z * scale))
    mask = np.int64((1 << 18) - 1)
    return ((level + 64) << 54) | ((i & mask) << 36) | ((j & mask) << 18) | (k & mask)


@kernel
def _slot_of(key, table):  # type: ignore[no-untyped-def]
    """Slot of a key, or the empty one where it would be."""
    mask = np.int64(len(table) - 1)
    word = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(word >> np.uint64(20)) & mask
    while table[slot, 0] != _EMPTY and table[slot, 0] != key:
        slot = (slot + 1) & mask
    return slot


@kernel
def list_keys(position, reach, level, key, record):  # type: ignore[no-untyped-def]
    """Keys of the cells that each record reaches into, up to 8; returns how many there are."""
    total = 0
    for r in range(len(reach)):
        size = 2.0 ** level[r]
        first = np.empty(3, np.int64)
        last = np.empty(3, np.int64)
        for c in range(3):
            first[c] = np.int64(np.floor((position[r, c] - reach[r]) / size))
            last[c] = np.int64(np.floor((position[r, c] + reach[r]) / size))
        for i in range(first[0], last[0] + 1):
            for j in range(first[1], last[1] + 1):
                for k in range(first[2], last[2] + 1):
                    key[total] = cell_key(level[r], (i + 0.5) * size, (j + 0.5) * size, (k + 0.5) * size)
                    record[total] = r
                    total += 1
    return total


@kernel
def fill_hash(keys, table):  # type: ignore[no-untyped-def]
    """Enter ascending `keys`, equal ones as one list, into the slots of a `RecordHash`."""
    n = len(keys)
    e = 0
    while e < n:
        last = e + 1
        while last < n and keys[last] == keys[e]:
            last += 1
        slot = _slot_of(keys[e], table)
        table[slot, 0], table[slot, 1], table[slot, 2] = keys[e], e, last
        e = last


@kernel
def _weight(row, r, limit, x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Weight of a record at a place, 0 to 1; it ends smoothly where the record or the place's own limit does."""
    dx, dy, dz = x - row[r, 0], y - row[r, 1], z - row[r, 2]
    d2 = dx * dx + dy * dy + dz * dz
    far = min(row[r, 6], limit)
    if d2 >= far * far:
        return np.float32(0.0)
    mx, my, mz = row[r, 3], row[r, 4], row[r, 5]
    turn = row[r, 7]
    turned = np.float32(1.0) - (nx * mx + ny * my + nz * mz)
    if turned >= turn:
        return np.float32(0.0)
    height = np.float32(0.5) * (dx * (nx + mx) + dy * (ny + my) + dz * (nz + mz))
    if abs(height) > _STEP * far:
        return np.float32(0.0)
    # Turns count from the noise of float32 normals on.
    error = np.float32(np.sqrt(d2)) / far + np.float32(np.sqrt(max(turned, np.float32(0.0)) / turn))
    if error >= np.float32(1.0):
        return np.float32(0.0)
    left = np.float32(1.0) - error
    return row[r, 8] * left


@parallel_kernel
def find_records(index, position, normal, limit, count, record, weight, coverage):  # type: ignore[no-untyped-def]
    """Records that reach each of m places, and weights that add up to 1.

    Parameters
    ----------
    index : RecordHash
    position, normal : (m, 3) float32
        World space; shading normals.
    limit : (m,) float32
        Metres beyond which no record can know the light of the place.
    count : (m,) int32, record : (m, MAX_ENTRIES) int32, weight : (m, MAX_ENTRIES) float32, out
    coverage : (m,) float32, out
        Sum of the weights before.
    """
    scale = 2.0**-index.level
    for p in prange(len(position)):
        _find_at(
            np.int64(p),
            index.level,
            scale,
            index.slot,
            index.record,
            index.row,
            position,
            normal,
            limit,
            count,
            record,
            weight,
            coverage,
        )


@kernel
def _find_at(  # type: ignore[no-untyped-def]
    p, levels, scale, slots, listed, rows, position, normal, limit, count, record, weight, coverage
):
    x, y, z = position[p, 0], position[p, 1], position[p, 2]
    nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
    n = 0
    total = np.float32(0.0)
    for q in range(len(levels)):
        slot = _slot_of(_key_in(levels[q], scale[q], x, y, z), slots)
        if slots[slot, 0] == _EMPTY:
            continue
        for e in range(slots[slot, 1], slots[slot, 2]):
            r = listed[e]
            w = _weight(rows, r, limit[p], x, y, z, nx, ny, nz)
            if not w > np.float32(0.0):
                continue
            total += w
            if n < MAX_ENTRIES:
                record[p, n], weight[p, n] = r, w
                n += 1
                continue
            least = 0
            for k in range(1, n):
                if weight[p, k] < weight[p, least]:
                    least = k
            if w > weight[p, least]:
                record[p, least], weight[p, least] = r, w
    count[p] = n
    coverage[p] = total
    kept = np.float32(0.0)
    for k in range(n):
        kept += weight[p, k]
    for k in range(n):
        weight[p, k] /= kept


@parallel_kernel
def find_covered(index, position, normal, limit, wanted, out):  # type: ignore[no-untyped-def]
    """Whether the records that reach a place have weights that add up to `wanted` before they are scaled.

    As `find_records` has it; `out` (m,) uint8.
    """
    scale = 2.0**-index.level
    for p in prange(len(position)):
        out[p] = _is_covered(
            np.int64(p),
            index.level,
            scale,
            index.slot,
            index.record,
            index.row,
            position,
            normal,
            limit,
            wanted,
        )


@kernel
def _is_covered(p, levels, scale, slots, listed, rows, position, normal, limit, wanted):  # type: ignore[no-untyped-def]
    x, y, z = position[p, 0], position[p, 1], position[p, 2]
    nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
    total = np.float32(0.0)
    # Records in the open, which reach far, cover most places.
    for q in range(len(levels) - 1, -1, -1):
        slot = _slot_of(_key_in(levels[q], scale[q], x, y, z), slots)
        if slots[slot, 0] == _EMPTY:
            continue
        for e in range(slots[slot, 1], slots[slot, 2]):
            total += _weight(rows, listed[e], limit[p], x, y, z, nx, ny, nz)
            if total >= wanted:
                return np.uint8(1)
    return np.uint8(0)


@parallel_kernel
def interpolate(  # type: ignore[no-untyped-def]
    at, facing, irradiance, by_turn, by_move, slot, position, normal, count, record, weight, out
):
    """Irradiance at m places from the records of `find_records`, with both gradients; not clamped.

    Parameters
    ----------
    at, facing : (n, 3) float32
        Of the records.
    irradiance : (s, C), by_turn, by_move : (s, C, 3) float32
    slot : (n,) int32
        Row of each record in these.
    out : (m, C) float32
    """
    for p in prange(len(position)):
        for c in range(out.shape[1]):
            out[p, c] = np.float32(0.0)
        for k in range(count[p]):
            r = record[p, k]
            s = slot[r]
            w = weight[p, k]
            dx, dy, dz = position[p, 0] - at[r, 0], position[p, 1] - at[r, 1], position[p, 2] - at[r, 2]
            mx, my, mz = facing[r, 0], facing[r, 1], facing[r, 2]
            nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
            tx, ty, tz = my * nz - mz * ny, mz * nx - mx * nz, mx * ny - my * nx
            for c in range(out.shape[1]):
                value = irradiance[s, c]
                value += tx * by_turn[s, c, 0] + ty * by_turn[s, c, 1] + tz * by_turn[s, c, 2]
                value += dx * by_move[s, c, 0] + dy * by_move[s, c, 1] + dz * by_move[s, c, 2]
                out[p, c] += w * value


@parallel_kernel
def differences(  # type: ignore[no-untyped-def]
    table, irradiance, by_turn, by_move, first, count, record, floor, out
):
    """How wrong each record near a new one was there: relative error of its own prediction, all channels together.

    Parameters
    ----------
    first : int
        The new records are ``first:``; `count`, `record` are what `find_records` found of the old ones at them.
    floor : float
        Irradiance below which errors do not show.
    out : (n_new, MAX_ENTRIES) float32
    """
    at, facing = table.position, table.normal
    for q in prange(len(count)):
        i = first + q
        for k in range(count[q]):
            r = record[q, k]
            dx, dy, dz = at[i, 0] - at[r, 0], at[i, 1] - at[r, 1], at[i, 2] - at[r, 2]
            mx, my, mz = facing[r, 0], facing[r, 1], facing[r, 2]
            nx, ny, nz = facing[i, 0], facing[i, 1], facing[i, 2]
            tx, ty, tz = my * nz - mz * ny, mz * nx - mx * nz, mx * ny - my * nx
            wrong, true = np.float32(0.0), np.float32(0.0)
            for c in range(irradiance.shape[1]):
                value = irradiance[r, c]
                value += tx * by_turn[r, c, 0] + ty * by_turn[r, c, 1] + tz * by_turn[r, c, 2]
                value += dx * by_move[r, c, 0] + dy * by_move[r, c, 1] + dz * by_move[r, c, 2]
                wrong += abs(value - irradiance[i, c])
                true += irradiance[i, c]
            out[q, k] = wrong / max(true, np.float32(floor))
