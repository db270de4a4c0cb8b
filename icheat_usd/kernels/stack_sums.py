"""What a stack of edits that know nothing but masks makes of records' light, for receivers of given masks.

Beside the change of a record's light comes its derivative by each mask that varies from place to place, so that the
places around, whose masks are a little different, need no record of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.mask_table import MaskTable
from icheat_usd.kernels.record_lanes import LANES, add_change
from icheat_usd.kernels.simd import (
    address_of,
    black,
    color_add,
    color_of,
    color_product,
    difference,
    load_color,
    scale_add,
    scaled,
    store_color,
)

#: Casters whose edits are remembered while the light of a record is looked at.
_HELD = 8


class StackTable(NamedTuple):
    """Edits as lines: a weight w takes each channel x to ``(1 + slope w) x + shift w``; keys of an edit are summed."""

    edit: NDArray[np.int32]  #: (n_rows,) edit that a row is a key of, ascending
    slope: NDArray[np.float32]  #: (n_rows, n_blocks, 4) by group of lights, and for what is added to all light
    shift: NDArray[np.float32]  #: (n_rows, n_blocks, 4)
    start: NDArray[np.float32]  #: (n_blocks, 4) x before all edits: 1 for S, 0 for E


class SlotTable(NamedTuple):
    """Masks of receivers that records' light is wanted for."""

    begin: NDArray[np.int64]  #: (n_records + 1,) slots of each record
    masks: NDArray[np.float32]  #: (n_slots, n_rows)
    pattern: NDArray[np.int32]  #: (n_slots,)
    place: NDArray[np.int16]  #: (n_patterns, n_rows) place of the derivative by a mask among the slot's, -1 for none
    derived: NDArray[np.int64]  #: (n_slots + 1,) first derivative of each slot


class Edits(NamedTuple):
    """What is asked of a stack, and the masks that it is asked for; parallel loops are given its parts."""

    casters: MaskTable
    column: NDArray[np.int64]  #: (n_entries,) column of each entry of `casters` in painted weights, -1 for none
    factor: NDArray[np.float32]  #: (n_entries,) what that is multiplied by, or the weight itself
    stack: StackTable
    slots: SlotTable


class Lines(NamedTuple):
    """Edits that act on the last few casters, up to n_rows of each, for the slots of one record.

    Compiled loops read these arrays by themselves, as to look into a tuple again and again took half the time. What
    they know by its address alone lives here, so that it lives as long.
    """

    caster: NDArray[np.int64]  #: (_HELD,) instance, -1 for none
    number: NDArray[np.int64]  #: (_HELD,) edits that act on it
    is_last: NDArray[np.uint8]  #: (_HELD * n_rows,) whether no other key of the edit follows
    column: NDArray[np.int64]  #: (_HELD * n_rows,) of the weights of painted masks, -1 for none
    weight: NDArray[np.float32]  #: (_HELD * n_rows,) factor on that, or the weight itself
    row: NDArray[np.int64]  #: (_HELD * n_rows,)
    at_hit: NDArray[np.float32]  #: (n_rows,) weights of one entry
    past: NDArray[np.float32]  #: (n_rows, 4) x before each edit
    factor: NDArray[np.float32]  #: (n_rows, 4) what it was multiplied by
    slope: NDArray[np.float32]  #: (n_rows, 4) derivative of the change by the receiver's mask of each
    to: NDArray[np.int64]  #: (n_rows,) place of that among the slot's, -1 for none
    line: NDArray[np.float32]  #: (n_rows, n_blocks, 2, 4) slope and shift
    own: NDArray[np.float32]  #: (_HELD, n_slots, n_blocks, n_rows, 2, 4) slope and shift times the masks of each slot


