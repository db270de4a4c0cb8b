"""Shadow rays of places in runs, in packets of 16, and what is in their way."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.embree import call_packet
from icheat_usd.kernels.place_columns import COLUMNS, ORIGIN, RUN
from icheat_usd.kernels.shadow_lanes import keep_near_boxes
from icheat_usd.kernels.simd import address_of

#: States of a ray: something opaque is in its way, nothing, or only what lets light through.
BLOCKED, CLEAR, THROUGH = 0, 1, 2
_INVALID = np.uint32(0xFFFFFFFF)
_STOP_SHORT = np.float32(1.0 - 1e-4)  # as for other shadow rays: lights may lie in the plane of a ceiling
_ZERO = np.float32(0.0)


@kernel
def find_columns(columns: int, column: np.ndarray, run: int, at: np.ndarray) -> None:
    """Addresses of the columns of a run, from that of all."""
    for c in range(COLUMNS):
        at[c] = columns + np.int64(column[run, c]) * (RUN * 4)


@kernel
def prepare_packet(rays: np.ndarray) -> None:
    """What all packets of shadow rays (22, 16) have in common, which tracing leaves as it is."""
    words = rays.view(np.uint32)
    for lane in range(16):
        rays[3, lane] = _ZERO
        rays[7, lane] = _ZERO
        words[9, lane] = _INVALID
        words[10, lane] = 0
        words[11, lane] = 0


@kernel
def trace_rows(
    function: int, arguments: int, opaque: int, passing: int, boxes: np.ndarray, distant: bool, columns: np.ndarray,
    column: np.ndarray, runs: np.ndarray, found: np.ndarray, rays: np.ndarray, valid: np.ndarray, rows: np.ndarray,
    n: int, state: np.ndarray,
) -> None:  # fmt: skip
    """Shadow rays of the first `n` rows of some runs, in packets of 16; their `state` is set."""
    limit = np.float32(np.inf) if distant else _STOP_SHORT
    for begin in range(0, n, 16):
        count = min(16, n - begin)
        for lane in range(16):
            valid[lane] = -1 if lane < count else 0
            k, j = divmod(np.uint32(rows[begin + min(lane, count - 1)]), np.uint32(RUN))
            for c in range(3):
                rays[c, lane] = columns[column[runs[k], ORIGIN + c], j]
                rays[4 + c, lane] = found[k, c, j]
            rays[8, lane] = limit
        call_packet(function, address_of(valid), opaque, address_of(rays), arguments)
        for lane in range(count):
            state[rows[begin + lane]] = CLEAR if rays[8, lane] >= _ZERO else BLOCKED
        if passing == 0:
            continue
        for lane in range(count):
            valid[lane] = -1 if rays[8, lane] >= _ZERO else 0
        if not keep_near_boxes(boxes, rays, valid):
            continue
        call_packet(function, address_of(valid), passing, address_of(rays), arguments)
        for lane in range(count):
            if valid[lane] != 0 and rays[8, lane] < _ZERO:
                state[rows[begin + lane]] = THROUGH
