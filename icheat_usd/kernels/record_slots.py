"""Slots: masks of receivers that the edited light of a cache record is found for, and light at places from these.

Places whose masks are near those of a slot share it: the light there is that of the slot plus its derivatives by the
masks that differ. Whatever one mask makes of light is a straight line; what two of them make together bends it.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.record_lanes import LANES
from icheat_usd.kernels.simd import (
    address_of,
    black,
    channel,
    color_product,
    difference,
    load,
    load_color,
    load_one,
    multiply_add,
    plus_size,
    product,
    sixteen_of,
    spread,
    store_rgb,
    sum_of_fives,
    zeros,
)

#: New slots of one record from one call, beyond which places take the nearest.
MOST_SLOTS = 32
_CHUNK = 256  # places


@kernel
def list_pairs(count, record, where, is_wanted, begin, pair, place):  # type: ignore[no-untyped-def]
    """Pairs of m places and their records that are wanted, by record; those of one record stay in order.

    Parameters
    ----------
    count : (n,) int32, record : (n, MAX_ENTRIES) int32
        As of `irradiance_cache.find_records`.
    where : (m,) int64
        Places that are looked at.
    is_wanted : (n_pairs,) bool
        By place.
    begin : (n_records + 1,) int64, out
        Pairs of each record.
    pair : (n_wanted,) int64, out
        Number of each among all pairs.
    place : (n_wanted,) int64, out
        Which of `where` it is of.
    """
    begin[:] = 0
    n = 0
    for q in range(len(where)):
        for k in range(count[where[q]]):
            begin[record[where[q], k] + 1] += is_wanted[n]
            n += 1
    for r in range(len(begin) - 1):
        begin[r + 1] += begin[r]
    n = 0
    for q in range(len(where)):
        for k in range(count[where[q]]):
            if is_wanted[n]:
                e = begin[record[where[q], k]]
                pair[e], place[e] = n, q
                begin[record[where[q], k]] += 1
            n += 1
    for r in range(len(begin) - 1, 0, -1):
        begin[r] = begin[r - 1]
    begin[0] = 0


@kernel
def mark_records(count, record, where, pattern, needed):  # type: ignore[no-untyped-def]
    """Which records are asked in which patterns.

    Parameters
    ----------
    count, record, where : as of `list_pairs`
    pattern : (m,) int32
        Of each place.
    needed : (n_records, n_patterns) uint8, out
        Set to 1.
    """
    for q in range(len(where)):
        p = where[q]
        for k in range(count[p]):
            needed[record[p, k], pattern[q]] = 1


@parallel_kernel
def slots_of_pairs(count, record, where, pattern, known, first, slot):  # type: ignore[no-untyped-def]
    """Slot of every pair of a place and a record, by ``known[record, pattern]``; `first` as of `mix_slots`."""
    for q in prange(len(where)):
        p = where[q]
        for k in range(count[p]):
            slot[first[q] + k] = known[record[p, k], pattern[q]]


@kernel
def _change(a_0, b_0, bend_0, n):  # type: ignore[no-untyped-def]
    """How differently two rows of `n` masks at addresses act: sum of relative changes."""
    total = black()
    for q in range(0, 4 * (n - n % 4), 16):
        step = difference(load_color(a_0 + q), load_color(b_0 + q))
        total = plus_size(total, color_product(step, load_color(bend_0 + q)))
    change = (channel(total, 0) + channel(total, 1)) + (channel(total, 2) + channel(total, 3))
    for q in range(4 * (n - n % 4), 4 * n, 4):
        change += abs(load_one(a_0 + q) - load_one(b_0 + q)) * load_one(bend_0 + q)
    return change


@kernel
def _is_near(change, a_0, b_0, bend_0, n, most_change, most_bend):  # type: ignore[no-untyped-def]
    """Whether two rows of masks, `_change` apart, may share a slot."""
    if change > most_change:
        return False
    # Without what each mask does alone.
    bent = np.float32(0.5) * change * change
    for q in range(0, 4 * n, 4):
        own = (load_one(a_0 + q) - load_one(b_0 + q)) * load_one(bend_0 + q)
        bent -= np.float32(0.5) * own * own
    return bent <= most_bend


@parallel_kernel
def served_by_own(  # type: ignore[no-untyped-def]
    count,
    record,
    where,
    which,
    masks,
    pattern,
    own_masks,
    own_pattern,
    bend,
    most_change,
    most_bend,
    first,
    slot,
    is_used,
):
    """Which pairs of a place and a record are served by a slot with the masks of the record's own place.

    Parameters
    ----------
    count, record, where : as of `list_pairs`
    which : (m,) int64
        Column of masks of each place.
    masks : (k, n_rows) float32, pattern : (k,) int32
        Columns; those of different patterns never share a slot.
    own_masks : (n_records, n_rows) float32, own_pattern : (n_records,) int32
        Of the records' own places.
    bend : (n_rows,) float32
        Largest relative change of light by each row, 0 where masks do not vary within a pattern.
    most_change, most_bend : float
        Limits of the relative change between a place and its slot, and of what it misses of it.
    first : (m,) int64
        First pair of each place.
    slot : (n_pairs,) int64, out
        -1 for pairs that are, -2 for those that are not.
    is_used : (n_records,) uint8, out
        Set to 1 for records that a pair is served by.
    """
    for chunk in prange((len(where) + _CHUNK - 1) // _CHUNK):
        _serve(
            chunk * _CHUNK,
            where,
            which,
            first,
            count,
            record,
            masks,
            pattern,
            own_masks,
            own_pattern,
            bend,
            most_change,
            most_bend,
            slot,
            is_used,
        )


@kernel
def _serve(  # type: ignore[no-untyped-def]
    begin,
    where,
    which,
    first,
    count,
    record,
    masks,
    pattern,
    own_masks,
    own_pattern,
    bend,
    most_change,
    most_bend,
    slot,
    is_used,
):
    n, masks_0, own_0, bend_0 = len(bend), address_of(masks), address_of(own_masks), address_of(bend)
    # What changes so little bends no more than it may.
    straight = np.float32(min(most_change, np.sqrt(2.0 * most_bend)))
    for q in range(begin, min(begin + _CHUNK, len(where))):
        p, column = where[q], which[q]
        at = masks_0 + 4 * n * column
        for k in range(count[p]):
            r = record[p, k]
            slot[first[q] + k] = -2
            if own_pattern[r] == pattern[column]:
                own = own_0 + 4 * n * r
                change = _change(at, own, bend_0, n)
                if change <= straight or _is_near(change, at, own, bend_0, n, most_change, most_bend):
                    slot[first[q] + k] = -1
                    is_used[r] = 1


@parallel_kernel
def take_own(count, record, where, own_slot, first, slot):  # type: ignore[no-untyped-def]
    """Put the slots of the records' own places, (n_records,), where `served_by_own` left -1."""
    for q in prange(len(where)):
        p = where[q]
        for k in range(count[p]):
            if slot[first[q] + k] == -1:
                slot[first[q] + k] = own_slot[record[p, k]]


