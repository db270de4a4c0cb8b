"""One edit laid over what the weaker edits have made of n pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from icheat_usd.edits.bound import BoundEdit, Ends, of_receivers, taken
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level, PairCoefficients, PairEnd, Pairs
from icheat_usd.scene import F32, I64

ONE = np.float32(1)
_NOWHERE = PairEnd(*(np.zeros((1, 3), np.float32),) * 3)


@dataclass(eq=False)
class State:
    """What the edits so far have made of the pairs."""

    scale: F32
    emission: F32
    offsets: list[F32 | None]  #: diffuse, paint, then one for each edit that lets light through


def lay(
    state: State,
    bound: BoundEdit,
    b: F32,
    receivers: Ends,
    casters: Ends,
    weights: list[F32],
    touched: I64,
    resolved: Sequence[PairCoefficients],
    first_located: int,
    through_slot: int | None,
) -> None:
    """Lay one edit over the state, at the touched pairs."""
    n = b.shape[1]
    which: Any = slice(None) if len(touched) == n else touched
    groups = np.flatnonzero(bound.groups)
    seen = _seen(state, bound, b, groups, which)
    pairs = Pairs(seen, _end(receivers.place, which, n), _end(casters.place, which, n))
    delta, added = np.zeros_like(seen), np.zeros_like(seen)
    extra: dict[int, F32] = {}
    kept = np.zeros((len(seen), 1), np.float32)
    located = first_located
    for key in range(bound.n_keys):
        weight = weights[key][which, None]
        if bound.level is Level.AGGREGATE:
            coefficients = resolved[key]
            if len(coefficients.scale) > 1:
                coefficients = of_receivers(coefficients, which)
        else:
            at = (None, None)
            if bound.rows[key] is not None:
                at = (_pick(receivers.located[located], which, n), _pick(casters.located[located], which, n))
                located += 1
            coefficients = bound.evaluate(key, pairs, *at)
        kept += weight
        delta += weight * (coefficients.scale - ONE)
        if coefficients.emission is not None:
            added += weight * coefficients.emission
        for slot, value in (
            (int(bound.offset_is_paint), coefficients.offset),
            (through_slot, coefficients.through),
        ):
            if value is not None and slot is not None:
                extra[slot] = weight * value + extra.get(slot, np.float32(0))
    all_groups = len(groups) == len(b)
    carried = {Blend.COMPOSE: ONE + delta, Blend.OVER: ONE - kept, Blend.ADD: np.ones_like(kept)}[bound.edit.blend]
    for group in groups:
        before = state.scale[group, which]
        if bound.edit.blend is Blend.COMPOSE:
            state.scale[group, which] = carried * before
        else:
            state.scale[group, which] = carried * before + (kept * (bound.edit.blend is Blend.OVER) + delta)
    if all_groups:
        state.emission[which] = carried * state.emission[which] + added
    else:
        state.emission[which] += added
    for slot, value in enumerate(state.offsets):
        if value is not None:
            for group in groups:
                value[group, which] *= carried
        if slot in extra:
            if value is None:
                value = state.offsets[slot] = np.zeros((len(b), n, 3), np.float32)
            for group in groups:
                value[group, which] += extra[slot]


def _end(place: PairEnd | None, which: Any, n: int) -> PairEnd:
    if place is None:
        return _NOWHERE
    return place if len(place.position) != n else PairEnd(*(column[which] for column in place))


def _pick(entry: Any, which: Any, n: int) -> Any:
    if isinstance(which, slice):
        return entry
    shared = len(entry[0] if isinstance(entry, tuple) else entry) != n
    return entry if shared else taken(entry, which)


def pair_weights(bound: BoundEdit, rows: range, receivers: Ends, casters: Ends, first_located: int) -> list[F32]:
    """Amount x key weight x u x w of each key, (n,) each."""
    shares = key_shares(bound, receivers.located[first_located : first_located + bound.n_keys])
    return [share * receivers.masks[row] * casters.masks[row] for share, row in zip(shares, rows, strict=True)]


def key_shares(bound: BoundEdit, located: Sequence[Any]) -> list[Any]:
    """Amount x key weight of each key, at receivers whose rows are `located`: numbers, or (n,) each."""
    shares: list[Any] = [np.float32(bound.edit.amount * weight) for weight in bound.key_weights]
    if bound.n_keys > 1 and all(key_rows is not None for key_rows in bound.rows):
        # Where one key has no samples, the other speaks alone: disocclusion is no reason to fade.
        confidence = [mixture.confidence for mixture in located]
        total = sum(w * c for w, c in zip(bound.key_weights, confidence, strict=True))
        safe = np.where(total > 0, total, ONE)
        shares = [share * (c / safe).astype(np.float32) for share, c in zip(shares, confidence, strict=True)]
    return shares


def _seen(state: State, bound: BoundEdit, b: F32, groups: I64, which: Any) -> F32:
    """The light that an edit looks at: as the weaker edits left it where it composes, else unedited."""
    if bound.edit.blend is not Blend.COMPOSE:
        return np.asarray(sum(b[group, which] for group in groups), np.float32)
    seen: Any = sum(state.scale[group, which] * b[group, which] for group in groups)
    if len(groups) == len(b):
        seen = seen + state.emission[which]
    return np.asarray(seen, np.float32)
