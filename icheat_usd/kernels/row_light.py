"""Sampled rows and the light of cache records: what one decoded row makes of the light that a hemisphere brings.

The weight that a row has at a receiver stays outside: sums are kept for each row near a record, and mixed at the
camera sample by its own weights. Where several edits act on a receiver, their product is taken as straight in each
weight about those at the record.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels import simd
from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.row_mixing import LANES

#: How an edit meets the weaker ones.
COMPOSE, OVER, ADD = 0, 1, 2

_TOUCHING = np.float32(1e-6)  # metres: a ray may end where it starts, in a crease


class HemisphereTable(NamedTuple):
    """Rays of n hemispheres; see `record_rays.trace_hemispheres`."""

    cell: NDArray[np.int32]  #: (n, n_rays)
    caster: NDArray[np.int32]  #: (n, n_rays) where masks and leaves are looked up
    distance: NDArray[np.float32]  #: (n, n_rays)
    shading_normal: NDArray[np.float32]  #: (n, 3)
    stream: NDArray[np.int64]  #: (n,)
    adjusted_begin: NDArray[np.int64]  #: (n + 1,)
    adjusted: NDArray[np.int64]  #: ascending numbers ``row * n_rays + ray``
    throughput: NDArray[np.float32]  #: (n_adjusted, 3)
    share: NDArray[np.float32]  #: (n,) in its record
    shrink: NDArray[np.float32]  #: (n,) factor on what changes with place


class Stack(NamedTuple):
    """Edits that act on pairs, weakest first, and their keys."""

    first_key: NDArray[np.int64]  #: (n_edits + 1,)
    blend: NDArray[np.int64]  #: (n_edits,)
    groups: NDArray[np.uint8]  #: (n_edits, G) groups of lights that each acts on
    payload: NDArray[np.int32]  #: (n_keys,) rows of each key, -1 for constants
    share: NDArray[np.float32]  #: (n_keys,) amount
    constant: NDArray[np.float32]  #: (n_keys, 6) S - 1 and E
    mask: NDArray[np.float32]  #: (n_keys, n_casters)
    key: NDArray[np.int32]  #: (n_payloads,)
    leaf: NDArray[np.int32]  #: (n_payloads, n_casters) -1 where rows are the identity
    column: NDArray[np.int32]  #: (n_payloads, 6) decoded column of S - 1 and of E, -1 for 0
    n_cells: NDArray[np.int64]  #: (n_payloads,)


@parallel_kernel
def row_sums(  # type: ignore[no-untyped-def]
    hemispheres,
    stack,
    sent,
    emits,
    seed,
    n_theta,
    n_phi,
    order,
    range_of,
    is_in,
    is_new,
    own_at,
    own_weight,
    first_sum,
    payload,
    at,
    decoded,
    out_base,
    out,
):
    """Sums of some bases' rows, and what edits make of the light at the records themselves.

    Parameters
    ----------
    hemispheres, stack : HemisphereTable, Stack
    sent : (G, n_cells, 3) float32
        Radiance that gather cells send.
    emits : bool
        Whether emission counts.
    order : (n_hemispheres,) int64, range_of : (n, 2) int64
        Which places of `order` hold the hemispheres of each base.
    is_in : (n, n_keys) uint8
    is_new : (n,) uint8
        Whether `out_base` is wanted.
    own_at, own_weight : (n, n_payloads, 4)
        Rows at the record about which the product of edits is taken, as places in `decoded`, and their weights; 0
        where one edit alone acts.
    first_sum : (n + 1,) int64, payload, at : (n_sums,)
        Sums of each base, ordered by payload: where their rows begin in `decoded`.
    out_base : (n, LANES), out : (n_sums, LANES) float32
    """
    for b in prange(len(is_new)):
        _sums_of_base(
            b,
            hemispheres,
            stack,
            sent,
            emits,
            seed,
            n_theta,
            n_phi,
            order,
            range_of,
            is_in,
            is_new,
            own_at,
            own_weight,
            first_sum,
            payload,
            at,
            decoded,
            out_base,
            out,
        )


@kernel
def _sums_of_base(  # type: ignore[no-untyped-def]
    b,
    hemispheres,
    stack,
    sent,
    emits,
    seed,
    n_theta,
    n_phi,
    order,
    range_of,
    is_in,
    is_new,
    own_at,
    own_weight,
    first_sum,
    payload,
    at,
    decoded,
    out_base,
    out,
):
    n_rays = n_theta * n_phi
    n_edits, n_groups = len(stack.blend), len(sent)
    acts = np.zeros(n_edits, np.uint8)
    n_acting = 0
    for e in range(n_edits):
        for q in range(stack.first_key[e], stack.first_key[e + 1]):
            if is_in[b, q]:
                acts[e] = 1
        n_acting += acts[e]
    linear = np.empty((n_rays, 5), np.float32)
    is_alone = n_acting == 1 and not is_new[b]
    # Where one edit acts alone, its light is what arrives.
    by_scale = np.zeros((0 if is_alone else n_edits, n_rays, 3), np.float32)
    by_emission = np.zeros((0 if is_alone else n_edits, n_rays, 3), np.float32)
    lanes = np.zeros((n_rays, LANES), np.float32)
    leaf = np.empty(n_rays, np.int64)
    light, scale = np.empty((n_groups + 1, 3), np.float32), np.empty((n_groups + 1, 3), np.float32)
    state = np.empty((n_edits, n_groups + 2, 3), np.float32)
    total = np.zeros((3, 5), np.float64)
    for p in range(first_sum[b], first_sum[b + 1]):
        for k in range(LANES):
            out[p, k] = np.float32(0.0)
    for place in range(range_of[b, 0], range_of[b, 1]):
        h = order[place]
        _linear_in_light(h, hemispheres, seed, n_theta, n_phi, linear)
        if not is_alone:
            _derivatives(
                b,
                h,
                hemispheres,
                stack,
                sent,
                emits,
                acts,
                is_in,
                own_at,
                own_weight,
                decoded,
                linear,
                light,
                scale,
                state,
                by_scale,
                by_emission,
                total,
            )
        p = first_sum[b]
        while p < first_sum[b + 1]:
            one, last = payload[p], p + 1
            while last < first_sum[b + 1] and payload[last] == one:
                last += 1
            key = stack.key[one]
            edit = np.searchsorted(stack.first_key, key, "right") - 1
            for kind in range(2):
                if stack.column[one, 3 * kind] < 0 and stack.column[one, 3 * kind + 1] < 0:
                    if stack.column[one, 3 * kind + 2] < 0:
                        continue
                if is_alone:
                    groups = stack.groups[edit]
                    n = _lanes_of_one(h, hemispheres, stack, one, key, groups, kind, sent, emits, linear, lanes, leaf)
                else:
                    by = by_scale[edit] if kind == 0 else by_emission[edit]
                    n = _lit_lanes(h, hemispheres, stack, one, key, by, linear, lanes, leaf)
                for k in range(p, last):
                    _add_row(k, at[k], stack.column, one, kind, stack.n_cells[one], n, decoded, lanes, leaf, out)
            p = last
    if is_new[b]:
        for c in range(3):
            for i in range(5):
                out_base[b, 5 * c + i] = total[c, i]
        out_base[b, 15] = np.float32(0.0)


@kernel
def _linear_in_light(h, hemispheres, seed, n_theta, n_phi, out):  # type: ignore[no-untyped-def]
    """What one unit of radiance of each ray adds to irradiance and its gradients (`record_sums.record_sums`)."""
    distance, m, n = hemispheres.distance, n_theta, n_phi
    first_turn = turn_of(seed, hemispheres.stream[h])
    share = hemispheres.share[h]
    shrunk = share * hemispheres.shrink[h]
    value = np.float32(np.pi / (m * n)) * share
    slope, low, width = np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32)
    for j in range(m):
        u = (j + 0.5) / m
        slope[j] = value * np.sqrt(u / (1.0 - u))
        low[j] = shrunk * (1.0 - j / m) * np.sqrt(j / m) * (2.0 * np.pi / n)
        width[j] = shrunk * (np.sqrt((j + 1) / m) - np.sqrt(j / m))
    for ray in range(m * n):
        out[ray, 3], out[ray, 4] = np.float32(0.0), np.float32(0.0)
    for k in range(n):
        phi = 2.0 * np.pi * ((k + 0.5) / n + first_turn)
        edge = 2.0 * np.pi * (k / n + first_turn)
        across, along = np.float32(np.cos(phi)), np.float32(np.sin(phi))
        edge_across, edge_along = np.float32(np.cos(edge)), np.float32(np.sin(edge))
        before = k - 1 if k > 0 else n - 1
        for j in range(m):
            ray, beside, inside = j * n + k, j * n + before, max(j - 1, 0) * n + k
            d = distance[h, ray]
            outwards = low[j] / max(min(d, distance[h, inside]), _TOUCHING)
            around = width[j] / max(min(d, distance[h, beside]), _TOUCHING)
            out[ray, 0] = value
            out[ray, 1] = -along * slope[j]
            out[ray, 2] = across * slope[j]
            out[ray, 3] += across * outwards - edge_along * around
            out[ray, 4] += along * outwards + edge_across * around
            out[inside, 3] -= across * outwards
            out[inside, 4] -= along * outwards
            out[beside, 3] += edge_along * around
            out[beside, 4] -= edge_across * around


@kernel
def _arriving(h, ray, a, hemispheres, sent, emits, light):  # type: ignore[no-untyped-def]
    """Light of a ray by group, and behind these what a unit of added emission comes to; returns the next `a`."""
    n_groups, n_rays, cell = len(sent), hemispheres.cell.shape[1], hemispheres.cell[h, ray]
    is_adjusted = a < hemispheres.adjusted_begin[h + 1] and hemispheres.adjusted[a] == h * n_rays + ray
    for c in range(3):
        tint = hemispheres.throughput[a, c] if is_adjusted else np.float32(1.0)
        for g in range(n_groups):
            light[g, c] = tint * sent[g, cell, c] if cell >= 0 else np.float32(0.0)
        light[n_groups, c] = tint if emits else np.float32(0.0)
    return a + 1 if is_adjusted else a


@kernel
def _derivatives(  # type: ignore[no-untyped-def]
    b,
    h,
    hemispheres,
    stack,
    sent,
    emits,
    acts,
    is_in,
    own_at,
    own_weight,
    decoded,
    linear,
    light,
    scale,
    state,
    by_scale,
    by_emission,
    total,
):
    """Light of each ray by one unit more of each edit's S - 1 and E; what edits change of it is added to `total`."""
    n_groups = len(sent)
    a = hemispheres.adjusted_begin[h]
    change, met = np.empty(6, np.float32), np.empty(len(acts), np.bool_)
    for ray in range(hemispheres.cell.shape[1]):
        a = _arriving(h, ray, a, hemispheres, sent, emits, light)
        if hemispheres.cell[h, ray] < 0:
            continue
        for c in range(3):
            for g in range(n_groups):
                scale[g, c] = np.float32(1.0)
            scale[n_groups, c] = np.float32(0.0)
        caster = hemispheres.caster[h, ray]
        n_met = 0
        for e in range(len(acts)):
            # Edits whose masks are 0 here carry all that they meet.
            met[e] = acts[e] != 0 and _is_masked(b, e, caster, stack, is_in)
            if met[e]:
                kept = _change_of(b, e, caster, stack, is_in, own_at, own_weight, decoded, change)
                _lay(e, stack, kept, change, scale, state)
                n_met += 1
        if n_met == 0:
            continue
        for c in range(3):
            changed = scale[n_groups, c] * light[n_groups, c]
            for g in range(n_groups):
                changed += (scale[g, c] - np.float32(1.0)) * light[g, c]
            for i in range(5):
                total[c, i] += np.float64(linear[ray, i]) * changed
        # From the strongest edit back: `light` becomes what a unit of scale, left by the edits so far, comes to.
        for step in range(len(acts)):
            e = len(acts) - 1 - step
            if met[e]:
                _back(e, ray, stack, state, light, by_scale, by_emission)


