"""Records of irradiance: their gradients and reach, a hash of the space that they reach, and interpolation.

Ward and Heckbert 1992, Irradiance Gradients; Krivanek, Bouatouch, Pattanaik, Zara 2006, Making Radiance and
Irradiance Caching Practical: Adaptive Caching and Neighbor Clamping.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.samples import basis

MAX_ENTRIES = 12  # records of one point; the lightest beyond them are left out
#: Rays lower than this above the tangent plane, as a share of the cosine distribution, do not tell how near
#: the nearest surface is: a bevelled floor would be one.
_HIGH = 0.97
_TOUCHING = np.float32(1e-6)  # metres: a ray may end where it starts, in a crease
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
    key: NDArray[np.int64]  #: (size,) -1 is empty; size is a power of two
    begin: NDArray[np.int32]  #: (size + 1,) see `record`; list of slot s is ``begin[s]:end[s]``
    end: NDArray[np.int32]
    record: NDArray[np.int32]


@parallel_kernel
def record_sums(  # type: ignore[no-untyped-def]
    radiance, distance, shading_normal, stream, seed, n_theta, n_phi, irradiance, by_turn, by_move, spread
):
    """Irradiance and its gradients from stratified hemispheres (`record_rays.trace_hemispheres`).

    Ward and Heckbert 1992, equations 3 and 4, with the signs and weights that finite differences confirm.

    Parameters
    ----------
    radiance : (n, n_rays, C) float32
    distance : (n, n_rays) float32
    irradiance : (n, C) float32, out
    by_turn, by_move : (n, C, 3) float32, out
        Change with ``normal x other normal``, and with place, metres, both in world space.
    spread : (n, 3) float32, out
        Harmonic mean of the distances, and the least of them but for grazing rays; metres, inf if there is nothing.
        Relative standard error of the irradiance, as neighbouring rays differ: too large where light varies smoothly.
    """
    for r in prange(len(stream)):
        _sums_of_record(
            r,
            radiance,
            distance,
            shading_normal,
            turn_of(hash_combine(seed, stream[r])),
            n_theta,
            n_phi,
            irradiance,
            by_turn,
            by_move,
            spread,
        )


@kernel
def _sums_of_record(  # type: ignore[no-untyped-def]
    r, radiance, distance, shading_normal, first_turn, n_theta, n_phi, irradiance, by_turn, by_move, spread
):
    n_channels = radiance.shape[2]
    nx, ny, nz = shading_normal[r, 0], shading_normal[r, 1], shading_normal[r, 2]
    tx, ty, tz, bx, by, bz = basis(nx, ny, nz)
    m, n = n_theta, n_phi
    closeness, nearest = 0.0, np.inf
    for j in range(m):
        for k in range(n):
            d = distance[r, j * n + k]
            closeness += 1.0 / max(d, np.float32(1e-30))
            if (j + 0.5) / m < _HIGH:
                nearest = min(nearest, d)
    spread[r, 0] = m * n / closeness if closeness > 0.0 else np.inf
    spread[r, 1] = nearest
    slope, low, width = np.empty(m), np.empty(m), np.empty(m)
    for j in range(m):
        u = (j + 0.5) / m
        slope[j] = np.sqrt(u / (1.0 - u))
        low[j] = (1.0 - j / m) * np.sqrt(j / m) * (2.0 * np.pi / n)
        width[j] = np.sqrt((j + 1) / m) - np.sqrt(j / m)
    unlike = 0.0
    total, turn, move = np.zeros(n_channels), np.zeros((n_channels, 2)), np.zeros((n_channels, 2))
    for k in range(n):
        phi = 2.0 * np.pi * ((k + 0.5) / n + first_turn)
        edge = 2.0 * np.pi * (k / n + first_turn)
        across, along = np.cos(phi), np.sin(phi)
        edge_across, edge_along = np.cos(edge), np.sin(edge)
        before = k - 1 if k > 0 else n - 1
        for j in range(m):
            ray, beside, inside = j * n + k, j * n + before, max(j - 1, 0) * n + k
            d = distance[r, ray]
            outwards = low[j] / max(min(d, distance[r, inside]), _TOUCHING)
            around = width[j] / max(min(d, distance[r, beside]), _TOUCHING)
            step = 0.0
            for c in range(n_channels):
                value = np.float64(radiance[r, ray, c])
                step += value - radiance[r, beside, c]
                total[c] += value
                turn[c, 0] -= along * slope[j] * value
                turn[c, 1] += across * slope[j] * value
                out = outwards * (value - radiance[r, inside, c])
                turned = around * (value - radiance[r, beside, c])
                move[c, 0] += across * out - edge_along * turned
                move[c, 1] += along * out + edge_across * turned
            unlike += step * step
    light = 0.0
    for c in range(n_channels):
        light += total[c]
    spread[r, 2] = np.sqrt(0.5 * unlike) / light if light > 0.0 else 0.0
    share = np.pi / (m * n)
    for c in range(n_channels):
        irradiance[r, c] = share * total[c]
        a, b = share * turn[c, 0], share * turn[c, 1]
        by_turn[r, c, 0] = a * tx + b * bx
        by_turn[r, c, 1] = a * ty + b * by
        by_turn[r, c, 2] = a * tz + b * bz
        by_move[r, c, 0] = move[c, 0] * tx + move[c, 1] * bx
        by_move[r, c, 1] = move[c, 0] * ty + move[c, 1] * by
        by_move[r, c, 2] = move[c, 0] * tz + move[c, 1] * bz


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
        out[i] = _clamped(i, position, reach, old)


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
    size = 2.0**level
    i, j, k = np.int64(np.floor(x / size)), np.int64(np.floor(y / size)), np.int64(np.floor(z / size))
    mask = np.int64((1 << 18) - 1)
    return ((np.int64(level) + 64) << 54) | ((i & mask) << 36) | ((j & mask) << 18) | (k & mask)


@kernel
def _slot_of(key, table):  # type: ignore[no-untyped-def]
    """Slot of a key, or the empty one where it would be."""
    mask = np.int64(len(table) - 1)
    word = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    slot = np.int64(word >> np.uint64(20)) & mask
    while table[slot] != _EMPTY and table[slot] != key:
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
def fill_hash(keys, table, begin, end):  # type: ignore[no-untyped-def]
    """Enter ascending `keys`, equal ones as one list."""
    n = len(keys)
    e = 0
    while e < n:
        last = e + 1
        while last < n and keys[last] == keys[e]:
            last += 1
        slot = _slot_of(keys[e], table)
        table[slot] = keys[e]
        begin[slot] = e
        end[slot] = last
        e = last


@kernel
def _weight(position, normal, reach, turn, trust, r, limit, x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Weight of a record at a place, 0 to 1; it ends smoothly where the record or the place's own limit does."""
    dx, dy, dz = x - position[r, 0], y - position[r, 1], z - position[r, 2]
    d2 = dx * dx + dy * dy + dz * dz
    far = min(reach[r], limit)
    if d2 >= far * far:
        return np.float32(0.0)
    mx, my, mz = normal[r, 0], normal[r, 1], normal[r, 2]
    turned = np.float32(1.0) - (nx * mx + ny * my + nz * mz)
    if turned >= turn[r]:
        return np.float32(0.0)
    height = np.float32(0.5) * (dx * (nx + mx) + dy * (ny + my) + dz * (nz + mz))
    if abs(height) > _STEP * far:
        return np.float32(0.0)
    # Turns count from the noise of float32 normals on.
    error = np.float32(np.sqrt(d2)) / far + np.float32(np.sqrt(max(turned, np.float32(0.0)) / turn[r]))
    if error >= np.float32(1.0):
        return np.float32(0.0)
    left = np.float32(1.0) - error
    return trust[r] * left


