"""Rays of cache records taken together as by `merged_rays`, and given to `stack_sums` before the next record's.

Light of records that no other stack will ask for stays where it was made: to keep it took as long as to find it.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.merged_rays import merge_record, most_of_turn, number_of_turns, ray_room
from icheat_usd.kernels.record_lanes import LANES
from icheat_usd.kernels.stack_sums import no_lines, stack_of_record


@parallel_kernel
def stack_of_rays(  # type: ignore[no-untyped-def]
    rays,
    face,
    face_uv,
    sent,
    order,
    group,
    record,
    share,
    selected,
    sheets,
    patches,
    plateaus,
    width,
    seed,
    n_theta,
    n_phi,
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
    rays, face, face_uv, sent, order, group, record, share, selected, sheets, patches, plateaus, seed, n_theta, n_phi
        As of `merged_rays.merge_rays`.
    width : int
        Most columns of the sheets of any instance.
    casters, column, factor, stack, slots, values, derivative
        As of `stack_sums.stack_of_casters`.
    """
    for turn in prange(number_of_turns(len(record))):
        _stack_of_some(
            np.int64(turn),
            rays,
            face,
            face_uv,
            sent,
            order,
            group,
            record,
            share,
            selected,
            sheets,
            patches,
            plateaus,
            width,
            seed,
            n_theta,
            n_phi,
            casters,
            column,
            factor,
            stack,
            slots,
            values,
            derivative,
        )


@kernel
def _stack_of_some(  # type: ignore[no-untyped-def]
    turn,
    rays,
    face,
    face_uv,
    sent,
    order,
    group,
    record,
    share,
    selected,
    sheets,
    patches,
    plateaus,
    width,
    seed,
    n_theta,
    n_phi,
    casters,
    column,
    factor,
    stack,
    slots,
    values,
    derivative,
):
    n_turns, most = number_of_turns(len(record)), most_of_turn(turn, group)
    room = ray_room(most, n_theta, n_phi, len(selected) + max(patches.number, plateaus.number))
    n_slots = np.int64(0)
    for g in range(turn, len(record), n_turns):
        n_slots = max(n_slots, slots.begin[record[g] + 1] - slots.begin[record[g]])
    lines, n_rays = no_lines(n_slots, stack), rays.cell.shape[1] * most
    entry = np.arange(n_rays)
    caster, weights = np.empty(n_rays, np.int32), np.empty((n_rays, width), np.float32)
    light = np.empty((n_rays, sent.shape[1], LANES), np.float32)
    for g in range(turn, len(record), n_turns):
        r = record[g]
        n = merge_record(
            order,
            group[g],
            group[g + 1],
            rays,
            face,
            face_uv,
            sent,
            share[r],
            selected,
            sheets,
            patches,
            plateaus,
            seed,
            room,
            caster,
            weights,
            light,
        )
        stack_of_record(
            r, lines, 0, n, entry, caster, weights, light, casters, column, factor, stack, slots, values, derivative
        )
    # Keeps them: Numba may free an array after its last mention, and compiled loops have its address.
    caster[:1], weights[:1], light[:1] = 0, np.float32(0.0), np.float32(0.0)
