"""Receivers by the edits that they are in: light under a mask between 0 and 1 is mixed from light with it and without.

Pair functions are straight lines in each receiver mask, so that what k such masks make of a receiver's light is a
mixture of what 2^k sets of edits make of it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import Ends
from icheat_usd.edits.field import EditField
from icheat_usd.kernels.mask_table import any_positive
from icheat_usd.scene import F32, I32, I64, U8, Bool, SurfacePoints

#: Masks of one receiver between 0 and 1; with more, mixtures would be of more than 16 sets.
MOST_SOFT = 4


class Touched(NamedTuple):
    """Points that an edit may change, as receivers."""

    field: EditField
    where: I64  #: (m,) ascending
    columns: F32  #: (n_rows, k) different masks
    which: I64  #: (m,) column of each
    whole: Ends | None  #: of the m points, where masks alone do not tell all

    def ends(self) -> Ends:
        """All that the stack asks of them."""
        return self.whole or Ends(np.take(self.columns.T, self.which, axis=0).T, None, ())

    def view_lines(self) -> tuple[F32, F32] | None:
        """`EditField.view_lines` of the points."""
        found = self.field.view_lines(self.columns)
        return None if found is None else (np.take(found[0], self.which, axis=0), np.take(found[1], self.which, axis=0))

    def take(self, some: I64) -> Touched:
        """Some of them."""
        whole = None if self.whole is None else self.whole.take(some)
        if whole is None:
            return self._replace(where=self.where[some], which=self.which[some])
        return Touched(self.field, self.where[some], whole.masks, np.arange(len(some)), whole)


def touched(field: EditField, points: SurfacePoints) -> Touched:
    """The points of some that an edit may change."""
    if field.uses_receiver:
        everyone = field.receivers(points)
        where = np.flatnonzero((everyone.masks > 0).any(axis=0))
        some = everyone if len(where) == everyone.masks.shape[1] else everyone.take(where)
        return Touched(field, where, some.masks, np.arange(len(where)), some)
    selections = [receivers for bound in field.edits for receivers in bound.receivers]
    if not all(receivers.constant_on_instances for receivers in selections):
        masks = np.ascontiguousarray(field.receiver_masks(points).T)
        is_in = np.empty(len(masks), np.uint8)
        any_positive(masks, is_in)
        where = np.flatnonzero(is_in)
        if 2 * len(where) > len(masks):
            # To copy them would take longer than to carry the others along.
            return Touched(field, where, masks.T, where, None)
        return Touched(field, where, masks[where].T, np.arange(len(where)), None)
    on_instances = np.stack([selection.on_instances for selection in selections]).astype(np.float32)
    columns, of_instance = np.unique(on_instances, axis=1, return_inverse=True)
    acts: Bool = np.asarray((columns > 0).any(axis=0), np.bool_)
    column = np.where(acts, np.arange(len(acts)), -1)[of_instance.reshape(-1)]
    which = np.append(column, -1)[points.instance]
    where = np.flatnonzero(which >= 0)
    return Touched(field, where, columns, which[where], None)


class Mixtures(NamedTuple):
    """Sets of edits that columns of masks are mixed from: entries ``begin[i]:begin[i + 1]`` of column i."""

    is_in: list[Bool]  #: of each set, (n_rows,)
    begin: I64  #: (k + 1,)
    entry: I32  #: (n_entries,) set
    weight: F32  #: (n_entries,)


def mixtures(columns: F32, wanted: Bool) -> Mixtures:
    """How masks (n_rows, k) are mixed from masks of 0 and 1; those that are not `wanted` (k,) from none.

    No more than `MOST_SOFT` of a wanted column lie between 0 and 1.
    """
    chosen = np.flatnonzero(wanted)
    masks = columns[:, chosen]
    hard, soft = masks >= 1, (masks > 0) & (masks < 1)
    first, which = patterns(np.packbits(np.concatenate([hard, soft]), axis=0))
    order = np.argsort(which, kind="stable")
    begin = np.searchsorted(which[order], np.arange(len(first) + 1))
    number: dict[bytes, int] = {}
    is_in: list[Bool] = []
    owner, entry, weight = [np.zeros(0, np.int64)], [np.zeros(0, np.int32)], [np.zeros(0, np.float32)]
    for pattern, example in enumerate(first.tolist()):
        places = order[begin[pattern] : begin[pattern + 1]]
        rows = np.flatnonzero(soft[:, example])
        for bits in range(1 << len(rows)):
            inside = hard[:, example].copy()
            share = np.ones(len(places), np.float32)
            for k, row in enumerate(rows.tolist()):
                inside[row] = bool(bits >> k & 1)
                share *= masks[row, places] if inside[row] else 1 - masks[row, places]
            if not inside.any():
                continue
            one = number.setdefault(inside.tobytes(), len(is_in))
            if one == len(is_in):
                is_in.append(inside)
            owner.append(chosen[places])
            entry.append(np.full(len(places), one, np.int32))
            weight.append(share)
    column = np.concatenate(owner)
    order = np.argsort(column, kind="stable")
    return Mixtures(
        is_in,
        np.searchsorted(column[order], np.arange(columns.shape[1] + 1)),
        np.concatenate(entry)[order],
        np.concatenate(weight)[order],
    )


def mixtures_of(receivers: Touched) -> Mixtures:
    """The same for the masks of some receivers."""
    used = np.zeros(receivers.columns.shape[1], np.bool_)
    used[receivers.which] = True
    return mixtures(receivers.columns, used)


def soft_masks(masks: F32) -> I64:
    """(m,) how many masks (n_rows, m) of each receiver lie between 0 and 1."""
    found: I64 = ((masks > 0) & (masks < 1)).sum(axis=0)
    return found


def patterns(columns: U8) -> tuple[I64, I64]:
    """Different columns of (k, m) bytes: the first place of each, and which one every place has.

    ``np.unique(columns, axis=1)``, which sorts whole columns, took a quarter of a frame with 64 edits.
    """
    k, m = columns.shape
    words = np.zeros((m, -(-k // 8) * 8), np.uint8)
    words[:, :k] = columns.T
    key = np.zeros(m, np.uint64)
    for word in words.view(np.uint64).T:
        key = (key ^ word) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    if not (columns == columns[:, first[which]]).all():  # Two patterns share a key.
        _, first, which = np.unique(columns, axis=1, return_index=True, return_inverse=True)
    return first, which.reshape(-1)