@parallel_kernel
def find_records(table, index, position, normal, limit, count, record, weight, coverage):  # type: ignore[no-untyped-def]
    """Records that reach each of m places, and weights that add up to 1.

    Parameters
    ----------
    table, index : RecordTable, RecordHash
    position, normal : (m, 3) float32
        World space; shading normals.
    limit : (m,) float32
        Metres beyond which no record can know the light of the place.
    count : (m,) int32, record : (m, MAX_ENTRIES) int32, weight : (m, MAX_ENTRIES) float32, out
    coverage : (m,) float32, out
        Sum of the weights before.
    """
    for p in prange(len(position)):
        _find_at(
            p,
            table.position,
            table.normal,
            table.reach,
            table.turn,
            table.trust,
            index.level,
            index.key,
            index.begin,
            index.end,
            index.record,
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
    p,
    at,
    facing,
    reach,
    turn,
    trust,
    levels,
    keys,
    begin,
    end,
    listed,
    position,
    normal,
    limit,
    count,
    record,
    weight,
    coverage,
):
    x, y, z = position[p, 0], position[p, 1], position[p, 2]
    nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
    n = 0
    total = np.float32(0.0)
    for q in range(len(levels)):
        slot = _slot_of(cell_key(levels[q], x, y, z), keys)
        if keys[slot] == _EMPTY:
            continue
        for e in range(begin[slot], end[slot]):
            r = listed[e]
            w = _weight(at, facing, reach, turn, trust, r, limit[p], x, y, z, nx, ny, nz)
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


