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
_SLIGHT = np.float32(1 / 16)  # a relative change of light


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
    """What each row of a field makes of a pair, if `is_of_masks`; see `full_stack`."""
    return at_amounts(full_stack(field, with_emission=with_emission), field)


def full_stack(field: EditField, *, with_emission: bool) -> StackTable:
    """`mask_stack` with every edit at an amount of 1.

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


def at_amounts(full: StackTable, field: EditField) -> StackTable:
    """A `full_stack` with the field's amounts."""
    amount = np.array([bound.edit.amount for bound in field.edits for _ in range(bound.n_keys)], np.float32)
    return full._replace(slope=full.slope * amount[:, None, None], shift=full.shift * amount[:, None, None])


def _lines(bound: BoundEdit, key: int, n_groups: int, slope: F32, shift: F32) -> None:
    """Change of a and b with u w, for each group of lights and last for emission; (n_groups + 1, 4) each, out.

    They are straight lines of the amount, too, which is taken to be 1.
    """
    share = np.float32(bound.key_weights[key])
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


def bends(full: StackTable, field: EditField) -> F32:
    """(n_rows,) largest relative change of light that a mask of each row makes, of a `full_stack`.

    For all amounts up to 1, or the next power of two.
    """
    n_groups = int(full.start[:, 0].sum())
    found = np.maximum(np.abs(full.slope).max(axis=(1, 2)), np.abs(full.shift[:, :n_groups]).max(axis=(1, 2)))
    adds = full.shift[:, n_groups:].any(axis=(1, 2))
    # Of what is added nobody knows how much it is beside the light that is there.
    return np.asarray(np.maximum(found, adds) * _largest(field), np.float32)


def steepness(full: StackTable, field: EditField) -> tuple[F32, F32]:
    """`bends`, and changes of light by block and channel, (n_rows, 4 n_blocks), so rough that slight edits leave both.

    Sizes are rounded up to powers of two, and slight ones are none.
    """
    change = full.slope + full.shift * full.start
    lines = change.reshape(len(change), -1) * _largest(field)[:, None]
    size = np.abs(lines)
    rounded = np.where(size < _SLIGHT, 0, np.copysign(_power_of_two(np.maximum(size, _SLIGHT)), lines))
    return _power_of_two(np.maximum(bends(full, field), _SLIGHT)), rounded.astype(np.float32)


def _largest(field: EditField) -> F32:
    """(n_rows,) amounts, rounded up to powers of two, 1 at least."""
    amount = np.array([bound.edit.amount for bound in field.edits for _ in range(bound.n_keys)], np.float32)
    return _power_of_two(np.maximum(np.abs(amount), 1))


def _power_of_two(x: F32) -> F32:
    """The next one at or above."""
    share, power = np.frexp(x)
    return np.asarray(np.ldexp(np.float32(1), power - (share == 0.5)), np.float32)
