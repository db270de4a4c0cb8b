"""Hemispheres of some cache records side by side, and the casters that their rays end on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.record_rays import RecordRays
from icheat_usd.kernels import hemisphere_light as kernels
from icheat_usd.materials import concatenate_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, U8, SceneSnapshot, SurfacePoints


class Collected(NamedTuple):
    """Hemispheres of some records."""

    table: kernels.HemisphereTable
    order: I64  #: (n,) by record
    number: I64  #: (n_records,) of each record among these
    begin: I64  #: of each of these in `order`
    strangers: SurfacePoints | None  #: casters that are no gather sample; they are numbered on from these

    def range_of(self, records: I64) -> I64:
        """(k, 2) places in `order`."""
        number = self.number[records]
        return np.stack([self.begin[number], self.begin[number + 1]], axis=1)


def collect(
    hemispheres: Hemispheres, records: I64, snapshot: SceneSnapshot, gather: GatherSamples, varied: U8
) -> Collected:
    """Hemispheres of some records, ascending.

    Parameters
    ----------
    varied : (n_instances,) uint8
        1 where edits look at the place that a ray hits; elsewhere its gather sample speaks for it, as it does for the
        light that it sends.
    """
    wanted = np.full(hemispheres.n, -1, np.int64)
    wanted[records] = np.arange(len(records))
    share = hemispheres.shares()
    columns: list[tuple[Any, ...]] = []
    strangers: list[SurfacePoints] = []
    n_casters, n_rows = len(gather.area), 0
    for rays, _, owner in hemispheres.parts:
        rows = np.flatnonzero(wanted[owner] >= 0)
        if len(rows) == 0:
            continue
        cell = np.take(rays.cell, rows, axis=0)
        caster, flat = cell, _strangers(cell, np.take(rays.instance, rows, axis=0), gather.points.instance, varied)
        if len(flat):
            caster = cell.copy()
            caster.reshape(-1)[flat] = n_casters + np.arange(len(flat), dtype=np.int32)
            n_casters += len(flat)
            row, ray = flat // rays.n_rays, flat % rays.n_rays
            strangers.append(rays.ends(snapshot, rows[row] * rays.n_rays + ray))
        adjusted, throughput, way = _adjusted(rays, rows)
        columns.append(
            (
                cell,
                caster,
                np.take(rays.distance, rows, axis=0),
                np.take(rays.shading_normal, rows, axis=0),
                rays.stream[rows],
                adjusted + n_rows * rays.n_rays,
                throughput,
                way,
                share[owner[rows]],
                hemispheres.shrink[owner[rows]],
                wanted[owner[rows]],
            )
        )
        n_rows += len(rows)
    cell, caster, distance, normal, stream, adjusted, throughput, way, shares, shrink, record = (
        np.concatenate(column) for column in zip(*columns, strict=True)
    )
    first = np.searchsorted(adjusted, cell.shape[1] * np.arange(len(cell) + 1))
    order = np.argsort(record, kind="stable")
    return Collected(
        kernels.HemisphereTable(
            cell, caster, distance, normal, stream, first, adjusted, throughput, way, shares, shrink
        ),
        order,
        wanted,
        np.searchsorted(record[order], np.arange(len(records) + 1)),
        concatenate_points(*strangers) if strangers else None,
    )


def _strangers(cell: I32, instance: I32, of_cell: I32, varied: U8) -> I64:
    """Rays that do not end where their cell is, or that edits look at themselves."""
    found = np.empty(cell.size, np.int64)
    return found[: kernels.find_strangers(cell, instance, of_cell, varied, found)]


def _adjusted(rays: RecordRays, rows: I64) -> tuple[I64, F32, F32]:
    """Numbers among the rays of some rows of those that bring other light than cells, and their tints."""
    place = np.full(len(rays.stream), -1, np.int64)
    place[rows] = np.arange(len(rows))
    row = place[rays.adjusted // rays.n_rays]
    kept = np.flatnonzero(row >= 0)
    number = row[kept] * rays.n_rays + rays.adjusted[kept] % rays.n_rays
    return number, np.ascontiguousarray(rays.throughput[kept], np.float32), rays.way()[kept]