@parallel_kernel
def list_casters(instance, local, number, listed):  # type: ignore[no-untyped-def]
    """Different casters of each row of rays.

    Parameters
    ----------
    instance : (n, n_rays) int32
        Of the surface that sends each ray its light, -1 for none.
    local : (n, n_rays) int16, out
        Place of it in the row's list, -1 for none.
    number : (n,) int32, listed : (n, n_rays) int32, out
    """
    for r in prange(instance.shape[0]):
        _list_row(r, instance, local, number, listed)


@kernel
def _list_row(r, instance, local, number, listed):  # type: ignore[no-untyped-def]
    n = 0
    last = 0
    for ray in range(instance.shape[1]):
        i = instance[r, ray]
        local[r, ray] = -1
        if i < 0:
            continue
        if n == 0 or listed[r, last] != i:
            last = 0
            while last < n and listed[r, last] != i:
                last += 1
            if last == n:
                listed[r, n] = i
                n += 1
        local[r, ray] = last
    number[r] = n


@parallel_kernel
def caster_sums(  # type: ignore[no-untyped-def]
    radiance, distance, local, begin, shading_normal, stream, seed, n_theta, n_phi, irradiance, by_turn, by_move
):
    """`record_sums` of the light of each caster alone.

    Parameters
    ----------
    radiance : (n, n_rays, C) float32
    local : (n, n_rays) int16, as of `list_casters`
    begin : (n,) int64
        Row of the first caster of each hemisphere in the outputs, which are zero before.
    irradiance : (m, C), by_turn, by_move : (m, C, 3) float32, out
    """
    for r in prange(len(stream)):
        _caster_sums_of_row(
            r,
            radiance,
            distance,
            local,
            begin[r],
            shading_normal,
            turn_of(hash_combine(seed, stream[r])),
            n_theta,
            n_phi,
            irradiance,
            by_turn,
            by_move,
        )


@kernel
def _caster_sums_of_row(  # type: ignore[no-untyped-def]
    r, radiance, distance, local, begin, shading_normal, first_turn, n_theta, n_phi, irradiance, by_turn, by_move
):
    tx, ty, tz, bx, by, bz = basis(shading_normal[r, 0], shading_normal[r, 1], shading_normal[r, 2])
    m, n = n_theta, n_phi
    n_channels = radiance.shape[2]
    share = np.pi / (m * n)
    slope, low, width = np.empty(m), np.empty(m), np.empty(m)
    for j in range(m):
        u = (j + 0.5) / m
        slope[j] = share * np.sqrt(u / (1.0 - u))
        low[j] = (1.0 - j / m) * np.sqrt(j / m) * (2.0 * np.pi / n)
        width[j] = np.sqrt((j + 1) / m) - np.sqrt(j / m)
    for k in range(n):
        phi = 2.0 * np.pi * ((k + 0.5) / n + first_turn)
        edge = 2.0 * np.pi * (k / n + first_turn)
        next_edge = 2.0 * np.pi * ((k + 1) / n + first_turn)
        across, along = np.cos(phi), np.sin(phi)
        before, after = (k - 1 if k > 0 else n - 1), (k + 1 if k + 1 < n else 0)
        for j in range(m):
            ray = j * n + k
            if local[r, ray] < 0:
                continue
            # A ray counts in the differences to the four beside it, with one sign or the other.
            d = distance[r, ray]
            out = 0.0
            if j > 0:
                out += low[j] / max(min(d, distance[r, ray - n]), _TOUCHING)
            if j + 1 < m:
                out -= low[j + 1] / max(min(d, distance[r, ray + n]), _TOUCHING)
            here = width[j] / max(min(d, distance[r, j * n + before]), _TOUCHING)
            there = width[j] / max(min(d, distance[r, j * n + after]), _TOUCHING)
            a = across * out - np.sin(edge) * here + np.sin(next_edge) * there
            b = along * out + np.cos(edge) * here - np.cos(next_edge) * there
            ga, gb = -along * slope[j], across * slope[j]
            row = begin + local[r, ray]
            for c in range(n_channels):
                value = np.float64(radiance[r, ray, c])
                irradiance[row, c] += share * value
                by_turn[row, c, 0] += value * (ga * tx + gb * bx)
                by_turn[row, c, 1] += value * (ga * ty + gb * by)
                by_turn[row, c, 2] += value * (ga * tz + gb * bz)
                by_move[row, c, 0] += value * (a * tx + b * bx)
                by_move[row, c, 1] += value * (a * ty + b * by)
                by_move[row, c, 2] += value * (a * tz + b * bz)
