"""View samples grouped by what the edits see of them.

Samples with the same receiver masks get the same edited light from the
casters, so one edited copy of the casters' radiance serves them all, and their
rows are multiplied as they are. Light is linear in the mask of the strongest
edit, so samples that differ in that one alone still form a group. All others
are evaluated pair by pair. All ways are exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from icheat_usd.edits.bound import BoundEdit, Ends
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level
from icheat_usd.errors import EditError
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, I64, Bool
from icheat_usd.transport import HeldBack, Lobe

#: An edited copy of the radiance costs about as much as this many rows evaluated pair by pair.
SMALLEST_GROUP = 64


@dataclass(frozen=True, eq=False)
class ReceiverGroup:
    """View samples that share their receiver masks, but for those of the edit `last`."""

    where: I64  #: positions in `Receivers.samples`, ascending
    last: int | None = None  #: the strongest edit that touches them, where it is laid on top sample by sample


@dataclass(frozen=True, eq=False)
class Receivers:
    """The view samples that any edit touches; all others keep their unedited light, bit for bit."""

    samples: I64  #: (n,) ascending
    ends: Ends  #: of them
    groups: tuple[ReceiverGroup, ...]
    single: I64  #: positions in `samples` of those to evaluate pair by pair
    held_back: tuple[tuple[Lobe, ...], ...] = ()  #: rows for each edit of `EditField.throughs`, or nothing


def group_receivers(field: EditField, view: ViewSamples) -> Receivers:
    """Sort the view samples by their receiver masks."""
    everywhere = field.receivers(view.points)
    samples = np.flatnonzero((everywhere.masks > 0).any(axis=0))
    return group_samples(field, samples, everywhere.take(samples))


def group_samples(field: EditField, samples: I64, ends: Ends) -> Receivers:
    """Sort some view samples, ascending, by their receiver masks."""
    if len(samples) == 0:
        return Receivers(samples, ends, (), samples)
    # What touches views is applied at the very end.
    acts = np.array([bound.level is not Level.VIEW for bound in field.edits], np.bool_)
    row_edit = np.repeat(np.arange(len(field.edits)), [bound.n_keys for bound in field.edits])
    masks = ends.masks * acts[row_edit, None]
    touches = np.zeros((len(field.edits), len(samples)), np.bool_)
    for row, edit in enumerate(row_edit):
        touches[edit] |= masks[row] > 0

    alone = np.array([_looks_at_receiver(bound) for bound in field.edits], np.bool_)
    aggregate = np.array([bound.level is Level.AGGREGATE for bound in field.edits], np.bool_)
    n_aggregates = touches[aggregate].sum(axis=0)
    reached: Bool = np.asarray(touches.any(axis=0), np.bool_)
    left: Bool = reached & ~touches[alone].any(axis=0)
    mixtures = _mixtures(ends)
    known = np.concatenate([masks, mixtures])
    groups = [ReceiverGroup(where) for where in _alike(known, np.flatnonzero(left & (n_aggregates == 0)))]
    for group in groups:
        left[group.where] = False

    strongest = len(field.edits) - 1 - touches[::-1].argmax(axis=0)
    linear = np.array([_is_linear(bound) for bound in field.edits], np.bool_)
    left &= linear[strongest] & (n_aggregates == aggregate[strongest])
    flags = np.where(row_edit[:, None] == strongest, masks > 0, masks)
    known = np.concatenate([flags, mixtures])
    groups += [ReceiverGroup(where, int(strongest[where[0]])) for where in _alike(known, np.flatnonzero(left))]

    single: Bool = reached.copy()
    for group in groups:
        single[group.where] = False
    return Receivers(samples, ends, tuple(groups), np.flatnonzero(single))


def behind_occluders(field: EditField, receivers: Receivers, held_back: HeldBack | None) -> Receivers:
    """The receivers with the rows of what edits let pass their occluders.

    Raises
    ------
    EditError
        The stack has such edits, and `held_back` is None.
    """
    if not field.throughs:
        return receivers
    if held_back is None:
        raise EditError("the edit stack lets light pass occluders, which needs a HeldBack; give the relighter one")
    lobes = []
    for edit in field.throughs:
        masks = receivers.ends.masks[field.rows_of(edit)]
        reached = receivers.samples[(masks > 0).any(axis=0)]
        lobes.append(held_back.rows(reached, field.edits[edit].occluders))
    return replace(receivers, held_back=tuple(lobes))


def _alike(masks: F32, which: I64) -> Iterator[I64]:
    """Those of the samples with the same masks, where there are enough of them."""
    if len(which) == 0:
        return
    _, inverse, counts = np.unique(masks[:, which], axis=1, return_inverse=True, return_counts=True)
    order = np.argsort(inverse.reshape(-1), kind="stable")
    ends = np.cumsum(counts)
    for k in np.flatnonzero(counts >= SMALLEST_GROUP):
        yield which[order[ends[k] - counts[k] : ends[k]]]


def _mixtures(ends: Ends) -> F32:
    """Rows, and their weights, that hold at the samples, of every edit that is baked as rows: (n_columns, n)."""
    columns = [np.asarray(column, np.float32).T for entry in ends.located for column in (entry.rows, entry.weights)]
    return np.concatenate([np.zeros((0, ends.masks.shape[1]), np.float32), *columns])


def _looks_at_receiver(bound: BoundEdit) -> bool:
    """Whether receivers of the same masks, and of the same sampled rows, differ under the edit."""
    return bound.operation is not None and bound.operation.uses_receiver


def _is_linear(bound: BoundEdit) -> bool:
    """Whether light is linear in the edit's receiver mask, once the weaker edits are applied."""
    return bound.level is Level.PAIR or (bound.level is Level.AGGREGATE and bound.edit.blend is Blend.COMPOSE)
