"""Brute-force final gathering: every camera sample shoots its own gather rays.

The plain version: no cache, no photon map, no denoiser. Slow and unbiased,
apart from the limits below; what is faster is measured against it.

Limits: all reflections before the last are diffuse; caustics through glass are
left out of the lighting, as shadow rays pass straight through it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import offset_radiance
from icheat_usd.errors import EditError
from icheat_usd.final_gather.hits import reflected_radiance, trace_hemisphere
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.transport import point_sets
from icheat_usd.lighting import LightSampler, build_light_sampler, reflected_direct, samples_per_light
from icheat_usd.materials import concatenate_points, is_glossy, sample_specular, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples, view_samples
from icheat_usd.samples.develop import average, develop
from icheat_usd.scene import F32, F64, I64, Bool, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points

#: Gather rays in flight; bounds memory and keeps a chunk's arrays near the caches.
RAYS_AT_ONCE = 1 << 19

#: Where pilot points are taken from in the picture, at most.
PILOT_ROWS, PILOT_COLUMNS = 24, 128

#: Light that leaves points on casters as the edits should see its colour, free of noise: (n,) points -> (n, 3).
IncidentColor = Callable[[SurfacePoints], F32]


@dataclass(frozen=True)
class GatherSettings:
    """Effort of a final gather."""

    samples_per_pixel: int = 4
    gather_rays: int = 64  #: per camera sample
    light_samples: int = 4  #: shadow rays per light and camera sample, for direct light
    n_bounces: int = 16  #: diffuse reflections before the last one
    seed: int = 0
    dome_samples: int | None = None  #: `light_samples` of domes; 4 times those of other lights by default


@dataclass(frozen=True, eq=False)
class FinalGather:
    """Image layers, (height, width, 3) float64, scene-linear; `depth` is (height, width, 1)."""

    background: F64
    emission: F64
    direct: F64
    indirect: F64
    indirect_edited: F64
    albedo: F64
    normal: F64
    depth: F64


class _Light(NamedTuple):
    base: F32  #: (n, 3) indirect radiance without edits
    edited: F32  #: (n, 3) with them


@dataclass(frozen=True, eq=False)
class _Gatherer:
    """What every chunk of the gather needs."""

    snapshot: SceneSnapshot
    tracer: Tracer
    sampler: LightSampler
    field: EditField
    incident_color: IncidentColor | None
    offsets: GatherSamples | None
    offset_radiance: F32 | None
    settings: GatherSettings


def final_gather(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    field: EditField,
    *,
    settings: GatherSettings,
    gather: GatherSamples | None = None,
    gather_radiance: F32 | None = None,
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
    gather, gather_radiance : GatherSamples and (n_gather, 3) float32, optional
        The gather-sample solution of the relighter. Needed by operations that
        depend on the colour of the light, whose ratio must not be formed from
        single noisy rays, and by offsets, which are integrated over area.

    Raises
    ------
    EditError
        The stack needs the gather-sample solution and it was not given.
    """
    if (field.uses_incident or field.has_offset) and (gather is None or gather_radiance is None):
        raise EditError("the edit stack needs the gather-sample solution: pass gather and gather_radiance")
    incident = None
    if gather is not None and gather_radiance is not None:
        incident = _incident_from(gather, gather_radiance)
    progress("gather", 0.0)
    sampler = build_light_sampler(snapshot, tracer, _pilot_points(snapshot, tracer, settings.seed), settings.seed)
    gatherer = _Gatherer(snapshot, tracer, sampler, field, incident, gather, gather_radiance, settings)
    n_pixels = snapshot.camera.width * snapshot.camera.height
    band = max(RAYS_AT_ONCE // (settings.samples_per_pixel * max(settings.gather_rays, 1)), 1)
    bands: list[dict[str, F64]] = []
    for first in range(0, n_pixels, band):
        progress("gather", first / n_pixels)
        pixels = (first, min(first + band, n_pixels))
        view = view_samples(
            snapshot,
            tracer,
            samples_per_pixel=settings.samples_per_pixel,
            seed=settings.seed,
            max_splits=0,
            pixels=pixels,
        )
        bands.append(_band(gatherer, view, pixels, int(hash_combine(settings.seed, first))))
    progress("gather", 1.0)
    shape = (snapshot.camera.height, snapshot.camera.width, -1)
    layers = {name: np.concatenate([part[name] for part in bands]).reshape(shape) for name in bands[0]}
    return FinalGather(**layers)


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
        points, through = trace_hemisphere(
            snapshot, tracer, points, stream, n_rays, int(hash_combine(seed, 20 + bounce))
        )
        points = take_points(points, np.flatnonzero(through.any(axis=1)))
        found.append(points)
    return concatenate_points(*found)


def _incident_from(gather: GatherSamples, radiance: F32) -> IncidentColor:
    def color(points: SurfacePoints) -> F32:
        return radiance[gather.locate(points)]

    return color


def _band(gatherer: _Gatherer, view: ViewSamples, pixels: tuple[int, int], seed: int) -> dict[str, F64]:
    """Layers of some of the pixels, (n_pixels, k) each."""
    direct = reflected_direct(
        gatherer.snapshot,
        gatherer.tracer,
        gatherer.sampler,
        view.points,
        view.to_eye,
        seed,
        samples_per_light(gatherer.snapshot, gatherer.settings.light_samples, gatherer.settings.dome_samples),
    ).sum(axis=0)
    light = _indirect(gatherer, view.points, view.to_eye, np.arange(view.n, dtype=np.int64), seed)
    return {
        "background": view.background[slice(*pixels)].astype(np.float64),
        "emission": develop(view, view.points.emission, pixels),
        "direct": develop(view, direct, pixels),
        "indirect": develop(view, light.base, pixels),
        "indirect_edited": develop(view, light.edited, pixels),
        "albedo": average(view, view.points.albedo, pixels),
        "normal": average(view, view.points.shading_normal, pixels),
        "depth": average(view, view.depth[:, None], pixels),
    }


def _indirect(gatherer: _Gatherer, points: SurfacePoints, to_eye: F32, stream: I64, seed: int) -> _Light:
    """Indirect radiance that the points send to the eye, unedited and edited."""
    receiver = gatherer.field.receiver_masks(points)
    touched: Bool = np.asarray((receiver > 0).any(axis=0), np.bool_)
    n_rays = gatherer.settings.gather_rays
    hits, through = trace_hemisphere(gatherer.snapshot, gatherer.tracer, points, stream, n_rays, seed)
    diffuse = _sum_rays(gatherer, hits, through, receiver, touched, n_rays, seed)
    base = points.albedo * diffuse.base
    edited = points.albedo * diffuse.edited
    glossy = np.flatnonzero(is_glossy(points))
    if len(glossy):
        specular = _specular(
            gatherer,
            take_points(points, glossy),
            to_eye[glossy],
            stream[glossy],
            receiver[:, glossy],
            touched[glossy],
            seed,
        )
        base[glossy] += specular.base
        edited[glossy] += specular.edited
    if gatherer.field.has_offset and touched.any():
        which = np.flatnonzero(touched)
        gather, b = gatherer.offsets, gatherer.offset_radiance
        assert gather is not None and b is not None
        casters = gatherer.field.caster_masks(gather.points)
        albedo = points.albedo[which]
        edited[which] += offset_radiance(gatherer.field, b, gather.area, receiver[:, which], casters, albedo)
    edited = np.where(touched[:, None], np.maximum(edited, np.float32(0)), base)
    return _Light(base, edited)


def _specular(
    gatherer: _Gatherer,
    points: SurfacePoints,
    to_eye: F32,
    stream: I64,
    receiver: F32,
    touched: Bool,
    seed: int,
) -> _Light:
    """The specular lobe's share, by rays that follow the lobe."""
    n_rays = gatherer.settings.gather_rays
    seed = int(hash_combine(seed, 7))
    repeated = take_points(points, np.repeat(np.arange(len(stream)), n_rays))
    u = _lobe_numbers(stream, n_rays, seed)
    directions, base_weight, edge_weight = sample_specular(repeated, np.repeat(to_eye, n_rays, axis=0), u)
    ends = first_surfaces(
        gatherer.snapshot,
        gatherer.tracer,
        spawn_points(gatherer.snapshot, repeated, directions),
        directions,
        int(hash_combine(seed, 1)),
    )
    reflectance = base_weight[:, None] * repeated.specular + edge_weight[:, None] * repeated.specular_edge
    lit = (ends.points.instance >= 0)[:, None]
    through = np.where(lit, reflectance * ends.throughput, np.float32(0)).astype(np.float32)
    return _sum_rays(gatherer, ends.points, through, receiver, touched, n_rays, int(hash_combine(seed, 2)))


def _lobe_numbers(stream: I64, n_rays: int, seed: int) -> F32:
    out = np.empty((len(stream) * n_rays, 2), np.float32)
    point_sets(seed, stream, n_rays, out)
    return out


def _sum_rays(
    gatherer: _Gatherer, hits: SurfacePoints, through: F32, receiver: F32, touched: Bool, n_rays: int, seed: int
) -> _Light:
    """Mean over each point's rays of the light they bring, unedited and edited."""
    brought = reflected_radiance(
        gatherer.snapshot,
        gatherer.tracer,
        gatherer.sampler,
        hits,
        through,
        n_bounces=gatherer.settings.n_bounces,
        seed=int(hash_combine(seed, 11)),
    )
    base = _mean(brought, n_rays)
    edited = base.copy()
    rays = np.flatnonzero(np.repeat(touched, n_rays) & through.any(axis=1))
    if len(rays):
        some = take_points(hits, rays)
        caster = gatherer.field.caster_masks(some)
        color = np.zeros((len(rays), 3), np.float32)
        if gatherer.incident_color is not None:
            color = gatherer.incident_color(some)
        coefficients = gatherer.field.evaluate(color, receiver[:, rays // n_rays], caster)
        changed = brought.copy()
        changed[rays] = coefficients.scale * brought[rays] + coefficients.emission * through[rays]
        which = np.flatnonzero(touched)
        edited[which] = _mean(changed.reshape(-1, n_rays, 3)[which].reshape(-1, 3), n_rays)
    return _Light(base, edited)


def _mean(values: F32, n_rays: int) -> F32:
    return values.reshape(-1, n_rays, 3).sum(axis=1, dtype=np.float64).astype(np.float32) / np.float32(n_rays)
