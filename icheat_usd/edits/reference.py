"""The slow, obvious evaluator: what an edit stack means, pair by pair, in double precision.

    B'_i = s_i sum_j [ t_ij (sum_l S_ijl b_jl + E_ij) + A_j sum_l O_ijl b_jl + sum_k P_ijk h_ijk b_j ] + o_i

`h` is transport that the occluders of edit k hold back, and `P` how much of
it the edit lets through. Aggregates scale S, E, O and P of a receiver's pairs
by what they make of the sum over their casters, which send as E what no scale
can reach, and views act on the result;
`l` runs over groups of lights. This loop is the definition; every renderer is
tested against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.bound import BoundEdit, Ends
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level, PairEnd, Pairs

F64Array = NDArray[np.float64]


class PairFunctions(NamedTuple):
    """The composed functions at one pair, float64."""

    scale: F64Array  #: (G, 3)
    emission: F64Array  #: (3,)
    offset_diffuse: F64Array  #: (G, 3)
    offset_paint: F64Array  #: (G, 3)
    through: F64Array  #: (n_throughs, G, 3)


class Resolved(NamedTuple):
    """What an aggregate came to at one receiver, float64."""

    scale: F64Array  #: (3,)
    emission: F64Array  #: (3,) radiance that each of its casters sends anew


def pair_functions(
    field: EditField,
    b: F64Array,
    receiver: Ends,
    caster: Ends,
    resolved: Sequence[Resolved] = (),
    upto: int | None = None,
) -> PairFunctions:
    """S, E, O and P for one pair.

    Parameters
    ----------
    b : (G, 3) radiance that leaves the gather sample, by group of lights
    receiver, caster : Ends of one point each
    resolved : what each aggregate came to at this receiver
    upto : compose only the edits before this one
    """
    n_groups = len(b)
    scale, emission = np.ones((n_groups, 3)), np.zeros(3)
    # Offsets and what passes occluders behave alike: one table, by kind.
    carried: dict[Any, F64Array] = {kind: np.zeros((n_groups, 3)) for kind in ("diffuse", "paint", *field.throughs)}
    row = located = n_resolved = 0
    for index, bound in enumerate(field.edits[:upto]):
        first_row, first_located = row, located
        row += bound.n_keys
        located += sum(rows is not None for rows in bound.rows)
        if bound.level is Level.VIEW:
            continue
        found: Sequence[Resolved] = ()
        if bound.level is Level.AGGREGATE:
            found = resolved[n_resolved : n_resolved + bound.n_keys]
            n_resolved += bound.n_keys
        shares = _key_shares(bound, receiver, first_located)
        weights = [
            bound.edit.amount * share * float(receiver.masks[first_row + k, 0]) * float(caster.masks[first_row + k, 0])
            for k, share in enumerate(shares)
        ]
        if not any(weights):
            continue
        groups = [g for g in range(n_groups) if bound.groups[g]]
        whole = len(groups) == n_groups
        if bound.edit.blend is Blend.COMPOSE:
            seen = sum(scale[g] * b[g] for g in groups) + (emission if whole else 0.0)
        else:
            seen = sum(b[g] for g in groups)
        delta, e = np.zeros(3), np.zeros(3)
        added: dict[Any, F64Array] = {}
        for key, weight in enumerate(weights):
            if bound.level is Level.AGGREGATE:
                delta, e = delta + weight * (found[key].scale - 1), e + weight * found[key].emission
                continue
            s_key, e_key, o_key, p_key = _coefficients(bound, key, seen, receiver, caster, first_located)
            delta, e = delta + weight * (s_key - 1), e + weight * e_key
            kind = "paint" if bound.offset_is_paint else "diffuse"
            added[kind] = added.get(kind, 0) + weight * o_key
            if index in field.throughs:
                added[index] = added.get(index, 0) + weight * p_key
        kept = 1 - sum(weights)
        factor = {Blend.COMPOSE: 1 + delta, Blend.OVER: np.full(3, kept), Blend.ADD: np.ones(3)}[bound.edit.blend]
        plus = {Blend.COMPOSE: np.zeros(3), Blend.OVER: (1 - kept) + delta, Blend.ADD: delta}[bound.edit.blend]
        emission = (factor * emission if whole else emission) + e
        for g in groups:
            scale[g] = factor * scale[g] + plus
            for kind, value in carried.items():
                value[g] = factor * value[g] + added.get(kind, 0)
    through = np.array([carried[edit] for edit in field.throughs]).reshape(-1, n_groups, 3)
    return PairFunctions(scale, emission, carried["diffuse"], carried["paint"], through)


def _key_shares(bound: BoundEdit, receiver: Ends, first_located: int) -> list[float]:
    """Weight of each key; where all are sampled, those with samples near the receiver speak for the others."""
    if bound.n_keys < 2 or any(rows is None for rows in bound.rows):
        return list(bound.key_weights)
    confidence = [float(receiver.located[first_located + k].confidence[0]) for k in range(bound.n_keys)]
    total = sum(w * c for w, c in zip(bound.key_weights, confidence, strict=True))
    return [w * c / total if total else 0.0 for w, c in zip(bound.key_weights, confidence, strict=True)]


def _coefficients(
    bound: BoundEdit, key: int, seen: F64Array, receiver: Ends, caster: Ends, first_located: int
) -> tuple[F64Array, F64Array, F64Array, F64Array]:
    nowhere = PairEnd(*(np.zeros((1, 3), np.float32),) * 3)
    pairs = Pairs(seen.astype(np.float32)[None, :], receiver.place or nowhere, caster.place or nowhere)
    at: tuple[Any, Any] = (None, None)
    if bound.rows[key] is not None:
        slot = first_located + sum(rows is not None for rows in bound.rows[:key])
        at = (receiver.located[slot], caster.located[slot])
    found = bound.evaluate(key, pairs, *at)
    values = (found.scale, found.emission, found.offset, found.through)
    s, e, o, p = (np.zeros(3) if value is None else np.asarray(value[0], np.float64) for value in values)
    return s, e, o, p


def edited_radiance(
    field: EditField,
    transport: F64Array,
    radiance: F64Array,
    area: F64Array,
    albedo: F64Array,
    receivers: Ends,
    casters: Ends,
    held_back: Sequence[F64Array] = (),
) -> F64Array:
    """Edited indirect radiance of every view sample.

    Parameters
    ----------
    transport : (n_view, n_gather, 3) dimensionless, everything but the light and the edits
    radiance : (G, n_gather, 3) b by group of lights
    area : (n_gather,) square metres
    albedo : (n_view, 3) diffuse albedo of the receivers, for offsets that it reflects
    receivers, casters : Ends of the view and of the gather samples
    held_back : for each edit of `field.throughs`, (n_view, n_gather, 3) transport that its occluders hold back

    Returns
    -------
    (n_view, 3) float64
    """
    n_view, n_gather = transport.shape[:2]
    result = np.zeros((n_view, 3))
    for i in range(n_view):
        receiver = receivers.take(np.array([i]))

        def total(resolved: Sequence[Resolved], upto: int | None, row: int | None, groups: Any, i: int = i) -> F64Array:
            """Light of receiver i; of an aggregate's casters (mask `row`) and `groups` of lights alone where asked."""
            light = np.zeros(3)
            for j in range(n_gather):
                b = radiance[:, j].astype(np.float64)
                here = receivers.take(np.array([i])), casters.take(np.array([j]))
                f = pair_functions(field, b, *here, resolved, upto)
                some = range(len(b)) if groups is None else [g for g in range(len(b)) if groups[g]]
                pair = transport[i, j] * sum(f.scale[g] * b[g] for g in some)
                pair = pair + (transport[i, j] * f.emission if len(some) == len(b) else 0.0)
                pair = pair + area[j] * sum((albedo[i] * f.offset_diffuse[g] + f.offset_paint[g]) * b[g] for g in some)
                for k, held in enumerate(held_back):
                    pair = pair + held[i, j] * sum(f.through[k, g] * b[g] for g in some)
                light = light + pair * (1.0 if row is None else float(casters.masks[row, j]))
            return light

        resolved: list[Resolved] = []
        for aggregate in field.aggregates:
            bound = field.edits[aggregate.edit]
            # Keys of one edit see the same weaker stack.
            light = total(resolved, aggregate.upto, aggregate.row, bound.groups)
            scale, added = field.resolve(aggregate, light.astype(np.float32)[None, :])
            reach = sum(transport[i, j] * float(casters.masks[aggregate.row, j]) for j in range(n_gather))
            emission = np.divide(added[0], reach, out=np.zeros(3), where=reach > 0)
            resolved.append(Resolved(scale[0].astype(np.float64), emission))
        result[i] = _finish(field, total(resolved, None, None, None), receiver)
    return result


def _finish(field: EditField, light: F64Array, receiver: Ends) -> F64Array:
    scale, offset = np.ones(3), np.zeros(3)
    row = 0
    for bound in field.edits:
        first, row = row, row + bound.n_keys
        if bound.level is not Level.VIEW:
            continue
        s, o, kept = np.zeros(3), np.zeros(3), 1.0
        for key, share in enumerate(bound.key_weights):
            weight = bound.edit.amount * share * float(receiver.masks[first + key, 0])
            s_key, o_key = bound.view(key)
            s, o, kept = s + weight * (s_key.astype(float) - 1), o + weight * o_key.astype(float), kept - weight
        if bound.edit.blend is Blend.COMPOSE:
            scale, offset = (1 + s) * scale, (1 + s) * offset + o
        elif bound.edit.blend is Blend.OVER:
            scale, offset = kept * scale + (1 - kept) + s, kept * offset + o
        else:
            scale, offset = scale + s, offset + o
    return np.maximum(scale * light + offset, 0)
