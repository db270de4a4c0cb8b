"""Sampled rows and the light of cache records: what one decoded row makes of the light that a hemisphere brings.

The weight that a row has at a receiver stays outside: sums are kept for each row near a record, and mixed at the
camera sample by its own weights. Where several edits act on a receiver, their product is taken as straight in each
weight about those at the record.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels import simd
from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.hemisphere_light import linear_in_light
from icheat_usd.kernels.row_edits import derivatives, grey_derivatives, own_rows
from icheat_usd.kernels.row_mixing import LANES


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
            np.int64(b),
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
    own = np.empty(0, np.float32) if is_alone else own_rows(b, stack, own_at, own_weight, decoded)
    # Where one edit acts alone, its light is what arrives.
    is_grey = stack.is_grey and not is_alone
    n_derived = 0 if is_alone or is_grey else n_edits
    by_scale = np.zeros((n_derived, n_rays, 3), np.float32)
    by_emission = np.zeros((n_derived, n_rays, 3), np.float32)
    by_grey = np.zeros((n_edits if is_grey else 0, n_rays), np.float32)
    lit = np.zeros((n_rays if is_grey else 0, LANES), np.float32)
    grey_state = np.empty((n_edits, 3), np.float32)
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
        linear_in_light(h, hemispheres, seed, n_theta, n_phi, linear)
        if is_grey:
            grey_derivatives(
                b, h, hemispheres, stack, sent, acts, is_in, own, linear, light, grey_state, by_grey, lit, total
            )
        elif not is_alone:
            derivatives(
                b,
                h,
                hemispheres,
                stack,
                sent,
                emits,
                acts,
                is_in,
                own,
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
                if is_grey:
                    n = _grey_lanes(h, hemispheres, stack, one, key, by_grey[edit], lit, lanes, leaf)
                elif is_alone:
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
                light *= hemispheres.way[a - 1, c] if kind == 1 else hemispheres.throughput[a - 1, c]
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
def _grey_lanes(h, hemispheres, stack, one, key, by, lit, lanes, leaf):  # type: ignore[no-untyped-def]
    """`_lit_lanes` of `row_edits.grey_derivatives`."""
    n, lit_at, lanes_at = 0, simd.address_of(lit), simd.address_of(lanes)
    for ray in range(hemispheres.cell.shape[1]):
        if hemispheres.cell[h, ray] < 0:
            continue
        caster = hemispheres.caster[h, ray]
        mask = stack.mask[key, caster]
        if mask == np.float32(0.0) or stack.leaf[one, caster] < 0:
            continue
        leaf[n] = stack.leaf[one, caster]
        light = simd.multiply_add(simd.spread(mask * by[ray]), simd.load(lit_at + 64 * ray), simd.zeros())
        simd.store(lanes_at + 64 * n, light)
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
