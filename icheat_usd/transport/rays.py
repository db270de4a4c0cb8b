"""Rows of transport measured by gather rays: traced, looked up in the gather cells, and merged."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from icheat_usd.kernels import gather_rows as gather_kernels
from icheat_usd.kernels import rows as row_kernels
from icheat_usd.kernels import transport as kernels
from icheat_usd.kernels.cell_map import CellTable
from icheat_usd.kernels.embree import TraceTable
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.workers import overlapping
from icheat_usd.materials import sample_specular, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, U8, Hits, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points
from icheat_usd.transport.cell_paths import cells_behind
from icheat_usd.transport.sparse import SparseRows, add_shares, concatenate_rows, placed_rows

Chunk = TypeVar("Chunk")

#: Some tenths of a second of one worker: who interrupts waits for the chunks that are on their way.
_RAYS_AT_ONCE = 1 << 19
_UNITS = 1024  # of a ray: counts stay whole numbers where mirrors and glass let part of its light through
#: Of a row that is measured in parts: float32 shares give back counts of units below 2^23.
MOST_RAYS = (1 << 23) // _UNITS
_LANES_PER_THREAD = 4  # few lanes are few counters, several even out the rows' cost
_DETOUR = np.int32, np.float32, np.int32, np.int32, np.float32, np.float32  # a ray, and the columns of `Hits`
_DETOUR_DEPTH = 8  # mirrors and faces of glass on a gather ray: what is trapped for longer is darkness to the row
_WEAK_SPECULAR = 0.2  # reflectance at normal incidence; dielectrics have 0.02 to 0.17


def routed_triangles(snapshot: SceneSnapshot) -> U8:
    """Triangles on which a path may go straight on or be mirrored: 1 where a hit must be looked at more closely."""
    m = snapshot.materials
    textured = m.texture >= 0
    opacity = (m.opacity < 1) | textured[:, 5]
    smooth = (m.roughness <= 0.01) | textured[:, 4]
    dark = (m.metallic > 0.99) | textured[:, 3] | textured[:, 0] | np.all(m.diffuse <= 0, axis=1)
    dark |= m.use_display_color.astype(bool)
    return (opacity | (smooth & dark)).astype(np.uint8)[snapshot.geometry.material]


class MeasuredRows(NamedTuple):
    """Where the rays of rows end, as shares of `n_rays`."""

    cells: SparseRows  #: (n_rows x n_gather)
    n_rays: int

    def continued(self, more: MeasuredRows) -> MeasuredRows:
        """These rows and further rays of the same rows: the same, bit for bit, as all rays measured at once.

        Raises
        ------
        ValueError
            More than `MOST_RAYS` in all, whose counts float32 could not hold.
        """
        n_rays = self.n_rays + more.n_rays
        if n_rays > MOST_RAYS:
            raise ValueError(f"{n_rays} gather rays a row are too many to add up exactly; at most {MOST_RAYS}")
        before, after = self.n_rays * _UNITS, more.n_rays * _UNITS
        cells = add_shares(self.cells, before, more.cells, after, before + after)
        return MeasuredRows(cells, n_rays)


class RowBuilder:
    """Traces rays of many rows at a time and merges their hits."""

    def __init__(self, snapshot: SceneSnapshot, tracer: Tracer, gather: GatherSamples, seed: int) -> None:
        self._snapshot, self._tracer, self._gather, self._seed = snapshot, tracer, gather, seed
        self._route = routed_triangles(snapshot)
        self._hit_cells = gather.hit_cells

    def diffuse_rows(
        self,
        points: SurfacePoints,
        point_begin: I64,
        stream: I64,
        n_rays: int,
        purpose: int,
        progress: Progress,
        step: str,
    ) -> SparseRows:
        """Rows of cosine-distributed rays; row r starts from points ``point_begin[r]:point_begin[r + 1]``."""
        return self.measure(points, point_begin, stream, n_rays, purpose, progress, step).cells

    def measure(
        self,
        points: SurfacePoints,
        point_begin: I64,
        stream: I64,
        n_rays: int,
        purpose: int,
        progress: Progress = silent,
        step: str = "gather rays",
        *,
        first_ray: int = 0,
        of_rays: int | None = None,
    ) -> MeasuredRows:
        """Rows of cosine-distributed rays.

        Parameters
        ----------
        point_begin : (n_rows + 1,)
            Row r starts from points ``point_begin[r]:point_begin[r + 1]``.
        stream : (n_rows,)
            Number of each row's sequence of rays.
        purpose
            Rows of different purposes have different rays.
        first_ray
            Rays ``first_ray:first_ray + n_rays`` of the sequence are traced; see `MeasuredRows.continued`.
        of_rays
            How many there will be in all, over which the points of a row are spread.

        Notes
        -----
        Bitwise the same for any number of threads. Each row is the same whatever rows it is measured with, but for
        rays on an edge between triangles: which of the two a ray of a packet meets can depend on the rays beside it.
        Memory: 64 MB beside the rows.
        """
        rays = _Rays(
            spawn_points(self._snapshot, points, points.normal),
            np.require(points.shading_normal, np.float32, ["C", "W"]),
            np.require(points.normal, np.float32, ["C", "W"]),
            np.require(point_begin, np.int64, ["C", "W"]),
            np.require(stream, np.int64, ["C", "W"]),
            self._seed_for(purpose),
            first_ray,
            n_rays,
            first_ray + n_rays if of_rays is None else of_rays,
        )
        table = self._trace_table()
        lookup = self._hit_cells.table(self._snapshot.geometry, len(stream) * n_rays)
        counter = _Counter(self._gather.n)

        def row_chunk(first: int, last: int) -> SparseRows:
            part = rays.rows(first, last)
            if table is not None:
                return self._count_hits(table, lookup, part, counter)
            n = last - first
            row, ray = np.repeat(np.arange(n), n_rays), np.tile(np.arange(first_ray, first_ray + n_rays), n)
            return _counted(row, *self._ends(part, row, ray), n, self._gather.n)

        units = concatenate_rows(self._in_chunks(len(stream), n_rays, row_chunk, progress, step), self._gather.n)
        kernels.divide(units.weights, float(_UNITS * n_rays))
        return MeasuredRows(units, n_rays)

    def _trace_table(self) -> TraceTable | None:
        return self._tracer.compiled()

    def _count_hits(self, trace: TraceTable, lookup: CellTable, rays: _Rays, counter: _Counter) -> SparseRows:
        """Units of light that arrive from cells."""
        geometry, gather = self._snapshot.geometry, self._gather
        n = len(rays.stream)
        count = np.empty(n, np.int64)
        key, hits = (np.empty((n, min(rays.n_rays, counter.n_keys)), np.int32) for _ in range(2))
        together = gather_kernels.block_rows(rays.n_rays)
        n_detours = np.empty(-(-n // together), np.int64)
        detour, *met = (np.empty((len(n_detours), together * rays.n_rays), kind) for kind in _DETOUR)
        gather_kernels.count_hits(
            trace,
            lookup,
            gather.locator.table,
            gather.locator.depth,
            geometry.points,
            geometry.instance_to_world,
            geometry.instance_to_object,
            self._route,
            rays.position,
            rays.shading_normal,
            rays.normal,
            rays.point_begin,
            rays.stream,
            rays.seed,
            rays.first_ray,
            rays.n_rays,
            rays.of_rays,
            counter.count,
            counter.mark,
            count,
            key,
            hits,
            n_detours,
            detour,
            Hits(*met),
        )
        begin = np.concatenate([[0], np.cumsum(count)])
        rows = SparseRows(begin, np.empty(begin[-1], np.int32), np.empty(begin[-1], np.float32), counter.n_keys)
        kernels.pack_units(count, begin, key, hits, _UNITS, rows.indices, rows.weights)
        begin = np.concatenate([[0], np.cumsum(n_detours)])
        if begin[-1] == 0:
            return rows
        packed = [np.empty(begin[-1], kind) for kind in _DETOUR]
        for column, entries in zip((detour, *met), packed, strict=True):
            row_kernels.pack_ints(n_detours, begin, column.view(np.int32), entries.view(np.int32))
        row = np.repeat(np.arange(len(n_detours)) * together, n_detours) + packed[0] // rays.n_rays
        ray = rays.first_ray + packed[0] % rays.n_rays
        ends = self._ends(rays, row, ray, Hits(*packed[1:]))
        return add_shares(rows, 1, _counted(row, *ends, n, counter.n_keys), 1, 1)

    def _ends(self, rays: _Rays, row: I64, ray: I32 | I64, first: Hits | None = None) -> tuple[I64, I64, I64]:
        """Where some rays end: number of the ray in `row`, column and units of light.

        `first`: what they meet first, where it is known, and all of it may not simply reflect.
        """
        n = len(row)
        origins, directions = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
        counter = np.empty(n, np.int32)
        gather_kernels.rays_of_rows(
            rays.position,
            rays.shading_normal,
            rays.normal,
            rays.point_begin,
            rays.stream,
            rays.seed,
            rays.of_rays,
            row,
            ray,
            origins,
            directions,
            counter,
        )
        cell: I32
        weight: F32 | None
        if first is None:
            cell, weight = self._cells(origins, directions, counter, rays.seed)
        else:
            cell, weight = self._cells_behind(origins, directions, counter, rays.seed, first)
        which = np.flatnonzero(cell >= 0)
        units = np.full(n, _UNITS) if weight is None else np.rint(weight * np.float32(_UNITS)).astype(np.int64)
        column, units = cell[which].astype(np.int64), units[which]
        return which, column, units

    def specular_rows(
        self, points: SurfacePoints, to_eye: F32, stream: I64, glossy: I64, n_rays: int | I64, progress: Progress
    ) -> tuple[SparseRows, SparseRows]:
        """Rows that multiply the specular colour, and rows that multiply the specular edge.

        Both stand on the same directions, and share their columns in memory.

        Parameters
        ----------
        glossy : (n_glossy,)
            Which points reflect, ascending.
        n_rays
            Of each of these, (n_glossy,); one number is for strong reflections, see `specular_counts`.
        """
        seed = self._seed_for(2)
        counts = n_rays if isinstance(n_rays, np.ndarray) else specular_counts(points, glossy, n_rays)
        parts: list[tuple[I64, SparseRows, F32]] = []
        for rays in np.unique(counts).tolist():
            rows = glossy[counts == rays]

            def row_chunk(first: int, last: int, rows: I64 = rows, rays: int = rays) -> tuple[SparseRows, F32]:
                start = np.repeat(rows[first:last], rays)
                u = np.empty((len(start), 2), np.float32)
                kernels.point_sets(seed, stream[rows[first:last]], rays, u)
                many = take_points(points, start)
                directions, to_base, to_edge = sample_specular(many, np.ascontiguousarray(to_eye[start]), u)
                origins = spawn_points(self._snapshot, many, directions)
                counter = np.empty(len(start), np.int32)
                kernels.ray_counters(seed, stream[rows[first:last]], rays, counter)
                cell, weight = self._cells(origins, directions, counter, seed)
                both = np.stack([to_base, to_edge], axis=1) / np.float32(rays)
                return self._merge(cell, both if weight is None else both * weight[:, None], rays)

            chunks = self._in_chunks(len(rows), rays, row_chunk, progress, "glossy gather rays", _RAYS_AT_ONCE // 2)
            edge = np.concatenate([part for _, part in chunks])
            parts.append((rows, concatenate_rows([base for base, _ in chunks], self._gather.n), edge))

        whole = scatter_rows([(rows, base) for rows, base, _ in parts], len(stream), self._gather.n)
        if len(parts) == 1:
            edge_weights = parts[0][2]
        else:
            edge_parts = [(rows, replace(base, weights=edge)) for rows, base, edge in parts]
            edge_weights = scatter_rows(edge_parts, len(stream), self._gather.n).weights
        return whole, replace(whole, weights=edge_weights)

    def _seed_for(self, purpose: int) -> int:
        return _mix(self._seed, purpose)

    def _in_chunks(
        self,
        n_rows: int,
        n_rays: int,
        row_chunk: Callable[[int, int], Chunk],
        progress: Progress,
        step: str,
        rays_at_once: int = _RAYS_AT_ONCE,
    ) -> list[Chunk]:
        at_once = max(1, rays_at_once // n_rays)
        spans = [(first, min(first + at_once, n_rows)) for first in range(0, n_rows, at_once)]
        chunks = []
        progress(step, 0.0)
        for (_, last), chunk in zip(spans, overlapping([partial(row_chunk, *span) for span in spans]), strict=True):
            chunks.append(chunk)
            progress(step, last / n_rows)
        return chunks

    def _cells(self, origins: F32, directions: F32, counters: I32, seed: int) -> tuple[I32, F32 | None]:
        """Cell that each ray ends in and its throughput; None for the throughput where it is 1 for all."""
        if self._trace_table() is not None:
            return self._cells_behind(origins, directions, counters, seed)
        hits = self._tracer.intersect(origins, directions)
        cell = np.empty(len(origins), np.int32)
        detour = np.empty(len(origins), np.uint8)
        geometry, locator = self._snapshot.geometry, self._gather.locator
        kernels.cells_of_hits(
            self._hit_cells.table(geometry, len(origins)),
            locator.table,
            locator.depth,
            geometry.points,
            geometry.instance_to_world,
            geometry.instance_to_object,
            self._route,
            directions,
            hits.instance,
            hits.triangle,
            hits.u,
            hits.v,
            cell,
            detour,
        )
        rest = np.flatnonzero(detour)
        if not len(rest):
            return cell, None
        weight = np.ones(len(cell), np.float32)
        cell[rest], weight[rest] = self._cells_behind(origins[rest], directions[rest], counters[rest], seed)
        return cell, weight

    def _cells_behind(
        self, origins: F32, directions: F32, counters: I32, seed: int, first: Hits | None = None
    ) -> tuple[I32, F32]:
        """Cell at the end of each path over mirrors, glass and holes, and the path's throughput."""
        trace = self._trace_table()
        if trace is not None:
            rays = trace, self._gather, self._route, origins, directions
            cell, throughput = cells_behind(self._snapshot, *rays, counters, seed, _DETOUR_DEPTH, first)
            red, green, blue = throughput.T
            return cell, (red + green + blue) / np.float32(3)
        ends = first_surfaces(self._snapshot, self._tracer, origins, directions, seed, _DETOUR_DEPTH, counters)
        red, green, blue = ends.throughput.T
        return self._gather.locate(ends.points), (red + green + blue) / np.float32(3)

    def _merge(self, cell: I32, weight: F32, n_rays: int) -> tuple[SparseRows, F32]:
        """Rows of the first column of `weight` (n, k), and the last column's weights of the same entries."""
        n = len(cell) // n_rays
        counts = np.empty(n, np.int64)
        merged, weights = np.empty_like(cell), np.empty(weight.shape, np.float32)
        kernels.merge_weights(n_rays, cell, np.ascontiguousarray(weight), counts, merged, weights)
        indptr = np.concatenate([[0], np.cumsum(counts)])
        indices = np.empty(indptr[-1], np.int32)
        packed = np.empty((weight.shape[1], indptr[-1]), np.float32)
        kernels.pack_weights(n_rays, counts, indptr, merged, weights, indices, packed)
        return SparseRows(indptr, indices, packed[0], self._gather.n), packed[-1]


