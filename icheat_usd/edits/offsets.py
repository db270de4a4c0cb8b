"""Offset light: what edits add per area of their casters, whether the receivers see them or not.

    sum_j A_j sum_g O_ijg b_jg

Gather rays only find what is visible, so this sum is taken over the gather
samples, without a visibility test and without noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import Aggregate, EditField, Ends
from icheat_usd.scene import F32, F64, I64

#: Pairs of receivers and gather samples evaluated at once.
PAIRS_AT_ONCE = 1 << 17


class OffsetCasters(NamedTuple):
    """The gather samples that edits may take offsets from."""

    ends: Ends
    b: F32  #: (G, n, 3) radiance that leaves them, by group of lights
    area: F32  #: (n,) square metres


def offset_casters(field: EditField, casters: Ends, b: F32, area: F32) -> OffsetCasters | None:
    """Those of the gather samples that lie in the casters of an edit with offsets; None if there are none."""
    if not field.has_offset:
        return None
    rows: list[int] = []
    row = 0
    for bound in field.edits:
        if bound.operation is None or bound.operation.has_offset:
            rows += range(row, row + bound.n_keys)
        row += bound.n_keys
    which = np.flatnonzero((casters.masks[rows] > 0).any(axis=0))
    return OffsetCasters(casters.take(which), np.take(b, which, axis=1), area[which]) if len(which) else None


def offset_radiance(
    field: EditField,
    casters: OffsetCasters,
    receivers: Ends,
    albedo: F32,
    resolved: Sequence[F32] = (),
    upto: int | None = None,
    aggregate: Aggregate | None = None,
) -> F32:
    """Radiance that offsets add at n receivers.

    Parameters
    ----------
    receivers : Ends of n points
    albedo : (n, 3) float32, diffuse albedo of the receivers
    resolved : scales (n, 3) of the aggregates
    upto : compose only the edits before this one
    aggregate : count only what this aggregate looks at

    Returns
    -------
    (n, 3) float32, radiance, scene-linear
    """
    n = receivers.masks.shape[1]
    result = np.zeros((n, 3), np.float32)
    if resolved or field.uses_receiver:
        at_once = max(1, PAIRS_AT_ONCE // len(casters.area))
        for begin in range(0, n, at_once):
            which = np.arange(begin, min(begin + at_once, n))
            diffuse, paint = offset_sums(field, casters, receivers, which, resolved, upto, aggregate)
            result[which] = albedo[which] * diffuse.astype(np.float32) + paint.astype(np.float32)
        return result
    _, first, inverse = np.unique(receivers.masks, axis=1, return_index=True, return_inverse=True)
    inverse = inverse.reshape(-1)
    for k, one in enumerate(first):
        diffuse, paint = offset_sums(field, casters, receivers, np.array([one]), resolved, upto, aggregate)
        same = np.flatnonzero(inverse == k)
        result[same] = albedo[same] * diffuse.astype(np.float32) + paint.astype(np.float32)
    return result


def offset_sums(
    field: EditField,
    casters: OffsetCasters,
    receivers: Ends,
    which: I64,
    resolved: Sequence[F32] = (),
    upto: int | None = None,
    aggregate: Aggregate | None = None,
) -> tuple[F64, F64]:
    """Light that the albedo of `which` receivers reflects and light that it does not, (n, 3) each."""
    n_casters = len(casters.area)
    counted = casters.area[:, None] * casters.b
    if aggregate is not None:
        counted = field.aggregate_share(aggregate, casters.ends) * counted
    if len(which) == 1:
        ends, b, here = casters.ends, casters.b, receivers.take(which)
        scales = [scale[which] for scale in resolved]
    else:
        j = np.tile(np.arange(n_casters), len(which))
        i = np.repeat(which, n_casters)
        ends, b, here = casters.ends.take(j), np.take(casters.b, j, axis=1), receivers.take(i)
        scales = [np.take(scale, i, axis=0) for scale in resolved]
    coefficients = field.evaluate(b, here, ends, scales, upto)
    found = []
    for offset in (coefficients.offset_diffuse, coefficients.offset_paint):
        total = np.zeros((len(which), 3))
        if offset is not None:
            # Groups and casters are summed in double precision: offsets of many small casters add up.
            per_pair = offset.reshape(len(b), len(which), n_casters, 3) * counted[:, None]
            total = per_pair.sum(axis=(0, 2), dtype=np.float64)
        found.append(total)
    return found[0], found[1]
