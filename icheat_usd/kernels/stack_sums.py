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
from icheat_usd.kernels.caster_sums import N_VALUES, add_weighted, ray_weights, turn_to_world
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.simd import (
    address_of,
    black,
    color_add,
    color_of,
    color_product,
    difference,
    load_color,
    load_rgb,
    scale_add,
    scaled,
    store_color,
)
from icheat_usd.kernels.texels import corner_texels, texel_weight

#: Casters whose edits are remembered while the rays of a record are looked at.
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


class _Lines(NamedTuple):
    """Edits that act on the last few casters, up to n_rows of each, for the slots of one record.

    Compiled loops read these arrays by themselves, as to look into a tuple for every ray took half the time. What
    they know by its address alone lives here, so that it lives as long.
    """

    caster: NDArray[np.int64]  #: (_HELD,) instance, -1 for none
    number: NDArray[np.int64]  #: (_HELD,) edits that act on it
    is_last: NDArray[np.uint8]  #: (_HELD * n_rows,) whether no other key of the edit follows
    painted: NDArray[np.int64]  #: (_HELD * n_rows,) first texel of the instance in the mask, -1 for none
    resolution: NDArray[np.int64]  #: (_HELD * n_rows,)
    weight: NDArray[np.float32]  #: (_HELD * n_rows,) all over the instance
    row: NDArray[np.int64]  #: (_HELD * n_rows,)
    at_hit: NDArray[np.float32]  #: (n_rows,) weights where a ray ends
    past: NDArray[np.float32]  #: (n_rows, 4) x before each edit
    factor: NDArray[np.float32]  #: (n_rows, 4) what it was multiplied by
    slope: NDArray[np.float32]  #: (n_rows, 4) derivative of the change by the receiver's mask of each
    to: NDArray[np.int64]  #: (n_rows,) place of that among the slot's, -1 for none
    line: NDArray[np.float32]  #: (n_rows, n_blocks, 2, 4) slope and shift
    own: NDArray[np.float32]  #: (_HELD, n_slots, n_blocks, n_rows, 2, 4) slope and shift times the masks of each slot


