"""What hemispheres of rays bring from each caster: `record_sums`, split by sender."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
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
def ray_weights(distance, r, first_turn, n_theta, n_phi, factor, out):  # type: ignore[no-untyped-def]
    """How much each ray of hemisphere `r` counts: in its gradient with turns, and with place, along both tangents each.

    A ray counts in the differences to the four beside it, with one sign or the other (`record_sums`).

    Parameters
    ----------
    first_turn : float
        Where the first azimuth lies.
    factor : float
        On the hemisphere.
    out : (n_rays, 4) float32, out
    """
    m, n = n_theta, n_phi
    close = np.empty(m * n, np.float32)
    slope, low, width = np.empty(m), np.zeros(m + 1), np.empty(m)
    for j in range(m):
        u = (j + 0.5) / m
        slope[j] = np.pi / (m * n) * factor * np.sqrt(u / (1.0 - u))
        low[j] = (1.0 - j / m) * np.sqrt(j / m) * (2.0 * np.pi / n) * factor
        width[j] = factor * (np.sqrt((j + 1) / m) - np.sqrt(j / m))
    for ray in range(m * n):
        close[ray] = np.float32(1.0) / max(distance[r, ray], _TOUCHING)
    for k in range(n):
        phi = 2.0 * np.pi * ((k + 0.5) / n + first_turn)
        edge, next_edge = 2.0 * np.pi * (k / n + first_turn), 2.0 * np.pi * ((k + 1) / n + first_turn)
        across, along = np.cos(phi), np.sin(phi)
        edge_across, edge_along = np.cos(edge), np.sin(edge)
        next_across, next_along = np.cos(next_edge), np.sin(next_edge)
        before, after = (k - 1 if k > 0 else n - 1), (k + 1 if k + 1 < n else 0)
        for j in range(m):
            ray = j * n + k
            # Nothing is inside of the first ring, or outside of the last.
            step = low[j] * max(close[ray], close[ray - n if j > 0 else ray])
            step -= low[j + 1] * max(close[ray], close[ray + n if j + 1 < m else ray])
            here = width[j] * max(close[ray], close[j * n + before])
            there = width[j] * max(close[ray], close[j * n + after])
            out[ray, 0], out[ray, 1] = -along * slope[j], across * slope[j]
            out[ray, 2] = across * step - edge_along * here + next_along * there
            out[ray, 3] = along * step + edge_across * here - next_across * there


@kernel
def add_weighted(to, light, share, weights, ray):  # type: ignore[no-untyped-def]
    """Add a ray's light to five sums at an address: as it is, and times its `ray_weights`."""
    store_color(to, scale_add(light, share, load_color(to)))
    store_color(to + 16, scale_add(light, weights[ray, 0], load_color(to + 16)))
    store_color(to + 32, scale_add(light, weights[ray, 1], load_color(to + 32)))
    store_color(to + 48, scale_add(light, weights[ray, 2], load_color(to + 48)))
    store_color(to + 64, scale_add(light, weights[ray, 3], load_color(to + 64)))


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
    cell, instance, detour, end_instance = rays.cell, rays.instance, rays.detour, rays.end_instance
    n, last, place = 0, np.int32(-1), -1
    n_rays = cell.shape[1]
    d, d_end = rays.detour_begin[r], rays.detour_begin[r + 1]
    for ray in range(n_rays):
        i = instance[r, ray] if cell[r, ray] >= 0 else np.int32(-1)
        if d < d_end and detour[d] == r * n_rays + ray:
            i = end_instance[d]
            d += 1
        if i < 0 or not selected[i]:
            local[r, ray] = -1
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
            first_turn = turn_of(seed, rays.stream[r])
            _sums_of_row(r, rays, sent, local, begin[r], begin[r + 1], share[r], first_turn, n_theta, n_phi, out)


@kernel
def _sums_of_row(r, rays, sent, local, begin, end, factor, first_turn, n_theta, n_phi, out):  # type: ignore[no-untyped-def]
    cell, adjusted_ray = rays.cell, rays.adjusted
    n_rays, n_blocks = cell.shape[1], sent.shape[1]
    weights = np.empty((n_rays, 4), np.float32)
    ray_weights(rays.distance, r, first_turn, n_theta, n_phi, factor, weights)
    sums = np.zeros((end - begin, n_blocks, 5, 4), np.float32)
    sums_0, sent_0, throughput_0 = address_of(sums), address_of(sent), address_of(rays.throughput)
    share = np.float32(np.pi / n_rays * factor)
    adjusted, adjusted_end = rays.adjusted_begin[r], rays.adjusted_begin[r + 1]
    for ray in range(n_rays):
        is_adjusted = adjusted < adjusted_end and adjusted_ray[adjusted] == r * n_rays + ray
        if is_adjusted:
            adjusted += 1
        place = np.int64(local[r, ray])
        if place < 0:
            continue
        for block in range(n_blocks):
            light = load_color(sent_0 + 16 * (np.int64(cell[r, ray]) * n_blocks + block))
            if is_adjusted:
                light = color_product(light, load_rgb(throughput_0 + 12 * (adjusted - 1)))
            add_weighted(sums_0 + 80 * (place * n_blocks + block), light, share, weights, ray)
    nx, ny, nz = rays.shading_normal[r, 0], rays.shading_normal[r, 1], rays.shading_normal[r, 2]
    for e in range(end - begin):
        for block in range(n_blocks):
            turn_to_world(sums[e, block], nx, ny, nz, out[begin + e, block])
