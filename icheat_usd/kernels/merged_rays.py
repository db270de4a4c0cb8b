"""Rays of cache records that end where painted masks weigh alike, taken together.

What a stack of edits makes of a ray is a polynomial of the painted weights where it ends, of no more than the first
degree in each. Rays of one caster whose weights lie close to each other are as good as one ray that brings all their
light from where these weights have their mean: what is missed is how two masks change together among them.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.caster_sums import add_weighted, ray_weights, turn_to_world
from icheat_usd.kernels.mask_sheets import weights_in_sheets
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.simd import (
    address_of,
    black,
    color_add,
    color_product,
    difference,
    load_color,
    load_rgb,
    scale_add,
    store_color,
)

_FEW = 4
#: Of what is kept of a caster, the last few are compared with its next ray: where these end near, it often does.
_MOST_LOOKED_AT = 16


@parallel_kernel
def merge_rays(  # type: ignore[no-untyped-def]
    rays,
    face,
    face_uv,
    sent,
    order,
    group,
    record,
    share,
    selected,
    sheets,
    least_apart,
    seed,
    n_theta,
    n_phi,
    number,
    caster,
    weights,
    light,
):
    """What rays bring to records, by caster and by the painted weights where they end.

    Parameters
    ----------
    face : (n_triangles,) int32, face_uv : (n_triangles, 3, 2) float32
        Control faces, and places of corners in them.
    sent : (n_cells, n_blocks, 4) float32
        What cells send, by group of lights.
    order : (n_wanted,) int64
        Hemispheres, those of one record next to each other.
    group : (n_groups + 1,) int64
        Ranges of `order`, one for each record.
    record : (n_groups,) int64, share : (n_records,) float32
        Records, and a factor on the hemispheres of each.
    selected : (n_instances,) uint8
        Casters that count.
    sheets : MaskSheets
    least_apart : float
        Distance between columns of the sheets from which on rays are kept apart. Of a record where that leaves more
        than one in `_FEW` rays, all are kept apart: it gains little, and gradients suffer from errors that jump.
    number : (n_groups,) int64, out
        How many are left of the rays of each record.
    caster : (n_groups, room) int32, out
    weights : (n_groups, room, width) float32, out
        Mean of the sheets' columns.
    light : (n_groups, room, n_blocks, N_VALUES, 4) float32, out
    """
    for g in prange(len(record)):
        number[g] = _merge(
            order,
            group[g],
            group[g + 1],
            rays,
            face,
            face_uv,
            sent,
            share[record[g]],
            selected,
            sheets,
            least_apart * least_apart,
            seed,
            n_theta,
            n_phi,
            caster[g],
            weights[g],
            light[g],
        )


@parallel_kernel
def keep(end, number, caster, weights, light, kept_caster, kept_weights, kept_light):  # type: ignore[no-untyped-def]
    """Put what `merge_rays` left of each record's rays into rows up to ``end[g]`` of other arrays."""
    for g in prange(len(number)):
        _keep(g, end[g] - number[g], end[g], caster, weights, light, kept_caster, kept_weights, kept_light)


@kernel
def _keep(g, first, end, caster, weights, light, kept_caster, kept_weights, kept_light):  # type: ignore[no-untyped-def]
    kept_caster[first:end] = caster[g, : end - first]
    kept_weights[first:end] = weights[g, : end - first]
    kept_light[first:end] = light[g, : end - first]


@kernel
def _merge(  # type: ignore[no-untyped-def]
    order,
    first,
    end,
    rays,
    face,
    face_uv,
    sent,
    factor,
    selected,
    sheets,
    apart,
    seed,
    n_theta,
    n_phi,
    caster,
    weights,
    light,
):
    n, n_seen = _take_together(
        order,
        first,
        end,
        rays,
        face,
        face_uv,
        sent,
        factor,
        selected,
        sheets,
        apart,
        seed,
        n_theta,
        n_phi,
        caster,
        weights,
        light,
    )
    if apart > 0.0 and _FEW * n > n_seen:
        n, n_seen = _take_together(
            order,
            first,
            end,
            rays,
            face,
            face_uv,
            sent,
            factor,
            selected,
            sheets,
            0.0,
            seed,
            n_theta,
            n_phi,
            caster,
            weights,
            light,
        )
    return n


