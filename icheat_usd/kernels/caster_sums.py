"""What hemispheres of rays bring from each caster, and from the painted parts of it: `record_sums`, split by sender.

An edit's factor on the light of a ray is, in each painted mask there, a straight line. The light of a caster that is
seen through k masks is kept as its sums with each product of some of them, 2^k in all: from these any amounts and
colours of the edits can be served.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.samples import basis
from icheat_usd.kernels.texels import texel_weight

#: Painted masks on one caster.
MOST_MASKS = 4
_TOUCHING = np.float32(1e-6)  # metres: a ray may end where it starts, in a crease


class RayTable(NamedTuple):
    """Rays of n hemispheres; see `record_rays.trace_hemispheres`."""

    cell: NDArray[np.int32]  #: (n, n_rays)
    distance: NDArray[np.float32]  #: (n, n_rays)
    instance: NDArray[np.int32]  #: (n, n_rays)
    triangle: NDArray[np.int32]  #: (n, n_rays)
    uv: NDArray[np.float32]  #: (n, n_rays, 2)
    shading_normal: NDArray[np.float32]  #: (n, 3)
    stream: NDArray[np.int64]  #: (n,)
    detour_begin: NDArray[np.int64]  #: (n + 1,) detours of each row
    detour: NDArray[np.int64]  #: ascending numbers ``row * n_rays + ray``
    adjusted_begin: NDArray[np.int64]  #: (n + 1,) rays of each row that bring other light than cells
    adjusted: NDArray[np.int64]  #: ascending numbers of these; all lit detours are among them
    throughput: NDArray[np.float32]  #: (n_adjusted, 3)
    end_instance: NDArray[np.int32]  #: (n_detours,) -1 where nothing sends light
    end_face: NDArray[np.int32]
    end_face_uv: NDArray[np.float32]  #: (n_detours, 2)


class KeyTable(NamedTuple):
    """Under which keys the light of each instance is kept."""

    first: NDArray[np.int32]  #: (n_instances,) first key
    count: NDArray[np.int32]  #: (n_instances,) number of keys, 0 where no edit has casters
    n_masks: NDArray[np.int32]  #: (n_instances,)
    mask: NDArray[np.int32]  #: (n_instances, MOST_MASKS)
    texels: NDArray[np.float32]  #: of all masks
    texel_begin: NDArray[np.int64]  #: (n_masks,)
    resolution: NDArray[np.int64]  #: (n_masks,)
    first_face: NDArray[np.int64]  #: (n_masks, n_instances)


@kernel
def _sender(rays, r, ray, d, flat):  # type: ignore[no-untyped-def]
    """Instance that sends light along a ray, -1 for none; `d` is the next detour."""
    if d < rays.detour_begin[r + 1] and rays.detour[d] == flat:
        return rays.end_instance[d]
    return rays.instance[r, ray] if rays.cell[r, ray] >= 0 else np.int32(-1)


@parallel_kernel
def list_keys(rays, keys, wanted, local, number, listed):  # type: ignore[no-untyped-def]
    """Different keys that the rays of each row bring light of.

    Parameters
    ----------
    rays, keys : RayTable, KeyTable
    wanted : (n,) uint8
        Rows; the lists of all others are empty.
    local : (n, n_rays) int16, out
        Place of the first key of each ray's sender in the row's list, -1 for none.
    number : (n,) int32, listed : (n, room) int32, out
    """
    for r in prange(rays.cell.shape[0]):
        number[r] = 0
        if wanted[r]:
            _list_row(r, rays, keys, local, number, listed)


@kernel
def _list_row(r, rays, keys, local, number, listed):  # type: ignore[no-untyped-def]
    n = 0
    last = -1
    place = -1
    n_rays = rays.cell.shape[1]
    d = rays.detour_begin[r]
    for ray in range(n_rays):
        flat = r * n_rays + ray
        i = _sender(rays, r, ray, d, flat)
        if d < rays.detour_begin[r + 1] and rays.detour[d] == flat:
            d += 1
        local[r, ray] = -1
        if i < 0 or keys.count[i] == 0:
            continue
        if i != last:
            place = 0
            while place < n and listed[r, place] != keys.first[i]:
                place += 1
            if place == n:
                for k in range(keys.count[i]):
                    listed[r, n + k] = keys.first[i] + k
                n += keys.count[i]
            last = i
        local[r, ray] = place
    number[r] = n


@parallel_kernel
def caster_sums(  # type: ignore[no-untyped-def]
    rays, keys, face, face_uv, sent, local, begin, share, seed, n_theta, n_phi, irradiance, by_turn, by_move
):
    """`record_sums.record_sums` of the light of each key alone.

    Parameters
    ----------
    face : (n_triangles,) int32, face_uv : (n_triangles, 3, 2) float32
        Control faces, and places of corners in them.
    sent : (n_cells, C) float32
        What cells send; C is a multiple of 3.
    local : (n, n_rays) int16, as of `list_keys`
    begin : (n + 1,) int64
        Row of the first key of each hemisphere in the outputs, which are zero before.
    share : (n,) float32
        Factor on each hemisphere.
    irradiance : (m, C), by_turn, by_move : (m, C, 3) float32, out
    """
    for r in prange(len(begin) - 1):
        _sums_of_row(
            r,
            rays,
            keys,
            face,
            face_uv,
            sent,
            local,
            begin[r],
            begin[r + 1],
            share[r],
            turn_of(hash_combine(seed, rays.stream[r])),
            n_theta,
            n_phi,
            irradiance,
            by_turn,
            by_move,
        )


@kernel
def _sums_of_row(  # type: ignore[no-untyped-def]
    r,
    rays,
    keys,
    face,
    face_uv,
    sent,
    local,
    begin,
    end,
    factor,
    first_turn,
    n_theta,
    n_phi,
    irradiance,
    by_turn,
    by_move,
):
    if begin == end:
        return
    distance = rays.distance
    m, n = n_theta, n_phi
    n_channels = sent.shape[1]
    share = np.pi / (m * n) * factor
    slope, low, width = np.empty(m), np.empty(m), np.empty(m)
    for j in range(m):
        u = (j + 0.5) / m
        slope[j] = share * np.sqrt(u / (1.0 - u))
        low[j] = factor * (1.0 - j / m) * np.sqrt(j / m) * (2.0 * np.pi / n)
        width[j] = factor * (np.sqrt((j + 1) / m) - np.sqrt(j / m))
    across, along = np.empty(n), np.empty(n)
    edge_across, edge_along = np.empty(n + 1), np.empty(n + 1)
    for k in range(n):
        phi = 2.0 * np.pi * ((k + 0.5) / n + first_turn)
        edge = 2.0 * np.pi * (k / n + first_turn)
        across[k], along[k] = np.cos(phi), np.sin(phi)
        edge_across[k], edge_along[k] = np.cos(edge), np.sin(edge)
    edge_across[n], edge_along[n] = edge_across[0], edge_along[0]
    product = np.ones(1 << MOST_MASKS, np.float32)
    value = np.empty(n_channels, np.float64)
    d = rays.detour_begin[r]
    adjusted, adjusted_end = rays.adjusted_begin[r], rays.adjusted_begin[r + 1]
    for j in range(m):
        for k in range(n):
            ray = j * n + k
            flat = r * (m * n) + ray
            is_detour = d < rays.detour_begin[r + 1] and rays.detour[d] == flat
            if is_detour:
                d += 1
            is_adjusted = adjusted < adjusted_end and rays.adjusted[adjusted] == flat
            if is_adjusted:
                adjusted += 1
            if local[r, ray] < 0:
                continue
            cell = rays.cell[r, ray]
            for c in range(n_channels):
                value[c] = np.float64(sent[cell, c])
                if is_adjusted:
                    value[c] *= rays.throughput[adjusted - 1, c % 3]
            # A ray counts in the differences to the four beside it, with one sign or the other.
            far = distance[r, ray]
            before, after = (k - 1 if k > 0 else n - 1), (k + 1 if k + 1 < n else 0)
            out = 0.0
            if j > 0:
                out += low[j] / max(min(far, distance[r, ray - n]), _TOUCHING)
            if j + 1 < m:
                out -= low[j + 1] / max(min(far, distance[r, ray + n]), _TOUCHING)
            here = width[j] / max(min(far, distance[r, j * n + before]), _TOUCHING)
            there = width[j] / max(min(far, distance[r, j * n + after]), _TOUCHING)
            a = across[k] * out - edge_along[k] * here + edge_along[k + 1] * there
            b = along[k] * out + edge_across[k] * here - edge_across[k + 1] * there
            ga, gb = -along[k] * slope[j], across[k] * slope[j]
            i = rays.end_instance[d - 1] if is_detour else rays.instance[r, ray]
            n_masks = keys.n_masks[i]
            n_subsets = 1 << n_masks
            if n_masks > 0:
                if is_detour:
                    own_face = rays.end_face[d - 1]
                    s, t = rays.end_face_uv[d - 1, 0], rays.end_face_uv[d - 1, 1]
                else:
                    q = rays.triangle[r, ray]
                    own_face = face[q]
                    v, w = rays.uv[r, ray, 0], rays.uv[r, ray, 1]
                    u = np.float32(1.0) - v - w
                    s = u * face_uv[q, 0, 0] + v * face_uv[q, 1, 0] + w * face_uv[q, 2, 0]
                    t = u * face_uv[q, 0, 1] + v * face_uv[q, 1, 1] + w * face_uv[q, 2, 1]
                for bit in range(n_masks):
                    mask = keys.mask[i, bit]
                    size = keys.resolution[mask]
                    first = keys.texel_begin[mask] + (keys.first_face[mask, i] + own_face) * size * size
                    weight = texel_weight(keys.texels, first, size, s, t)
                    for subset in range(1 << bit):
                        product[subset | (1 << bit)] = product[subset] * weight
            row = begin + local[r, ray]
            # The light that no mask holds back has no key where no edit would ask for it.
            for subset in range(n_subsets - keys.count[i], n_subsets):
                p = product[subset]
                if p != np.float32(0.0):
                    for c in range(n_channels):
                        light = value[c] * p
                        irradiance[row, c] += share * light
                        by_turn[row, c, 0] += ga * light
                        by_turn[row, c, 1] += gb * light
                        by_move[row, c, 0] += a * light
                        by_move[row, c, 1] += b * light
                row += 1
    tx, ty, tz, bx, by, bz = basis(rays.shading_normal[r, 0], rays.shading_normal[r, 1], rays.shading_normal[r, 2])
    for row in range(begin, end):
        for c in range(n_channels):
            a, b = by_turn[row, c, 0], by_turn[row, c, 1]
            by_turn[row, c, 0], by_turn[row, c, 1] = a * tx + b * bx, a * ty + b * by
            by_turn[row, c, 2] = a * tz + b * bz
            a, b = by_move[row, c, 0], by_move[row, c, 1]
            by_move[row, c, 0], by_move[row, c, 1] = a * tx + b * bx, a * ty + b * by
            by_move[row, c, 2] = a * tz + b * bz


@parallel_kernel
def weigh_keys(  # type: ignore[no-untyped-def]
    wanted, begin, key, irradiance, by_turn, by_move, weight, shrink, out_irradiance, out_by_turn, out_by_move
):
    """Light of some records, each key times a weight.

    Parameters
    ----------
    wanted : (k,) int64
        Records.
    begin : (n + 1,) int64, key : (m,) int32
        Entries of each record.
    irradiance : (m, C), by_turn, by_move : (m, C, 3) float32
    weight : (n_keys, C) float32
    shrink : (n,) float32
        Factor on `by_move`.
    out_irradiance : (k, 3), out_by_turn, out_by_move : (k, 3, 3) float32, out, zero before
    """
    for q in prange(len(wanted)):
        r = wanted[q]
        for e in range(begin[r], begin[r + 1]):
            for c in range(weight.shape[1]):
                w = weight[key[e], c]
                if w == np.float32(0.0):
                    continue
                out_irradiance[q, c % 3] += w * irradiance[e, c]
                for axis in range(3):
                    out_by_turn[q, c % 3, axis] += w * by_turn[e, c, axis]
                    out_by_move[q, c % 3, axis] += w * by_move[e, c, axis]
        for c in range(3):
            for axis in range(3):
                out_by_move[q, c, axis] *= shrink[r]
