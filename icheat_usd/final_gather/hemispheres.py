"""Hemispheres of rays of many records, in the parts that they were traced in, and what was found of their light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from icheat_usd.final_gather.record_rays import RecordRays
from icheat_usd.kernels.caster_sums import RayTable
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I64, SurfacePoints

if TYPE_CHECKING:
    from icheat_usd.final_gather.edited_records import EditedRecords
    from icheat_usd.final_gather.merged_light import MergedLight
    from icheat_usd.final_gather.painted_light import LightByMasks
    from icheat_usd.final_gather.row_light import RowLight
    from icheat_usd.final_gather.slot_choices import SlotChoices

_RAYS_AT_ONCE = 1 << 19


class Part(NamedTuple):
    """Some hemispheres."""

    rays: RecordRays
    points: SurfacePoints  #: where they stand
    owner: I64  #: record of each


class TabledPart(NamedTuple):
    """Some hemispheres, and their rays for compiled loops."""

    rays: RecordRays
    owner: I64
    table: RayTable


@dataclass(eq=False)
class Hemispheres:
    """Rays of n records; some have several hemispheres."""

    parts: list[Part]
    shrink: F32  #: (n,) factor on what changes with place
    is_kept: bool = False  #: whether other stacks will ask for the same
    painted: list[LightByMasks] = field(default_factory=list)
    merged: list[MergedLight] = field(default_factory=list)
    of_rows: list[RowLight] = field(default_factory=list)
    of_pairs: list[EditedRecords] = field(default_factory=list)
    choices: list[SlotChoices] = field(default_factory=list)
    _shares: F32 | None = None
    _tables: list[TabledPart] | None = None

    @property
    def n(self) -> int:
        return len(self.shrink)

    def shares(self) -> F32:
        """(n,) share of each of a record's hemispheres in its light."""
        if self._shares is None:
            number = np.zeros(self.n, np.int64)
            for part in self.parts:
                number += np.bincount(part.owner, minlength=self.n)
            self._shares = (1 / np.maximum(number, 1)).astype(np.float32)
        return self._shares

    def chunks(self) -> Iterator[Part]:
        """All of them, not too many at once; parts that are small enough as they are."""
        for part in self.parts:
            n, at_once = len(part.owner), max(1, _RAYS_AT_ONCE // part.rays.n_rays)
            if n <= at_once:
                yield part
                continue
            for first in range(0, n, at_once):
                some = slice(first, min(first + at_once, n))
                yield Part(_rows(part.rays, some), take_points(part.points, some), part.owner[some])

    def tables(self) -> list[TabledPart]:
        """`chunks`, as compiled loops take them."""
        if self._tables is None:
            self._tables = [TabledPart(part.rays, part.owner, ray_table(part.rays)) for part in self.chunks()]
        return self._tables


def _rows(rays: RecordRays, some: slice) -> RecordRays:
    limits = rays.n_rays * np.array([some.start, some.stop])
    first, last = np.searchsorted(rays.adjusted, limits).tolist()
    begin, end = np.searchsorted(rays.detour, limits).tolist()
    columns = {
        name: getattr(rays, name)[some]
        for name in ("stream", "position", "shading_normal", "cell", "distance", "instance", "triangle", "uv")
    }
    return rays._replace(
        adjusted=rays.adjusted[first:last] - limits[0],
        throughput=rays.throughput[first:last],
        detour=rays.detour[begin:end] - limits[0],
        detour_ends=take_points(rays.detour_ends, slice(begin, end)),
        **columns,
    )


def ray_table(rays: RecordRays) -> RayTable:
    """Rays as compiled loops take them."""
    n, n_rays = rays.cell.shape
    ends = rays.detour_ends
    lit = rays.cell.reshape(-1)[rays.detour] >= 0
    return RayTable(
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