@parallel_kernel
def choose_slots(  # type: ignore[no-untyped-def]
    records,
    begin,
    which,
    masks,
    pattern,
    known_begin,
    known_slot,
    slot_masks,
    slot_pattern,
    bend,
    most_change,
    most_bend,
    centre,
):
    """Slots that pairs of places and records are served by.

    Parameters
    ----------
    records : (k,) int64
        Those with pairs, in any order.
    begin : (n_records + 1,) int64
        Pairs of each record.
    which : (n_pairs,) int64
        Column of masks of each.
    masks, pattern, bend, most_change, most_bend : as of `served_by_own`
    known_begin : (n_records + 1,) int64, known_slot : (n_slots,) int64
        Slots that there are already, by record.
    slot_masks : (n_slots, n_rows) float32, slot_pattern : (n_slots,) int32
    centre : (n_pairs,) int64, out
        Pair whose slot serves each, itself where it gets a new one; ``-1 - s`` for a known slot s.
    """
    for g in prange(len(records)):
        _choose(
            records[g],
            begin,
            which,
            masks,
            pattern,
            known_begin,
            known_slot,
            slot_masks,
            slot_pattern,
            bend,
            most_change,
            most_bend,
            centre,
        )


@kernel
def _choose(  # type: ignore[no-untyped-def]
    r,
    begin,
    which,
    masks,
    pattern,
    known_begin,
    known_slot,
    slot_masks,
    slot_pattern,
    bend,
    most_change,
    most_bend,
    centre,
):
    new, n_new = np.empty(MOST_SLOTS, np.int64), 0
    n, masks_0, slots_0, bend_0 = len(bend), address_of(masks), address_of(slot_masks), address_of(bend)
    for e in range(begin[r], begin[r + 1]):
        column = which[e]
        own = masks_0 + 4 * n * column
        best, least = np.int64(e), np.float32(np.inf)
        is_near = False
        for k in range(known_begin[r], known_begin[r + 1]):
            s = known_slot[k]
            if slot_pattern[s] != pattern[column]:
                continue
            there = slots_0 + 4 * n * s
            change = _change(own, there, bend_0, n)
            if change < least:
                best, least = -1 - s, change
                is_near = _is_near(change, own, there, bend_0, n, most_change, most_bend)
                if is_near:
                    break
        q = 0
        while q < n_new and not is_near:
            other = which[new[q]]
            q += 1
            if pattern[other] != pattern[column]:
                continue
            there = masks_0 + 4 * n * other
            change = _change(own, there, bend_0, n)
            if change < least:
                best, least = new[q - 1], change
                is_near = _is_near(change, own, there, bend_0, n, most_change, most_bend)
        if not is_near and (n_new < MOST_SLOTS or best == e):
            best = np.int64(e)
            if n_new < MOST_SLOTS:
                new[n_new] = e
                n_new += 1
        centre[e] = best


