"""Sampled rows at camera samples: sums of `row_light` that they ask for, and how these are mixed by their weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels import simd
from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.samples import basis

#: Floats of a sum: for red, green and blue the irradiance, its change by two turns and by two moves; then a pad.
LANES = 16

_BLOCK = 256  # places that one thread mixes


class Lists(NamedTuple):
    """Sums that are kept: of each base (a record, and a set of edits that its receivers are in) and row."""

    head: NDArray[np.int32]  #: (n_bases, n_payloads) first sum of each payload's rows, -1 for none
    next: NDArray[np.int32]  #: (room,) -1 at the end
    row: NDArray[np.int32]  #: (room,)


@kernel
def _find(lists, base, payload, row):  # type: ignore[no-untyped-def]
    p = lists.head[base, payload]
    while p >= 0 and lists.row[p] != row:
        p = lists.next[p]
    return p


@kernel
def list_sums(  # type: ignore[no-untyped-def]
    first, count, record, where, which, begin, entry, slot, active, rows, weights, lists, base_of, payload_of, n
):
    """Enter the sums that places ask for, from place `first` on; returns where it ended for want of room, and `n`.

    Parameters
    ----------
    count, record, where, which, begin, entry : as of `record_mixtures.mark_records`
    slot : (n_sets, n_records) int32
        Base of each record.
    active : (n_sets, n_payloads) uint8
    rows, weights : (m, n_payloads, 4)
        Of the places.
    n : int
        Sums so far.
    """
    n_payloads, n_mixed = rows.shape[1], rows.shape[2]
    for q in range(first, len(where)):
        p = where[q]
        entries = range(begin[which[q]], begin[which[q] + 1])
        if n + len(entries) * count[p] * n_payloads * n_mixed > len(lists.row):
            return q, n
        for e in entries:
            for k in range(count[p]):
                base = slot[entry[e], record[p, k]]
                for payload in range(n_payloads):
                    if active[entry[e], payload] == 0:
                        continue
                    for s in range(n_mixed):
                        row = rows[q, payload, s]
                        if row < 0 or weights[q, payload, s] == np.float32(0.0):
                            continue
                        if _find(lists, base, payload, row) < 0:
                            lists.row[n] = row
                            lists.next[n] = lists.head[base, payload]
                            lists.head[base, payload] = n
                            base_of[n] = base
                            payload_of[n] = payload
                            n += 1
    return len(where), n


@kernel
def take_own(lists, bases, own_row, own_weight, sums, out):  # type: ignore[no-untyped-def]
    """Take from the light at records what their own rows bring: the mixture of a place brings its own instead."""
    for i in range(len(bases)):
        b = bases[i]
        for payload in range(own_row.shape[1]):
            for s in range(own_row.shape[2]):
                if own_row[i, payload, s] >= 0 and own_weight[i, payload, s] != np.float32(0.0):
                    p = _find(lists, b, payload, own_row[i, payload, s])
                    for k in range(LANES):
                        out[b, k] -= own_weight[i, payload, s] * sums[p, k]


@parallel_kernel
def mix_rows(  # type: ignore[no-untyped-def]
    at,
    facing,
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
    slot,
    active,
    lists,
    rows,
    weights,
    bases,
    sums,
    out,
):
    """Change of irradiance at m of n places, (m, 3): records' sums under the places' own rows, interpolated.

    Parameters
    ----------
    at, facing, position, normal, count, record, weight, where, which, begin, entry, share :
        as of `record_mixtures.mix_records`
    slot, active, rows, weights : as of `list_sums`
    bases : (n_bases, LANES), sums : (n_sums, LANES) float32
    """
    m = len(where)
    for block in prange((m + _BLOCK - 1) // _BLOCK):
        _mix_block(
            block * _BLOCK,
            min(m, (block + 1) * _BLOCK),
            at,
            facing,
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
            slot,
            active,
            lists,
            rows,
            weights,
            bases,
            sums,
            out,
        )


@kernel
def _mix_block(  # type: ignore[no-untyped-def]
    first,
    end,
    at,
    facing,
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
    slot,
    active,
    lists,
    rows,
    weights,
    bases,
    sums,
    out,
):
    mixed = np.empty(LANES, np.float32)
    mixed_at, bases_at, sums_at = simd.address_of(mixed), simd.address_of(bases), simd.address_of(sums)
    for q in range(first, end):
        p = where[q]
        total_r, total_g, total_b = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        for k in range(count[p]):
            r = record[p, k]
            dx, dy, dz = position[p, 0] - at[r, 0], position[p, 1] - at[r, 1], position[p, 2] - at[r, 2]
            mx, my, mz = facing[r, 0], facing[r, 1], facing[r, 2]
            nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
            cx, cy, cz = my * nz - mz * ny, mz * nx - mx * nz, mx * ny - my * nx
            tx, ty, tz, bx, by, bz = basis(mx, my, mz)
            turn_t, turn_b = cx * tx + cy * ty + cz * tz, cx * bx + cy * by + cz * bz
            move_t, move_b = dx * tx + dy * ty + dz * tz, dx * bx + dy * by + dz * bz
            for e in range(begin[which[q]], begin[which[q] + 1]):
                one = entry[e]
                base = np.int64(slot[one, r])
                light = simd.load(bases_at + 64 * base)
                for payload in range(rows.shape[1]):
                    if active[one, payload] == 0:
                        continue
                    for s in range(rows.shape[2]):
                        w = weights[q, payload, s]
                        if rows[q, payload, s] >= 0 and w != np.float32(0.0):
                            found = np.int64(_find(lists, base, payload, rows[q, payload, s]))
                            light = simd.multiply_add(simd.spread(w), simd.load(sums_at + 64 * found), light)
                simd.store(mixed_at, light)
                w = weight[p, k] * share[e]
                total_r += w * _value(mixed, 0, turn_t, turn_b, move_t, move_b)
                total_g += w * _value(mixed, 5, turn_t, turn_b, move_t, move_b)
                total_b += w * _value(mixed, 10, turn_t, turn_b, move_t, move_b)
        out[q, 0], out[q, 1], out[q, 2] = total_r, total_g, total_b


@kernel
def _value(lanes, first, turn_t, turn_b, move_t, move_b):  # type: ignore[no-untyped-def]
    value = lanes[first] + turn_t * lanes[first + 1] + turn_b * lanes[first + 2]
    return value + move_t * lanes[first + 3] + move_b * lanes[first + 4]
