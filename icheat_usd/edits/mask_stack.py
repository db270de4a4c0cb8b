"""Stacks whose pair functions know nothing of a pair but its masks: every edit is a straight line of the light.

Semantics (DESIGN, section 3): an edit of weight ``u w`` takes a channel of S or E from x to ``a x + b``, where a and b
are straight lines in u w.
"""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level, PairEnd, Pairs
from icheat_usd.kernels.stack_sums import StackTable
from icheat_usd.scene import F32

_NOTHING = np.zeros((1, 3), np.float32)
_NOWHERE = PairEnd(_NOTHING, _NOTHING, _NOTHING)


def is_of_masks(field: EditField) -> bool:
    """Whether casters differ in nothing but instances and painted masks, and receivers in nothing but their masks."""
    if field.uses_incident or field.uses_caster or field.uses_receiver:
        return False
    return all(
        bound.level is not Level.AGGREGATE and rows is None and not casters.within
        for bound in field.edits
        for casters, rows in zip(bound.casters, bound.rows, strict=True)
    )


def looks_at_hits(field: EditField) -> bool:
    """Whether it matters where on an instance a caster lies."""
    return not is_of_masks(field) or any(casters.mask is not None for bound in field.edits for casters in bound.casters)


def mask_stack(field: EditField, *, with_emission: bool) -> StackTable:
    """What each row of a field makes of a pair, if `is_of_masks`.

    Parameters
    ----------
    with_emission : bool
        Whether what edits add to the light of no light counts; then it has the last block, if an edit adds any.
    """
    n_groups = field.n_groups
    slope = np.zeros((field.n_rows, n_groups + 1, 4), np.float32)
    shift = np.zeros_like(slope)
    edit = np.zeros(field.n_rows, np.int32)
    row = 0
    for index, bound in enumerate(field.edits):
        for key in range(bound.n_keys):
            edit[row] = index
            if bound.level is Level.PAIR:
                _lines(bound, key, n_groups, slope[row], shift[row])
            row += 1
    n_blocks = n_groups + int(with_emission and shift[:, n_groups].any())
    start = np.zeros((n_blocks, 4), np.float32)
    start[:n_groups] = 1
    slope, shift = (np.ascontiguousarray(lines[:, :n_blocks]) for lines in (slope, shift))
    return StackTable(edit, slope, shift, start)


def _lines(bound: BoundEdit, key: int, n_groups: int, slope: F32, shift: F32) -> None:
    """Change of a and b with u w, for each group of lights and last for emission; (n_groups + 1, 4) each, out."""
    share = np.float32(bound.edit.amount * bound.key_weights[key])
    found = bound.evaluate(key, Pairs(_NOTHING, _NOWHERE, _NOWHERE), None, None)
    delta = share * (found.scale[0] - np.float32(1))
    of_all = bound.groups.all()
    acts = np.flatnonzero(np.append(bound.groups, of_all))
    scaled = acts[acts < n_groups]
    if bound.edit.blend is Blend.COMPOSE:
        slope[acts, :3] = delta
    else:
        over = share * (bound.edit.blend is Blend.OVER)
        slope[acts, :3] = -over
        shift[scaled, :3] = over + delta
    if found.emission is not None:
        shift[n_groups, :3] = share * found.emission[0]


def bends(table: StackTable) -> F32:
    """(n_rows,) largest relative change of light that a mask of each row makes."""
    n_groups = int(table.start[:, 0].sum())
    found = np.maximum(np.abs(table.slope).max(axis=(1, 2)), np.abs(table.shift[:, :n_groups]).max(axis=(1, 2)))
    adds = table.shift[:, n_groups:].any(axis=(1, 2))
    # Of what is added nobody knows how much it is beside the light that is there.
    return np.asarray(np.maximum(found, adds), np.float32)
