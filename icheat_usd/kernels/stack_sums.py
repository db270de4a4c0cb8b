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
from icheat_usd.kernels.caster_sums import N_VALUES, add_weighted, ray_weights, sender_of, strata_of, turn_to_world
from icheat_usd.kernels.mask_table import weight_of_entry
from icheat_usd.kernels.random import hash_combine
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


class _Scratch(NamedTuple):
    """Room for the edits that act on one caster."""

    row: NDArray[np.int32]  #: (n_rows,) ascending
    entry: NDArray[np.int64]  #: (n_rows,)
    weight: NDArray[np.float32]  #: (n_rows,) of the caster
    past: NDArray[np.float32]  #: (n_rows, 4) x before each
    factor: NDArray[np.float32]  #: (n_rows, 4)


@kernel
def _scratch(n_rows):  # type: ignore[no-untyped-def]
    return _Scratch(
        np.empty(n_rows, np.int32),
        np.empty(n_rows, np.int64),
        np.empty(n_rows, np.float32),
        np.empty((n_rows, 4), np.float32),
        np.empty((n_rows, 4), np.float32),
    )


@kernel
def _list_active(i, first, end, casters, slots, scratch):  # type: ignore[no-untyped-def]
    """Rows that have casters on an instance and that receivers of some slots are in, or would be nearby."""
    n = 0
    for e in range(casters.begin[i], casters.begin[i + 1]):
        row = casters.row[e]
        for s in range(first, end):
            if slots.masks[s, row] != np.float32(0.0) or slots.place[slots.pattern[s], row] >= 0:
                scratch.row[n], scratch.entry[n] = row, e
                n += 1
                break
    return n


@kernel
def _composed(block, s, n, stack, slots, scratch):  # type: ignore[no-untyped-def]
    """Change of one block of S or E by the first `n` rows of the scratch, for slot `s`."""
    slope_0, shift_0 = address_of(stack.slope), address_of(stack.shift)
    past_0, factor_0 = address_of(scratch.past), address_of(scratch.factor)
    n_blocks = stack.slope.shape[1]
    one = color_of(np.float32(1.0), np.float32(1.0), np.float32(1.0))
    start = load_color(address_of(stack.start) + 16 * block)
    x = start
    q = 0
    while q < n:
        edit = stack.edit[scratch.row[q]]
        a, b = one, black()
        while q < n and stack.edit[scratch.row[q]] == edit:
            row = np.int64(scratch.row[q])
            weight = slots.masks[s, row] * scratch.weight[q]
            at = 16 * (row * n_blocks + block)
            a = scale_add(load_color(slope_0 + at), weight, a)
            b = scale_add(load_color(shift_0 + at), weight, b)
            store_color(past_0 + 16 * q, x)
            q += 1
        store_color(factor_0 + 16 * (q - 1), a)
        x = color_add(a, x, b)
    return difference(x, start)


@kernel
def _derive(block, s, n, stack, slots, scratch, light, derivative):  # type: ignore[no-untyped-def]
    """Add the derivatives of a light's change by masks of the receiver, after `_composed`."""
    slope_0, shift_0 = address_of(stack.slope), address_of(stack.shift)
    past_0, factor_0 = address_of(scratch.past), address_of(scratch.factor)
    out_0 = address_of(derivative) + 16 * slots.derived[s]
    n_blocks = stack.slope.shape[1]
    after = light
    q = n - 1
    while q >= 0:
        edit = stack.edit[scratch.row[q]]
        a = load_color(factor_0 + 16 * q)
        while q >= 0 and stack.edit[scratch.row[q]] == edit:
            row = np.int64(scratch.row[q])
            place = np.int64(slots.place[slots.pattern[s], row])
            if place >= 0:
                at = 16 * (row * n_blocks + block)
                own = color_add(load_color(slope_0 + at), load_color(past_0 + 16 * q), load_color(shift_0 + at))
                to = out_0 + 16 * place
                own = scaled(own, scratch.weight[q])
                store_color(to, color_add(own, after, load_color(to)))
            q -= 1
        after = color_product(after, a)


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
    values : (n_slots, N_VALUES, 4), derivative : (n_derivatives, 4) float32, out, zero before
    """
    for g in prange(len(records)):
        _of_casters(records[g], begin, caster, light, casters, stack, slots, values, derivative)


@kernel
def _of_casters(r, begin, caster, light, casters, stack, slots, values, derivative):  # type: ignore[no-untyped-def]
    first, end = slots.begin[r], slots.begin[r + 1]
    scratch = _scratch(len(stack.edit))
    light_0, values_0 = address_of(light), address_of(values)
    n_blocks = stack.slope.shape[1]
    for e in range(begin[r], begin[r + 1]):
        n = _list_active(caster[e], first, end, casters, slots, scratch)
        if n == 0:
            continue
        for q in range(n):
            scratch.weight[q] = casters.weight[scratch.entry[q]]
        for s in range(first, end):
            for block in range(n_blocks):
                change = _composed(block, s, n, stack, slots, scratch)
                at = light_0 + 16 * N_VALUES * (e * light.shape[1] + block)
                for v in range(N_VALUES):
                    to = values_0 + 16 * (N_VALUES * s + v)
                    store_color(to, color_add(change, load_color(at + 16 * v), load_color(to)))
                if slots.derived[s] < slots.derived[s + 1]:
                    _derive(block, s, n, stack, slots, scratch, load_color(at), derivative)


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
    values : (n_slots, N_VALUES, 4), derivative : (n_derivatives, 4) float32, out, added to
    """
    for g in prange(len(record)):
        for q in range(group[g], group[g + 1]):
            r = order[q]
            own = strata_of(turn_of(hash_combine(seed, rays.stream[r])), n_theta, n_phi, share[record[g]])
            _of_rays(r, record[g], rays, face, face_uv, sent, own, casters, stack, slots, values, derivative)


