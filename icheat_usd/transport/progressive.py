"""Transport that is usable from its first second and gets better: records placed, then more rays for each."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from icheat_usd.errors import IcheatError
from icheat_usd.kernels.rows import place_rows
from icheat_usd.materials import is_glossy, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I64, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport.build import Lobe, Transport
from icheat_usd.transport.outliers import Survey, add_outliers
from icheat_usd.transport.pieces import PartStore, Pieces
from icheat_usd.transport.rays import MOST_RAYS, MeasuredRows, RowBuilder
from icheat_usd.transport.records import Records, RecordSettings, place_records, tile_order
from icheat_usd.transport.sparse import SparseRows, concatenate_rows

#: Rays of a row while records are placed. All rows have the same, so that neighbours differ by what they see.
_PLACING_RAYS = 128
#: The same for every view sample, when outliers are looked for.
_SURVEY_RAYS = 64
_STRONG = 0.2  # reflectance: what reflects less follows from its neighbours, or is not missed
_SURVEYED_AT_ONCE = 1 << 15  # samples, whose rows are held in memory
_GROWTH = 4  # of the rays from one transport to the next
_LOBES = ("diffuse", "specular_base", "specular_edge")


def build_transports(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    gather: GatherSamples,
    training: F32,
    *,
    settings: RecordSettings | None = None,
    rays_per_row: int = 2048,
    seed: int = 0,
    progress: Progress = silent,
    parts: PartStore | None = None,
) -> Iterator[Transport]:
    """Measure the transport at adaptively placed records; better and better, each one usable.

    Parameters
    ----------
    training : (n_lights, n_gather) float32
        What plausible lights make leave the cells: `training_radiance`.
    rays_per_row
        Of the last transport, per record and lobe; at most `MOST_RAYS`.
    parts
        Where rows that were traced before are found, and those that are traced now are kept.

    Yields
    ------
    Transport
        While records are placed, with few rays that all rows share, as noise
        they move slowly over a surface instead of from record to record; then
        with rays of their own. Rows are in the order of `tile_order`.

    Raises
    ------
    IcheatError
        `rays_per_row` is too large.

    Notes
    -----
    Bitwise the same for any number of threads.
    """
    if rays_per_row > MOST_RAYS:
        raise IcheatError(f"{rays_per_row} gather rays a row are more than records can have; take {MOST_RAYS} at most")
    builder = RowBuilder(snapshot, tracer, gather, seed)
    lights = np.ascontiguousarray(training.T)
    share = _scalar(view.throughput) * np.float32(
        view.samples_per_pixel
    )  # of its pixel's light, where several share it
    colours = view.points.albedo, view.points.specular, view.points.specular_edge
    tint = np.stack([_scalar(colour) * share for colour in colours])
    placed: list[list[SparseRows]] = [[], [], []]
    pieces = Pieces(parts)

    def trace(samples: I64, stream: I64, first_ray: int, n_rays: int, of_rays: int) -> MeasuredRows:
        points = take_points(view.points, samples)
        one_each = np.arange(len(samples) + 1, dtype=np.int64)
        return builder.measure(
            points, one_each, stream, n_rays, 0, progress, "gather rays", first_ray=first_ray, of_rays=of_rays
        )

    def trace_specular(samples: I64, stream: I64, n_rays: int) -> tuple[SparseRows, SparseRows]:
        points = take_points(view.points, samples)
        glossy = np.flatnonzero(is_glossy(points))
        if not len(glossy):
            nothing = SparseRows.empty(len(samples), gather.n)
            return nothing, nothing
        return builder.specular_rows(points, view.to_eye[samples], stream, glossy, n_rays, progress)

    def rows_of(samples: I64, stream: I64, first_ray: int, n_rays: int, of_rays: int) -> MeasuredRows:
        def make(rows: I64) -> MeasuredRows:
            return trace(samples[rows], stream[rows], first_ray, n_rays, of_rays)

        return pieces.measured(np.arange(len(samples)), n_rays, make)

    def specular(samples: I64, stream: I64, n_rays: int) -> list[SparseRows]:
        def make(rows: I64) -> tuple[SparseRows, SparseRows]:
            return trace_specular(samples[rows], stream[rows], n_rays)

        return list(pieces.both(np.arange(len(samples)), n_rays, make))

    def look(samples: I64) -> F32:
        """Diffuse light by few rays, in two halves: (n, 2, n_lights)."""
        stream, half = np.zeros_like(samples), _SURVEY_RAYS // 2
        parts = [trace(samples, stream, first, half, _SURVEY_RAYS).cells.matmul(lights) for first in (0, half)]
        return np.stack(parts, axis=1)

    def look_specular(samples: I64) -> F32:
        both = trace_specular(samples, np.zeros_like(samples), _SURVEY_RAYS)
        return np.stack([rows.matmul(lights) for rows in both], axis=1)

    def survey() -> Survey:
        """The light at every view sample."""
        reflects = is_glossy(view.points) & (view.points.specular.max(axis=1) >= _STRONG)
        glossy = np.flatnonzero(reflects)
        diffuse = [pieces.get(partial(look, samples)) for samples in _chunks(np.arange(view.n))]
        reflected = [pieces.get(partial(look_specular, samples)) for samples in _chunks(glossy)]
        return Survey(np.concatenate(diffuse), glossy, np.concatenate(reflected))

    def probe(samples: I64) -> F32:
        out = np.zeros((2, 3, len(samples), lights.shape[1]), np.float32)
        stream = np.zeros(len(samples), np.int64)
        half = _PLACING_RAYS // 2
        one = rows_of(samples, stream, 0, half, _PLACING_RAYS)
        two = rows_of(samples, stream, half, half, _PLACING_RAYS)
        out[0, 0], out[1, 0] = one.cells.matmul(lights), two.cells.matmul(lights)
        placed[0].append(one.continued(two).cells)
        for lobe, rows in enumerate(specular(samples, stream, _PLACING_RAYS), 1):
            out[:, lobe] = rows.matmul(lights)
            placed[lobe].append(rows)
        return out

    settings = settings or RecordSettings()
    records: Records | None = None
    for records in place_records(view, snapshot.camera, probe, tint, settings):
        rows = [concatenate_rows(list(part), gather.n) for part in placed]
        placed = [[part] for part in rows]
        yield _transport(view, records, rows, _PLACING_RAYS, seed, np.zeros(len(records.view), np.int64))
    assert records is not None
    placed.clear()
    records = add_outliers(records, survey(), tint, settings)
    samples = records.view.astype(np.int64)
    measured: MeasuredRows | None = None
    n_rays = min(rays_per_row, 2 * _PLACING_RAYS)
    while True:
        before = measured.n_rays if measured else 0
        more = rows_of(samples, samples, before, n_rays - before, rays_per_row)
        measured = measured.continued(more) if measured else more
        yield _transport(view, records, [measured.cells, *specular(samples, samples, n_rays)], n_rays, seed, None)
        if n_rays == rays_per_row:
            return
        n_rays = min(rays_per_row, n_rays * _GROWTH)


def _chunks(samples: I64) -> list[I64]:
    return np.split(samples, range(_SURVEYED_AT_ONCE, len(samples), _SURVEYED_AT_ONCE))


def _transport(
    view: ViewSamples, records: Records, rows: list[SparseRows], n_rays: int, seed: int, stream: I64 | None
) -> Transport:
    points = view.points
    order = tile_order(points.position[records.view], points.shading_normal[records.view])
    tints = points.albedo, points.specular, points.specular_edge
    lobes = [
        Lobe(name, _in_order(part, order), tint)
        for name, part, tint in zip(_LOBES, rows, tints, strict=True)
        if name == "diffuse" or part.n_entries
    ]
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    weights = records.interpolation
    column = place[weights.indices]
    entry = np.lexsort((column, np.repeat(np.arange(weights.n_rows), np.diff(weights.indptr))))
    spread = SparseRows(weights.indptr, column[entry], weights.weights[entry], weights.n_columns)
    return Transport(tuple(lobes), records.view[order], spread, n_rays, seed, None if stream is None else stream[order])


def _in_order(rows: SparseRows, order: I64) -> SparseRows:
    indptr = np.concatenate([[0], np.cumsum(np.diff(rows.indptr)[order])])
    out = SparseRows(indptr, np.empty_like(rows.indices), np.empty_like(rows.weights), rows.n_columns)
    begin = np.empty(len(order), np.int64)
    begin[order] = indptr[:-1]
    place_rows(rows.indptr, begin, rows.indices, rows.weights, out.indices, out.weights)
    return out


def _scalar(tint: F32) -> F32:
    return np.ascontiguousarray(tint.mean(axis=1))
