"""Edited light of camera samples from cache records, whose light is known for sets of edits."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

_INVERSE_PI = np.float32(1.0 / np.pi)


@kernel
def mark_records(count, record, where, which, begin, entry, needed):  # type: ignore[no-untyped-def]
    """Which records are asked in which sets of edits.

    Parameters
    ----------
    count : (n,) int32, record : (n, MAX_ENTRIES) int32
        As of `irradiance_cache.find_records`.
    where : (m,) int64
        Places that are looked at.
    which : (m,) int64
        Column of masks of each.
    begin : (k + 1,) int64, entry : (n_entries,) int32
        Sets that each column is mixed from.
    needed : (n_sets, n_records) uint8, out
        Set to 1.
    """
    for q in range(len(where)):
        p = where[q]
        for e in range(begin[which[q]], begin[which[q] + 1]):
            one = entry[e]
            for k in range(count[p]):
                needed[one, record[p, k]] = 1


@parallel_kernel
def lay_change(base, albedo, where, change, number, light):  # type: ignore[no-untyped-def]
    """Light of m of n places with a change of their irradiance.

    Parameters
    ----------
    base, albedo : (n, 3) float32
        Radiance without the change.
    where : (m,) int64, change : (m, 3) float32
    number : (m,) int64
        Rows of `light` that they go to.
    light : (k, 3) float32, out
    """
    for q in prange(len(where)):
        p, to = where[q], number[q]
        for c in range(3):
            light[to, c] = base[p, c] + albedo[p, c] * (change[q, c] * _INVERSE_PI)


@parallel_kernel
def lay_positive(light, where, out):  # type: ignore[no-untyped-def]
    """Put light (m, 3), or 0 where it is less, into rows `where` (m,) of `out` (n, 3)."""
    for q in prange(len(where)):
        for c in range(3):
            own = light[q, c]
            out[where[q], c] = np.float32(0.0) if own < np.float32(0.0) else own


@parallel_kernel
def mix_records(  # type: ignore[no-untyped-def]
    at,
    facing,
    irradiance,
    by_turn,
    by_move,
    slot,
    position,
    normal,
    count,
    record,
    weight,
    where,
    which,
    begin,
    entry,
    share,
    out,
):
    """`irradiance_cache.interpolate` at m of n places, of values that are mixed for each place.

    Parameters
    ----------
    slot : (n_sets, n_records) int32
        Rows of the records' values in each set.
    where, which, begin, entry : as of `mark_records`
    share : (n_entries,) float32
        Of each set in a column.
    out : (m, 3) float32
    """
    for q in prange(len(where)):
        _mix_at(
            np.int64(q),
            where[q],
            at,
            facing,
            irradiance,
            by_turn,
            by_move,
            slot,
            position,
            normal,
            count,
            record,
            weight,
            begin[which[q]],
            begin[which[q] + 1],
            entry,
            share,
            out,
        )


@kernel
def _mix_at(  # type: ignore[no-untyped-def]
    q,
    p,
    at,
    facing,
    irradiance,
    by_turn,
    by_move,
    slot,
    position,
    normal,
    count,
    record,
    weight,
    first,
    end,
    entry,
    share,
    out,
):
    total_r, total_g, total_b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
    for k in range(count[p]):
        r = record[p, k]
        dx, dy, dz = position[p, 0] - at[r, 0], position[p, 1] - at[r, 1], position[p, 2] - at[r, 2]
        mx, my, mz = facing[r, 0], facing[r, 1], facing[r, 2]
        tx, ty, tz = my * nz - mz * ny, mz * nx - mx * nz, mx * ny - my * nx
        for e in range(first, end):
            s = slot[entry[e], r]
            w = weight[p, k] * share[e]
            total_r += w * _value(irradiance, by_turn, by_move, s, 0, dx, dy, dz, tx, ty, tz)
            total_g += w * _value(irradiance, by_turn, by_move, s, 1, dx, dy, dz, tx, ty, tz)
            total_b += w * _value(irradiance, by_turn, by_move, s, 2, dx, dy, dz, tx, ty, tz)
    out[q, 0], out[q, 1], out[q, 2] = total_r, total_g, total_b


@kernel
def _value(irradiance, by_turn, by_move, s, c, dx, dy, dz, tx, ty, tz):  # type: ignore[no-untyped-def]
    value = irradiance[s, c]
    value += tx * by_turn[s, c, 0] + ty * by_turn[s, c, 1] + tz * by_turn[s, c, 2]
    value += dx * by_move[s, c, 0] + dy * by_move[s, c, 1] + dz * by_move[s, c, 2]
    return value
