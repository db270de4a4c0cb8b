"""Whether two stacks look at the same places: all else about them may differ and leave what was found of these."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.operations import PairCoefficients
from icheat_usd.edits.selection import BoundSelection
from icheat_usd.scene import F32


def same_receivers(a: EditField, b: EditField) -> bool:
    """Whether every point is the same receiver for both, of fields of one scene."""
    if len(a.edits) != len(b.edits) or a.uses_receiver != b.uses_receiver:
        return False
    return all(
        same_rows(one, other) and _same_selections(one.receivers, other.receivers)
        for one, other in zip(a.edits, b.edits, strict=True)
    )


def same_but_amounts(a: EditField, b: EditField) -> bool:
    """Whether two stacks make the same of every pair but for amounts; receivers may be others."""
    if len(a.edits) != len(b.edits) or not np.array_equal(a.light_group, b.light_group):
        return False
    return all(
        same_casters(one, other)
        and one.operation is other.operation
        and (one.parameters is other.parameters or one.parameters == other.parameters)
        and one.edit.blend is other.edit.blend
        and one.key_weights == other.key_weights
        and all(_same_constants(*pair) for pair in zip(one.baked, other.baked, strict=True))
        and np.array_equal(one.groups, other.groups)
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


def _same_constants(a: PairCoefficients | None, b: PairCoefficients | None) -> bool:
    if a is None or b is None:
        return a is b
    return all(same_values(one, other) for one, other in zip(a, b, strict=True))


def same_values(a: F32 | None, b: F32 | None) -> bool:
    """Whether both are the same array, or none."""
    return a is b if a is None or b is None else np.array_equal(a, b)


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
