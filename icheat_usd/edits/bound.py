"""What edits are once they know a scene, the points that they look at, and what they ask for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.edits.encodings.rows import BoundRows
from icheat_usd.edits.model import Edit, Value
from icheat_usd.edits.operations import Level, Operation, PairCoefficients, PairEnd, Pairs
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.scene import F32, I64, Bool


class Ends(NamedTuple):
    """n points as the edits see them: receivers, or casters."""

    masks: F32  #: (n_rows, n) weights: one row per edit and key, in the order of the edits
    place: PairEnd | None  #: (n, 3) each; None where no edit asks
    located: tuple[Any, ...]  #: for every key that is baked as rows: where its samples are looked up

    def take(self, which: I64) -> Ends:
        """Some of the points, in the order of `which`."""
        place = None if self.place is None else PairEnd(*(np.take(column, which, axis=0) for column in self.place))
        return Ends(np.take(self.masks, which, axis=1), place, tuple(taken(entry, which) for entry in self.located))


def taken(entry: Any, which: I64) -> Any:
    """Some entries of an array, or of all arrays of a named tuple."""
    if isinstance(entry, tuple):
        return type(entry)(*(np.take(column, which, axis=0) for column in entry))
    return np.take(entry, which, axis=0)


class StackCoefficients(NamedTuple):
    """The composed pair functions at n pairs, for G groups of lights.

    A pair's light is ``t (sum_g scale_g b_g + emission) + A sum_g offset_g b_g``.
    `through` holds, for each edit of `EditField.throughs`, the factor on light
    that its occluders hold back; None is 0 everywhere.
    """

    scale: F32  #: (G, n, 3)
    emission: F32  #: (n, 3)
    offset_diffuse: F32 | None  #: (G, n, 3) to be multiplied by the receiver's albedo; None is 0
    offset_paint: F32 | None  #: (G, n, 3) not to be; None is 0
    through: tuple[F32 | None, ...]  #: (G, n, 3) each

    def light(self, b: F32) -> F32:
        """What the casters send to the receivers in sight, per unit of transport: (n, 3) from (G, n, 3)."""
        return weighted(self.scale, b) + self.emission


def weighted(factor: F32, b: F32) -> F32:
    """Sum over groups of lights of factor x b: (n, 3) from two (G, n, 3)."""
    total = factor[0] * b[0]
    for group in range(1, len(b)):
        total += factor[group] * b[group]
    return total


class Aggregate(NamedTuple):
    """One key of an edit that acts on all light from its casters: `resolve` it before evaluating beyond its edit."""

    edit: int
    key: int
    row: int  #: of the masks
    upto: int  #: edits before this one have acted on the light that it sees; none where it replaces or adds to them


@dataclass(frozen=True, eq=False)
class BoundEdit:
    """An edit that knows the scene; tuples have one entry per key."""

    edit: Edit
    operation: Operation | None  #: None: unknown here, what is baked is used
    parameters: tuple[Mapping[str, Value], ...]
    baked: tuple[PairCoefficients | None, ...]  #: used where the operation is unknown and there are no rows
    rows: tuple[BoundRows | None, ...]  #: used where the operation is unknown
    receivers: tuple[BoundSelection, ...]
    casters: tuple[BoundSelection, ...]
    key_weights: tuple[float, ...]
    groups: Bool  #: (G,) groups of lights that the scale acts on
    occluders: Bool  #: (n_instances,) what light passes through

    @property
    def level(self) -> Level:
        return Level.PAIR if self.operation is None else self.operation.level

    @property
    def n_keys(self) -> int:
        return len(self.key_weights)

    @property
    def at_full_amount(self) -> BoundEdit:
        """The same edit with an amount of 1."""
        return replace(self, edit=replace(self.edit, amount=1.0))

    @property
    def is_prepared(self) -> bool:
        """True if parameters are filled in from what the selections select."""
        return self.operation is not None and type(self.operation).prepare is not Operation.prepare

    @property
    def offset_is_paint(self) -> bool:
        return self.operation is None or not self.operation.offset_times_albedo

    def evaluate(self, key: int, pairs: Pairs, receivers: Any, casters: Any) -> PairCoefficients:
        """Pair coefficients at full amount and masks, as of one key.

        `receivers` and `casters` are the key's entries of `Ends.located`, if it is baked as rows.
        """
        if self.operation is not None:
            return self.operation.evaluate(self.parameters[key], pairs)
        rows = self.rows[key]
        if rows is not None:
            return rows.evaluate(receivers, casters)
        baked = self.baked[key]
        assert baked is not None
        return baked

    def view(self, key: int) -> tuple[F32, F32]:
        """Scale and offset of an edit at level VIEW, (3,) each."""
        assert self.operation is not None
        return self.operation.evaluate_view(self.parameters[key])


def sent_anew(scale: F32, added: F32, reach: F32) -> PairCoefficients:
    """What pairs need so that the light of an aggregate's casters becomes ``scale light + added``.

    What is added is light that the casters send, all of them the same radiance, so that stronger edits find it. From
    casters that do not reach a receiver, or that it does not reflect, none can come.

    Parameters
    ----------
    scale, added : (n, 3) float32
        From `EditField.resolve`.
    reach : (n, 3) float32
        Transport from the casters, weighted by their masks.
    """
    reached = reach > 0
    emission = np.divide(added, reach, out=np.zeros_like(added), where=reached)
    return PairCoefficients(scale, np.minimum(emission, np.float32(1e30)))


def of_receivers(coefficients: PairCoefficients, which: Any) -> PairCoefficients:
    """A resolved aggregate at some receivers."""
    emission = coefficients.emission
    return PairCoefficients(coefficients.scale[which], None if emission is None else emission[which])