@kernel
def _is_masked(b, e, caster, stack, is_in):  # type: ignore[no-untyped-def]
    for q in range(stack.first_key[e], stack.first_key[e + 1]):
        if is_in[b, q] and stack.mask[q, caster] != np.float32(0.0):
            return True
    return False


@kernel
def _change_of(b, e, caster, stack, is_in, own_at, own_weight, decoded, change):  # type: ignore[no-untyped-def]
    """S - 1 and E of one edit and pair, weighted, and the sum of its keys' weights."""
    kept, last = np.float32(0.0), np.float32(0.0)
    for c in range(6):
        change[c] = np.float32(0.0)
    for q in range(stack.first_key[e], stack.first_key[e + 1]):
        mask = stack.mask[q, caster]
        if is_in[b, q] == 0 or mask == np.float32(0.0):
            continue
        kept += stack.share[q] * mask
        one = stack.payload[q]
        if one < 0:
            for c in range(6):
                change[c] += stack.share[q] * mask * stack.constant[q, c]
            continue
        leaf = stack.leaf[one, caster]
        if leaf < 0:
            continue
        for c in range(6):
            column = stack.column[one, c]
            if column < 0:
                continue
            if c % 3 > 0 and column == stack.column[one, c - 1]:
                value = last
            else:
                value = np.float32(0.0)
                for s in range(own_at.shape[2]):
                    if own_weight[b, one, s] != np.float32(0.0):
                        place = own_at[b, one, s] + leaf + column * stack.n_cells[one]
                        value += own_weight[b, one, s] * decoded[place]
            last = value
            change[c] += mask * value
    return kept