@kernel
def no_lines(n_slots, stack):  # type: ignore[no-untyped-def]
    """Room for the edits of one record after the other, none of which has more slots."""
    n_rows, n_blocks = stack.slope.shape[0], stack.slope.shape[1]
    line = np.empty((n_rows, n_blocks, 2, 4), np.float32)
    line[:, :, 0] = stack.slope
    line[:, :, 1] = stack.shift
    n = _HELD * n_rows
    return Lines(
        np.full(_HELD, -1, np.int64),
        np.empty(_HELD, np.int64),
        np.empty(n, np.uint8),
        np.empty(n, np.int64),
        np.empty(n, np.float32),
        np.empty(n, np.int64),
        np.empty(n_rows, np.float32),
        np.empty((n_rows, 4), np.float32),
        np.empty((n_rows, 4), np.float32),
        np.empty((n_rows, 4), np.float32),
        np.empty(n_rows, np.int64),
        line,
        np.empty((_HELD, n_slots, n_blocks, n_rows, 2, 4), np.float32),
    )


@kernel
def _hold(i, first, end, edits, lines):  # type: ignore[no-untyped-def]
    """Keep the edits that act on an instance, and that receivers of the slots are in or would be nearby."""
    casters, column, factor, stack, slots = edits.casters, edits.column, edits.factor, edits.stack, edits.slots
    held, n_rows, n_blocks = i % _HELD, len(stack.edit), stack.slope.shape[1]
    n, edit = 0, -1
    for e in range(casters.begin[i], casters.begin[i + 1]):
        row = casters.row[e]
        acts = False
        for s in range(first, end):
            acts |= slots.masks[s, row] != np.float32(0.0) or slots.place[slots.pattern[s], row] >= 0
        if not acts:
            continue
        q = held * n_rows + n
        if stack.edit[row] == edit:
            lines.is_last[q - 1] = 0
        edit = stack.edit[row]
        lines.is_last[q], lines.row[q], lines.weight[q], lines.column[q] = 1, row, factor[e], column[e]
        for s in range(first, end):
            for block in range(n_blocks):
                for c in range(4):
                    lines.own[held, s - first, block, n, 0, c] = slots.masks[s, row] * stack.slope[row, block, c]
                    lines.own[held, s - first, block, n, 1, c] = slots.masks[s, row] * stack.shift[row, block, c]
        n += 1
    lines.caster[held], lines.number[held] = i, n


@kernel
def _has_shifts(stack):  # type: ignore[no-untyped-def]
    """Whether an edit adds anything to what it does not multiply."""
    for value in stack.shift.reshape(-1):
        if value != np.float32(0.0):
            return True
    return False


@kernel
def _composed(own_0, shifts, is_last, base, n, weight, start, past_0, factor_0):  # type: ignore[no-untyped-def]
    """Change of a block of S or E by `n` edits, whose lines are at an address; what derivatives need goes to others."""
    one = color_of(np.float32(1.0), np.float32(1.0), np.float32(1.0))
    x, a, b = start, one, black()
    for q in range(n):
        a = scale_add(load_color(own_0 + 32 * q), weight[q], a)
        if shifts:
            b = scale_add(load_color(own_0 + 32 * q + 16), weight[q], b)
        store_color(past_0 + 16 * q, x)
        store_color(factor_0 + 16 * q, a)
        if is_last[base + q]:
            x = color_add(a, x, b)
            a, b = one, black()
    return difference(x, start)


@kernel
def _derive(line_0, step, row, place, pattern, is_last, base, n, weight, past_0, factor_0, slope_0, to):  # type: ignore[no-untyped-def]
    """Derivatives of a change by masks of the receiver, after `_composed`: where they belong, and at an address.

    `line_0` is the address of a block's slope in the first row, `step` the bytes from one row's to the next; `pattern`
    is where places of derivatives begin.
    """
    one = color_of(np.float32(1.0), np.float32(1.0), np.float32(1.0))
    after, before = one, one
    for k in range(n):
        q = n - 1 - k
        if is_last[base + q]:
            after = before
            before = color_product(after, load_color(factor_0 + 16 * q))
        to[q] = np.int64(place[pattern + row[base + q]])
        if to[q] >= 0:
            line = line_0 + step * row[base + q]
            own = color_add(load_color(line), load_color(past_0 + 16 * q), load_color(line + 16))
            store_color(slope_0 + 16 * q, color_product(scaled(own, weight[q]), after))