@kernel
def _no_lines(n_slots, stack):  # type: ignore[no-untyped-def]
    n_rows, n_blocks = stack.slope.shape[0], stack.slope.shape[1]
    line = np.empty((n_rows, n_blocks, 2, 4), np.float32)
    line[:, :, 0] = stack.slope
    line[:, :, 1] = stack.shift
    n = _HELD * n_rows
    return _Lines(
        np.full(_HELD, -1, np.int64),
        np.zeros(_HELD, np.int64),
        np.empty(n, np.uint8),
        np.empty(n, np.int64),
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
def _hold(i, first, end, casters, stack, slots, lines):  # type: ignore[no-untyped-def]
    """Keep the edits that act on an instance, and that receivers of the slots are in or would be nearby."""
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
        mask = casters.mask[e]
        lines.is_last[q], lines.row[q], lines.weight[q], lines.painted[q] = 1, row, casters.weight[e], -1
        if mask >= 0:
            size = casters.resolution[mask]
            lines.painted[q] = casters.texel_begin[mask] + casters.first_face[e] * size * size
            lines.resolution[q] = size
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
def stack_of_casters(begin, caster, light, casters, stack, slots, records, values, derivative):  # type: ignore[no-untyped-def]
    """Change of the light of slots, where casters differ in nothing but their instances.

    Parameters
    ----------
    begin : (n_records + 1,) int64, caster : (m,) int32, light : (m, n_blocks, N_VALUES, 4) float32
        Light of each record by caster: `caster_sums.caster_sums`.
    casters, stack, slots : MaskTable, StackTable, SlotTable
    records : (k,) int64
        Records with slots.
    values : (n_slots, N_VALUES, 4), derivative : (n_derivatives, N_VALUES, 4) float32, out, zero before
    """
    for g in prange(len(records)):
        _of_casters(records[g], begin, caster, light, casters, stack, slots, values, derivative)


@kernel
def _of_casters(r, begin, caster, light, casters, stack, slots, values, derivative):  # type: ignore[no-untyped-def]
    first, end = slots.begin[r], slots.begin[r + 1]
    n_rows, n_blocks = stack.slope.shape[0], stack.slope.shape[1]
    lines = _no_lines(end - first, stack)
    number, is_last, row, on_caster = lines.number, lines.is_last, lines.row, lines.weight
    place, weight = slots.place.reshape(-1), lines.at_hit
    past_0, factor_0 = address_of(lines.past), address_of(lines.factor)
    slope_0, to_place = address_of(lines.slope), lines.to
    own_0, line_0 = address_of(lines.own), address_of(lines.line)
    shifts = _has_shifts(stack)
    light_0, values_0, start_0 = address_of(light), address_of(values), address_of(stack.start)
    derivative_0 = address_of(derivative)
    for e in range(begin[r], begin[r + 1]):
        i = np.int64(caster[e])
        _hold(i, first, end, casters, stack, slots, lines)
        held = i % _HELD
        n, base = number[held], held * n_rows
        for q in range(n):
            weight[q] = on_caster[base + q]
        for s in range(first, end):
            for block in range(n_blocks):
                own = own_0 + 32 * n_rows * ((held * (end - first) + s - first) * n_blocks + block)
                start = load_color(start_0 + 16 * block)
                change = _composed(own, shifts, is_last, base, n, weight, start, past_0, factor_0)
                at = light_0 + 16 * N_VALUES * (e * light.shape[1] + block)
                for v in range(N_VALUES):
                    to = values_0 + 16 * (N_VALUES * s + v)
                    store_color(to, color_add(change, load_color(at + 16 * v), load_color(to)))
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
                            slope = load_color(slope_0 + 16 * q)
                            own = derivative_0 + 16 * N_VALUES * (slots.derived[s] + to_place[q])
                            for v in range(N_VALUES):
                                to = own + 16 * v
                                store_color(to, color_add(slope, load_color(at + 16 * v), load_color(to)))


@parallel_kernel
def stack_of_rays(  # type: ignore[no-untyped-def]
    rays,
    face,
    face_uv,
    sent,
    order,
    group,
    record,
    share,
    casters,
    stack,
    slots,
    seed,
    n_theta,
    n_phi,
    values,
    derivative,
):
    """Change of the light of slots, ray by ray.

    Parameters
    ----------
    face : (n_triangles,) int32, face_uv : (n_triangles, 3, 2) float32
        Control faces, and places of corners in them.
    sent : (n_cells, n_blocks, 4) float32
        What cells send, by group of lights, and 1 for what is added to all light.
    order : (n_wanted,) int64
        Hemispheres, those of one record next to each other.
    group : (n_groups + 1,) int64
        Ranges of `order`, one for each record.
    record : (n_groups,) int64
        Records, all different.
    share : (n_records,) float32
        Factor on the hemispheres of each record.
    casters, stack, slots : MaskTable, StackTable, SlotTable
    values : (n_slots, N_VALUES, 4), derivative : (n_derivatives, N_VALUES, 4) float32, out, added to
    """
    for g in prange(len(record)):
        for q in range(group[g], group[g + 1]):
            r = order[q]
            turn = turn_of(seed, rays.stream[r])
            _of_rays(
                r,
                record[g],
                rays,
                face,
                face_uv,
                sent,
                share[record[g]],
                turn,
                n_theta,
                n_phi,
                casters,
                stack,
                slots,
                values,
                derivative,
            )


@kernel
def _of_rays(  # type: ignore[no-untyped-def]
    r,
    record,
    rays,
    face,
    face_uv,
    sent,
    factor,
    first_turn,
    n_theta,
    n_phi,
    casters,
    stack,
    slots,
    values,
    derivative,
):
    first, end = slots.begin[record], slots.begin[record + 1]
    n_slots = end - first
    n_rows, n_blocks = stack.slope.shape[0], stack.slope.shape[1]
    n_rays = rays.cell.shape[1]
    weights = np.empty((n_rays, 4), np.float32)
    ray_weights(rays.distance, r, first_turn, n_theta, n_phi, factor, weights)
    lines = _no_lines(n_slots, stack)
    caster, number, is_last, row = lines.caster, lines.number, lines.is_last, lines.row
    painted, resolution, on_caster = lines.painted, lines.resolution, lines.weight
    texels, weight = casters.texels, lines.at_hit
    place, pattern, derived = slots.place.reshape(-1), slots.pattern, slots.derived
    past_0, factor_0 = address_of(lines.past), address_of(lines.factor)
    slope_0, to_place = address_of(lines.slope), lines.to
    own_0, line_0 = address_of(lines.own), address_of(lines.line)
    shifts = _has_shifts(stack)
    sums = np.zeros((n_slots, 5, 4), np.float32)
    sums_0, sent_0, throughput_0 = address_of(sums), address_of(sent), address_of(rays.throughput)
    slopes = np.zeros((derived[end] - derived[first], 5, 4), np.float32)
    start_0, slopes_0 = address_of(stack.start), address_of(slopes)
    cell, instance, triangle, uv = rays.cell, rays.instance, rays.triangle, rays.uv
    detour, end_instance, end_face, end_face_uv = rays.detour, rays.end_instance, rays.end_face, rays.end_face_uv
    share = np.float32(np.pi / n_rays * factor)
    d, d_end, adjusted_ray = rays.detour_begin[r], rays.detour_begin[r + 1], rays.adjusted
    adjusted, adjusted_end = rays.adjusted_begin[r], rays.adjusted_begin[r + 1]
    for ray in range(n_rays):
        i = np.int64(instance[r, ray]) if cell[r, ray] >= 0 else np.int64(-1)
        is_detour = d < d_end and detour[d] == r * n_rays + ray
        if is_detour:
            i = np.int64(end_instance[d])
            d += 1
        is_adjusted = adjusted < adjusted_end and adjusted_ray[adjusted] == r * n_rays + ray
        if is_adjusted:
            adjusted += 1
        if i < 0:
            continue
        held = i % _HELD
        if caster[held] != i:
            _hold(i, first, end, casters, stack, slots, lines)
        n, base = number[held], held * n_rows
        if n == 0:
            continue
        if is_detour:
            own_face = np.int64(end_face[d - 1])
            at_s, at_t = end_face_uv[d - 1, 0], end_face_uv[d - 1, 1]
        else:
            hit = triangle[r, ray]
            own_face = np.int64(face[hit])
            v, w = uv[r, ray, 0], uv[r, ray, 1]
            u = np.float32(1.0) - v - w
            at_s = u * face_uv[hit, 0, 0] + v * face_uv[hit, 1, 0] + w * face_uv[hit, 2, 0]
            at_t = u * face_uv[hit, 0, 1] + v * face_uv[hit, 1, 1] + w * face_uv[hit, 2, 1]
        acts = False
        last, corners = np.int64(1), corner_texels(np.int64(1), at_s, at_t)
        for q in range(n):
            own_weight = on_caster[base + q]
            if painted[base + q] >= 0:
                size = resolution[base + q]
                if size != last:
                    last, corners = size, corner_texels(size, at_s, at_t)
                own_weight *= texel_weight(texels, painted[base + q] + own_face * size * size, corners)
            weight[q] = own_weight
            acts |= own_weight != np.float32(0.0)
        if not acts:
            continue
        for block in range(n_blocks):
            light = load_color(sent_0 + 16 * (np.int64(cell[r, ray]) * n_blocks + block))
            if is_adjusted:
                light = color_product(light, load_rgb(throughput_0 + 12 * (adjusted - 1)))
            start = load_color(start_0 + 16 * block)
            for s in range(n_slots):
                own = own_0 + 32 * n_rows * ((held * n_slots + s) * n_blocks + block)
                change = _composed(own, shifts, is_last, base, n, weight, start, past_0, factor_0)
                add_weighted(sums_0 + 80 * s, color_product(change, light), share, weights, ray)
                if derived[first + s] < derived[first + s + 1]:
                    _derive(
                        line_0 + 32 * block,
                        32 * n_blocks,
                        row,
                        place,
                        n_rows * pattern[first + s],
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
                            to = slopes_0 + 80 * (derived[first + s] - derived[first] + to_place[q])
                            brought = color_product(load_color(slope_0 + 16 * q), light)
                            add_weighted(to, brought, share, weights, ray)
    nx, ny, nz = rays.shading_normal[r, 0], rays.shading_normal[r, 1], rays.shading_normal[r, 2]
    for s in range(n_slots):
        turn_to_world(sums[s], nx, ny, nz, values[first + s])
    for k in range(len(slopes)):
        turn_to_world(slopes[k], nx, ny, nz, derivative[derived[first] + k])
