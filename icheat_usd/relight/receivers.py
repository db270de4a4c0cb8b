"""View samples grouped by what the edits see of them.

Samples with the same receiver masks get the same edited light from the
casters, so one edited copy of the casters' radiance serves them all, and their
rows are multiplied as they are. Samples on the soft border of a mask, each
with masks of its own, are evaluated pair by pair. Both are exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, I64

#: An edited copy of the radiance costs about as much as this many rows evaluated pair by pair.
SMALLEST_GROUP = 64


@dataclass(frozen=True, eq=False)
class ReceiverGroup:
    """View samples that share their receiver masks."""

    masks: F32  #: (n_rows of the field,)
    samples: I64  #: ascending


@dataclass(frozen=True, eq=False)
class Receivers:
    """The view samples that any edit touches; all others keep their unedited light, bit for bit."""

    groups: tuple[ReceiverGroup, ...]
    single: I64  #: samples to evaluate pair by pair
    single_masks: F32  #: (n_rows, n_single)


def group_receivers(field: EditField, view: ViewSamples) -> Receivers:
    """Sort the view samples by their receiver masks."""
    masks = field.receiver_masks(view.points)
    touched = np.flatnonzero((masks > 0).any(axis=0))
    if len(touched) == 0:
        return Receivers((), touched, masks[:, touched])
    signatures, inverse, counts = np.unique(masks[:, touched], axis=1, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)
    order = np.argsort(inverse, kind="stable")
    ends = np.cumsum(counts)
    groups = tuple(
        ReceiverGroup(np.ascontiguousarray(signatures[:, k]), touched[np.sort(order[ends[k] - counts[k] : ends[k]])])
        for k in np.flatnonzero(counts >= SMALLEST_GROUP)
    )
    single = touched[counts[inverse] < SMALLEST_GROUP]
    return Receivers(groups, single, np.ascontiguousarray(masks[:, single]))