@kernel
def _lay(e, stack, kept, change, scale, state):  # type: ignore[no-untyped-def]
    """Lay an edit over a pair (`edits.composing.lay`), and keep what it met and what it carries of that."""
    n_groups = len(scale) - 1
    whole = _acts_on_all(stack.groups, e)
    for c in range(3):
        carried, more = np.float32(1.0) + change[c], np.float32(0.0)
        if stack.blend[e] == OVER:
            carried, more = np.float32(1.0) - kept, kept + change[c]
        elif stack.blend[e] == ADD:
            carried, more = np.float32(1.0), change[c]
        for g in range(n_groups):
            state[e, g, c] = scale[g, c]
            if stack.groups[e, g]:
                scale[g, c] = carried * scale[g, c] + more
        state[e, n_groups, c] = scale[n_groups, c]
        state[e, n_groups + 1, c] = carried
        scale[n_groups, c] = (carried * scale[n_groups, c] if whole else scale[n_groups, c]) + change[3 + c]


@kernel
def _acts_on_all(groups, e):  # type: ignore[no-untyped-def]
    for g in range(groups.shape[1]):
        if groups[e, g] == 0:
            return False
    return True


@kernel
def _back(e, ray, stack, state, light, by_scale, by_emission):  # type: ignore[no-untyped-def]
    n_groups = len(light) - 1
    whole = _acts_on_all(stack.groups, e)
    composes = stack.blend[e] == COMPOSE
    for c in range(3):
        carried = state[e, n_groups + 1, c]
        slope = np.float32(0.0)
        for g in range(n_groups):
            if stack.groups[e, g]:
                slope += light[g, c] * (state[e, g, c] if composes else np.float32(1.0))
                light[g, c] *= carried
        if whole and composes:
            slope += light[n_groups, c] * state[e, n_groups, c]
        by_scale[e, ray, c] = slope
        by_emission[e, ray, c] = light[n_groups, c]
        if whole:
            light[n_groups, c] *= carried


