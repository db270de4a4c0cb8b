"""A stack of sampled rows at the ends of a hemisphere's rays: laid edit by edit, and derived by each edit's rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.hemisphere_light import arriving

#: How an edit meets the weaker ones.
COMPOSE, OVER, ADD = 0, 1, 2


class Stack(NamedTuple):
    """Edits that act on pairs, weakest first, and their keys."""

    first_key: NDArray[np.int64]  #: (n_edits + 1,)
    blend: NDArray[np.int64]  #: (n_edits,)
    groups: NDArray[np.uint8]  #: (n_edits, G) groups of lights that each acts on
    payload: NDArray[np.int32]  #: (n_keys,) rows of each key, -1 for constants
    share: NDArray[np.float32]  #: (n_keys,) amount
    constant: NDArray[np.float32]  #: (n_keys, 6) S - 1 and E
    mask: NDArray[np.float32]  #: (n_keys, n_casters)
    key: NDArray[np.int32]  #: (n_payloads,)
    leaf: NDArray[np.int32]  #: (n_payloads, n_casters) -1 where rows are the identity
    column: NDArray[np.int32]  #: (n_payloads, 6) decoded column of S - 1 and of E, -1 for 0
    n_cells: NDArray[np.int64]  #: (n_payloads,)
    own: NDArray[np.int64]  #: (n_payloads + 1,) where the mixture of each begins in `own_rows`
    is_grey: bool  #: all edits do the same to all channels and groups of lights, and add no light


@kernel
def own_rows(b, stack, own_at, own_weight, decoded):  # type: ignore[no-untyped-def]
    """The mixture of each payload's rows at base `b`, which is looked at ray by ray; see `row_light.row_sums`."""
    own = np.zeros(stack.own[-1], np.float32)
    for one in range(len(stack.n_cells)):
        first, n = stack.own[one], stack.own[one + 1] - stack.own[one]
        for s in range(own_at.shape[2]):
            w, at = own_weight[b, one, s], own_at[b, one, s]
            if w != np.float32(0.0):
                for i in range(n):
                    own[first + i] += w * decoded[at + i]
    return own


@kernel
def derivatives(  # type: ignore[no-untyped-def]
    b,
    h,
    hemispheres,
    stack,
    sent,
    emits,
    acts,
    is_in,
    own,
    linear,
    light,
    scale,
    state,
    by_scale,
    by_emission,
    total,
):
    """Light of each ray by one unit more of each edit's S - 1 and E; what edits change of it is added to `total`.

    `own` is what `own_rows` made of the base.
    """
    n_groups = len(sent)
    a = hemispheres.adjusted_begin[h]
    change, met = np.empty(6, np.float32), np.empty(len(acts), np.bool_)
    for ray in range(hemispheres.cell.shape[1]):
        a = arriving(h, ray, a, hemispheres, sent, emits, light)
        if hemispheres.cell[h, ray] < 0:
            continue
        for c in range(3):
            for g in range(n_groups):
                scale[g, c] = np.float32(1.0)
            scale[n_groups, c] = np.float32(0.0)
        caster = hemispheres.caster[h, ray]
        n_met = 0
        for e in range(len(acts)):
            # Edits whose masks are 0 here carry all that they meet.
            met[e] = acts[e] != 0 and _is_masked(b, e, caster, stack, is_in)
            if met[e]:
                kept = _change_of(b, e, caster, stack, is_in, own, change)
                _lay(e, stack, kept, change, scale, state)
                n_met += 1
        if n_met == 0:
            continue
        for c in range(3):
            changed = scale[n_groups, c] * light[n_groups, c]
            for g in range(n_groups):
                changed += (scale[g, c] - np.float32(1.0)) * light[g, c]
            for i in range(5):
                total[c, i] += np.float64(linear[ray, i]) * changed
        # From the strongest edit back: `light` becomes what a unit of scale, left by the edits so far, comes to.
        for step in range(len(acts)):
            e = len(acts) - 1 - step
            if met[e]:
                _back(e, ray, stack, state, light, by_scale, by_emission)


