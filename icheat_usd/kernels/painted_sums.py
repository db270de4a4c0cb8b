"""Light of cache records by caster and by what the painted masks on it leave of it: all that amounts do not change.

What a stack of edits makes of a pair is a polynomial of the weights of its painted masks, of no more than the first
degree in each. So of a caster with k of them, the light times the weights of each of their 2^k subsets tells all that
any amounts and colours, and any masks of receivers, make of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.caster_sums import ray_weights, weight_room
from icheat_usd.kernels.record_lanes import LANES, add_change, add_ray
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.simd import address_of, color_product, load_color, load_rgb, scaled
from icheat_usd.kernels.texels import corner_texels, texel_weight

#: Painted masks on one caster; with more, there are more subsets than it takes to look at the rays again.
MOST_PAINTED = 1

_CHUNK = 16  # rows that a thread takes


class Subsets(NamedTuple):
    """Sums that the rays of n hemispheres are added to: of each, its casters, and of these the subsets of masks."""

    local: NDArray[np.int16]  #: (n, n_rays) place of each ray's caster, as of `list_casters`
    begin: NDArray[np.int64]  #: (n + 1,) entries of each hemisphere, one for each caster
    first: NDArray[np.int64]  #: (m + 1,) sums of each entry, by the number of the subset: a bit for each mask
    caster: NDArray[np.int32]  #: (m,)
    share: NDArray[np.float32]  #: (n,) factor on each hemisphere


@parallel_kernel
def painted_sums(rays, senders, subsets, painted, least, seed, n_theta, n_phi, out):  # type: ignore[no-untyped-def]
    """What rays bring to records by caster, times the weights of subsets of its painted masks.

    Parameters
    ----------
    rays, senders, subsets : RayTable, Senders, Subsets
    painted : MaskTable
        Painted masks on each caster, no more than `MOST_PAINTED`, and nothing else.
    least : int
        1 to leave out the light itself, which no edit asks for that is painted.
    out : (n_sums, n_blocks, LANES) float32, out, zero before
    """
    n = len(subsets.begin) - 1
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        first_row = np.int64(chunk) * _CHUNK
        end_row = min(n, first_row + _CHUNK)
        _sums_of_some(first_row, end_row, rays, senders, subsets, painted, least, seed, n_theta, n_phi, out)


@kernel
def _sums_of_some(  # type: ignore[no-untyped-def]
    first_row, end_row, rays, senders, subsets, painted, least, seed, n_theta, n_phi, out
):
    room = weight_room(n_theta, n_phi)
    for r in range(first_row, end_row):
        if subsets.begin[r] < subsets.begin[r + 1]:
            ray_weights(rays.distance, r, turn_of(seed, rays.stream[r]), subsets.share[r], room)
            _sums_of_row(r, rays, senders, subsets, painted, least, address_of(room.weights), out)
    room.weights[0, 0] = np.float32(0.0)  # keeps it: Numba may free an array after its last mention


@kernel
def _sums_of_row(r, rays, senders, subsets, painted, least, weights_0, out):  # type: ignore[no-untyped-def]
    face, face_uv, sent = senders.face, senders.face_uv, senders.sent
    local, first, caster, begin = subsets.local, subsets.first, subsets.caster, subsets.begin[r]
    cell, adjusted_ray, detour = rays.cell, rays.adjusted, rays.detour
    triangle, uv, end_face, end_face_uv = rays.triangle, rays.uv, rays.end_face, rays.end_face_uv
    n_rays, n_blocks = cell.shape[1], sent.shape[1]
    sent_0, throughput_0 = address_of(sent), address_of(rays.throughput)
    out_0 = address_of(out) + 4 * LANES * n_blocks * first[begin]
    share = np.float32(np.pi / n_rays * subsets.share[r])
    adjusted, adjusted_end = rays.adjusted_begin[r], rays.adjusted_begin[r + 1]
    d, d_end = rays.detour_begin[r], rays.detour_begin[r + 1]
    mask_begin, mask_weight, mask, first_face = painted.begin, painted.weight, painted.mask, painted.first_face
    texels, texel_begin, resolution = painted.texels, painted.texel_begin, painted.resolution
    product = np.ones(1 << MOST_PAINTED, np.float32)
    for ray in range(n_rays):
        is_adjusted = adjusted < adjusted_end and adjusted_ray[adjusted] == r * n_rays + ray
        if is_adjusted:
            adjusted += 1
        is_detour = d < d_end and detour[d] == r * n_rays + ray
        if is_detour:
            d += 1
        place = np.int64(local[r, ray])
        if place < 0:
            continue
        i = np.int64(caster[begin + place])
        n = 1
        if mask_begin[i] < mask_begin[i + 1]:
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
            last, corners = np.int64(1), corner_texels(np.int64(1), at_s, at_t)
            for e in range(mask_begin[i], mask_begin[i + 1]):
                size = resolution[mask[e]]
                if size != last:
                    last, corners = size, corner_texels(size, at_s, at_t)
                texel = texel_begin[mask[e]] + (first_face[e] + own_face) * size * size
                own = mask_weight[e] * texel_weight(texels, texel, corners)
                for subset in range(n):
                    product[n + subset] = product[subset] * own
                n *= 2
        base = first[begin + place] - first[begin]
        for block in range(n_blocks):
            light = load_color(sent_0 + 16 * (np.int64(cell[r, ray]) * n_blocks + block))
            if is_adjusted and (is_detour or sent[cell[r, ray], block, 3] >= np.float32(0.0)):
                light = color_product(light, load_rgb(throughput_0 + 12 * (adjusted - 1)))
            for subset in range(least, n):
                if product[subset] != np.float32(0.0):
                    to = out_0 + 4 * LANES * ((base + subset) * n_blocks + block)
                    add_ray(to, scaled(light, product[subset]), share, weights_0, ray)


@parallel_kernel
def stack_of_painted(begin, caster, first, light, bit, casters, stack, slots, records, values, derivative):  # type: ignore[no-untyped-def]
    """Change of the light of slots, `stack_sums.stack_of_rays` from sums.

    Parameters
    ----------
    begin : (n_records + 1,) int64, caster : (m,) int32, first : (m + 1,) int64
    light : (n_sums, n_blocks, LANES) float32
        As of `painted_sums`, by record.
    bit : (n_entries,) int64
        Of each entry of `casters` in the numbers of subsets, -1 where it is not painted.
    casters, stack, slots : MaskTable, StackTable, SlotTable
    records : (k,) int64
        Records with slots.
    values : (n_slots, LANES), derivative : (n_derivatives, LANES) float32, out, zero before
    """
    for g in prange(len(records)):
        _of_painted(records[g], begin, caster, first, light, bit, casters, stack, slots, values, derivative)


@kernel
def _of_painted(r, begin, caster, first, light, bit, casters, stack, slots, values, derivative):  # type: ignore[no-untyped-def]
    n_most, n_blocks = 1 << MOST_PAINTED, stack.slope.shape[1]
    before, found = np.zeros((n_most, 2, 4), np.float32), np.zeros((n_most, 2, 4), np.float32)
    light_0, values_0, found_0 = address_of(light), address_of(values), address_of(found)
    derivative_0 = address_of(derivative)
    for e in range(begin[r], begin[r + 1]):
        i, n = np.int64(caster[e]), first[e + 1] - first[e]
        for s in range(slots.begin[r], slots.begin[r + 1]):
            for block in range(n_blocks):
                light_of_e = light_0 + 4 * LANES * (first[e] * n_blocks + block)
                _polynomial(i, s, block, -1, n, bit, casters, stack, slots, before, found)
                for subset in range(n):
                    at = light_of_e + 4 * LANES * n_blocks * subset
                    add_change(values_0 + 4 * LANES * s, load_color(found_0 + 32 * subset), at)
                if slots.derived[s] == slots.derived[s + 1]:
                    continue
                for k in range(casters.begin[i], casters.begin[i + 1]):
                    row = np.int64(casters.row[k])
                    place = np.int64(slots.place[slots.pattern[s], row])
                    if place < 0:
                        continue
                    _polynomial(i, s, block, row, n, bit, casters, stack, slots, before, found)
                    own = derivative_0 + 4 * LANES * (slots.derived[s] + place)
                    for subset in range(n):
                        at = light_of_e + 4 * LANES * n_blocks * subset
                        add_change(own, load_color(found_0 + 32 * subset + 16), at)


@kernel
def _polynomial(i, s, block, by, n, bit, casters, stack, slots, before, out):  # type: ignore[no-untyped-def]
    """Change of a block of S or E by the edits on caster `i`, as factors of the `n` products of painted weights.

    Beside it, its derivative by the receiver's mask of row `by`; ``before`` and ``out`` are (n, 2, 4).
    """
    masks, slope, shift, start = slots.masks, stack.slope, stack.shift, stack.start
    for subset in range(n):
        for c in range(3):
            out[subset, 0, c] = out[subset, 1, c] = np.float32(0.0)
    edit = -1
    for k in range(casters.begin[i], casters.begin[i + 1]):
        row = casters.row[k]
        if masks[s, row] == np.float32(0.0) and row != by:
            continue
        if stack.edit[row] != edit:
            # Keys of one edit all meet what weaker edits have left.
            edit = stack.edit[row]
            for subset in range(n):
                for c in range(3):
                    before[subset, 0, c], before[subset, 1, c] = out[subset, 0, c], out[subset, 1, c]
        step, weight = np.int64(0), casters.weight[k]
        if bit[k] >= 0:
            step, weight = np.int64(1) << bit[k], np.float32(1.0)
        inside, own = weight * masks[s, row], weight if row == by else np.float32(0.0)
        for c in range(3):
            a, b = slope[row, block, c], shift[row, block, c]
            out[step, 0, c] += inside * b
            out[step, 1, c] += own * b
            for subset in range(n):
                if subset & step:
                    continue
                met = before[subset, 0, c] + (start[block, c] if subset == 0 else np.float32(0.0))
                out[subset + step, 0, c] += inside * a * met
                out[subset + step, 1, c] += inside * a * before[subset, 1, c] + own * a * met