class _Rays(NamedTuple):
    """Rays of some rows, made from counters wherever they are needed."""

    position: F32  # (p, 3) clear of the surface
    shading_normal: F32
    normal: F32
    point_begin: I64  # (n_rows + 1,)
    stream: I64  # (n_rows,)
    seed: int
    first_ray: int
    n_rays: int
    of_rays: int

    def rows(self, first: int, last: int) -> _Rays:
        return self._replace(point_begin=self.point_begin[first : last + 1], stream=self.stream[first:last])


class _Counter(threading.local):
    """Zeros that the kernel counts on, some lanes for each of its workers; of each thread that calls the kernel."""

    def __init__(self, n_keys: int) -> None:
        lanes = _LANES_PER_THREAD * gather_kernels.thread_count()
        self.n_keys = n_keys
        self.count = np.zeros((lanes, n_keys), np.int32)
        self.mark = np.zeros((lanes, -(-n_keys // 64)), np.uint64)


def specular_counts(points: SurfacePoints, glossy: I64, n_rays: int) -> I64:
    """Rays of the specular rows of some points: weak reflections, of all dielectrics, take a quarter.

    Their noise is scaled down by their reflectance.
    """
    weak = points.specular[glossy].max(axis=1) < _WEAK_SPECULAR
    return np.where(weak, max(1, n_rays // 4), n_rays).astype(np.int64)


def _counted(row: I64, which: I64, column: I64, units: I64, n_rows: int, n_columns: int) -> SparseRows:
    """Rows of added units; entry e belongs to row ``row[which[e]]``."""
    code = row[which] * n_columns + column
    order = np.argsort(code[units > 0], kind="stable")
    code, units = code[units > 0][order], units[units > 0][order]
    first = np.flatnonzero(np.concatenate([[True], code[1:] != code[:-1]])[: len(code)])
    total = np.add.reduceat(units, first) if len(first) else units
    code = code[first]
    indptr = np.searchsorted(code, np.arange(n_rows + 1) * n_columns)
    return SparseRows(indptr, (code % n_columns).astype(np.int32), total.astype(np.float32), n_columns)


def _mix(seed: int, value: int) -> int:
    return int(hash_combine(seed & 0xFFFFFFFF, value))


def scatter_rows(parts: list[tuple[I64, SparseRows]], n_rows: int, n_columns: int) -> SparseRows:
    """One matrix of parts whose rows belong at given places, ascending in each part; other rows are empty."""
    if len(parts) == 1:  # without a copy of it
        place, rows = parts[0]
        counts = np.zeros(n_rows, np.int64)
        counts[place] = np.diff(rows.indptr)
        return SparseRows(np.concatenate([[0], np.cumsum(counts)]), rows.indices, rows.weights, n_columns)
    return placed_rows([(place, rows, np.arange(rows.n_rows)) for place, rows in parts], n_rows, n_columns)
