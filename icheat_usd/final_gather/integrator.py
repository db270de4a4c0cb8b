"""Final gathering: diffuse light from an irradiance cache, by a few rays of every camera sample, or by brute force.

Both the cache and the few rays take earlier bounces from the gather samples.
The brute-force way takes them from paths: slow and unbiased, apart from the
limits below; what is faster is measured against it.

Limits: all reflections before the last are diffuse; caustics through glass are
left out of the lighting, as shadow rays pass straight through it. What curves
make of a receiver's light is found from the gather rays of one camera sample;
the noise of few rays is bent by a steep curve, so such edits want many rays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.edits.mask_stack import looks_at_hits
from icheat_usd.edits.offsets import offset_casters
from icheat_usd.errors import EditError
from icheat_usd.final_gather.cached import CachedGather
from icheat_usd.final_gather.camera_pass import Band, CameraPass, draws_of
from icheat_usd.final_gather.contrast import light_edges
from icheat_usd.final_gather.direct_light import DirectLight
from icheat_usd.final_gather.extras import (
    NO_EXTRAS,
    Extras,
    contribution_layers,
    covered,
    with_prefixes,
)
from icheat_usd.final_gather.gatherer import GatheredLight, Gatherer, GatherSolution, gathered_light
from icheat_usd.final_gather.hits import trace_hemisphere
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Places, join_places, overture
from icheat_usd.final_gather.light_parts import part_layers, with_parts
from icheat_usd.final_gather.near_hits import NearLight
from icheat_usd.final_gather.places import near_of, pixel_extent
from icheat_usd.final_gather.record_rays import HemisphereTracer
from icheat_usd.final_gather.replay import KeptBand, Replay
from icheat_usd.final_gather.settings import GatherSettings
from icheat_usd.image.cryptomatte import Coverage, weighted_sum
from icheat_usd.kernels.random import hash_combine
from icheat_usd.lighting import LightSampler, build_light_sampler
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, view_samples
from icheat_usd.samples.develop import average, develop
from icheat_usd.scene import F32, F64, I64, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import sum_groups

#: Gather rays in flight; bounds memory and keeps a chunk's arrays near the caches.
RAYS_AT_ONCE = 1 << 19

#: Camera samples that are shaded together, where earlier bounces are those of the gather samples.
SAMPLES_AT_ONCE = 1 << 17

#: What the indirect light of a band is found by, from random counters and sequences of its samples and a seed.
FindLight = Callable[[Band, I64, I64, int], GatheredLight]

#: Where pilot points are taken from in the picture, at most.
PILOT_ROWS, PILOT_COLUMNS = 24, 128


@dataclass(frozen=True, eq=False)
class FinalGather:
    """Image layers, (height, width, 3) float64, scene-linear; `depth` and `seen` are (height, width, 1)."""

    background: F64
    emission: F64
    direct: F64
    indirect: F64
    indirect_edited: F64
    albedo: F64
    normal: F64
    depth: F64
    seen: F64  #: share of each pixel's camera samples that end on a surface
    contributions: Mapping[str, F64] = field(default_factory=lambda: MappingProxyType({}))
    #: what each edit adds to the edits before it, by path; if asked for
    light_groups: Mapping[tuple[str, str], F64] = field(default_factory=lambda: MappingProxyType({}))
    #: light of groups of lights, by one of `light_parts.KINDS` and the group's name; if asked for
    coverage: Mapping[str, Coverage] = field(default_factory=lambda: MappingProxyType({}))
    #: which prims ("object") and edits ("edit") the pixels show; if asked for
    records: CacheRecords | None = None  #: of the cached method
    replay: Replay | None = None  #: the same frame under other edits; if asked for, and only by the cached method


class CacheRecords(NamedTuple):
    """Where n records of cached light stand in the picture, as seen over mirrors and through glass too."""

    pixel: I64  #: (n,) row-major
    reach: F32  #: (n,) pixels
    spacing: I64  #: (n,) pixels between the places of the overture's round that asked for it


class _Band(NamedTuple):
    """Layers of some of the pixels, (n_pixels, k) each."""

    usual: dict[str, F64]
    contributions: dict[str, F64]
    light_groups: dict[tuple[str, str], F64]
    coverage: dict[str, Coverage]


def final_gather(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    field: EditField,
    *,
    settings: GatherSettings,
    gather: GatherSamples | None = None,
    gather_radiance: F32 | None = None,
    sampler: LightSampler | None = None,
    extras: Extras = NO_EXTRAS,
    is_kept: bool = False,
    progress: Progress = silent,
) -> FinalGather:
    """Render direct and indirect light, the latter with and without edits.

    The unedited image does not depend on the edits: both are formed from the
    same rays, and pixels whose samples have no receiver mask above 0 hold the
    same bits in both.

    Parameters
    ----------
    field : EditField
        The stack, bound to this snapshot.
    gather, gather_radiance : GatherSamples and (n_lights, n_gather, 3) float32, optional
        The gather-sample solution of the relighter, per light. Needed by
        operations that depend on the colour of the light, whose ratio must not
        be formed from single noisy rays, by curves, and by offsets, which are
        integrated over area.
    sampler : LightSampler, optional
        One that knows where lights can be seen; by default that is learnt here, around what the camera sees.
    extras : Extras
        What to compute beside the usual layers.
    is_kept : bool
        Whether the image comes with a `Replay`: 10 kB of memory for each hemisphere of rays, 0.5 kB for each camera
        sample, and 4 kB more for a glossy one.

    Raises
    ------
    EditError
        The stack needs the gather-sample solution and it was not given.
    """
    if (settings.uses_cells or field.uses_incident or field.has_offset) and (gather is None or gather_radiance is None):
        raise EditError(
            f"the {settings.method} method and this edit stack need the gather-sample solution: pass gather and "
            "gather_radiance"
        )
    progress("gather", 0.0)
    sampler = sampler or _sampler_of_view(snapshot, tracer, settings.seed)
    gatherer = Gatherer(
        snapshot,
        tracer,
        sampler,
        settings.gather_rays,
        settings.n_bounces,
        field,
        _solution(field, gather, gather_radiance),
        tuple(build_tracer(snapshot, tracer.engine, hidden=field.edits[edit].occluders) for edit in field.throughs),
        follows_paths=not settings.uses_cells,
    )
    if extras.contributions:
        gatherer = with_prefixes(gatherer)
    if extras.indirect:
        gatherer = with_parts(gatherer, extras.light_groups, gather_radiance)
    band = SAMPLES_AT_ONCE if settings.uses_cells else max(RAYS_AT_ONCE // max(settings.gather_rays, 1), 1)
    n_edge = settings.edge_samples if settings.uses_cells else 0
    # Errors of images that are parts of one are to cancel.
    seed = settings.seed if settings.first_sample is None else int(hash_combine(settings.seed, settings.first_sample))
    near: dict[str, Any] = {}
    if settings.is_cached:
        near["measure"] = partial(near_of, snapshot, tracer, seed=seed, most_reach=settings.cache.most_reach)
    camera = CameraPass(snapshot, tracer, settings, n_edge, band, **near)
    find: FindLight = partial(_followed, gatherer)
    bands: list[_Band] = []
    kept: list[KeptBand] = []
    replay, records = None, None
    if settings.uses_cells and gather is not None and gather_radiance is not None:
        cached, records = _from_cells(gatherer, gather, camera, settings, seed, is_kept, progress)
        find = partial(_interpolated, gatherer, cached)
        replay = Replay(gatherer, cached, kept, gather_radiance) if is_kept else None
    direct = DirectLight(snapshot, tracer, sampler, settings)
    for number, (part, per_light) in enumerate(direct.bands(camera.all())):
        progress("gather", number / len(camera.bands))
        own_seed = int(hash_combine(seed, part.pixels[0]))
        bands.append(_band(gatherer, find, camera, part, per_light, draws_of(part.view, settings), own_seed, extras))
        if replay is not None:
            kept.append(KeptBand(part.pixels, part.view))
    progress("gather", 1.0)
    shape = (snapshot.camera.height, snapshot.camera.width, -1)

    def whole(parts: list[dict[Any, F64]]) -> dict[Any, F64]:
        return {name: np.concatenate([part[name] for part in parts]).reshape(shape) for name in parts[0]}

    mattes = [part.coverage for part in bands]
    return FinalGather(
        **whole([part.usual for part in bands]),
        contributions=whole([part.contributions for part in bands]),
        light_groups=whole([part.light_groups for part in bands]),
        coverage={name: weighted_sum((1.0, part[name]) for part in mattes) for name in mattes[0]},
        records=records,
        replay=replay,
    )


def _from_cells(
    gatherer: Gatherer,
    gather: GatherSamples,
    camera: CameraPass,
    settings: GatherSettings,
    seed: int,
    is_kept: bool,
    progress: Progress,
) -> tuple[CachedGather, CacheRecords | None]:
    """Place all records, if there are to be any, by the camera samples that every pixel has."""
    assert gatherer.solution is not None
    snapshot = gatherer.snapshot
    cells = np.concatenate([gatherer.solution.total, np.zeros((1, 3), np.float32)])
    n_theta, n_phi, own_seed = settings.cache.n_theta, settings.cache.n_phi, int(hash_combine(seed, 0xCAC4E))
    near = None
    if n_paths := settings.cache.near_paths:
        total = gatherer.solution.total
        near = NearLight(snapshot, gatherer.tracer, gatherer.sampler, gather, total, n_paths, own_seed)
    tracer = HemisphereTracer(snapshot, gatherer.tracer, gather, n_theta, n_phi, own_seed, near)
    keeps_rays = is_kept or bool(gatherer.parts) or not gatherer.field.acts_on_views_alone
    keeps_hits = is_kept or bool(gatherer.parts) or looks_at_hits(gatherer.field)
    cache = IrradianceCache(tracer, cells, settings.cache, keeps_rays, keeps_hits)
    records = None
    if settings.is_cached:
        records = _place_records(cache, snapshot, camera, settings, progress)
    else:
        for _ in camera.first():
            pass  # edges are found, and nothing is placed
    return CachedGather(gatherer, cache, settings.glossy_rays, settings.own_strata, is_kept=is_kept), records


def _place_records(
    cache: IrradianceCache, snapshot: SceneSnapshot, camera: CameraPass, settings: GatherSettings, progress: Progress
) -> CacheRecords:
    """Fill a cache, and have more camera samples where its light has edges."""
    found, pixel = [], []
    for band in camera.first():
        found.append(_places(snapshot, band))
        pixel.append(band.view.pixel)
    places, pixels = join_places(found), np.concatenate(pixel)
    width, height = snapshot.camera.width, snapshot.camera.height
    placed = overture(cache, places, pixels, width, progress)
    if settings.edge_samples:
        camera.sharpen(light_edges(cache, places, pixels, width, width * height))
    return CacheRecords(placed.pixel, cache.table.reach / placed.extent, placed.spacing)


def _places(snapshot: SceneSnapshot, band: Band) -> Places:
    return Places(band.view.points, pixel_extent(snapshot.camera, band.view), band.measured)


def _followed(gatherer: Gatherer, band: Band, stream: I64, draws: I64, seed: int) -> GatheredLight:
    return gathered_light(gatherer, band.view.points, band.view.to_eye, stream, seed, draws)


def _interpolated(
    gatherer: Gatherer, cached: CachedGather, band: Band, stream: I64, draws: I64, seed: int
) -> GatheredLight:
    return cached.light(_places(gatherer.snapshot, band), band.view.to_eye, stream, draws, seed)


def _sampler_of_view(snapshot: SceneSnapshot, tracer: Tracer, seed: int) -> LightSampler:
    # Only domes are learnt about.
    pilot = _pilot_points(snapshot, tracer, seed) if (snapshot.lights.kind == LightKind.DOME).any() else None
    return build_light_sampler(snapshot, tracer, pilot, seed)


def _pilot_points(snapshot: SceneSnapshot, tracer: Tracer, seed: int) -> SurfacePoints:
    """Some of the points that light will be asked for: seen in a few rows of the picture, or hit from there."""
    width, height = snapshot.camera.width, snapshot.camera.height
    rows = np.unique(np.linspace(0, height - 1, PILOT_ROWS + 2)[1:-1].round().astype(np.int64))
    found = []
    for row in rows.tolist():
        pixels = (row * width, (row + 1) * width)
        points = view_samples(snapshot, tracer, samples_per_pixel=1, seed=seed, max_splits=0, pixels=pixels).points
        found.append(take_points(points, np.arange(0, len(points.instance), max(1, width // PILOT_COLUMNS))))
    points = concatenate_points(*found)
    found = [points]
    for bounce, n_rays in enumerate((4, 1)):
        stream = np.arange(len(points.instance), dtype=np.int64)
        rays = trace_hemisphere(snapshot, tracer, points, stream, n_rays, int(hash_combine(seed, 20 + bounce)))
        points = take_points(rays.ends, np.flatnonzero(rays.throughput.any(axis=1)))
        found.append(points)
    return concatenate_points(*found)


def _solution(field: EditField, gather: GatherSamples | None, per_light: F32 | None) -> GatherSolution | None:
    if gather is None or per_light is None:
        return None
    b = sum_groups(per_light, field.light_group, field.n_groups)
    total = per_light.sum(axis=0, dtype=np.float32)
    offsets = offset_casters(field, field.casters(gather.points), b, gather.area) if field.has_offset else None
    return GatherSolution(gather, b, total, offsets)


def _band(
    gatherer: Gatherer,
    find: FindLight,
    camera: CameraPass,
    band: Band,
    per_light: F32,
    draws: I64,
    seed: int,
    extras: Extras,
) -> _Band:
    pixels, view = band.pixels, band.view
    light = find(band, view.stream.astype(np.int64) & 0x7FFFFFFF, draws, seed)
    albedo, normal = camera.features(band)
    usual = {
        "background": view.background[slice(*pixels)].astype(np.float64),
        "emission": develop(view, view.points.emission, pixels),
        "direct": develop(view, per_light.sum(axis=0), pixels),
        "indirect": develop(view, light.base, pixels),
        "indirect_edited": develop(view, light.edited, pixels),
        "albedo": albedo,
        "normal": normal,
        "depth": average(view, view.depth[:, None], pixels),
        "seen": band.seen,
    }
    return _Band(
        usual,
        contribution_layers(gatherer.field, light, view, pixels) if extras.contributions else {},
        part_layers(extras.light_groups, gatherer.snapshot, per_light, light, view, pixels),
        covered(extras, gatherer.snapshot, gatherer.field, view, pixels),
    )
