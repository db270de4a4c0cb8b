"""Packets of 16 gather rays: traced together, and the gather cells that they end in looked up side by side."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.cell_map import (
    NO_FACES,
    WALK,
    nearest_listed,
    place_on,
    plane_of,
    side_seen,
    square_at,
    unit_normal,
)
from icheat_usd.kernels.embree import PACKET, call_1, call_packet
from icheat_usd.kernels.fetch import fetch
from icheat_usd.kernels.locate import nearest_sample

NOTHING = -1  # cell of a ray that ends nowhere: below its surface, or on a degenerate triangle
DETOUR = -2  # cell of a ray that ended on a triangle that does not simply reflect
INVALID = np.uint32(0xFFFFFFFF)  # what Embree calls no geometry
CELL, INSTANCE, TRIANGLE = 0, 1, 2  #: rows of `look_up_cells`
_SIDE, _SQUARE, _LISTED, _ROWS = 3, 4, 5, 6  # and what it keeps in others


@kernel
def make_packet():  # type: ignore[no-untyped-def]
    """Room for 16 rays as `trace_16` wants them: which count, their floats, the same as words, and those of one ray."""
    storage = np.zeros(PACKET + 64, np.float32)
    shift = np.int64((-storage.ctypes.data % 64) // 4)
    valid = storage[shift : shift + 16].view(np.int32)
    rays = storage[shift + 16 : shift + 16 + PACKET].reshape(22, 16)
    single = storage[shift + 16 + PACKET : shift + 40 + PACKET]
    return valid, rays, rays.view(np.uint32), single, single.view(np.uint32)


@kernel
def clear_packet(rays, words):  # type: ignore[no-untyped-def]
    """Rays without end that have met nothing; origins and directions stay."""
    rays[3, :] = 0.0
    rays[7, :] = 0.0
    rays[8, :] = np.inf
    words[9, :] = INVALID
    words[10, :] = 0
    words[11, :] = 0
    words[17:21, :] = INVALID


@kernel
def trace_16(trace, rays, words, valid, rays_at, valid_at, single, single_words, single_at):  # type: ignore[no-untyped-def]
    """Nearest hits of a packet, one by one where packets are slower."""
    if trace.packets:
        call_packet(trace.function, valid_at, trace.scene, rays_at, trace.arguments)
        return
    for k in range(16):
        if valid[k] == 0:
            continue
        for c in range(12):
            single[c] = rays[c, k]
        for c in range(17, 21):
            single_words[c] = INVALID
        call_1(trace.function, trace.scene, single_at)
        rays[8, k] = single[8]
        for c in range(15, 17):
            rays[c, k] = single[c]
        for c in range(17, 21):
            words[c, k] = single_words[c]


@kernel
def make_look_up():  # type: ignore[no-untyped-def]
    """Room for `look_up_cells`: whole numbers and others of 16 rays."""
    return np.empty((_ROWS, 16), np.int64), np.empty((16, 9), np.float64)


@kernel
def look_up_cells(  # type: ignore[no-untyped-def]
    valid,
    rays,
    words,
    mesh_begin,
    instance_mesh,
    place,
    face,
    square,
    candidates,
    sample,
    slot,
    slot_detour,
    locator,
    points,
    to_world,
    to_object,
    triangle_route,
    stack,
    bound,
    found,
    at,
):
    """Gather cells in which the traced rays of a packet end.

    In steps over the packet: what one ray loads next is on its way to the cache while the others take the same step.

    Parameters
    ----------
    valid, rays, words
        Of `make_packet`, after `trace_16`.
    mesh_begin, instance_mesh, place, face, square, candidates, sample, slot, slot_detour
        Columns of `TraceTable`, `CellTable` and the locator's table, taken from them outside all loops; see `cell_map`.
    locator
        That table itself.
    points, to_world, to_object, triangle_route
        As of `gather_rows.count_hits`.
    stack : (depth + 1, 2) int64, bound : (depth + 1,) float32
        Work space for the locator's tree.
    found, at
        Of `make_look_up`. Rows of `found`: `CELL`, a cell, `NOTHING` or `DETOUR`; `INSTANCE` and `TRIANGLE`, -1 where
        nothing is met.
    """
    for k in range(16):
        found[CELL, k] = NOTHING
        found[INSTANCE, k] = -1
        found[TRIANGLE, k] = -1
        if valid[k] != 0 and words[18, k] != INVALID:
            i = np.int64(words[18, k] if words[19, k] == INVALID else words[19, k])
            t = mesh_begin[instance_mesh[i]] + np.int64(words[17, k])
            found[INSTANCE, k] = i
            found[TRIANGLE, k] = t
            fetch(points, t)
            fetch(points, t + 1)  # a triangle may lie on two lines of the cache
            fetch(triangle_route, t)
            fetch(face, max(0, 2 * (place[i] + t)))
    for k in range(16):
        i, t = found[INSTANCE, k], found[TRIANGLE, k]
        found[_LISTED, k] = 0
        if i < 0:
            continue
        if triangle_route[t] != 0:
            found[CELL, k] = DETOUR
            continue
        plane = plane_of(points, to_object, i, t)
        if not plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2] > 0.0:
            continue
        at[k, 6], at[k, 7], at[k, 8] = plane
        side = side_seen(plane, rays[4, k], rays[5, k], rays[6, k])
        found[_SIDE, k] = side
        found[_LISTED, k] = 1
        found[CELL, k] = WALK
        found[_SQUARE, k] = -1
        if place[i] != NO_FACES:
            f = 2 * (place[i] + t) + side
            found[CELL, k] = face[f, 0]
            found[_SQUARE, k] = square_at(face, f, rays[15, k], rays[16, k])
            fetch(square, max(found[_SQUARE, k], 0))
    for k in range(16):
        if found[_LISTED, k] == 0:
            continue
        if found[_SQUARE, k] >= 0:
            found[CELL, k] = square[found[_SQUARE, k]]
        entry = found[CELL, k]
        if entry >= 0:
            found[_LISTED, k] = 0
            continue
        if entry != WALK:
            fetch(candidates, -1 - entry)
        i, t, plane = found[INSTANCE, k], found[TRIANGLE, k], (at[k, 6], at[k, 7], at[k, 8])
        at[k, 0], at[k, 1], at[k, 2] = place_on(points, to_world, i, t, rays[15, k], rays[16, k])
        at[k, 3], at[k, 4], at[k, 5] = unit_normal(plane, found[_SIDE, k])
    for k in range(16):
        if found[_LISTED, k] == 1 and found[CELL, k] != WALK:
            begin = -found[CELL, k]
            for a in range(begin, begin + min(candidates[begin - 1], 4)):
                fetch(sample, candidates[a])
    for k in range(16):
        if found[_LISTED, k] == 0:
            continue
        entry, i, side = found[CELL, k], found[INSTANCE, k], found[_SIDE, k]
        px, py, pz = np.float32(at[k, 0]), np.float32(at[k, 1]), np.float32(at[k, 2])
        nx, ny, nz = np.float32(at[k, 3]), np.float32(at[k, 4]), np.float32(at[k, 5])
        if entry == WALK:
            found[CELL, k] = nearest_sample(locator, i, side, px, py, pz, nx, ny, nz, stack, bound)
        else:
            detour = slot_detour[slot[2 * i + side]]
            found[CELL, k] = nearest_listed(candidates, sample, entry, detour, px, py, pz, nx, ny, nz)
