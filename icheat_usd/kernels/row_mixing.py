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
    base: NDArray[np.int32]  #: (room,)
    payload: NDArray[np.int32]  #: (room,)


class PackedLists(NamedTuple):
    """The same, one list after another, rows ascending."""

    begin: NDArray[np.int32]  #: (n_bases * n_payloads + 1,)
    row: NDArray[np.int32]  #: (n_sums,)
    sum: NDArray[np.int32]  #: (n_sums,)


@kernel
def _find(lists, base, payload, row):  # type: ignore[no-untyped-def]
    p = lists.head[base, payload]
    while p >= 0 and lists.row[p] != row:
        p = lists.next[p]
    return p


@kernel
def _list_rows(lists, base, active, rows, weights, n, first_row, last_base):  # type: ignore[no-untyped-def]
    """Enter the rows (n_payloads, 4) of one place that are not there yet; returns `n`, -1 for want of room.

    `last_base` is, for each row of each payload, the base that it was last seen to be listed for.
    """
    for payload in range(rows.shape[0]):
        if active[payload] == 0:
            continue
        for s in range(rows.shape[1]):
            row = rows[payload, s]
            if row < 0 or weights[payload, s] == np.float32(0.0) or last_base[first_row[payload] + row] == base:
                continue
            if _find(lists, base, payload, row) >= 0:
                last_base[first_row[payload] + row] = base
                continue
            if n == len(lists.row):
                return -1
            lists.row[n] = row
            lists.next[n] = lists.head[base, payload]
            lists.base[n] = base
            lists.payload[n] = payload
            lists.head[base, payload] = n
            n += 1
    return n


@kernel
def list_sums(  # type: ignore[no-untyped-def]
    first, pair_begin, place, which, begin, entry, slot, first_row, active, rows, weights, lists, n
):
    """Enter the sums that places ask of records `first` on; returns where it ended for want of room, and `n`.

    Parameters
    ----------
    pair_begin : (n_records + 1,) int64, place : (n_pairs,) int64
        As of `record_slots.list_pairs`: places of each record.
    which, begin, entry : as of `record_mixtures.mark_records`
    slot : (n_sets, n_records) int32
        Base of each record.
    first_row : (n_payloads + 1,) int64
        Rows of the payloads before each.
    active : (n_sets, n_payloads) uint8
    rows, weights : (m, n_payloads, 4)
        Of the places.
    n : int
        Sums so far.
    """
    last_base = np.full(first_row[-1], -1, np.int32)
    for r in range(first, len(pair_begin) - 1):
        last = np.int64(-1)
        for e in range(pair_begin[r], pair_begin[r + 1]):
            q = place[e]
            # Neighbours mostly ask for the same.
            if last >= 0 and which[q] == which[last] and _is_same(rows, weights, q, last):
                continue
            last = q
            for i in range(begin[which[q]], begin[which[q] + 1]):
                one = entry[i]
                found = _list_rows(lists, slot[one, r], active[one], rows[q], weights[q], n, first_row, last_base)
                if found < 0:
                    return r, len(lists.row)
                n = found
    return len(pair_begin) - 1, n


@kernel
def _is_same(rows, weights, a, b):  # type: ignore[no-untyped-def]
    for payload in range(rows.shape[1]):
        for s in range(rows.shape[2]):
            if rows[a, payload, s] != rows[b, payload, s]:
                return False
            if (weights[a, payload, s] == np.float32(0.0)) != (weights[b, payload, s] == np.float32(0.0)):
                return False
    return True


@kernel
def list_own(first, bases, first_row, active, rows, weights, lists, n):  # type: ignore[no-untyped-def]
    """`list_sums` of rows that belong to bases themselves: those from ``bases[first]`` on, (n_bases, n_payloads, 4)."""
    last_base = np.full(first_row[-1], -1, np.int32)
    for i in range(first, len(bases)):
        found = _list_rows(lists, bases[i], active[i], rows[i], weights[i], n, first_row, last_base)
        if found < 0:
            return i, len(lists.row)
        n = found
    return len(bases), n


@kernel
def pack_lists(lists, begin, row, number):  # type: ignore[no-untyped-def]
    """Fill `PackedLists`."""
    n_payloads, n = lists.head.shape[1], 0
    begin[0] = 0
    for base in range(lists.head.shape[0]):
        for payload in range(n_payloads):
            first = n
            p = lists.head[base, payload]
            while p >= 0:
                k = n
                while k > first and row[k - 1] > lists.row[p]:
                    row[k], number[k] = row[k - 1], number[k - 1]
                    k -= 1
                row[k], number[k] = lists.row[p], p
                n += 1
                p = lists.next[p]
            begin[base * n_payloads + payload + 1] = n


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
    lists : PackedLists
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
                    at_list = base * rows.shape[1] + payload
                    i, end_of_list = lists.begin[at_list], lists.begin[at_list + 1]
                    for s in range(rows.shape[2]):
                        row, w = rows[q, payload, s], weights[q, payload, s]
                        if row < 0 or w == np.float32(0.0):
                            continue
                        k_row = _place_in(lists.row, i, end_of_list, row)
                        sum_at = sums_at + 64 * np.int64(lists.sum[k_row])
                        light = simd.multiply_add(simd.spread(w), simd.load(sum_at), light)
                simd.store(mixed_at, light)
                w = weight[p, k] * share[e]
                total_r += w * _value(mixed, 0, turn_t, turn_b, move_t, move_b)
                total_g += w * _value(mixed, 5, turn_t, turn_b, move_t, move_b)
                total_b += w * _value(mixed, 10, turn_t, turn_b, move_t, move_b)
        out[q, 0], out[q, 1], out[q, 2] = total_r, total_g, total_b


@kernel
def _place_in(ascending, first, end, row):  # type: ignore[no-untyped-def]
    """Where a row is listed: how many rows of the list are below it, which no branch needs to guess."""
    n = first
    for i in range(first, end):
        n += np.int32(ascending[i] < row)
    return n


@kernel
def _value(lanes, first, turn_t, turn_b, move_t, move_b):  # type: ignore[no-untyped-def]
    value = lanes[first] + turn_t * lanes[first + 1] + turn_b * lanes[first + 2]
    return value + move_t * lanes[first + 3] + move_b * lanes[first + 4]