@parallel_kernel
def stack_of_casters(  # type: ignore[no-untyped-def]
    begin, entry, caster, weights, light, casters, column, factor, stack, slots, records, values, derivative
):
    """Change of the light of slots, where casters differ in nothing but their instances and painted weights.

    Parameters
    ----------
    begin : (n_records + 1,) int64, entry : (m,) int64
        Entries ``entry[begin[r]:begin[r + 1]]`` of each record.
    caster : (k,) int32, light : (k, n_blocks, LANES) float32
        Light by caster: `merged_rays.merge_rays`.
    weights : (k, width) float32
        Painted weights that it meets.
    casters, column, factor, stack, slots
        `Edits`.
    records : (k,) int64
        Records with slots.
    values : (n_slots, LANES), derivative : (n_derivatives, LANES) float32, out, added to
    """
    for g in prange(len(records)):
        r = records[g]
        edits = Edits(casters, column, factor, stack, slots)
        lines = no_lines(slots.begin[r + 1] - slots.begin[r], stack)
        stack_of_record(r, lines, begin[r], begin[r + 1], entry, caster, weights, light, edits, values, derivative)


@kernel
def stack_of_record(  # type: ignore[no-untyped-def]
    r, lines, begin, end_of_entries, entry, caster, weights, light, edits, values, derivative
):
    """`stack_of_casters` of record `r` alone, whose entries are ``entry[begin:end_of_entries]``; `lines` is scratch."""
    stack, slots = edits.stack, edits.slots
    first, end = slots.begin[r], slots.begin[r + 1]
    n_rows, n_blocks, room = stack.slope.shape[0], stack.slope.shape[1], lines.own.shape[1]
    lines.caster[:] = -1
    number, is_last, row, on_caster = lines.number, lines.is_last, lines.row, lines.weight
    place, weight, painted, held_caster = slots.place.reshape(-1), lines.at_hit, lines.column, lines.caster
    past_0, factor_0 = address_of(lines.past), address_of(lines.factor)
    slope_0, to_place = address_of(lines.slope), lines.to
    own_0, line_0 = address_of(lines.own), address_of(lines.line)
    shifts = _has_shifts(stack)
    light_0, values_0, start_0 = address_of(light), address_of(values), address_of(stack.start)
    derivative_0 = address_of(derivative)
    for place_of_e in range(begin, end_of_entries):
        e = entry[place_of_e]
        i = np.int64(caster[e])
        held = i % _HELD
        if held_caster[held] != i:
            _hold(i, first, end, edits, lines)
        n, base = number[held], held * n_rows
        acts = False
        for q in range(n):
            own_weight = on_caster[base + q]
            if painted[base + q] >= 0:
                own_weight *= weights[e, painted[base + q]]
            weight[q] = own_weight
            acts |= own_weight != np.float32(0.0)
        if not acts:
            continue
        for s in range(first, end):
            for block in range(n_blocks):
                own = own_0 + 32 * n_rows * ((held * room + s - first) * n_blocks + block)
                start = load_color(start_0 + 16 * block)
                change = _composed(own, shifts, is_last, base, n, weight, start, past_0, factor_0)
                at = light_0 + 4 * LANES * (e * light.shape[1] + block)
                add_change(values_0 + 4 * LANES * s, change, at)
                if slots.derived[s] < slots.derived[s + 1]:
                    _derive(
                        line_0 + 32 * block,
                        32 * n_blocks,
                        row,
                        place,
                        n_rows * slots.pattern[s],
                        is_last,
                        base,
                        n,
                        weight,
                        past_0,
                        factor_0,
                        slope_0,
                        to_place,
                    )
                    for q in range(n):
                        if to_place[q] >= 0:
                            own = derivative_0 + 4 * LANES * (slots.derived[s] + to_place[q])
                            add_change(own, load_color(slope_0 + 16 * q), at)