@parallel_kernel
def rows_in(masks, acts, out):  # type: ignore[no-untyped-def]
    """Bits of the rows that act in columns of masks (k, n_rows), into words (k, n_words)."""
    for chunk in prange((len(masks) + _CHUNK - 1) // _CHUNK):
        _rows_of_some(chunk * _CHUNK, masks, acts, out)


@kernel
def _rows_of_some(begin, masks, acts, out):  # type: ignore[no-untyped-def]
    for k in range(begin, min(begin + _CHUNK, len(masks))):
        for word in range(out.shape[1]):
            found = np.uint64(0)
            for row in range(64 * word, min(64 * word + 64, masks.shape[1])):
                if masks[k, row] > np.float32(0.0) and acts[row]:
                    found |= np.uint64(1) << np.uint64(row & 63)
            out[k, word] = found


@parallel_kernel
def mix_slots(  # type: ignore[no-untyped-def]
    frame,
    values,
    derivative,
    derived,
    slot_masks,
    slot_pattern,
    soft_begin,
    soft_row,
    slot,
    position,
    normal,
    count,
    record,
    weight,
    where,
    which,
    masks,
    first_pair,
    out,
):
    """`irradiance_cache.interpolate` at m of n places, of each record's light in the slot for the place.

    Parameters
    ----------
    frame : (n_records, 16) float32
        As of `record_lanes.frames_of`.
    values : (n_slots, LANES), derivative : (n_derivatives, LANES) float32
    derived : (n_slots + 1,) int64
        Derivatives of each slot, by the rows ``soft_row[soft_begin[p]:soft_begin[p + 1]]`` of its pattern p.
    slot : (n_pairs,) int64
        Slot of each pair of a place and a record.
    masks : (k, n_rows) float32
    first : (m,) int64
        First pair of each place.
    out : (m, 3) float32
    """
    for chunk in prange((len(where) + _CHUNK - 1) // _CHUNK):
        _mix_some(
            chunk * _CHUNK,
            frame,
            values,
            derivative,
            derived,
            slot_masks,
            slot_pattern,
            soft_begin,
            soft_row,
            slot,
            position,
            normal,
            count,
            record,
            weight,
            where,
            which,
            masks,
            first_pair,
            out,
        )


@kernel
def _mix_some(  # type: ignore[no-untyped-def]
    begin,
    frame,
    values,
    derivative,
    derived,
    slot_masks,
    slot_pattern,
    soft_begin,
    soft_row,
    slot,
    position,
    normal,
    count,
    record,
    weight,
    where,
    which,
    masks,
    first_pair,
    out,
):
    values_0, derivative_0, out_0 = address_of(values), address_of(derivative), address_of(out)
    for q in range(begin, min(begin + _CHUNK, len(where))):
        p, column, first = where[q], which[q], first_pair[q]
        x, y, z = position[p, 0], position[p, 1], position[p, 2]
        nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
        total = zeros()
        for k in range(count[p]):
            r, s = record[p, k], slot[first + k]
            light = load(values_0 + 4 * LANES * s)
            if derived[s] < derived[s + 1]:
                pattern = slot_pattern[s]
                by = derivative_0 + 4 * LANES * (derived[s] - soft_begin[pattern])
                for e in range(soft_begin[pattern], soft_begin[pattern + 1]):
                    row = soft_row[e]
                    step = masks[column, row] - slot_masks[s, row]
                    light = multiply_add(spread(step), load(by + 4 * LANES * e), light)
            dx, dy, dz = x - frame[r, 0], y - frame[r, 1], z - frame[r, 2]
            mx, my, mz = frame[r, 3], frame[r, 4], frame[r, 5]
            cx, cy, cz = my * nz - mz * ny, mz * nx - mx * nz, mx * ny - my * nx
            taken = sixteen_of(
                np.float32(1.0),
                cx * frame[r, 6] + cy * frame[r, 7] + cz * frame[r, 8],
                cx * frame[r, 9] + cy * frame[r, 10] + cz * frame[r, 11],
                frame[r, 12] * (dx * frame[r, 6] + dy * frame[r, 7] + dz * frame[r, 8]),
                frame[r, 12] * (dx * frame[r, 9] + dy * frame[r, 10] + dz * frame[r, 11]),
            )
            total = multiply_add(product(light, taken), spread(weight[p, k]), total)
        store_rgb(out_0 + 12 * q, sum_of_fives(total))
