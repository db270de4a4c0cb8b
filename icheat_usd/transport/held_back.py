"""Transport that occluders hold back: what gather rays would reach if these surfaces were not there."""

from __future__ import annotations

from typing import Any

import numpy as np

from icheat_usd.materials import is_glossy, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I32, I64, Bool, SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer, first_surfaces
from icheat_usd.transport.build import Lobe, Transport
from icheat_usd.transport.rays import RowBuilder, scatter_rows, specular_counts
from icheat_usd.transport.sparse import SparseRows

#: Sets of rows that are kept: one for each edit that an artist goes back and forth between.
_KEPT = 8


class HeldBack:
    """Rows behind occluders for one view and its transport, made when asked for and kept.

    The rays are those of the transport's own rows, so that rows and what is
    held back of them add up to the rows of the scene without the occluders.
    Only rays that end on an occluder count: a mirror's or a pane's light is
    its own.
    """

    def __init__(
        self,
        snapshot: SceneSnapshot,
        tracer: Tracer,
        view: ViewSamples,
        gather: GatherSamples,
        transport: Transport,
        progress: Progress = silent,
    ) -> None:
        self._snapshot, self._tracer, self._view, self._gather = snapshot, tracer, view, gather
        self._transport, self._progress = transport, progress
        self._kept: dict[tuple[bytes, bytes], tuple[Lobe, ...]] = {}

    def rows(self, samples: I64, occluders: Bool) -> tuple[Lobe, ...]:
        """Lobes like those of the transport, with entries in the rows that some view samples use.

        Parameters
        ----------
        samples : view samples, ascending
        occluders : (n_instances,) the surfaces to pass
        """
        key = (samples.tobytes(), occluders.tobytes())
        if key not in self._kept:
            while len(self._kept) >= _KEPT:
                del self._kept[next(iter(self._kept))]
            self._kept[key] = self._trace(samples, occluders)
        return self._kept[key]

    def _trace(self, samples: I64, occluders: Bool) -> tuple[Lobe, ...]:
        transport, view = self._transport, self._view
        which = samples
        n_rows = len(transport.row_view)
        if transport.interpolation is not None:
            spread = transport.interpolation
            used = np.zeros(view.n, np.bool_)
            used[samples] = True
            which = np.unique(spread.indices[np.repeat(used, np.diff(spread.indptr))]).astype(np.int64)
        if len(which) == 0:
            return ()
        row_view = transport.row_view[which].astype(np.int64)
        points = take_points(view.points, row_view)
        clear = build_tracer(self._snapshot, self._tracer.engine, hidden=occluders)
        try:
            builder = _BehindOccluders(self._snapshot, self._tracer, clear, self._gather, transport.seed, occluders)
            stream = row_view if transport.stream is None else transport.stream[which]
            counts, glossy = transport.counts, np.flatnonzero(is_glossy(points))
            diffuse, specular = (
                (np.full(len(which), transport.rays_per_row), specular_counts(points, glossy, transport.rays_per_row))
                if counts is None
                else (counts.diffuse[which], counts.specular[which][glossy])
            )
            parts = []
            for rays in np.unique(diffuse).tolist():
                some = np.flatnonzero(diffuse == rays)
                one_each = np.arange(len(some) + 1, dtype=np.int64)
                part = take_points(points, some)
                rows = builder.diffuse_rows(
                    part, one_each, stream[some], rays, 0, self._progress, "rays behind occluders"
                )
                parts.append((some, rows))
            found = [scatter_rows(parts, len(which), self._gather.n)]
            if len(glossy):
                found += builder.specular_rows(points, view.to_eye[row_view], stream, glossy, specular, self._progress)
        finally:
            clear.close()
        return tuple(
            Lobe(lobe.name, rows, lobe.tint)
            for lobe, rows in zip(transport.lobes, _placed(found, which, n_rows), strict=False)
        )


def _placed(found: list[SparseRows], which: I64, n_rows: int) -> list[SparseRows]:
    return [scatter_rows([(which, rows)], n_rows, rows.n_columns) for rows in found]


class _BehindOccluders(RowBuilder):
    """Counts of each ray what lies behind the occluder that it ends on, and nothing of the others."""

    def __init__(self, snapshot: SceneSnapshot, tracer: Tracer, clear: Tracer, gather: Any, seed: int, hidden: Bool):
        super().__init__(snapshot, tracer, gather, seed)
        self._clear, self._hidden = clear, hidden

    def _trace_table(self) -> None:
        """Rays are traced through two scenes, which compiled loops do not do."""

    def _cells(self, origins: F32, directions: F32, counters: I32, seed: int) -> tuple[I32, F32 | None]:
        cell, weight = np.full(len(origins), -1, np.int32), np.zeros(len(origins), np.float32)
        met = first_surfaces(self._snapshot, self._tracer, origins, directions, seed, counters=counters)
        instance = met.points.instance
        held = np.flatnonzero((instance >= 0) & self._hidden[np.maximum(instance, 0)])
        # The same random numbers take the ray the same way up to the occluder.
        ends = first_surfaces(
            self._snapshot, self._clear, origins[held], directions[held], seed, counters=counters[held]
        )
        cell[held] = self._gather.locate(ends.points)
        weight[held] = ends.throughput.mean(axis=1)
        return cell, weight
