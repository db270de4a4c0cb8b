"""Offset light: what edits add per area of their casters, whether the receivers see them or not.

    sum_j A_j sum_g O_ijg b_jg

Gather rays only find what is visible, so this sum is taken over the gather
samples, without a visibility test and without noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import Aggregate, Ends, of_receivers
from icheat_usd.edits.field import EditField
from icheat_usd.edits.operations import Level, Operation, PairCoefficients
from icheat_usd.scene import F32, F64, I64, Bool

#: Pairs evaluated at once; bounds memory and keeps the arrays of a step near the caches.
PAIRS_AT_ONCE = 1 << 17

#: Where every receiver has offsets of its own, more casters than this are gathered into patches.
MOST_CASTERS = 1024
#: Receivers with different masks that are still worth a sum over all casters each.
MOST_SUMS = 16


class OffsetCasters(NamedTuple):
    """The gather samples that edits may take offsets from, neighbours next to each other."""

    ends: Ends
    b: F32  #: (G, n, 3) radiance that leaves them, by group of lights
    area: F32  #: (n,) square metres
    sent: F32 | None = None  #: (G, n, 3) the part of `b` that is added up, where edits look at more than that


def offset_casters(field: EditField, casters: Ends, b: F32, area: F32, sent: F32 | None = None) -> OffsetCasters | None:
    """Those of the gather samples that lie in the casters of an edit with offsets; None if there are none."""
    if not field.has_offset:
        return None
    rows: list[int] = []
    for edit, bound in enumerate(field.edits):
        if bound.operation is None or bound.operation.has_offset:
            rows += range(*field.rows_of(edit).indices(field.n_rows))
    which = np.flatnonzero((casters.masks[rows] > 0).any(axis=0))
    if len(which) == 0:
        return None
    part = None if sent is None else np.take(sent, which, axis=1)
    return OffsetCasters(casters.take(which), np.take(b, which, axis=1), area[which], part)


def patches(casters: OffsetCasters) -> OffsetCasters:
    """About `MOST_CASTERS` casters that stand for all: each for some neighbours of its own masks, with all their light.

    Exact but for what edits and soft masks change within a patch.
    """
    n = len(casters.area)
    if n <= MOST_CASTERS:
        return casters
    inside = casters.ends.masks > 0
    breaks = np.ones(n, np.bool_)
    breaks[1:] = (inside[:, 1:] != inside[:, :-1]).any(axis=0)
    breaks[:: -(-n // MOST_CASTERS)] = True
    begin = np.flatnonzero(breaks)
    end = np.append(begin[1:], n)
    area = np.add.reduceat(casters.area, begin).astype(np.float32)
    whole = np.maximum(area, np.float32(1e-30))[:, None]

    def mean(light: F32) -> F32:
        return (np.add.reduceat(casters.area[:, None] * light, begin, axis=1) / whole).astype(np.float32)

    ends = casters.ends.take((begin + end - 1) // 2)
    masks = np.add.reduceat(casters.area * casters.ends.masks, begin, axis=1) / whole[:, 0]
    ends = ends._replace(masks=masks.astype(np.float32))
    if casters.ends.place is not None and ends.place is not None:
        position = np.add.reduceat(casters.area[:, None] * casters.ends.place.position, begin, axis=0) / whole
        ends = ends._replace(place=ends.place._replace(position=position.astype(np.float32)))
    return OffsetCasters(ends, mean(casters.b), area, None if casters.sent is None else mean(casters.sent))


def offset_radiance(
    field: EditField,
    casters: OffsetCasters,
    receivers: Ends,
    albedo: F32,
    resolved: Sequence[PairCoefficients] = (),
    upto: int | None = None,
    aggregate: Aggregate | None = None,
) -> F32:
    """Radiance that offsets add at n receivers.

    Parameters
    ----------
    receivers : Ends of n points
    albedo : (n, 3) float32, diffuse albedo of the receivers
    resolved : what each aggregate came to, at the receivers
    upto : compose only the edits before this one
    aggregate : count only what this aggregate looks at

    Returns
    -------
    (n, 3) float32, radiance, scene-linear
    """
    result = np.zeros((receivers.masks.shape[1], 3), np.float32)

    def add(source: OffsetCasters, one: I64, to: I64) -> None:
        diffuse, paint = offset_sums(field, source, receivers, one, resolved, upto, aggregate)
        result[to] = albedo[to] * diffuse.astype(np.float32) + paint.astype(np.float32)

    alone = _have_their_own(field, receivers)
    shared = np.flatnonzero(~alone)
    if len(shared):
        _, first, inverse = np.unique(receivers.masks[:, shared], axis=1, return_index=True, return_inverse=True)
        if len(first) <= MOST_SUMS:
            for k, one in enumerate(shared[first]):
                add(casters, np.array([one]), shared[inverse.reshape(-1) == k])
        else:
            alone[shared] = True
    rest = np.flatnonzero(alone)
    if len(rest):
        few = patches(casters)
        at_once = max(1, PAIRS_AT_ONCE // len(few.area))
        for begin in range(0, len(rest), at_once):
            some = rest[begin : begin + at_once]
            add(few, some, some)
    return result


def _have_their_own(field: EditField, receivers: Ends) -> Bool:
    """Receivers whose offsets depend on more than their masks: an edit that looks at them lies over an offset."""
    found = np.zeros(receivers.masks.shape[1], np.bool_)
    offset_below = any(bound.operation is not None and _offset_looks_at_light(bound.operation) for bound in field.edits)
    for edit, bound in enumerate(field.edits):
        operation = bound.operation
        offset_below |= operation is None or operation.has_offset
        looks = any(rows is not None for rows in bound.rows) if operation is None else operation.uses_receiver
        if offset_below and (looks or bound.level is Level.AGGREGATE):
            found |= (receivers.masks[field.rows_of(edit)] > 0).any(axis=0)
    return found


def _offset_looks_at_light(operation: Operation) -> bool:
    return operation.has_offset and operation.uses_incident


def offset_sums(
    field: EditField,
    casters: OffsetCasters,
    receivers: Ends,
    which: I64,
    resolved: Sequence[PairCoefficients] = (),
    upto: int | None = None,
    aggregate: Aggregate | None = None,
) -> tuple[F64, F64]:
    """Light that the albedo of `which` receivers reflects and light that it does not, (n, 3) each."""
    n_casters = len(casters.area)
    if aggregate is not None:
        counted = field.aggregate_share(aggregate, casters.ends) * (casters.area[:, None] * casters.b)
    else:
        counted = casters.area[:, None] * (casters.b if casters.sent is None else casters.sent)
    if len(which) == 1:
        ends, b, here = casters.ends, casters.b, receivers.take(which)
        at_receivers = [of_receivers(found, which) for found in resolved]
    else:
        j = np.tile(np.arange(n_casters), len(which))
        i = np.repeat(which, n_casters)
        ends, b, here = casters.ends.take(j), np.take(casters.b, j, axis=1), receivers.take(i)
        at_receivers = [of_receivers(found, i) for found in resolved]
    coefficients = field.evaluate(b, here, ends, at_receivers, upto)
    found = []
    for offset in (coefficients.offset_diffuse, coefficients.offset_paint):
        total = np.zeros((len(which), 3))
        if offset is not None:
            # Groups and casters are summed in double precision: offsets of many small casters add up.
            per_pair = offset.reshape(len(b), len(which), n_casters, 3) * counted[:, None]
            total = per_pair.sum(axis=(0, 2), dtype=np.float64)
        found.append(total)
    return found[0], found[1]