@kernel
def grey_derivatives(  # type: ignore[no-untyped-def]
    b, h, hemispheres, stack, sent, acts, is_in, own, linear, light, state, by_scale, lit, total
):
    """`derivatives` where all edits are grey: `by_scale` (n_edits, n_rays) is of `lit`, a ray's light in lanes."""
    n_groups, n_edits = len(sent), len(acts)
    a = hemispheres.adjusted_begin[h]
    for ray in range(hemispheres.cell.shape[1]):
        a = arriving(h, ray, a, hemispheres, sent, False, light)
        if hemispheres.cell[h, ray] < 0:
            continue
        for c in range(3):
            whole = np.float32(0.0)
            for g in range(n_groups):
                whole += light[g, c]
            for k in range(5):
                lit[ray, 5 * c + k] = whole * linear[ray, k]
        caster, scale, n_met = hemispheres.caster[h, ray], np.float32(1.0), 0
        for e in range(n_edits):
            state[e, 0] = np.float32(-1.0)
            if acts[e] == 0 or not _is_masked(b, e, caster, stack, is_in):
                continue
            kept, change = _grey_change(b, e, caster, stack, is_in, own)
            carried, more = np.float32(1.0) + change, np.float32(0.0)
            if stack.blend[e] == OVER:
                carried, more = np.float32(1.0) - kept, kept + change
            elif stack.blend[e] == ADD:
                carried, more = np.float32(1.0), change
            state[e, 0], state[e, 1], state[e, 2] = np.float32(1.0), scale, carried
            scale = carried * scale + more
            n_met += 1
        if n_met == 0:
            continue
        factor = scale - np.float32(1.0)
        for k in range(15):
            total[k // 5, k % 5] += np.float64(factor * lit[ray, k])
        slope = np.float32(1.0)
        for step in range(n_edits):
            e = n_edits - 1 - step
            if state[e, 0] > np.float32(0.0):
                by_scale[e, ray] = slope * state[e, 1] if stack.blend[e] == COMPOSE else slope
                slope *= state[e, 2]


@kernel
def _grey_change(b, e, caster, stack, is_in, own):  # type: ignore[no-untyped-def]
    """The sum of the weights of an edit's keys for a pair, and S - 1."""
    kept, change = np.float32(0.0), np.float32(0.0)
    for q in range(stack.first_key[e], stack.first_key[e + 1]):
        mask = stack.mask[q, caster]
        if is_in[b, q] == 0 or mask == np.float32(0.0):
            continue
        kept += stack.share[q] * mask
        one = stack.payload[q]
        if one < 0:
            change += stack.share[q] * mask * stack.constant[q, 0]
        elif stack.leaf[one, caster] >= 0 and stack.column[one, 0] >= 0:
            at = stack.own[one] + stack.leaf[one, caster] + stack.column[one, 0] * stack.n_cells[one]
            change += mask * own[at]
    return kept, change


@kernel
def _is_masked(b, e, caster, stack, is_in):  # type: ignore[no-untyped-def]
    for q in range(stack.first_key[e], stack.first_key[e + 1]):
        if is_in[b, q] and stack.mask[q, caster] != np.float32(0.0):
            return True
    return False


@kernel
def _change_of(b, e, caster, stack, is_in, own, change):  # type: ignore[no-untyped-def]
    """S - 1 and E of one edit and pair, weighted, and the sum of its keys' weights."""
    kept, last = np.float32(0.0), np.float32(0.0)
    for c in range(6):
        change[c] = np.float32(0.0)
    for q in range(stack.first_key[e], stack.first_key[e + 1]):
        mask = stack.mask[q, caster]
        if is_in[b, q] == 0 or mask == np.float32(0.0):
            continue
        kept += stack.share[q] * mask
        one = stack.payload[q]
        if one < 0:
            for c in range(6):
                change[c] += stack.share[q] * mask * stack.constant[q, c]
            continue
        leaf = stack.leaf[one, caster]
        if leaf < 0:
            continue
        for c in range(6):
            column = stack.column[one, c]
            if column < 0:
                continue
            if c % 3 > 0 and column == stack.column[one, c - 1]:
                value = last
            else:
                value = own[np.int64(stack.own[one]) + leaf + column * stack.n_cells[one]]
            last = value
            change[c] += mask * value
    return kept


@kernel
def _lay(e, stack, kept, change, scale, state):  # type: ignore[no-untyped-def]
    """Lay an edit over a pair (`edits.composing.lay`), and keep what it met and what it carries of that."""
    n_groups = len(scale) - 1
    whole = _acts_on_all(stack.groups, e)
    for c in range(3):
        carried, more = np.float32(1.0) + change[c], np.float32(0.0)
        if stack.blend[e] == OVER:
            carried, more = np.float32(1.0) - kept, kept + change[c]
        elif stack.blend[e] == ADD:
            carried, more = np.float32(1.0), change[c]
        for g in range(n_groups):
            state[e, g, c] = scale[g, c]
            if stack.groups[e, g]:
                scale[g, c] = carried * scale[g, c] + more
        state[e, n_groups, c] = scale[n_groups, c]
        state[e, n_groups + 1, c] = carried
        scale[n_groups, c] = (carried * scale[n_groups, c] if whole else scale[n_groups, c]) + change[3 + c]


@kernel
def _acts_on_all(groups, e):  # type: ignore[no-untyped-def]
    for g in range(groups.shape[1]):
        if groups[e, g] == 0:
            return False
    return True


@kernel
def _back(e, ray, stack, state, light, by_scale, by_emission):  # type: ignore[no-untyped-def]
    n_groups = len(light) - 1
    whole = _acts_on_all(stack.groups, e)
    composes = stack.blend[e] == COMPOSE
    for c in range(3):
        carried = state[e, n_groups + 1, c]
        slope = np.float32(0.0)
        for g in range(n_groups):
            if stack.groups[e, g]:
                slope += light[g, c] * (state[e, g, c] if composes else np.float32(1.0))
                light[g, c] *= carried
        if whole and composes:
            slope += light[n_groups, c] * state[e, n_groups, c]
        by_scale[e, ray, c] = slope
        by_emission[e, ray, c] = light[n_groups, c]
        if whole:
            light[n_groups, c] *= carried
