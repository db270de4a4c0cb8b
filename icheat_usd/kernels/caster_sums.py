"""Rays of hemispheres, how much each of them counts in irradiance and its gradients, and which casters they see."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.samples import basis
from icheat_usd.kernels.simd import load_color, scale_add, store_color

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
    close, azimuth = np.empty(m * n, np.float32), np.empty((n + 1, 4), np.float32)
    for ray in range(m * n):
        close[ray] = np.float32(1.0) / max(distance[r, ray], _TOUCHING)
    # Middles and edges of sectors, each a turn of the one before.
    cos, sin = np.cos(2.0 * np.pi / n), np.sin(2.0 * np.pi / n)
    across, along = np.cos(2.0 * np.pi * (0.5 / n + first_turn)), np.sin(2.0 * np.pi * (0.5 / n + first_turn))
    edge_across, edge_along = np.cos(2.0 * np.pi * first_turn), np.sin(2.0 * np.pi * first_turn)
    for k in range(n + 1):
        azimuth[k, 0], azimuth[k, 1], azimuth[k, 2], azimuth[k, 3] = across, along, edge_across, edge_along
        across, along = across * cos - along * sin, along * cos + across * sin
        edge_across, edge_along = edge_across * cos - edge_along * sin, edge_along * cos + edge_across * sin
    for j in range(m):
        u = (j + 0.5) / m
        slope = np.float32(np.pi / (m * n) * factor * np.sqrt(u / (1.0 - u)))
        sector = 2.0 * np.pi / n * factor
        # Nothing is inside of the first ring, or outside of the last.
        low = np.float32((1.0 - j / m) * np.sqrt(j / m) * sector)
        high = np.float32((1.0 - (j + 1) / m) * np.sqrt((j + 1) / m) * sector)
        inside, outside = (j * n - n if j > 0 else j * n), (j * n + n if j + 1 < m else j * n)
        width = np.float32(factor * (np.sqrt((j + 1) / m) - np.sqrt(j / m)))
        there = width * max(close[j * n], close[j * n + n - 1])
        for k in range(n):
            ray = j * n + k
            here, there = there, width * max(close[ray], close[ray + 1 if k + 1 < n else j * n])
            step = low * max(close[ray], close[inside + k]) - high * max(close[ray], close[outside + k])
            out[ray, 0], out[ray, 1] = -azimuth[k, 1] * slope, azimuth[k, 0] * slope
            out[ray, 2] = azimuth[k, 0] * step - azimuth[k, 3] * here + azimuth[k + 1, 3] * there
            out[ray, 3] = azimuth[k, 1] * step + azimuth[k, 2] * here - azimuth[k + 1, 2] * there


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
