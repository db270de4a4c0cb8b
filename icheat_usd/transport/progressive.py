"""Transport that is usable from its first second and gets better: records placed, then more rays for each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from icheat_usd.errors import IcheatError
from icheat_usd.materials import is_glossy, reflectance_to_eye, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I32, I64, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport.allotment import Counts, allot_rays
from icheat_usd.transport.build import Lobe, Transport
from icheat_usd.transport.fitting import fit_weights
from icheat_usd.transport.outliers import Survey, add_outliers, doubtful_samples
from icheat_usd.transport.pieces import PartStore, Pieces
from icheat_usd.transport.rays import MOST_RAYS, MeasuredRows, RowBuilder, scatter_rows, specular_counts
from icheat_usd.transport.records import Records, RecordSettings, place_records, tile_order
from icheat_usd.transport.sparse import SparseRows, concatenate_rows, take_rows

#: Rays of a row while records are placed. All rows have the same, so that neighbours differ by what they see.
_PLACING_RAYS = 128
#: The same for every view sample, when outliers are looked for.
_SURVEY_RAYS = 64
_WEAK_RAYS = 8  # in each half of the survey, for reflections that hardly show
_DOUBTED = 0.25  # share of the samples that are surveyed with more rays: those that few rays say least of
_CLOSER_SHARE = 4  # of a row's rays, one in so many is traced for these, rounded down to a power of two
#: Numbers of the survey that are held in memory, though it has some lights at least.
_SURVEYED_NUMBERS, _FEWEST_LIGHTS = 1 << 26, 48
_STRONG = 0.2  # reflectance towards the eye: what reflects less gets no records of its own for that
_SURVEYED_AT_ONCE = 1 << 13  # samples, whose rows are held in memory
_FIRST_RAYS = 256  # of each record by itself, by which the others are allotted
_GROWTH = 4  # of the rays from one transport to the next
_TILE = (8, 16)  # pixels: places whose rays are traced together
_DIFFUSE_STEP, _GLOSSY_STEP = "gather rays", "glossy gather rays"
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
        Of the last transport, the mean over the records; at most `MOST_RAYS`. See `allot_rays`.
    parts
        Where rows that were traced before are found, and those that are traced now are kept.

    Yields
    ------
    Transport
        While records are placed, with few rays that all rows share, as noise
        they move slowly over a surface instead of from record to record; then
        with rays of their own. Rows are in the order of `tile_order`.
        There is one without rows where the camera sees no surface.

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
    if not view.n:
        none, nothing = np.empty(0, np.int64), SparseRows.empty(0, gather.n)
        spread = SparseRows.empty(0, 0)
        yield _transport(view, none.astype(np.int32), spread, [nothing] * 3, seed, None, Counts(none, none))
        return
    builder = RowBuilder(snapshot, tracer, gather, seed)
    lights = np.ascontiguousarray(training.T)
    share = _scalar(view.throughput) * np.float32(
        view.samples_per_pixel
    )  # of its pixel's light, where several share it
    colours = view.points.albedo, view.points.specular, view.points.specular_edge
    tint = np.stack([_scalar(colour) * share for colour in colours])
    placed: list[list[SparseRows]] = [[], [], []]
    pieces = Pieces(parts, progress)

    def trace(samples: I64, stream: I64, first_ray: int, n_rays: int, of_rays: int) -> MeasuredRows:
        points = take_points(view.points, samples)
        one_each = np.arange(len(samples) + 1, dtype=np.int64)
        return builder.measure(points, one_each, stream, n_rays, 0, first_ray=first_ray, of_rays=of_rays)

    def trace_specular(samples: I64, stream: I64, counts: I64) -> tuple[SparseRows, SparseRows]:
        points = take_points(view.points, samples)
        glossy = np.flatnonzero(counts)
        if not len(glossy):
            nothing = SparseRows.empty(len(samples), gather.n)
            return nothing, nothing
        return builder.specular_rows(points, view.to_eye[samples], stream, glossy, counts[glossy], silent)

    def rows_of(samples: I64, stream: I64, first_ray: int, n_rays: int) -> MeasuredRows:
        def make(rows: I64) -> MeasuredRows:
            return trace(samples[rows], stream[rows], first_ray, n_rays, first_ray + n_rays)

        return pieces.measured(make, np.arange(len(samples)), n_rays, _DIFFUSE_STEP)

    def specular(samples: I64, stream: I64, counts: I64) -> list[SparseRows]:
        def make(rows: I64) -> tuple[SparseRows, SparseRows]:
            return trace_specular(samples[rows], stream[rows], counts[rows])

        n_rays = int(counts.mean()) + 1 if len(counts) else 1
        return list(pieces.both(make, np.arange(len(samples)), n_rays, _GLOSSY_STEP))

    is_strong = reflectance_to_eye(view.points, view.to_eye).max(axis=1) >= _STRONG
    n_surveyed = max(_FEWEST_LIGHTS, _SURVEYED_NUMBERS // (2 * view.n))
    survey_lights = np.ascontiguousarray(lights[:, :n_surveyed])

    def look(samples: I64, n_rays: int = _SURVEY_RAYS) -> F32:
        """Diffuse light by few rays, in two halves: (n, 2, n_lights)."""
        stream, half = np.zeros_like(samples), n_rays // 2
        parts = [trace(samples, stream, first, half, n_rays).cells.matmul(survey_lights) for first in (0, half)]
        return np.stack(parts, axis=1)

    n_closer = 1 << max(1, rays_per_row // _CLOSER_SHARE).bit_length() - 1

    def look_closer(samples: I64) -> F32:
        return look(samples, n_closer)

    def look_specular(samples: I64) -> F32:
        """Reflected light in two halves of the rays, before the tints: (n, 2, 2 lobes, n_lights)."""
        counts = np.where(is_strong[samples], _SURVEY_RAYS // 2, _WEAK_RAYS)
        halves = [trace_specular(samples, np.full_like(samples, half), counts) for half in (0, 1)]
        return np.stack([np.stack([rows.matmul(survey_lights) for rows in lobes], axis=1) for lobes in halves], axis=1)

    def survey() -> Survey:
        """The light at every view sample."""
        order = _in_image_tiles(view, np.arange(view.n))
        is_found = is_glossy(view.points)
        glossy = np.flatnonzero(is_found)
        diffuse = np.empty((view.n, 2, survey_lights.shape[1]), np.float32)
        reflected = np.empty((len(glossy), 2, 2, survey_lights.shape[1]), np.float32)
        chunks = _chunks(order)
        for some, light in zip(chunks, pieces.each(look, chunks, _DIFFUSE_STEP), strict=True):
            diffuse[some] = light
        chunks = _chunks(order[is_found[order]])
        for some, light in zip(chunks, pieces.each(look_specular, chunks, _GLOSSY_STEP), strict=True):
            reflected[np.searchsorted(glossy, some)] = light
        return Survey(diffuse, glossy, reflected)

    def surveyed_closer(seen: Survey, doubted: I64) -> Survey:
        """The same, with more rays for samples that it says little of."""
        chunks = _chunks(doubted[_in_image_tiles(view, doubted)], _SURVEYED_AT_ONCE * _SURVEY_RAYS // n_closer)
        closer = np.empty((len(doubted), *seen.diffuse.shape[1:]), np.float32)
        for some, light in zip(chunks, pieces.each(look_closer, chunks, _DIFFUSE_STEP), strict=True):
            closer[np.searchsorted(doubted, some)] = light
        return replace(seen, close=doubted, closer=closer)

    def probe(samples: I64) -> F32:
        order = _in_image_tiles(view, samples)
        back, some = np.argsort(order), samples[order]
        out = np.zeros((2, 3, len(samples), lights.shape[1]), np.float32)
        stream = np.zeros(len(samples), np.int64)
        half = _PLACING_RAYS // 2
        one = rows_of(some, stream, 0, half)
        two = rows_of(some, stream, half, half)
        out[0, 0, order], out[1, 0, order] = one.cells.matmul(lights), two.cells.matmul(lights)
        placed[0].append(take_rows(one.continued(two).cells, back))
        for lobe, rows in enumerate(specular(some, stream, _glossy_counts(view, some, _PLACING_RAYS)), 1):
            out[:, lobe, order] = rows.matmul(lights)
            placed[lobe].append(take_rows(rows, back))
        return out

    settings = settings or RecordSettings()
    records: Records | None = None
    for records in place_records(view, snapshot.camera, probe, tint, settings):
        rows = [concatenate_rows(list(part), gather.n) for part in placed]
        placed = [[part] for part in rows]
        order, spread = _in_tiles(view, records)
        stream = np.zeros(len(order), np.int64)
        yield _transport(view, records.view[order], spread, [take_rows(part, order) for part in rows], seed, stream)
    assert records is not None
    placed.clear()
    seen = survey()
    strong = tint.copy()
    strong[1:, ~is_strong] = 0
    if n_closer > _SURVEY_RAYS:
        seen = surveyed_closer(seen, doubtful_samples(records, seen, strong, _DOUBTED))
    records = fit_weights(add_outliers(records, seen, strong, settings), seen, tint)
    del seen

    order, spread = _in_tiles(view, records)
    samples = records.view[order].astype(np.int64)
    n_rays = min(rays_per_row, _FIRST_RAYS)
    cells = rows_of(samples, samples, 0, n_rays).cells
    traced = _glossy_counts(view, samples, n_rays)
    reflected = specular(samples, samples, traced)
    counts = Counts(np.full(len(samples), n_rays), traced)
    yield _transport(view, records.view[order], spread, [cells, *reflected], seed, None, counts)
    if n_rays == rays_per_row:
        return
    wanted = allot_rays([cells, *reflected], list(tint), spread, lights, np.flatnonzero(traced), rays_per_row)
    most = n_rays
    while most < wanted.diffuse.max() or most == n_rays:
        most *= _GROWTH
        groups = []
        for before, n in np.unique(np.stack([counts.diffuse, np.minimum(wanted.diffuse, most)]), axis=1).T.tolist():
            which = np.flatnonzero((counts.diffuse == before) & (np.minimum(wanted.diffuse, most) == n))
            some = MeasuredRows(take_rows(cells, which), before)
            if n > before:
                some = some.continued(rows_of(samples[which], samples[which], before, n - before))
            groups.append((which, some.cells))
        cells = scatter_rows(groups, len(samples), gather.n)
        if counts.specular is traced:
            reflected = specular(samples, samples, wanted.specular)
        counts = Counts(np.minimum(wanted.diffuse, most), wanted.specular)
        yield _transport(view, records.view[order], spread, [cells, *reflected], seed, None, counts)


def _glossy_counts(view: ViewSamples, samples: I64, n_rays: int) -> I64:
    """Specular rays of some view samples where each gets as many as its reflectance is worth."""
    points = take_points(view.points, samples)
    glossy = np.flatnonzero(is_glossy(points))
    out = np.zeros(len(samples), np.int64)
    out[glossy] = specular_counts(points, glossy, n_rays)
    return out


def _chunks(samples: I64, at_once: int = _SURVEYED_AT_ONCE) -> list[I64]:
    return np.split(samples, range(at_once, len(samples), at_once))


def _in_image_tiles(view: ViewSamples, samples: I64) -> I64:
    """Order in which samples that follow each other are neighbours: their rays meet the same surfaces."""
    y, x = view.pixel[samples] // view.width, view.pixel[samples] % view.width
    return np.lexsort((samples, x // _TILE[0], y // _TILE[1]))


def _in_tiles(view: ViewSamples, records: Records) -> tuple[I64, SparseRows]:
    """Order of the records in a transport, and the interpolation between them in that order."""
    order = tile_order(view.points.position[records.view], view.points.shading_normal[records.view])
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    weights = records.interpolation
    column = place[weights.indices]
    entry = np.lexsort((column, np.repeat(np.arange(weights.n_rows), np.diff(weights.indptr))))
    return order, SparseRows(weights.indptr, column[entry], weights.weights[entry], weights.n_columns)


def _transport(
    view: ViewSamples,
    row_view: I32,
    spread: SparseRows,
    rows: list[SparseRows],
    seed: int,
    stream: I64 | None,
    counts: Counts | None = None,
) -> Transport:
    tints = view.points.albedo, view.points.specular, view.points.specular_edge
    lobes = [
        Lobe(name, part, tint)
        for name, part, tint in zip(_LOBES, rows, tints, strict=True)
        if name == "diffuse" or part.n_entries
    ]
    mean = _PLACING_RAYS if counts is None else int(np.rint(counts.diffuse.mean())) if len(row_view) else 0
    return Transport(tuple(lobes), row_view, spread, mean, seed, stream, counts)


def _scalar(tint: F32) -> F32:
    return np.ascontiguousarray(tint.mean(axis=1))
