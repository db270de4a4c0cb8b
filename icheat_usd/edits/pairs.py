"""All light of receivers under a stack, summed over their pairs: what relighter and final gather have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import Aggregate, Ends, StackCoefficients, of_receivers, sent_anew, weighted
from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import PAIRS_AT_ONCE, OffsetCasters, offset_radiance
from icheat_usd.edits.operations import PairCoefficients
from icheat_usd.scene import F32, I64


class PairLight(NamedTuple):
    """Light that n pairs bring to their receivers before any edit."""

    owner: I64  #: (n,) position of the receiver among those that are evaluated together
    casters: Ends  #: of the n pairs
    seen: F32  #: (G, n, 3) radiance that leaves the casters, as the edits look at it
    brought: F32  #: (G, n, 3) radiance that arrives: transport times what leaves
    emitted: F32  #: (n, 3) transport, on which added emission travels; `brought` is this times `seen`, but for noise
    through: int | None = None  #: slot of `EditField.throughs` whose occluders hold this light back
    is_part: bool = False  #: `brought` is of some lights alone; what edits add that is of no light is none of it


def arriving(
    field: EditField,
    coefficients: StackCoefficients,
    brought: F32,
    emitted: F32 | np.float32,
    casters: Ends,
    through: int | None = None,
    aggregate: Aggregate | None = None,
) -> F32 | None:
    """Light of pairs under the stack, (n, 3); of an aggregate's casters and lights alone where one is given.

    None where it is 0 throughout.
    """
    if through is not None:
        factor = coefficients.through[through]
        if factor is None:
            return None
        share = brought if aggregate is None else field.aggregate_share(aggregate, casters) * brought
        return weighted(factor, share)
    if aggregate is None:
        return weighted(coefficients.scale, brought) + coefficients.emission * emitted
    light = weighted(coefficients.scale, field.aggregate_share(aggregate, casters) * brought)
    if field.edits[aggregate.edit].groups.all():
        light += casters.masks[aggregate.row][:, None] * (coefficients.emission * emitted)
    return light


def edited_light(
    field: EditField,
    receivers: Ends,
    blocks: Sequence[PairLight],
    offsets: OffsetCasters | None = None,
    albedo: F32 | None = None,
) -> F32:
    """Indirect light of m receivers under the stack, before `EditField.finish`.

    Parameters
    ----------
    receivers : Ends of the m receivers
    blocks : sequence of PairLight
        Together all of the receivers' pairs.
    offsets : OffsetCasters, optional
        What adds offsets, where the stack has any.
    albedo : (m, 3) float32, optional
        Diffuse albedo of the receivers, for `offsets`.

    Returns
    -------
    (m, 3) float32
    """
    n = receivers.masks.shape[1]

    def total(resolved: Sequence[PairCoefficients], upto: int | None = None, aggregate: Aggregate | None = None) -> F32:
        light = np.zeros((n, 3))
        for block in blocks:
            for part in _parts(block):
                here = [of_receivers(found, part.owner) for found in resolved]
                coefficients = field.evaluate(part.seen, receivers.take(part.owner), part.casters, here, upto)
                # Curves must not see more noise than they have to: they would turn it into bias.
                arrives = part.brought if aggregate is None else part.emitted * part.seen
                emitted = np.float32(0) if part.is_part and aggregate is None else part.emitted
                edited = arriving(field, coefficients, arrives, emitted, part.casters, part.through, aggregate)
                if edited is not None:
                    light += _sum_by(part.owner, edited, n)
        result: F32 = light.astype(np.float32)
        if offsets is not None and albedo is not None:
            result += offset_radiance(field, offsets, receivers, albedo, resolved, upto, aggregate)
        return result

    def reach(aggregate: Aggregate) -> F32:
        found = np.zeros((n, 3))
        for block in blocks:
            if block.through is None:
                found += _sum_by(block.owner, block.casters.masks[aggregate.row][:, None] * block.emitted, n)
        return found.astype(np.float32)

    resolved: list[PairCoefficients] = []
    for aggregate in field.aggregates:
        if not receivers.masks[aggregate.row].any():
            resolved.append(PairCoefficients(np.ones((n, 3), np.float32)))
            continue
        # Keys of one edit see the same weaker stack.
        scale, added = field.resolve(aggregate, total(resolved, aggregate.upto, aggregate))
        resolved.append(sent_anew(scale, added, reach(aggregate)))
    return total(resolved)


def _parts(block: PairLight) -> Iterator[PairLight]:
    n = len(block.owner)
    if n <= PAIRS_AT_ONCE:
        yield block
        return
    for begin in range(0, n, PAIRS_AT_ONCE):
        some = slice(begin, begin + PAIRS_AT_ONCE)
        yield PairLight(
            block.owner[some],
            block.casters.take(np.arange(n)[some]),
            block.seen[:, some],
            block.brought[:, some],
            block.emitted[some],
            block.through,
            block.is_part,
        )


def _sum_by(owner: I64, values: F32, n: int) -> F32:
    """Sum (m, 3) values by owner, (n, 3); serial and in float64."""
    return np.stack([np.bincount(owner, values[:, channel], n) for channel in range(3)], axis=1)