@kernel
def _lanes_of_one(h, hemispheres, stack, one, key, groups, kind, sent, emits, linear, lanes, leaf):  # type: ignore[no-untyped-def]
    """`_lit_lanes` where one edit alone acts: on light as it is."""
    n, a, n_rays = 0, hemispheres.adjusted_begin[h], hemispheres.cell.shape[1]
    for ray in range(n_rays):
        is_adjusted = a < hemispheres.adjusted_begin[h + 1] and hemispheres.adjusted[a] == h * n_rays + ray
        if is_adjusted:
            a += 1
        cell = hemispheres.cell[h, ray]
        if cell < 0:
            continue
        caster = hemispheres.caster[h, ray]
        mask = stack.mask[key, caster]
        if mask == np.float32(0.0) or stack.leaf[one, caster] < 0:
            continue
        leaf[n] = stack.leaf[one, caster]
        for c in range(3):
            light = np.float32(0.0)
            if kind == 1:
                light = mask if emits else np.float32(0.0)
            else:
                for g in range(len(sent)):
                    if groups[g]:
                        light += mask * sent[g, cell, c]
            if is_adjusted:
                light *= hemispheres.throughput[a - 1, c]
            for i in range(5):
                lanes[n, 5 * c + i] = light * linear[ray, i]
        n += 1
    return n


