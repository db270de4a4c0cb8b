"""Rays of cache records taken together as by `merged_rays`, and given to `stack_sums` before the next record's.

Light of records that no other stack will ask for stays where it was made: to keep it took as long as to find it.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.merged_rays import PaintedRays, merge_record, number_of_turns, ray_room
from icheat_usd.kernels.record_lanes import LANES
from icheat_usd.kernels.stack_sums import Edits, no_lines, stack_of_record


@parallel_kernel
def stack_of_rays(  # type: ignore[no-untyped-def]
    rays,
    groups,
    senders,
    sheets,
    patches,
    plateaus,
    width,
    casters,
    column,
    factor,
    stack,
    slots,
    values,
    derivative,
):
    """Change of the light of slots by what hemispheres of rays bring to their records.

    Parameters
    ----------
    rays, groups, senders, sheets, patches, plateaus
        `merged_rays.PaintedRays`.
    width : int
        Most columns of the sheets of any instance.
    casters, column, factor, stack, slots, values, derivative
        As of `stack_sums.stack_of_casters`.
    """
    for turn in prange(number_of_turns(groups)):
        painted = PaintedRays(rays, groups, senders, sheets, patches, plateaus)
        edits = Edits(casters, column, factor, stack, slots)
        _stack_of_some(np.int64(turn), painted, width, edits, values, derivative)


@kernel
def _stack_of_some(turn, painted, width, edits, values, derivative):  # type: ignore[no-untyped-def]
    room, n_turns = ray_room(painted, turn), number_of_turns(painted.groups)
    record, begin, n_rays = painted.groups.record, edits.slots.begin, len(room.bright)
    n_slots = np.int64(0)
    for g in range(turn, len(record), n_turns):
        n_slots = max(n_slots, begin[record[g] + 1] - begin[record[g]])
    lines, entry = no_lines(n_slots, edits.stack), np.arange(n_rays)
    caster, weights = np.empty(n_rays, np.int32), np.empty((n_rays, width), np.float32)
    light = np.empty((n_rays, painted.senders.sent.shape[1], LANES), np.float32)
    for g in range(turn, len(record), n_turns):
        n = merge_record(g, painted, room, caster, weights, light)
        stack_of_record(record[g], lines, 0, n, entry, caster, weights, light, edits, values, derivative)
    # Keeps them: Numba may free an array after its last mention, and compiled loops have its address.
    caster[:1], weights[:1], light[:1] = 0, np.float32(0.0), np.float32(0.0)
