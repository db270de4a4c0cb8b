"""Brute-force final gathering: every camera sample shoots its own gather rays.

The plain version: no cache, no photon map, no denoiser. Slow and unbiased,
apart from the limits below; what is faster is measured against it.

Limits: all reflections before the last are diffuse; caustics through glass are
left out of the lighting, as shadow rays pass straight through it. What curves
make of a receiver's light is found from the gather rays of one camera sample;
the noise of few rays is bent by a steep curve, so such edits want many rays.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import offset_casters
from icheat_usd.errors import EditError
from icheat_usd.final_gather.extras import (
    NO_EXTRAS,
    Extras,
    contribution_layers,
    covered,
    light_layers,
    with_prefixes,
)
from icheat_usd.final_gather.gatherer import Gatherer, GatherSolution, gathered_light
from icheat_usd.final_gather.hits import trace_hemisphere
from icheat_usd.image.cryptomatte import Coverage, weighted_sum
from icheat_usd.kernels.random import hash_combine
from icheat_usd.lighting import build_light_sampler, reflected_direct, samples_per_light
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples, view_samples
from icheat_usd.samples.develop import average, develop
from icheat_usd.scene import F32, F64, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import sum_groups

#: Gather rays in flight; bounds memory and keeps a chunk's arrays near the caches.
RAYS_AT_ONCE = 1 << 19

#: Where pilot points are taken from in the picture, at most.
PILOT_ROWS, PILOT_COLUMNS = 24, 128


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
    contributions: Mapping[str, F64] = field(default_factory=lambda: MappingProxyType({}))
    #: what each edit adds to the edits before it, by path; if asked for
    light_groups: Mapping[str, F64] = field(default_factory=lambda: MappingProxyType({}))
    #: direct light of groups of lights, by name; if asked for
    coverage: Mapping[str, Coverage] = field(default_factory=lambda: MappingProxyType({}))
    #: which prims ("object") and edits ("edit") the pixels show; if asked for


class _Band(NamedTuple):
    """Layers of some of the pixels, (n_pixels, k) each."""

    usual: dict[str, F64]
    contributions: dict[str, F64]
    light_groups: dict[str, F64]
    coverage: dict[str, Coverage]


def final_gather(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    field: EditField,
    *,
    settings: GatherSettings,
    gather: GatherSamples | None = None,
    gather_radiance: F32 | None = None,
    extras: Extras = NO_EXTRAS,
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
    extras : Extras
        What to compute beside the usual layers.

    Raises
    ------
    EditError
        The stack needs the gather-sample solution and it was not given.
    """
    if (field.uses_incident or field.has_offset) and (gather is None or gather_radiance is None):
        raise EditError("the edit stack needs the gather-sample solution: pass gather and gather_radiance")
    progress("gather", 0.0)
    sampler = build_light_sampler(snapshot, tracer, _pilot_points(snapshot, tracer, settings.seed), settings.seed)
    gatherer = Gatherer(
        snapshot,
        tracer,
        sampler,
        settings.gather_rays,
        settings.n_bounces,
        field,
        _solution(field, gather, gather_radiance),
        tuple(build_tracer(snapshot, tracer.engine, hidden=field.edits[edit].occluders) for edit in field.throughs),
    )
    if extras.contributions:
        gatherer = with_prefixes(gatherer)
    n_pixels = snapshot.camera.width * snapshot.camera.height
    band = max(RAYS_AT_ONCE // (settings.samples_per_pixel * max(settings.gather_rays, 1)), 1)
    bands: list[_Band] = []
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
        bands.append(_band(gatherer, view, settings, pixels, int(hash_combine(settings.seed, first)), extras))
    progress("gather", 1.0)
    shape = (snapshot.camera.height, snapshot.camera.width, -1)

    def whole(parts: list[dict[str, F64]]) -> dict[str, F64]:
        return {name: np.concatenate([part[name] for part in parts]).reshape(shape) for name in parts[0]}

    mattes = [part.coverage for part in bands]
    return FinalGather(
        **whole([part.usual for part in bands]),
        contributions=whole([part.contributions for part in bands]),
        light_groups=whole([part.light_groups for part in bands]),
        coverage={name: weighted_sum((1.0, part[name]) for part in mattes) for name in mattes[0]},
    )


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
    return GatherSolution(gather, b, offset_casters(field, field.casters(gather.points), b, gather.area))


def _band(
    gatherer: Gatherer,
    view: ViewSamples,
    settings: GatherSettings,
    pixels: tuple[int, int],
    seed: int,
    extras: Extras,
) -> _Band:
    per_light = reflected_direct(
        gatherer.snapshot,
        gatherer.tracer,
        gatherer.sampler,
        view.points,
        view.to_eye,
        seed,
        samples_per_light(gatherer.snapshot, settings.light_samples, settings.dome_samples),
    )
    light = gathered_light(gatherer, view.points, view.to_eye, np.arange(view.n, dtype=np.int64), seed)
    usual = {
        "background": view.background[slice(*pixels)].astype(np.float64),
        "emission": develop(view, view.points.emission, pixels),
        "direct": develop(view, per_light.sum(axis=0), pixels),
        "indirect": develop(view, light.base, pixels),
        "indirect_edited": develop(view, light.edited, pixels),
        "albedo": average(view, view.points.albedo, pixels),
        "normal": average(view, view.points.shading_normal, pixels),
        "depth": average(view, view.depth[:, None], pixels),
    }
    return _Band(
        usual,
        contribution_layers(gatherer.field, light, view, pixels) if extras.contributions else {},
        light_layers(extras, gatherer.snapshot, per_light, view, pixels),
        covered(extras, gatherer.snapshot, gatherer.field, view, pixels),
    )
