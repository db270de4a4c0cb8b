"""Rays of cache records that end where painted masks weigh alike, taken together.

What a stack of edits makes of a ray is a polynomial of the painted weights where it ends, of no more than the first
degree in each. Rays of one caster whose weights lie close to each other are as good as one ray that brings all their
light from where these weights have their mean: what is missed is how two masks change together among them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.caster_sums import RayTable, Senders, WeightRoom, ray_weights, weight_room
from icheat_usd.kernels.mask_patches import MaskPatches
from icheat_usd.kernels.mask_sheets import MaskSheets, add_texel, add_weights_in_sheet
from icheat_usd.kernels.record_lanes import LANES, add_ray
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.simd import address_of, black, color_product, load_color, load_rgb, store_color
from icheat_usd.kernels.texels import near_texels

#: Of a record where patches leave more than one in so many rays, rays are kept apart but for plateaus: it gains
#: little, and gradients suffer from errors that jump.
_FEW = 4

#: More turns than there are threads; each has records from everywhere, and memory of its own, which only pays for
#: several of them.
_TURNS, _LEAST_OF_TURN = 64, 8


class RayGroups(NamedTuple):
    """Hemispheres ``order[first[g]:first[g + 1]]`` of each of some records."""

    n_theta: int
    n_phi: int
    seed: int
    order: NDArray[np.int64]
    first: NDArray[np.int64]  #: (n_groups + 1,)
    record: NDArray[np.int64]  #: (n_groups,)
    share: NDArray[np.float32]  #: (n_records,) factor on the hemispheres of each


class PaintedRays(NamedTuple):
    """Rays of records, and the painted surfaces that they end on.

    Parallel loops are given its parts, as they take no tuples of tuples.
    """

    rays: RayTable
    groups: RayGroups
    senders: Senders
    sheets: MaskSheets
    patches: MaskPatches  #: where rays are taken together
    plateaus: MaskPatches  #: where all weights are the same


class RayRoom(NamedTuple):
    """Where the rays of one record after the other are taken together: each thread has its own."""

    weights: WeightRoom
    bright: NDArray[np.float32]  #: (n_rays of the longest record,) light of what is kept
    key: NDArray[np.int64]  #: (a power of two,) instances, and behind these patches; -1 for none
    kept: NDArray[np.int64]  #: (the same,) what is kept of each


@kernel
def ray_room(painted, turn):  # type: ignore[no-untyped-def]
    """Room for `merge_record` of the records of a turn."""
    groups, most = painted.groups, np.int64(0)
    for g in range(turn, len(groups.record), number_of_turns(groups)):
        most = max(most, groups.first[g + 1] - groups.first[g])
    n, n_patches = most * groups.n_theta * groups.n_phi, max(painted.patches.number, painted.plateaus.number)
    n_places = 4
    while n_places < 2 * min(n, len(painted.senders.selected) + n_patches):
        n_places *= 2
    return RayRoom(
        weight_room(groups.n_theta, groups.n_phi),
        np.empty(n, np.float32),
        np.full(n_places, -1, np.int64),
        np.empty(n_places, np.int64),
    )


@kernel
def number_of_turns(groups):  # type: ignore[no-untyped-def]
    """In how many turns threads take records: turn t has t, t + n, t + 2 n and so on."""
    return min(_TURNS, (len(groups.record) + _LEAST_OF_TURN - 1) // _LEAST_OF_TURN)


@parallel_kernel
def merge_rays(  # type: ignore[no-untyped-def]
    rays, groups, senders, sheets, patches, plateaus, number, caster, weights, light
):
    """What rays bring to records, by caster and by the painted weights where they end.

    Parameters
    ----------
    rays, groups, senders, sheets, patches, plateaus
        `PaintedRays`.
    number : (n_groups,) int64, out
        How many are left of the rays of each record.
    caster : (n_groups, room) int32, out
    weights : (n_groups, room, width) float32, out
        Mean of the sheets' columns: of rays in patches as the nearest texels of the finest sheet have them.
    light : (n_groups, room, n_blocks, LANES) float32, out
    """
    for turn in prange(number_of_turns(groups)):
        painted = PaintedRays(rays, groups, senders, sheets, patches, plateaus)
        _merge_some(np.int64(turn), painted, number, caster, weights, light)


@kernel
def _merge_some(turn, painted, number, caster, weights, light):  # type: ignore[no-untyped-def]
    room = ray_room(painted, turn)
    for g in range(turn, len(number), number_of_turns(painted.groups)):
        number[g] = merge_record(g, painted, room, caster[g], weights[g], light[g])


@parallel_kernel
def keep(end, number, caster, weights, light, kept_caster, kept_weights, kept_light):  # type: ignore[no-untyped-def]
    """Put what `merge_rays` left of each record's rays into rows up to ``end[g]`` of other arrays."""
    for g in prange(len(number)):
        at = np.int64(g)
        _keep(at, end[g] - number[g], end[g], caster, weights, light, kept_caster, kept_weights, kept_light)


