"""Changes of records' light under edits of pairs: tables of what each edit makes of each ray, laid and summed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.hemisphere_light import arriving, linear_in_light
from icheat_usd.kernels.row_edits import ADD, OVER
from icheat_usd.kernels.samples import basis


class PairTable(NamedTuple):
    """What the keys of some edits make of n rays of some hemispheres, at full amount."""

    begin: NDArray[np.int64]  #: (n_hemispheres + 1,) rays of each
    ray: NDArray[np.int32]  #: (n,) ascending within each
    weight: NDArray[np.float32]  #: (n_keys, n)
    #: (n_places, n_keys, n, 1 or 3) S - 1 times the weight, for the receiver at the record and for some beside it
    change: NDArray[np.float32]
    emission: NDArray[np.float32]  #: the same of E, (n_places, n_keys, n, 3); (n_places, 0, 0, 3) if there is none


class PairEdits(NamedTuple):
    """Edits that act on pairs, weakest first."""

    first_key: NDArray[np.int64]  #: (n_edits + 1,)
    blend: NDArray[np.int64]  #: (n_edits,)
    groups: NDArray[np.uint8]  #: (n_edits, G) groups of lights that each acts on


@parallel_kernel
def pair_sums(  # type: ignore[no-untyped-def]
    hemispheres, pairs, edits, amount, sent, emits, seed, n_theta, n_phi, row, which, is_in, out, beside
):
    """Changes of irradiance and their gradients, of hemispheres `row` for receivers in sets of edits.

    Parameters
    ----------
    hemispheres : HemisphereTable, without casters
    amount : (n_sets, n_edits) float32
        Of each edit, for receivers in each set.
    sent : (G, n_cells, 3) float32
        Radiance that gather cells send.
    emits : bool
        Whether emission counts.
    row, which : (n,) int64
        Hemispheres that are summed, and the set of each.
    is_in : (n_sets, n_keys) uint8
    out : (n, 3, 7) float32
        By channel: the irradiance, its change with ``normal x other normal``, and with place; what the light of a ray
        depends on the receiver by is not in these.
    beside : (n, n_places - 1, 3) float32
        What the same rays bring more of to receivers beside the record.
    """
    for t in prange(len(row)):
        _sums_of_hemisphere(
            np.int64(t),
            hemispheres,
            pairs,
            edits,
            amount,
            sent,
            emits,
            seed,
            n_theta,
            n_phi,
            row,
            which,
            is_in,
            out,
            beside,
        )


@kernel
def _sums_of_hemisphere(  # type: ignore[no-untyped-def]
    t, hemispheres, pairs, edits, amount, sent, emits, seed, n_theta, n_phi, row, which, is_in, out, beside
):
    h, one, n_groups, n_places = row[t], which[t], len(sent), len(pairs.change)
    n_rays = n_theta * n_phi
    linear = np.empty((n_rays, 5), np.float32)
    linear_in_light(h, hemispheres, seed, n_theta, n_phi, linear)
    light, scale = np.empty((n_groups + 1, 3), np.float32), np.empty((n_groups + 1, 3), np.float32)
    change = np.empty(6, np.float32)
    total, more = np.zeros((3, 5), np.float64), np.zeros((n_places, 3), np.float64)
    is_grey = _is_grey(pairs, edits)
    a = hemispheres.adjusted_begin[h]
    for i in range(pairs.begin[h], pairs.begin[h + 1]):
        ray = pairs.ray[i]
        while a < hemispheres.adjusted_begin[h + 1] and hemispheres.adjusted[a] < h * n_rays + ray:
            a += 1
        a = arriving(h, ray, a, hemispheres, sent, emits, light)
        if is_grey:
            _add_grey(i, one, pairs, edits, amount, is_in, linear[ray], light, total, more)
            continue
        for place in range(n_places):
            if not _lay_all(i, place, one, pairs, edits, amount, is_in, change, scale):
                break  # nor at any other place
            for c in range(3):
                changed = scale[n_groups, c] * light[n_groups, c]
                for g in range(n_groups):
                    changed += (scale[g, c] - np.float32(1.0)) * light[g, c]
                more[place, c] += np.float64(linear[ray, 0]) * changed
                if place == 0:
                    for k in range(5):
                        total[c, k] += np.float64(linear[ray, k]) * changed
    normal = hemispheres.shading_normal
    tx, ty, tz, bx, by, bz = basis(normal[h, 0], normal[h, 1], normal[h, 2])
    for c in range(3):
        out[t, c, 0] = total[c, 0]
        for k in range(2):
            along_t, along_b = total[c, 1 + 2 * k], total[c, 2 + 2 * k]
            out[t, c, 1 + 3 * k] = along_t * tx + along_b * bx
            out[t, c, 2 + 3 * k] = along_t * ty + along_b * by
            out[t, c, 3 + 3 * k] = along_t * tz + along_b * bz
        for place in range(1, n_places):
            beside[t, place - 1, c] = more[place, c] - more[0, c]


@kernel
def _is_grey(pairs, edits):  # type: ignore[no-untyped-def]
    """Whether edits do the same to all channels and groups of lights, and add no light."""
    if pairs.change.shape[3] > 1 or pairs.emission.shape[1] > 0:
        return False
    for e in range(len(edits.blend)):
        for g in range(edits.groups.shape[1]):
            if edits.groups[e, g] == 0:
                return False
    return True


@kernel
def _add_grey(i, one, pairs, edits, amount, is_in, linear, light, total, more):  # type: ignore[no-untyped-def]
    """Add what the edits of a set change of a pair's light, if all are grey."""
    red, green, blue = np.float32(0.0), np.float32(0.0), np.float32(0.0)
    for g in range(len(light) - 1):
        red, green, blue = red + light[g, 0], green + light[g, 1], blue + light[g, 2]
    for place in range(len(more)):
        scale, acts = np.float32(1.0), False
        for e in range(len(edits.blend)):
            kept, change = np.float32(0.0), np.float32(0.0)
            for q in range(edits.first_key[e], edits.first_key[e + 1]):
                if is_in[one, q] != 0 and pairs.weight[q, i] != np.float32(0.0):
                    kept += pairs.weight[q, i]
                    change += pairs.change[place, q, i, 0]
            if kept != np.float32(0.0):
                acts = True
                scale = _laid(edits.blend[e], amount[one, e], kept, change, scale)
        if not acts:
            return  # nor at any other place
        factor = scale - np.float32(1.0)
        light_r, light_g, light_b = factor * red, factor * green, factor * blue
        straight = np.float64(linear[0])
        more[place, 0] += straight * light_r
        more[place, 1] += straight * light_g
        more[place, 2] += straight * light_b
        if place == 0:
            for k in range(5):
                by = np.float64(linear[k])
                total[0, k] += by * light_r
                total[1, k] += by * light_g
                total[2, k] += by * light_b


