"""Rows of transport measured by gather rays: traced, looked up in the gather cells, and merged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from icheat_usd.kernels import rows as row_kernels
from icheat_usd.kernels import transport as kernels
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.samples import cosine_rays
from icheat_usd.materials import sample_specular, take_points
from icheat_usd.progress import Progress
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, U8, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points
from icheat_usd.transport.sparse import SparseRows, concatenate_rows

_RAYS_AT_ONCE = 1 << 20
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


class RowBuilder:
    """Traces rays of many rows at a time and merges their hits."""

    def __init__(self, snapshot: SceneSnapshot, tracer: Tracer, gather: GatherSamples, seed: int) -> None:
        self._snapshot, self._tracer, self._gather, self._seed = snapshot, tracer, gather, seed
        self._route = routed_triangles(snapshot)

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
        seed = self._seed_for(purpose)
        clear = spawn_points(self._snapshot, points, points.normal)

        def row_chunk(first: int, last: int) -> SparseRows:
            n = (last - first) * n_rays
            origins, directions = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)
            cosine_rays(
                clear,
                points.shading_normal,
                points.normal,
                point_begin[first : last + 1],
                n_rays,
                seed,
                stream[first:last],
                np.empty(n, np.int64),
                origins,
                directions,
            )
            cell, weight = self._cells(origins, directions, _mix(seed, 1 + first))
            if weight is None:
                return self._merge_counts(cell, n_rays)
            return self._merge(cell, weight[:, None] / np.float32(n_rays), n_rays)[0]

        return self._in_chunks(len(stream), n_rays, row_chunk, progress, step)

    def specular_rows(
        self, points: SurfacePoints, to_eye: F32, stream: I64, glossy: I64, n_rays: int, progress: Progress
    ) -> tuple[SparseRows, SparseRows]:
        """Rows that multiply the specular colour, and rows that multiply the specular edge.

        Both stand on the same directions, and share their columns in memory.
        Weak reflections, of all dielectrics, take a quarter of the rays: their
        noise is scaled down by their reflectance.
        """
        seed = self._seed_for(2)
        weak = points.specular[glossy].max(axis=1) < _WEAK_SPECULAR
        second: list[F32] = []
        parts: list[tuple[I64, SparseRows, F32]] = []
        for rows, rays in ((glossy[~weak], n_rays), (glossy[weak], max(1, n_rays // 4))):

            def row_chunk(first: int, last: int, rows: I64 = rows, rays: int = rays) -> SparseRows:
                start = np.repeat(rows[first:last], rays)
                u = np.empty((len(start), 2), np.float32)
                kernels.point_sets(seed, stream[rows[first:last]], rays, u)
                many = take_points(points, start)
                directions, to_base, to_edge = sample_specular(many, np.ascontiguousarray(to_eye[start]), u)
                origins = spawn_points(self._snapshot, many, directions)
                cell, weight = self._cells(origins, directions, _mix(seed, 1 + int(rows[first])))
                both = np.stack([to_base, to_edge], axis=1) / np.float32(rays)
                base, edge = self._merge(cell, both if weight is None else both * weight[:, None], rays)
                second.append(edge)
                return base

            if len(rows):
                base = self._in_chunks(len(rows), rays, row_chunk, progress, "glossy gather rays", _RAYS_AT_ONCE // 4)
                parts.append((rows, base, np.concatenate(second)))
                second.clear()

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
        row_chunk: Callable[[int, int], SparseRows],
        progress: Progress,
        step: str,
        rays_at_once: int = _RAYS_AT_ONCE,
    ) -> SparseRows:
        parts = []
        at_once = max(1, rays_at_once // n_rays)
        progress(step, 0.0)
        for first in range(0, n_rows, at_once):
            last = min(first + at_once, n_rows)
            parts.append(row_chunk(first, last))
            progress(step, last / n_rows)
        return concatenate_rows(parts, self._gather.n)

    def _cells(self, origins: F32, directions: F32, seed: int) -> tuple[I32, F32 | None]:
        """Cell that each ray ends in and its throughput; None for the throughput where it is 1 for all."""
        hits = self._tracer.intersect(origins, directions)
        cell = np.empty(len(origins), np.int32)
        detour = np.empty(len(origins), np.uint8)
        geometry, locator = self._snapshot.geometry, self._gather.locator
        kernels.cells_of_hits(
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
        ends = first_surfaces(self._snapshot, self._tracer, origins[rest], directions[rest], seed, _DETOUR_DEPTH)
        cell[rest] = self._gather.locate(ends.points)
        weight = np.ones(len(cell), np.float32)
        weight[rest] = ends.throughput.mean(axis=1)
        return cell, weight

    def _merge_counts(self, cell: I32, n_rays: int) -> SparseRows:
        n = len(cell) // n_rays
        counts = np.empty(n, np.int64)
        merged = np.empty((n, n_rays), np.int32)
        weights = np.empty((n, n_rays), np.float32)
        kernels.merge_counts(cell, n_rays, counts, merged, weights)
        indptr = np.concatenate([[0], np.cumsum(counts)])
        rows = SparseRows(indptr, np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32), self._gather.n)
        row_kernels.pack_rows(counts, indptr, merged, weights, rows.indices, rows.weights)
        return rows

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


def _mix(seed: int, value: int) -> int:
    return int(hash_combine(seed & 0xFFFFFFFF, value))


def scatter_rows(parts: list[tuple[I64, SparseRows]], n_rows: int, n_columns: int) -> SparseRows:
    """One matrix of parts whose rows belong at given places, ascending in each part; other rows are empty."""
    counts = np.zeros(n_rows, np.int64)
    for place, rows in parts:
        counts[place] = np.diff(rows.indptr)
    indptr = np.concatenate([[0], np.cumsum(counts)])
    if len(parts) == 1:
        return SparseRows(indptr, parts[0][1].indices, parts[0][1].weights, n_columns)
    out = SparseRows(indptr, np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32), n_columns)
    for place, rows in parts:
        row_kernels.place_rows(rows.indptr, indptr[place], rows.indices, rows.weights, out.indices, out.weights)
    return out