@kernel
def _lit_lanes(h, hemispheres, stack, one, key, by, linear, lanes, leaf):  # type: ignore[no-untyped-def]
    """Rays that a payload's rows act on: their leaves, and what a unit of a row there adds; returns how many."""
    n = 0
    for ray in range(hemispheres.cell.shape[1]):
        if hemispheres.cell[h, ray] < 0:
            continue
        caster = hemispheres.caster[h, ray]
        mask = stack.mask[key, caster]
        if mask == np.float32(0.0) or stack.leaf[one, caster] < 0:
            continue
        leaf[n] = stack.leaf[one, caster]
        for c in range(3):
            light = mask * by[ray, c]
            for i in range(5):
                lanes[n, 5 * c + i] = light * linear[ray, i]
        n += 1
    return n


@kernel
def _add_row(p, first, column, one, kind, n_cells, n, decoded, lanes, leaf, out):  # type: ignore[no-untyped-def]
    red, green, blue = column[one, 3 * kind], column[one, 3 * kind + 1], column[one, 3 * kind + 2]
    if red == green and green == blue:
        values, scratch = first + red * n_cells, simd.address_of(out) + 64 * p
        simd.store(scratch, _dot(simd.load(scratch), simd.address_of(decoded) + 4 * values, n, lanes, leaf))
        return
    own = np.empty(LANES, np.float32)
    for c in range(3):
        if column[one, 3 * kind + c] >= 0:
            values = first + column[one, 3 * kind + c] * n_cells
            found = _dot(simd.zeros(), simd.address_of(decoded) + 4 * values, n, lanes, leaf)
            simd.store(simd.address_of(own), found)
            for i in range(5):
                out[p, 5 * c + i] += own[5 * c + i]


@kernel
def _dot(total, values, n, lanes, leaf):  # type: ignore[no-untyped-def]
    at = simd.address_of(lanes)
    for k in range(n):
        total = simd.multiply_add(simd.load_spread(values + 4 * leaf[k]), simd.load(at + 64 * k), total)
    return total


@kernel
def find_strangers(cell, instance, of_cell, is_varied, out):  # type: ignore[no-untyped-def]
    """Numbers of rays whose sender is not that of their cell, or is masked in part; returns how many."""
    n, n_rays = cell.shape
    total = 0
    for r in range(n):
        for ray in range(n_rays):
            j, i = cell[r, ray], instance[r, ray]
            if j >= 0 and i >= 0 and (of_cell[j] != i or is_varied[i] != 0):
                if total < len(out):
                    out[total] = r * n_rays + ray
                total += 1
    return total
