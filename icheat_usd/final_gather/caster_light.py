"""Light of cache records by the surface that it comes from.

This is all that edits need to know of rays whose factors depend on nothing but the instances of the casters: for any
amounts and colours, and any masks of the receivers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from icheat_usd.final_gather.gatherer import GatherSolution
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.record_rays import RecordRays
from icheat_usd.kernels import caster_sums as kernels
from icheat_usd.scene import F32, I32, I64, Bool

#: Tables of light by caster that are kept for other stacks.
_MOST_KEPT = 32


def sent_by_group(solution: GatherSolution, *, with_transport: bool) -> F32:
    """What gather cells send, (n_cells, n_blocks, 4): a block for each group of lights, the last float of each unused.

    Parameters
    ----------
    with_transport : bool
        Whether a last block is of cells that send 1, as what is added travels on transport alone.
    """
    b = solution.b if solution.sent is None else solution.sent
    n_groups, n_cells = b.shape[:2]
    sent = np.zeros((n_cells, n_groups + int(with_transport), 4), np.float32)
    sent[:, :n_groups, :3] = b.transpose(1, 0, 2)
    if with_transport:
        sent[:, n_groups, :3] = 1
    return sent


def light_by_caster(of: Hemispheres, sent: F32, selected: Bool) -> LightByCaster:
    """What is known of hemispheres when cells send `sent`, from the `selected` (n_instances,) casters at least."""
    n_blocks = sent.shape[1]
    for one in of.light:
        is_enough = one.sent.shape[1] >= n_blocks and not (selected & ~one.selected).any()
        if is_enough and np.array_equal(one.sent[:, :n_blocks], sent):
            return one
    found = LightByCaster(sent, selected, of.n)
    of.light[:] = [*of.light[1 - _MOST_KEPT :], found]
    return found


class LightByCaster:
    """Light of n records by caster, found when it is first asked for."""

    def __init__(self, sent: F32, selected: Bool, n: int) -> None:
        self.sent, self.selected = sent, selected
        self._is_known = np.zeros(n, np.bool_)
        self._record = np.empty(0, np.int64)
        self.caster: I32 = np.empty(0, np.int32)  #: (m,)
        self.values = np.empty((0, sent.shape[1], kernels.N_VALUES, 4), np.float32)  #: (m, n_blocks, N_VALUES, 4)
        self.begin = np.zeros(n + 1, np.int64)  #: entries of each record

    def find(self, of: Hemispheres, needed: Bool) -> None:
        """See to it that some records are known."""
        new = needed & ~self._is_known
        if not new.any():
            return
        self._is_known |= new
        share = of.shares()
        records, casters, values = [self._record], [self.caster], [self.values]
        for rays, _, owner in of.chunks():
            some = new[owner]
            if not some.any():
                continue
            row, caster, light = self._of_rays(rays, share[owner], some)
            records.append(owner[row])
            casters.append(caster)
            values.append(light)
        record = np.concatenate(records)
        order = np.argsort(record, kind="stable")
        self._record, self.caster = record[order], np.concatenate(casters)[order]
        self.values = np.take(np.concatenate(values), order, axis=0)
        self.begin = np.searchsorted(self._record, np.arange(of.n + 1))

    def _of_rays(self, rays: RecordRays, share: F32, some: Bool) -> tuple[I64, I32, F32]:
        """Row, instance and light of every pair of a row and what it sees."""
        table = ray_table(rays)
        row, caster, local, begin = list_of_casters(rays, table, self.selected, some)
        light = np.zeros((len(row), *self.values.shape[1:]), np.float32)
        kernels.caster_sums(table, self.sent, local, begin, share, rays.seed, rays.n_theta, rays.n_phi, light)
        return row, caster, light


def list_of_casters(
    rays: RecordRays, table: kernels.RayTable, selected: Bool, some: Bool
) -> tuple[I64, I32, NDArray[np.int16], I64]:
    """Row and instance of every pair of a row and what it sees, place of each ray's among its row's, pairs by row."""
    n, n_rays = rays.cell.shape
    local = np.empty((n, n_rays), np.int16)
    listed = np.empty((n, min(int(selected.sum()), n_rays)), np.int32)
    number = np.empty(n, np.int32)
    kernels.list_casters(table, selected.view(np.uint8), some.view(np.uint8), local, number, listed)
    begin = np.concatenate([[0], np.cumsum(number, dtype=np.int64)])
    row = np.repeat(np.arange(n), number)
    return row, listed[row, np.arange(len(row)) - begin[row]], local, begin


def ray_table(rays: RecordRays) -> kernels.RayTable:
    """Rays as compiled loops take them."""
    n, n_rays = rays.cell.shape
    ends = rays.detour_ends
    lit = rays.cell.reshape(-1)[rays.detour] >= 0
    return kernels.RayTable(
        rays.cell,
        rays.distance,
        rays.instance,
        rays.triangle,
        rays.uv,
        rays.shading_normal,
        rays.stream,
        np.searchsorted(rays.detour, n_rays * np.arange(n + 1)),
        rays.detour,
        np.searchsorted(rays.adjusted, n_rays * np.arange(n + 1)),
        rays.adjusted,
        np.ascontiguousarray(rays.throughput, np.float32),
        np.where(lit, ends.instance, np.int32(-1)).astype(np.int32),
        ends.face,
        ends.face_uv,
    )
