"""Indirect light of camera samples from the gather rays of their lobes, without edits and with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import OffsetCasters
from icheat_usd.edits.pairs import PairLight, edited_light
from icheat_usd.final_gather.hits import GatherRays, Reflected, reflected_radiance, trace_hemisphere, trace_specular
from icheat_usd.kernels.random import hash_combine
from icheat_usd.lighting import LightSampler
from icheat_usd.materials import is_glossy, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I64, Bool, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces


@dataclass(frozen=True, eq=False)
class GatherSolution:
    """Light that leaves the gather samples, free of noise."""

    gather: GatherSamples
    b: F32  #: (G, n_gather, 3) by group of lights
    offsets: OffsetCasters | None

    def at(self, points: SurfacePoints) -> F32:
        """Light that leaves surface points, (G, n, 3)."""
        return np.take(self.b, self.gather.locate(points), axis=1)


@dataclass(frozen=True, eq=False)
class Gatherer:
    """What every chunk of the gather needs."""

    snapshot: SceneSnapshot
    tracer: Tracer
    sampler: LightSampler
    n_rays: int  #: per camera sample and lobe
    n_bounces: int
    field: EditField
    solution: GatherSolution | None  #: None where no edit asks for it
    clear: tuple[Tracer, ...]  #: the scene without the occluders of each of `EditField.throughs`
    prefixes: tuple[Gatherer, ...] = ()  #: the same for the first edits of the stack alone, if their light is wanted


class GatheredLight(NamedTuple):
    """Indirect radiance that n points send to the eye."""

    base: F32  #: (n, 3) without edits
    edited: F32  #: (n, 3) with them
    steps: tuple[F32, ...] = ()  #: (n, 3) with the first one, the first two, ... of them, for `Gatherer.prefixes`


class _Lobe(NamedTuple):
    """Rays of one lobe of some of the points, and the light that they bring."""

    where: I64  #: (m,) points that have the lobe
    rays: GatherRays  #: (m * n_rays,)
    light: Reflected
    tint: F32  #: (m, 3) reflectance outside the rays' throughput
    seed: int


def gathered_light(gatherer: Gatherer, points: SurfacePoints, to_eye: F32, stream: I64, seed: int) -> GatheredLight:
    """Gather at each point; points that no edit touches have the same bits in both results."""
    g = gatherer
    everywhere = np.arange(len(stream), dtype=np.int64)
    rays = trace_hemisphere(g.snapshot, g.tracer, points, stream, g.n_rays, seed)
    lobes = [_lit(g, everywhere, rays, points.albedo, seed)]
    base = points.albedo * _mean(lobes[0].light.total, g.n_rays)
    glossy = np.flatnonzero(is_glossy(points))
    if len(glossy):
        own = int(hash_combine(seed, 7))
        shiny = take_points(points, glossy)
        rays = trace_specular(g.snapshot, g.tracer, shiny, to_eye[glossy], stream[glossy], g.n_rays, own)
        white = np.ones((len(glossy), 3), np.float32)
        lobes.append(_lit(g, glossy, rays, white, int(hash_combine(own, 2))))
        base[glossy] += _mean(lobes[1].light.total, g.n_rays)
    steps = tuple(_edited(prefix, points, lobes, base) for prefix in g.prefixes)
    return GatheredLight(base, _edited(g, points, lobes, base), steps)


def _lit(gatherer: Gatherer, where: I64, rays: GatherRays, tint: F32, seed: int) -> _Lobe:
    return _Lobe(where, rays, _reflected(gatherer, rays.ends, rays.throughput, int(hash_combine(seed, 11))), tint, seed)


def _reflected(gatherer: Gatherer, points: SurfacePoints, throughput: F32, seed: int) -> Reflected:
    return reflected_radiance(
        gatherer.snapshot,
        gatherer.tracer,
        gatherer.sampler,
        points,
        throughput,
        n_bounces=gatherer.n_bounces,
        seed=seed,
        light_group=gatherer.field.light_group,
        n_groups=gatherer.field.n_groups,
    )


def _edited(gatherer: Gatherer, points: SurfacePoints, lobes: list[_Lobe], base: F32) -> F32:
    edited = base.copy()
    everyone = gatherer.field.receivers(points)
    touched = np.flatnonzero((everyone.masks > 0).any(axis=0))
    if len(touched) == 0:
        return edited
    position = np.full(len(base), -1, np.int64)
    position[touched] = np.arange(len(touched))
    receivers = everyone.take(touched)
    blocks = []
    for lobe in lobes:
        owner = position[np.repeat(lobe.where, gatherer.n_rays)]
        some = np.flatnonzero((owner >= 0) & lobe.rays.throughput.any(axis=1))
        if len(some) == 0:
            continue
        arrived = np.take(lobe.light.by_group, some, axis=1), np.take(lobe.rays.throughput, some, axis=0)
        blocks.append(_pairs(gatherer, lobe, some, owner[some], take_points(lobe.rays.ends, some), *arrived))
        for slot, edit in enumerate(gatherer.field.throughs):
            reached: Bool = np.asarray((receivers.masks[gatherer.field.rows_of(edit)] > 0).any(axis=0), np.bool_)
            hidden = gatherer.field.edits[edit].occluders
            held = some[reached[owner[some]] & hidden[lobe.rays.ends.instance[some]]]
            if len(held):
                blocks.append(_held_back(gatherer, lobe, held, owner[held], slot))
    offsets = None if gatherer.solution is None else gatherer.solution.offsets
    light = edited_light(gatherer.field, receivers, blocks, offsets, points.albedo[touched])
    edited[touched] = gatherer.field.finish(light, receivers)
    return edited


def _pairs(
    gatherer: Gatherer,
    lobe: _Lobe,
    some: I64,
    owner: I64,
    casters: SurfacePoints,
    brought: F32,
    throughput: F32,
    through: int | None = None,
) -> PairLight:
    """Rays `some` of a lobe as pairs with the casters that they end on."""
    field = gatherer.field
    seen = np.zeros_like(brought) if gatherer.solution is None else gatherer.solution.at(casters)
    tint = np.take(lobe.tint, some // gatherer.n_rays, axis=0) / np.float32(gatherer.n_rays)
    return PairLight(owner, field.casters(casters), seen, tint * brought, tint * throughput, through)


def _held_back(gatherer: Gatherer, lobe: _Lobe, held: I64, owner: I64, slot: int) -> PairLight:
    """What rays that end on an occluder would have brought from behind it."""
    rays = lobe.rays
    # The same random numbers take a ray the same way up to the occluder; the light behind draws from a stream of its
    # own, so that the unedited image cannot tell.
    behind = first_surfaces(
        gatherer.snapshot,
        gatherer.clear[slot],
        rays.origins[held],
        rays.directions[held],
        rays.seed,
        counters=held.astype(np.int32),
    )
    throughput = behind.throughput * (behind.points.instance >= 0)[:, None]
    if rays.reflectance is not None:
        throughput = rays.reflectance[held] * throughput
    light = _reflected(gatherer, behind.points, throughput, int(hash_combine(lobe.seed, 100 + slot)))
    return _pairs(gatherer, lobe, held, owner, behind.points, light.by_group, throughput, slot)


def _mean(values: F32, n_rays: int) -> F32:
    return values.reshape(-1, n_rays, 3).sum(axis=1, dtype=np.float64).astype(np.float32) / np.float32(n_rays)