@kernel
def _laid(blend, amount, kept, change, scale):  # type: ignore[no-untyped-def]
    if blend == OVER:
        return (np.float32(1.0) - amount * kept) * scale + amount * (kept + change)
    if blend == ADD:
        return scale + amount * change
    return (np.float32(1.0) + amount * change) * scale


@kernel
def _lay_all(i, place, one, pairs, edits, amount, is_in, change, scale):  # type: ignore[no-untyped-def]
    """Lay the edits of a set over a pair (`edits.composing.lay`): S by group, and E; returns whether any acts."""
    n_groups, n_channels = len(scale) - 1, pairs.change.shape[3]
    for c in range(3):
        for g in range(n_groups):
            scale[g, c] = np.float32(1.0)
        scale[n_groups, c] = np.float32(0.0)
    acts = False
    for e in range(len(edits.blend)):
        kept, is_met = np.float32(0.0), False
        for c in range(6):
            change[c] = np.float32(0.0)
        for q in range(edits.first_key[e], edits.first_key[e + 1]):
            weight = pairs.weight[q, i]
            if is_in[one, q] == 0 or weight == np.float32(0.0):
                continue
            is_met = True
            kept += weight
            for c in range(3):
                change[c] += pairs.change[place, q, i, c if n_channels == 3 else 0]
                if pairs.emission.shape[1] > 0:
                    change[3 + c] += pairs.emission[place, q, i, c]
        if is_met:
            acts = True
            _lay(e, edits, amount[one, e], kept, change, scale)
    return acts


@kernel
def _lay(e, edits, amount, kept, change, scale):  # type: ignore[no-untyped-def]
    n_groups = len(scale) - 1
    whole = True
    for g in range(n_groups):
        whole = whole and edits.groups[e, g] != 0
    for c in range(3):
        carried, more = np.float32(1.0) + amount * change[c], np.float32(0.0)
        if edits.blend[e] == OVER:
            carried, more = np.float32(1.0) - amount * kept, amount * (kept + change[c])
        elif edits.blend[e] == ADD:
            carried, more = np.float32(1.0), amount * change[c]
        for g in range(n_groups):
            if edits.groups[e, g]:
                scale[g, c] = carried * scale[g, c] + more
        scale[n_groups, c] = (carried * scale[n_groups, c] if whole else scale[n_groups, c]) + amount * change[3 + c]