@kernel
def _take_together(  # type: ignore[no-untyped-def]
    order,
    first,
    end,
    rays,
    face,
    face_uv,
    sent,
    factor,
    selected,
    sheets,
    apart,
    seed,
    n_theta,
    n_phi,
    caster,
    weights,
    light,
):
    """How many are left of the rays of a record, and how many there are."""
    room, width = weights.shape
    n_rays, n_blocks = rays.cell.shape[1], sent.shape[1]
    ray_weight = np.empty((n_rays, 4), np.float32)
    # Of each: weights of its first ray, how bright it is, which came before of its caster; and the last of each caster.
    like, bright, following = np.empty((room, width), np.float32), np.empty(room, np.float32), np.empty(room, np.int64)
    head, n_heads, n_seen = np.empty(room, np.int64), 0, 0
    sums, here = np.empty((room, n_blocks, 5, 4), np.float32), np.empty(width + 4, np.float32)
    size = np.empty(4, np.float32)
    like_0, here_0, size_0, sums_0 = address_of(like), address_of(here), address_of(size), address_of(sums)
    mean_0, sent_0, texels_0 = address_of(weights), address_of(sent), address_of(sheets.texels)
    throughput_0 = address_of(rays.throughput)
    cell, instance, triangle, uv = rays.cell, rays.instance, rays.triangle, rays.uv
    detour, end_instance, end_face, end_face_uv = rays.detour, rays.end_instance, rays.end_face, rays.end_face_uv
    adjusted_ray, detour_begin, adjusted_begin = rays.adjusted, rays.detour_begin, rays.adjusted_begin
    distance, stream, shading_normal = rays.distance, rays.stream, rays.shading_normal
    sheet_begin, resolution, sheet_first, sheet_width = sheets.begin, sheets.resolution, sheets.first, sheets.width
    share = np.float32(np.pi / n_rays * factor)
    n, last = 0, -1
    for k in range(first, end):
        r = order[k]
        ray_weights(distance, r, turn_of(seed, stream[r]), n_theta, n_phi, factor, ray_weight)
        sums[:n] = np.float32(0.0)
        d, d_end = detour_begin[r], detour_begin[r + 1]
        adjusted, adjusted_end = adjusted_begin[r], adjusted_begin[r + 1]
        for ray in range(n_rays):
            i = np.int64(instance[r, ray]) if cell[r, ray] >= 0 else np.int64(-1)
            is_detour = d < d_end and detour[d] == r * n_rays + ray
            if is_detour:
                i = np.int64(end_instance[d])
                d += 1
            is_adjusted = adjusted < adjusted_end and adjusted_ray[adjusted] == r * n_rays + ray
            if is_adjusted:
                adjusted += 1
            if i < 0 or not selected[i]:
                continue
            n_seen += 1
            wide = np.int64(0)
            if sheet_begin[i] < sheet_begin[i + 1]:
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
                wide = weights_in_sheets(
                    sheet_begin, resolution, sheet_first, sheet_width, i, own_face, at_s, at_t, texels_0, here_0
                )
            if last < 0 or caster[last] != i or _apart(here_0, like_0 + 4 * width * last, wide, size_0, size) > apart:
                last = _near(
                    i, caster, head, n_heads, following, here, like, here_0, like_0, width, wide, size_0, size, apart
                )
                if last < 0:
                    # None is near: a new one, first in the list of its caster.
                    last = n
                    following[n] = _place_in_list(i, n, caster, head, n_heads)
                    n_heads += following[n] < 0
                    caster[n], bright[n] = i, np.float32(0.0)
                    like[n, :wide] = here[:wide]
                    weights[n], sums[n], light[n] = np.float32(0.0), np.float32(0.0), np.float32(0.0)
                    n += 1
            total = black()
            for block in range(n_blocks):
                brought = load_color(sent_0 + 16 * (np.int64(cell[r, ray]) * n_blocks + block))
                if is_adjusted:
                    brought = color_product(brought, load_rgb(throughput_0 + 12 * (adjusted - 1)))
                total = scale_add(brought, np.float32(1.0), total)
                add_weighted(sums_0 + 80 * (last * n_blocks + block), brought, share, ray_weight, ray)
            store_color(size_0, total)
            brightness = size[0] + size[1] + size[2]
            bright[last] += brightness
            for q in range(4 * width * last, 4 * (width * last + wide), 16):
                at = load_color(here_0 + q - 4 * width * last)
                store_color(mean_0 + q, scale_add(at, brightness, load_color(mean_0 + q)))
        nx, ny, nz = shading_normal[r, 0], shading_normal[r, 1], shading_normal[r, 2]
        for e in range(n):
            for block in range(n_blocks):
                turn_to_world(sums[e, block], nx, ny, nz, light[e, block])
    for e in range(n):
        for c in range(width):
            weights[e, c] = weights[e, c] / bright[e] if bright[e] > np.float32(0.0) else np.float32(0.0)
    return n, n_seen


@kernel
def _apart(a_0, b_0, n, sum_0, sums):  # type: ignore[no-untyped-def]
    """Square of the distance between `n` floats at two addresses; `sums` (4,) at `sum_0` is scratch."""
    total = black()
    for q in range(0, 4 * n, 16):
        step = difference(load_color(a_0 + q), load_color(b_0 + q))
        total = color_add(step, step, total)
    store_color(sum_0, total)
    return (sums[0] + sums[1]) + (sums[2] + sums[3])


@kernel
def _square(x):  # type: ignore[no-untyped-def]
    return x * x


@kernel
def _near(i, caster, head, n_heads, following, here, like, here_0, like_0, width, wide, size_0, size, apart):  # type: ignore[no-untyped-def]
    """Of the last few that are kept of caster `i` the first within reach, -1 for none."""
    e = np.int64(-1)
    for h in range(n_heads):
        if caster[head[h]] == i:
            e = head[h]
            break
    n = 0
    while e >= 0 and n < _MOST_LOOKED_AT:
        # The first columns are what all masks together make of light: few get past them.
        is_like = wide == 0 or _square(here[0] - like[e, 0]) + _square(here[1] - like[e, 1]) <= apart
        if is_like and _apart(here_0, like_0 + 4 * width * e, wide, size_0, size) <= apart:
            return e
        e = following[e]
        n += 1
    return np.int64(-1)


@kernel
def _place_in_list(i, n, caster, head, n_heads):  # type: ignore[no-untyped-def]
    """Make `n` the first of caster `i`; the one that was, -1 for none."""
    for h in range(n_heads):
        if caster[head[h]] == i:
            before = head[h]
            head[h] = n
            return before
    head[n_heads] = n
    return np.int64(-1)