@kernel
def _of_rays(r, record, rays, face, face_uv, sent, strata, casters, stack, slots, values, derivative):  # type: ignore[no-untyped-def]
    first, end = slots.begin[record], slots.begin[record + 1]
    scratch = _scratch(len(stack.edit))
    n_blocks, n_phi, n_rays = stack.slope.shape[1], len(strata.across), rays.cell.shape[1]
    sums = np.zeros((end - first, 5, 4), np.float32)
    sums_0, sent_0, throughput_0 = address_of(sums), address_of(sent), address_of(rays.throughput)
    share = np.float32(strata.share)
    d = rays.detour_begin[r]
    adjusted, adjusted_end = rays.adjusted_begin[r], rays.adjusted_begin[r + 1]
    last, n = -1, 0
    for j in range(len(strata.slope)):
        for k in range(n_phi):
            ray = j * n_phi + k
            i = sender_of(rays, r, ray, d)
            is_detour = d < rays.detour_begin[r + 1] and rays.detour[d] == r * n_rays + ray
            if is_detour:
                d += 1
            is_adjusted = adjusted < adjusted_end and rays.adjusted[adjusted] == r * n_rays + ray
            if is_adjusted:
                adjusted += 1
            if i < 0:
                continue
            if i != last:
                n, last = _list_active(i, first, end, casters, slots, scratch), i
            if n == 0 or not _weigh(r, ray, d if is_detour else -1, n, rays, face, face_uv, casters, scratch):
                continue
            ga, gb, a, b = ray_weights(strata, rays.distance, r, j, k)
            for block in range(n_blocks):
                light = load_color(sent_0 + 16 * (np.int64(rays.cell[r, ray]) * n_blocks + block))
                if is_adjusted:
                    light = color_product(light, load_rgb(throughput_0 + 12 * (adjusted - 1)))
                for s in range(first, end):
                    change = color_product(_composed(block, s, n, stack, slots, scratch), light)
                    add_weighted(sums_0 + 80 * (s - first), change, share, ga, gb, a, b)
                    if slots.derived[s] < slots.derived[s + 1]:
                        _derive(block, s, n, stack, slots, scratch, scaled(light, share), derivative)
    nx, ny, nz = rays.shading_normal[r, 0], rays.shading_normal[r, 1], rays.shading_normal[r, 2]
    for s in range(first, end):
        turn_to_world(sums[s - first], nx, ny, nz, values[s])


@kernel
def _weigh(r, ray, detour, n, rays, face, face_uv, casters, scratch):  # type: ignore[no-untyped-def]
    """Weights of the place that a ray ends in, in the rows of the scratch; False if all are 0.

    `detour` is the number after that of the ray's detour, -1 if it made none.
    """
    if detour >= 0:
        own_face = rays.end_face[detour - 1]
        s, t = rays.end_face_uv[detour - 1, 0], rays.end_face_uv[detour - 1, 1]
    else:
        q = rays.triangle[r, ray]
        own_face = face[q]
        v, w = rays.uv[r, ray, 0], rays.uv[r, ray, 1]
        u = np.float32(1.0) - v - w
        s = u * face_uv[q, 0, 0] + v * face_uv[q, 1, 0] + w * face_uv[q, 2, 0]
        t = u * face_uv[q, 0, 1] + v * face_uv[q, 1, 1] + w * face_uv[q, 2, 1]
    found = False
    for q in range(n):
        weight = weight_of_entry(casters, scratch.entry[q], own_face, s, t)
        scratch.weight[q] = weight
        found |= weight != np.float32(0.0)
    return found