@kernel
def _keep(g, first, end, caster, weights, light, kept_caster, kept_weights, kept_light):  # type: ignore[no-untyped-def]
    kept_caster[first:end] = caster[g, : end - first]
    kept_weights[first:end] = weights[g, : end - first]
    kept_light[first:end] = light[g, : end - first]


@kernel
def merge_record(g, painted, room, caster, weights, light):  # type: ignore[no-untyped-def]
    """`merge_rays` of one record: how many are left of its rays."""
    n_rays = painted.rays.cell.shape[1] * (painted.groups.first[g + 1] - painted.groups.first[g])
    most = n_rays // _FEW if weights.shape[1] > 0 else n_rays
    n, n_seen = _take_together(g, painted, painted.patches, most, room, caster, weights, light)
    if _FEW * n > n_seen and weights.shape[1] > 0:
        n, n_seen = _take_together(g, painted, painted.plateaus, n_rays, room, caster, weights, light)
    return n


@kernel
def _take_together(g, painted, patches, most, room, caster, weights, light):  # type: ignore[no-untyped-def]
    """How many are left of a record's rays, and how many there are; it gives up when more than `most` are left."""
    # Loops look into arrays of their own: to look into tuples again and again took half of all time.
    rays, groups, senders, sheets = painted.rays, painted.groups, painted.senders, painted.sheets
    face, face_uv, sent, selected = senders.face, senders.face_uv, senders.sent, senders.selected
    order, stream = groups.order, rays.stream
    width, n_rays, n_blocks, n_instances = weights.shape[1], rays.cell.shape[1], sent.shape[1], len(selected)
    seed, factor = groups.seed, groups.share[groups.record[g]]
    of_weights, bright, key, kept = room.weights, room.bright, room.key, room.kept
    key[:] = -1
    light_0, sent_0, texels_0 = address_of(light), address_of(sent), address_of(sheets.texels)
    mean_0, weight_0, throughput_0 = address_of(weights), address_of(of_weights.weights), address_of(rays.throughput)
    cell, instance, triangle, uv, throughput = rays.cell, rays.instance, rays.triangle, rays.uv, rays.throughput
    detour, end_instance, end_face, end_face_uv = rays.detour, rays.end_instance, rays.end_face, rays.end_face_uv
    adjusted_ray, detour_begin, adjusted_begin = rays.adjusted, rays.detour_begin, rays.adjusted_begin
    sheet_begin, resolution, sheet_first, sheet_width = sheets.begin, sheets.resolution, sheets.first, sheets.width
    first_cell, patch = patches.first, patches.patch
    share = np.float32(np.pi / n_rays * factor)
    n, n_seen, last, last_key = 0, 0, np.int64(-1), np.int64(-1)
    last_instance, is_painted = np.int64(-1), False
    first_sheet, sheet_end, own_first, size = np.int64(0), np.int64(0), np.int64(0), np.int64(0)
    for k in range(groups.first[g], groups.first[g + 1]):
        r = order[k]
        ray_weights(rays.distance, r, turn_of(seed, stream[r]), factor, of_weights)
        d, d_end, a, a_end = detour_begin[r], detour_begin[r + 1], adjusted_begin[r], adjusted_begin[r + 1]
        next_detour = detour[d] - r * n_rays if d < d_end else n_rays
        next_adjusted = adjusted_ray[a] - r * n_rays if a < a_end else n_rays
        for ray in range(n_rays):
            sender = np.int64(cell[r, ray])
            i = np.int64(instance[r, ray]) if sender >= 0 else np.int64(-1)
            is_detour, is_adjusted = ray == next_detour, ray == next_adjusted
            if is_detour:
                i = np.int64(end_instance[d])
                d += 1
                next_detour = detour[d] - r * n_rays if d < d_end else n_rays
            if is_adjusted:
                a += 1
                next_adjusted = adjusted_ray[a] - r * n_rays if a < a_end else n_rays
            if i < 0 or not selected[i]:
                continue
            n_seen += 1
            if i != last_instance:
                last_instance, first_sheet, sheet_end = i, sheet_begin[i], sheet_begin[i + 1]
                own_first, is_painted = first_cell[i], first_sheet < sheet_end
                # The finest sheet is the last.
                size = resolution[sheet_end - 1] if is_painted else np.int64(0)
            own_key, own_face, nearest = i, np.int64(0), np.int64(0)
            s, t = np.float32(0.0), np.float32(0.0)
            if is_painted:
                if is_detour:
                    own_face = np.int64(end_face[d - 1])
                    s, t = end_face_uv[d - 1, 0], end_face_uv[d - 1, 1]
                else:
                    hit = np.int64(triangle[r, ray])
                    own_face = np.int64(face[hit])
                    v, w = uv[r, ray, 0], uv[r, ray, 1]
                    u = np.float32(1.0) - v - w
                    s = u * face_uv[hit, 0, 0] + v * face_uv[hit, 1, 0] + w * face_uv[hit, 2, 0]
                    t = u * face_uv[hit, 0, 1] + v * face_uv[hit, 1, 1] + w * face_uv[hit, 2, 1]
                cell_of_face, nearest = near_texels(size, s, t)
                first_texel = own_face * size * size
                nearest += first_texel
                own_patch = patch[own_first + first_texel + cell_of_face]
                own_key = n_instances + own_patch if own_patch >= 0 else np.int64(-1)
            if own_key < 0 or own_key != last_key:
                # Rays without a patch are kept apart.
                place = _place(own_key, key) if own_key >= 0 else np.int64(-1)
                if place < 0 or key[place] < 0:
                    if n == most:
                        return n + 1, n_seen
                    last = n
                    caster[n], bright[n] = i, np.float32(0.0)
                    _blacken(light_0 + 4 * LANES * n_blocks * n, LANES // 4 * n_blocks)
                    _blacken(mean_0 + 4 * width * n, width // 4)
                    n += 1
                    if place >= 0:
                        key[place], kept[place] = own_key, last
                else:
                    last = kept[place]
                last_key = own_key
            if is_painted:
                size_of_light = np.float32(0.0)
                for block in range(n_blocks):
                    if is_adjusted and (is_detour or sent[sender, block, 3] >= np.float32(0.0)):
                        for c in range(3):
                            size_of_light += sent[sender, block, c] * throughput[a - 1, c]
                    else:
                        size_of_light += abs(sent[sender, block, 3])
                bright[last] += size_of_light
                to = mean_0 + 4 * width * last
                for sheet in range(first_sheet, sheet_end):
                    wide = sheet_width[sheet]
                    if own_key >= 0 and sheet + 1 == sheet_end:
                        # Of many rays that end in one patch the nearest texels are as good, for a quarter of the reads.
                        add_texel(sheet_first[sheet], wide, nearest, size_of_light, texels_0, to)
                    else:
                        add_weights_in_sheet(
                            resolution[sheet], sheet_first[sheet], wide, own_face, s, t, size_of_light, texels_0, to
                        )
                    to += 4 * wide
            for block in range(n_blocks):
                brought = load_color(sent_0 + 16 * (sender * n_blocks + block))
                if is_adjusted and (is_detour or sent[sender, block, 3] >= np.float32(0.0)):
                    brought = color_product(brought, load_rgb(throughput_0 + 12 * (a - 1)))
                add_ray(light_0 + 4 * LANES * (last * n_blocks + block), brought, share, weight_0, ray)
    for e in range(n):
        if bright[e] > np.float32(0.0):
            for c in range(width):
                weights[e, c] /= bright[e]
    return n, n_seen


@kernel
def _place(wanted, key):  # type: ignore[no-untyped-def]
    """Where a number is in a table, or where there is room for it; the table's size is a power of two."""
    last = len(key) - 1
    place = wanted & last
    while key[place] >= 0 and key[place] != wanted:
        place = (place + 1) & last
    return place


@kernel
def _blacken(to, n):  # type: ignore[no-untyped-def]
    """Set `n` colours at an address to 0."""
    for k in range(n):
        store_color(to + 16 * k, black())
