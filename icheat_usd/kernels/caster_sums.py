"""What hemispheres of rays bring from each caster: `record_sums`, split by sender."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.samples import basis
from icheat_usd.kernels.simd import address_of, color_product, load_color, load_rgb, scale_add, store_color

#: Irradiance, its change with ``normal x other normal`` and with place: colours of a record's light.
N_VALUES = 7
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


@kernel
def sender_of(rays, r, ray, d):  # type: ignore[no-untyped-def]
    """Instance that sends light along a ray, -1 for none; `d` is the next detour."""
    if d < rays.detour_begin[r + 1] and rays.detour[d] == r * rays.cell.shape[1] + ray:
        return rays.end_instance[d]
    return rays.instance[r, ray] if rays.cell[r, ray] >= 0 else np.int32(-1)


class Strata(NamedTuple):
    """What rays of one hemisphere count in its irradiance and gradients, by ring and by sector."""

    slope: NDArray[np.float64]  #: (n_theta,)
    low: NDArray[np.float64]
    width: NDArray[np.float64]
    across: NDArray[np.float64]  #: (n_phi,)
    along: NDArray[np.float64]
    edge_across: NDArray[np.float64]  #: (n_phi + 1,)
    edge_along: NDArray[np.float64]
    share: float


@kernel
def strata_of(first_turn, n_theta, n_phi, factor):  # type: ignore[no-untyped-def]
    """Strata of a hemisphere whose first azimuth is at `first_turn`; all of it times `factor`."""
    m, n = n_theta, n_phi
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
    return Strata(slope, low, width, across, along, edge_across, edge_along, share)


@kernel
def ray_weights(strata, distance, r, j, k):  # type: ignore[no-untyped-def]
    """How much ray (j, k) counts: in the gradient with turns, and with place, along both tangents each.

    A ray counts in the differences to the four beside it, with one sign or the other (`record_sums`).
    """
    m, n = len(strata.slope), len(strata.across)
    ray = j * n + k
    far = distance[r, ray]
    before, after = (k - 1 if k > 0 else n - 1), (k + 1 if k + 1 < n else 0)
    out = 0.0
    if j > 0:
        out += strata.low[j] / max(min(far, distance[r, ray - n]), _TOUCHING)
    if j + 1 < m:
        out -= strata.low[j + 1] / max(min(far, distance[r, ray + n]), _TOUCHING)
    here = strata.width[j] / max(min(far, distance[r, j * n + before]), _TOUCHING)
    there = strata.width[j] / max(min(far, distance[r, j * n + after]), _TOUCHING)
    a = strata.across[k] * out - strata.edge_along[k] * here + strata.edge_along[k + 1] * there
    b = strata.along[k] * out + strata.edge_across[k] * here - strata.edge_across[k + 1] * there
    ga, gb = -strata.along[k] * strata.slope[j], strata.across[k] * strata.slope[j]
    return np.float32(ga), np.float32(gb), np.float32(a), np.float32(b)


@kernel
def add_weighted(to, light, share, ga, gb, a, b):  # type: ignore[no-untyped-def]
    """Add a ray's light to five sums at an address: as it is, and times its `ray_weights`."""
    store_color(to, scale_add(light, share, load_color(to)))
    store_color(to + 16, scale_add(light, ga, load_color(to + 16)))
    store_color(to + 32, scale_add(light, gb, load_color(to + 32)))
    store_color(to + 48, scale_add(light, a, load_color(to + 48)))
    store_color(to + 64, scale_add(light, b, load_color(to + 64)))


@kernel
def turn_to_world(sums, nx, ny, nz, out):  # type: ignore[no-untyped-def]
    """Values (N_VALUES, 4) of a record, out, from the five sums (5, 4) about its shading normal."""
    tx, ty, tz, bx, by, bz = basis(nx, ny, nz)
    for c in range(3):
        out[0, c] += sums[0, c]
        for which in range(2):
            a, b = sums[1 + 2 * which, c], sums[2 + 2 * which, c]
            out[1 + 3 * which, c] += a * tx + b * bx
            out[2 + 3 * which, c] += a * ty + b * by
            out[3 + 3 * which, c] += a * tz + b * bz


