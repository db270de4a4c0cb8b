"""Rays of cache records taken together as by `merged_rays`, and given to `stack_sums` before the next record's.

Light of records that no other stack will ask for stays where it was made: to keep it took as long as to find it.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.merged_rays import merge_record
from icheat_usd.kernels.record_lanes import LANES
from icheat_usd.kernels.stack_sums import stack_of_record

#: More turns than there are threads; each has records from everywhere, and memory of its own, which only pays for
#: several of them.
_TURNS, _LEAST_OF_TURN = 64, 8


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
    n_turns = min(_TURNS, (len(record) + _LEAST_OF_TURN - 1) // _LEAST_OF_TURN)
    for turn in prange(n_turns):
        _stack_of_some(
            np.int64(turn),
            n_turns,
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
    n_turns,
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
    most = np.int64(0)
    for g in range(turn, len(record), n_turns):
        most = max(most, group[g + 1] - group[g])
    room = rays.cell.shape[1] * most
    entry = np.arange(room)
    caster, weights = np.empty(room, np.int32), np.empty((room, width), np.float32)
    light = np.empty((room, sent.shape[1], LANES), np.float32)
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
            n_theta,
            n_phi,
            caster,
            weights,
            light,
        )
        stack_of_record(
            r, 0, n, entry, caster, weights, light, casters, column, factor, stack, slots, values, derivative
        )
    # Keeps them: Numba may free an array after its last mention, and compiled loops have its address.
    caster[:1], weights[:1], light[:1] = 0, np.float32(0.0), np.float32(0.0)
