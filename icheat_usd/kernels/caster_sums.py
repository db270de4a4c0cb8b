"""Rays of hemispheres, how much each of them counts in irradiance and its gradients, and which casters they see."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.simd import address_of, load, store_fours

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


class Senders(NamedTuple):
    """Surfaces that send light to records."""

    face: NDArray[np.int32]  #: (n_triangles,) control faces
    face_uv: NDArray[np.float32]  #: (n_triangles, 3, 2) places of corners in them
    sent: NDArray[np.float32]  #: (n_cells, n_blocks, 4) by group of lights, and how bright that is; below 0: transport
    selected: NDArray[np.uint8]  #: (n_instances,) casters that count


class WeightRoom(NamedTuple):
    """What `ray_weights` knows of hemispheres before it has seen one, and where it works: each thread has its own."""

    ring: NDArray[np.float64]  #: (n_theta, 4) slope of a turn, steps at the inner and the outer edge, width
    cos: NDArray[np.float32]  #: (n_phi + 1,) of the angles of sectors' edges from the first
    sin: NDArray[np.float32]  #: (n_phi + 1,)
    turned: NDArray[np.float32]  #: (4, n_phi + 1) scratch, as all that follow
    close: NDArray[np.float32]  #: (n_rays,)
    side: NDArray[np.float32]  #: (n_phi + 1,)
    step: NDArray[np.float32]  #: (n_phi,)
    by: NDArray[np.float32]  #: (4, n)
    weights: NDArray[np.float32]  #: (n, 4) what it finds; n is n_rays or a little more


@kernel
def weight_room(n_theta, n_phi):  # type: ignore[no-untyped-def]
    """Room for `ray_weights` of hemispheres of so many rings and sectors."""
    m, n = n_theta, n_phi
    ring, cos, sin = np.empty((m, 4)), np.empty(n + 1, np.float32), np.empty(n + 1, np.float32)
    for k in range(n + 1):
        cos[k], sin[k] = np.cos(2.0 * np.pi * k / n), np.sin(2.0 * np.pi * k / n)
    for j in range(m):
        u = (j + 0.5) / m
        ring[j, 0] = np.pi / (m * n) * np.sqrt(u / (1.0 - u))
        # Nothing is inside of the first ring, or outside of the last.
        ring[j, 1] = (1.0 - j / m) * np.sqrt(j / m) * 2.0 * np.pi / n
        ring[j, 2] = (1.0 - (j + 1) / m) * np.sqrt((j + 1) / m) * 2.0 * np.pi / n
        ring[j, 3] = np.sqrt((j + 1) / m) - np.sqrt(j / m)
    room = -(-m * n // 16) * 16
    return WeightRoom(
        ring,
        cos,
        sin,
        np.empty((4, n + 1), np.float32),
        np.empty(m * n, np.float32),
        np.empty(n + 1, np.float32),
        np.empty(n, np.float32),
        np.empty((4, room), np.float32),
        np.empty((room, 4), np.float32),
    )


@kernel
def ray_weights(distance, r, first_turn, factor, room):  # type: ignore[no-untyped-def]
    """How much each ray of hemisphere `r` counts: in its gradient with turns, and with place, along both tangents each.

    A ray counts in the differences to the four beside it, with one sign or the other (`record_sums`).

    Parameters
    ----------
    first_turn : float
        Where the first azimuth lies.
    factor : float
        On the hemisphere.
    room : WeightRoom
        The result is its `weights`.
    """
    ring, cos, sin, turned = room.ring, room.cos, room.sin, room.turned
    close, side, step, by, out = room.close, room.side, room.step, room.by, room.weights
    own = distance[r]
    cos_middle, sin_middle, cos_edge, sin_edge = turned[0], turned[1], turned[2], turned[3]
    m, n = len(ring), len(step)
    for ray in range(m * n):
        close[ray] = np.float32(1.0) / max(own[ray], _TOUCHING)
    # Edges and middles of sectors, turned from those of a hemisphere that begins at no angle.
    across, along = np.float32(np.cos(2.0 * np.pi * first_turn)), np.float32(np.sin(2.0 * np.pi * first_turn))
    for k in range(n + 1):
        cos_edge[k] = cos[k] * across - sin[k] * along
        sin_edge[k] = sin[k] * across + cos[k] * along
    half = 2.0 * np.pi * (first_turn + 0.5 / n)
    across, along = np.float32(np.cos(half)), np.float32(np.sin(half))
    for k in range(n + 1):
        cos_middle[k] = cos[k] * across - sin[k] * along
        sin_middle[k] = sin[k] * across + cos[k] * along
    for j in range(m):
        slope, low = np.float32(factor * ring[j, 0]), np.float32(factor * ring[j, 1])
        high, width = np.float32(factor * ring[j, 2]), np.float32(factor * ring[j, 3])
        inside, outside = (j * n - n if j > 0 else j * n), (j * n + n if j + 1 < m else j * n)
        # Loops over slices, with one result each, run over many rays at once: in a third of the time.
        own_ring, inner, outer = close[j * n : j * n + n], close[inside : inside + n], close[outside : outside + n]
        for k in range(n):
            step[k] = low * max(own_ring[k], inner[k]) - high * max(own_ring[k], outer[k])
        for k in range(1, n):
            side[k] = width * max(own_ring[k], own_ring[k - 1])
        side[0] = side[n] = width * max(own_ring[0], own_ring[n - 1])
        turn_a, turn_b = by[0, j * n : j * n + n], by[1, j * n : j * n + n]
        move_a, move_b = by[2, j * n : j * n + n], by[3, j * n : j * n + n]
        for k in range(n):
            turn_a[k] = -sin_middle[k] * slope
            turn_b[k] = cos_middle[k] * slope
        for k in range(n):
            move_a[k] = cos_middle[k] * step[k] - sin_edge[k] * side[k] + sin_edge[k + 1] * side[k + 1]
        for k in range(n):
            move_b[k] = sin_middle[k] * step[k] + cos_edge[k] * side[k] - cos_edge[k + 1] * side[k + 1]
    by_0, out_0, plane = address_of(by), address_of(out), 4 * len(out)
    for q in range(0, plane, 64):
        store_fours(
            out_0 + 4 * q,
            load(by_0 + q),
            load(by_0 + plane + q),
            load(by_0 + 2 * plane + q),
            load(by_0 + 3 * plane + q),
        )


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
            _list_row(np.int64(r), rays, selected, local, number, listed)


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