@parallel_kernel
def list_casters(rays, selected, wanted, local, number, listed):  # type: ignore[no-untyped-def]
    """Different instances that the rays of each row bring light of.

    Parameters
    ----------
    selected : (n_instances,) uint8
        Those that count.
    wanted : (n,) uint8
        Rows; the lists of all others are empty.
    local : (n, n_rays) int16, out
        Place of each ray's sender in the row's list, -1 for none.
    number : (n,) int32, listed : (n, room) int32, out
    """
    for r in prange(rays.cell.shape[0]):
        number[r] = 0
        if wanted[r]:
            _list_row(r, rays, selected, local, number, listed)


@kernel
def _list_row(r, rays, selected, local, number, listed):  # type: ignore[no-untyped-def]
    n, last, place = 0, -1, -1
    n_rays = rays.cell.shape[1]
    d = rays.detour_begin[r]
    for ray in range(n_rays):
        i = sender_of(rays, r, ray, d)
        if d < rays.detour_begin[r + 1] and rays.detour[d] == r * n_rays + ray:
            d += 1
        local[r, ray] = -1
        if i < 0 or not selected[i]:
            continue
        if i != last:
            place = 0
            while place < n and listed[r, place] != i:
                place += 1
            if place == n:
                listed[r, n] = i
                n += 1
            last = i
        local[r, ray] = place
    number[r] = n


@parallel_kernel
def caster_sums(rays, sent, local, begin, share, seed, n_theta, n_phi, out):  # type: ignore[no-untyped-def]
    """`record_sums.record_sums` of the light of each caster alone.

    Parameters
    ----------
    sent : (n_cells, n_blocks, 4) float32
        What cells send, by group of lights.
    local : (n, n_rays) int16, as of `list_casters`
    begin : (n + 1,) int64
        Row of the first caster of each hemisphere in the output.
    share : (n,) float32
        Factor on each hemisphere.
    out : (m, n_blocks, N_VALUES, 4) float32, out, zero before
    """
    for r in prange(len(begin) - 1):
        if begin[r] < begin[r + 1]:
            own = strata_of(turn_of(hash_combine(seed, rays.stream[r])), n_theta, n_phi, share[r])
            _sums_of_row(r, rays, sent, local, begin[r], begin[r + 1], own, out)


@kernel
def _sums_of_row(r, rays, sent, local, begin, end, strata, out):  # type: ignore[no-untyped-def]
    n_phi = len(strata.across)
    n_blocks = sent.shape[1]
    sums = np.zeros((end - begin, n_blocks, 5, 4), np.float32)
    sums_0, sent_0, throughput_0 = address_of(sums), address_of(sent), address_of(rays.throughput)
    share = np.float32(strata.share)
    adjusted, adjusted_end = rays.adjusted_begin[r], rays.adjusted_begin[r + 1]
    for j in range(len(strata.slope)):
        for k in range(n_phi):
            ray = j * n_phi + k
            is_adjusted = adjusted < adjusted_end and rays.adjusted[adjusted] == r * rays.cell.shape[1] + ray
            if is_adjusted:
                adjusted += 1
            if local[r, ray] < 0:
                continue
            ga, gb, a, b = ray_weights(strata, rays.distance, r, j, k)
            for block in range(n_blocks):
                light = load_color(sent_0 + 16 * (np.int64(rays.cell[r, ray]) * n_blocks + block))
                if is_adjusted:
                    light = color_product(light, load_rgb(throughput_0 + 12 * (adjusted - 1)))
                add_weighted(sums_0 + 80 * (np.int64(local[r, ray]) * n_blocks + block), light, share, ga, gb, a, b)
    nx, ny, nz = rays.shading_normal[r, 0], rays.shading_normal[r, 1], rays.shading_normal[r, 2]
    for e in range(end - begin):
        for block in range(n_blocks):
            turn_to_world(sums[e, block], nx, ny, nz, out[begin + e, block])
