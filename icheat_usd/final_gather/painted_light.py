"""Light of cache records by the surface that it comes from, and by the painted masks on it.

As `merged_light`, for stacks whose casters are painted with a few masks: replays look at no ray again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.record_rays import RecordRays
from icheat_usd.kernels import painted_sums as kernels
from icheat_usd.kernels.caster_sums import RayTable, Senders, list_casters
from icheat_usd.kernels.mask_table import MaskTable
from icheat_usd.kernels.record_lanes import LANES
from icheat_usd.scene import F32, I32, I64, Bool, Geometry

#: Stacks of masks whose light is kept for others.
_MOST_KEPT = 4


class _Entries(NamedTuple):
    """Light of pairs of a record and a caster."""

    record: I64  #: (m,) ascending
    caster: I32  #: (m,)
    first: I64  #: (m + 1,) sums of each
    values: F32  #: (n_sums, n_blocks, LANES)


def is_painted(casters: MaskTable) -> Bool:
    """(n_instances,) whether a caster has painted masks."""
    return np.asarray(_numbers(_painted(casters)) > 0)


def with_few(casters: MaskTable) -> Bool:
    """(n_instances,) whether a caster has painted masks, and no more than subsets are kept of."""
    return is_painted(casters) & (_numbers(_painted(casters)) <= kernels.MOST_PAINTED)


def light_by_masks(of: Hemispheres, sent: F32, casters: MaskTable, selected: Bool) -> LightByMasks:
    """What is known of hemispheres when cells send `sent`, from `selected` (n_instances,) casters with few masks."""
    painted = _painted(casters)
    least = int(not (np.diff(casters.begin) > _numbers(painted))[selected].any())
    for one in of.painted:
        if one.is_of(sent, painted, selected, least):
            return one
    found = LightByMasks(sent, painted, selected, least, of.n)
    of.painted[:] = [*of.painted[1 - _MOST_KEPT :], found]
    return found


def bits(casters: MaskTable) -> I64:
    """Number of each entry among the painted masks of its caster, -1 where it is not painted."""
    is_painted = casters.mask >= 0
    before = np.concatenate([[0], np.cumsum(is_painted)])
    own = np.repeat(before[casters.begin[:-1]], np.diff(casters.begin))
    return np.where(is_painted, before[:-1] - own, -1)


class LightByMasks:
    """Light of n records by caster and subset of its painted masks, found when it is first asked for."""

    def __init__(self, sent: F32, painted: MaskTable, selected: Bool, least: int, n: int) -> None:
        self._sent, self._painted, self._selected, self._least = sent, painted, selected, least
        self._is_known = np.zeros(n, np.bool_)
        empty = np.empty((0, sent.shape[1], LANES), np.float32)
        self.entries = _Entries(np.empty(0, np.int64), np.empty(0, np.int32), np.zeros(1, np.int64), empty)
        self.begin = np.zeros(n + 1, np.int64)  #: entries of each record

    def is_of(self, sent: F32, painted: MaskTable, selected: Bool, least: int) -> bool:
        """Whether it tells of these cells, painted masks and casters, from the subset `least` on."""
        if self._least > least or not (np.array_equal(self._selected, selected) and np.array_equal(self._sent, sent)):
            return False
        # Which row of a stack a mask belongs to does not matter.
        names = [name for name in MaskTable._fields if name != "row"]
        return all(np.array_equal(getattr(self._painted, name), getattr(painted, name)) for name in names)

    def find(self, of: Hemispheres, geometry: Geometry, needed: Bool) -> None:
        """See to it that some records are known."""
        new = needed & ~self._is_known
        if not new.any():
            return
        self._is_known |= new
        share = of.shares()
        senders = Senders(geometry.face, geometry.face_uv, self._sent, self._selected.view(np.uint8))
        number = 1 << _numbers(self._painted)
        records, casters, values = [self.entries.record], [self.entries.caster], [self.entries.values]
        for rays, owner, table in of.tables():
            some = new[owner]
            if not some.any():
                continue
            row, caster, local, begin = list_of_casters(rays, table, self._selected, some)
            first = np.concatenate([[0], np.cumsum(number[caster])])
            light = np.zeros((int(first[-1]), *self.entries.values.shape[1:]), np.float32)
            subsets = kernels.Subsets(local, begin, first, caster, share[owner])
            shape = rays.seed, rays.n_theta, rays.n_phi
            kernels.painted_sums(table, senders, subsets, self._painted, self._least, *shape, light)
            records.append(owner[row])
            casters.append(caster)
            values.append(light)
        record, caster = np.concatenate(records), np.concatenate(casters)
        order = np.argsort(record, kind="stable")
        size = number[caster]
        first = np.cumsum(size[order]) - size[order]
        old = (np.cumsum(size) - size)[order]
        where = np.repeat(old - first, size[order]) + np.arange(int(size.sum()))
        self.entries = _Entries(
            record[order],
            caster[order],
            np.append(first, len(where)),
            np.take(np.concatenate(values), where, axis=0),
        )
        self.begin = np.searchsorted(self.entries.record, np.arange(of.n + 1))


def _painted(casters: MaskTable) -> MaskTable:
    """Painted entries alone."""
    some = casters.mask >= 0
    begin = np.concatenate([[0], np.cumsum(some)])[casters.begin]
    columns = {name: getattr(casters, name)[some] for name in ("row", "weight", "mask", "first_face", "n_faces")}
    return casters._replace(begin=begin, **columns)


def _numbers(painted: MaskTable) -> I64:
    return np.diff(painted.begin)


def list_of_casters(
    rays: RecordRays, table: RayTable, selected: Bool, some: Bool
) -> tuple[I64, I32, NDArray[np.int16], I64]:
    """Row and instance of every pair of a row and what it sees, place of each ray's among its row's, pairs by row."""
    n, n_rays = rays.cell.shape
    local = np.empty((n, n_rays), np.int16)
    listed = np.empty((n, min(int(selected.sum()), n_rays)), np.int32)
    number = np.empty(n, np.int32)
    list_casters(table, selected.view(np.uint8), some.view(np.uint8), local, number, listed)
    begin = np.concatenate([[0], np.cumsum(number, dtype=np.int64)])
    row = np.repeat(np.arange(n), number)
    return row, listed[row, np.arange(len(row)) - begin[row]], local, begin
