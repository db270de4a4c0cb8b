"""Whether two stacks look at the same places: all else about them may differ and leave what was found of these."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.selection import BoundSelection


def same_receivers(a: EditField, b: EditField) -> bool:
    """Whether every point is the same receiver for both, of fields of one scene."""
    if len(a.edits) != len(b.edits) or a.uses_receiver != b.uses_receiver:
        return False
    return all(
        same_rows(one, other) and _same_selections(one.receivers, other.receivers)
        for one, other in zip(a.edits, b.edits, strict=True)
    )


def same_casters(a: BoundEdit, b: BoundEdit) -> bool:
    """Whether every point is the same caster for both."""
    return same_rows(a, b) and _same_selections(a.casters, b.casters)


def same_rows(a: BoundEdit, b: BoundEdit) -> bool:
    """Whether the keys of two edits hold the same sampled rows, or none."""
    if a.n_keys != b.n_keys:
        return False
    return all(
        one is other or (one is not None and other is not None and one.rows is other.rows)
        for one, other in zip(a.rows, b.rows, strict=True)
    )


def _same_selections(a: tuple[BoundSelection, ...], b: tuple[BoundSelection, ...]) -> bool:
    return all(_same_selection(one, other) for one, other in zip(a, b, strict=True))


def _same_selection(a: BoundSelection, b: BoundSelection) -> bool:
    if a is b:
        return True
    # Limits are bound anew with every stack, and say nothing of what they are.
    if a.within or b.within or (a.mask is None) != (b.mask is None):
        return False
    if not np.array_equal(a.on_instances, b.on_instances):
        return False
    if a.mask is None or b.mask is None:
        return True
    same_texels = a.mask.texels is b.mask.texels or np.array_equal(a.mask.texels, b.mask.texels)
    return same_texels and np.array_equal(a.mask.first_face, b.mask.first_face)
