"""Indirect light of camera samples from the gather rays of their lobes, without edits and with them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import Ends
from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import OffsetCasters
from icheat_usd.edits.pairs import PairLight, edited_light
from icheat_usd.final_gather.cell_rays import CellRays
from icheat_usd.final_gather.hits import GatherRays, Reflected, reflected_radiance, trace_hemisphere, trace_specular
from icheat_usd.final_gather.lobe_rays import trace_lobe
from icheat_usd.kernels.random import hash_combine
from icheat_usd.lighting import LightSampler
from icheat_usd.materials import is_glossy, take_points
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, I32, I64, Bool, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces


@dataclass(frozen=True, eq=False)
class GatherSolution:
    """Light that leaves the gather samples, free of noise."""

    gather: GatherSamples
    b: F32  #: (G, n_gather, 3) by group of lights
    total: F32  #: (n_gather, 3) of all lights; its last bits do not depend on the groups
    offsets: OffsetCasters | None
    sent: F32 | None = None  #: (G, n_gather, 3) part of `b` that arrives, where edits look at more than that

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
    follows_paths: bool = True  #: light at the ends of gather rays is found by paths; else it is that of `solution`
    parts: tuple[Gatherer, ...] = ()  #: the same for the light of some lights alone, if it is wanted
    lights: Bool | None = None  #: (n_lights,) those whose light alone arrives; edits look at all; None: all

    @property
    def is_part(self) -> bool:
        return self.lights is not None


class GatheredLight(NamedTuple):
    """Indirect radiance that n points send to the eye."""

    base: F32  #: (n, 3) without edits
    edited: F32  #: (n, 3) with them
    steps: tuple[F32, ...] = ()  #: (n, 3) with the first one, the first two, ... of them, for `Gatherer.prefixes`
    parts: tuple[tuple[F32, F32], ...] = ()  #: `base` and `edited` of each of `Gatherer.parts`


class Lobe(NamedTuple):
    """Rays of one lobe of some of the points, and the light that they bring."""

    where: I64  #: (m,) points that have the lobe
    rays: GatherRays | CellRays  #: (m * n_rays,)
    light: Reflected
    tint: F32  #: (m, 3) reflectance outside the rays' throughput
    seed: int

    @property
    def n_rays(self) -> int:
        return len(self.rays.throughput) // max(len(self.where), 1)

    def mean(self) -> F32:
        """Radiance that the points reflect by this lobe, (m, 3)."""
        total = self.light.total.reshape(len(self.where), self.n_rays, 3).sum(axis=1, dtype=np.float64)
        return self.tint * (total.astype(np.float32) / np.float32(self.n_rays))


def gathered_light(
    gatherer: Gatherer, points: SurfacePoints, to_eye: F32, stream: I64, seed: int, draws: I64 | None = None
) -> GatheredLight:
    """Gather at each point; points that no edit touches have the same bits in both results.

    Parameters
    ----------
    draws : (n, 2), optional
        Of specular rays, as of `trace_specular`; by default every point has the sequence of its `stream`.
    """
    g = gatherer
    everywhere = np.arange(len(stream), dtype=np.int64)
    lobes = [diffuse_lobe(g, points, everywhere, stream, seed)]
    base = lobes[0].mean()
    if draws is None:
        draws = np.stack([stream, np.zeros_like(stream)], axis=1)
    shiny = specular_lobe(g, points, to_eye, draws, g.n_rays, seed)
    if shiny is not None:
        lobes.append(shiny)
        base[shiny.where] += shiny.mean()
    steps = tuple(_under_stack(prefix, points, lobes, base) for prefix in g.prefixes)
    edited = _under_stack(g, points, lobes, base)
    parts = tuple(_part(part, points, lobes, edited) for part in g.parts)
    return GatheredLight(base, edited, steps, parts)


def _part(part: Gatherer, points: SurfacePoints, lobes: list[Lobe], whole: F32) -> tuple[F32, F32]:
    """Light of some lights alone, without edits and with them; `whole` is the edited light of all."""
    own = [relit(part, lobe) for lobe in lobes]
    base = np.zeros_like(whole)
    for lobe in own:
        base[lobe.where] += lobe.mean()
    return base, clamped_like(whole, _under_stack(part, points, own, base))


def clamped_like(whole: F32, part: F32) -> F32:
    """A part of edited light, nothing where all light together was clamped."""
    return np.where(whole > 0, part, np.float32(0))


def relit(gatherer: Gatherer, lobe: Lobe) -> Lobe:
    """The same rays with the light that a gatherer finds at their ends."""
    return lobe._replace(light=_brought(gatherer, lobe.rays, int(hash_combine(lobe.seed, 11))))


def _under_stack(gatherer: Gatherer, points: SurfacePoints, lobes: list[Lobe], base: F32) -> F32:
    edited = base.copy()
    receivers, touched = touched_receivers(gatherer.field, points)
    if len(touched):
        light = light_of_pairs(gatherer, receivers, touched, lobes, points.albedo)
        edited[touched] = gatherer.field.finish(light, receivers, is_part=gatherer.is_part)
    return edited


def diffuse_lobe(gatherer: Gatherer, points: SurfacePoints, where: I64, stream: I64, seed: int) -> Lobe:
    """Rays about the normals of points `where`."""
    g = gatherer
    some = take_points(points, where)
    rays = trace_hemisphere(g.snapshot, g.tracer, some, stream[where], g.n_rays, seed)
    return _lit(g, where, rays, some.albedo, seed)


def specular_lobe(
    gatherer: Gatherer, points: SurfacePoints, to_eye: F32, draws: I64, n_rays: int, seed: int
) -> Lobe | None:
    """Rays of the specular lobe of those points that have one."""
    g = gatherer
    glossy = np.flatnonzero(is_glossy(points))
    if len(glossy) == 0:
        return None
    own = int(hash_combine(seed, 7))
    shiny = take_points(points, glossy)
    asked = to_eye[glossy], draws[glossy], n_rays, own
    rays: GatherRays | CellRays | None = None
    if not g.follows_paths:
        assert g.solution is not None
        rays = trace_lobe(g.snapshot, g.tracer, g.solution.gather, shiny, *asked)
    if rays is None:
        rays = trace_specular(g.snapshot, g.tracer, shiny, *asked)
    return _lit(g, glossy, rays, np.ones((len(glossy), 3), np.float32), int(hash_combine(own, 2)))


def _lit(gatherer: Gatherer, where: I64, rays: GatherRays | CellRays, tint: F32, seed: int) -> Lobe:
    return Lobe(where, rays, _brought(gatherer, rays, int(hash_combine(seed, 11))), tint, seed)


def _brought(gatherer: Gatherer, rays: GatherRays | CellRays, seed: int) -> Reflected:
    """Light that rays bring."""
    if isinstance(rays, CellRays) or not gatherer.follows_paths:
        assert gatherer.solution is not None
        return _sent(gatherer.solution, rays.cells(gatherer.solution.gather), rays.throughput)
    return _reflected(gatherer, rays.ends, rays.throughput, seed)


def _sent(solution: GatherSolution, cell: I32, throughput: F32) -> Reflected:
    """Light that cells send along rays with some throughput."""
    if solution.sent is not None:
        by_group = np.take(solution.sent, cell, axis=1) * throughput
        return Reflected(by_group.sum(axis=0), by_group)
    by_group = np.take(solution.b, cell, axis=1) * throughput
    return Reflected(np.take(solution.total, cell, axis=0) * throughput, by_group)


def _reflected(gatherer: Gatherer, points: SurfacePoints, throughput: F32, seed: int) -> Reflected:
    """Light that points, the ends of rays with some throughput, reflect."""
    if not gatherer.follows_paths:
        assert gatherer.solution is not None
        return _sent(gatherer.solution, gatherer.solution.gather.locate(points), throughput)
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
        only=gatherer.lights,
    )


def touched_receivers(field: EditField, points: SurfacePoints) -> tuple[Ends, I64]:
    """The points that an edit may change, as receivers, and which they are."""
    everyone = field.receivers(points)
    touched = np.flatnonzero((everyone.masks > 0).any(axis=0))
    return everyone.take(touched), touched


def light_of_pairs(
    gatherer: Gatherer, receivers: Ends, touched: I64, lobes: list[Lobe], albedo: F32, *, with_offsets: bool = True
) -> F32:
    """Light of the lobes' rays under the stack, before `EditField.finish`.

    Parameters
    ----------
    receivers : Ends of the m points `touched`
    albedo : (n, 3) of all points
    """
    position = np.full(len(albedo), -1, np.int64)
    position[touched] = np.arange(len(touched))
    blocks = []
    for lobe in lobes:
        owner = position[np.repeat(lobe.where, lobe.n_rays)]
        some = np.flatnonzero((owner >= 0) & lobe.rays.throughput.any(axis=1))
        if len(some) == 0:
            continue
        arrived = np.take(lobe.light.by_group, some, axis=1), np.take(lobe.rays.throughput, some, axis=0)
        casters = lobe.rays.ends_of(gatherer.snapshot, some)
        blocks.append(_pairs(gatherer, lobe, some, owner[some], casters, *arrived))
        for slot, edit in enumerate(gatherer.field.throughs):
            reached: Bool = np.asarray((receivers.masks[gatherer.field.rows_of(edit)] > 0).any(axis=0), np.bool_)
            hidden = gatherer.field.edits[edit].occluders
            held = some[reached[owner[some]] & hidden[casters.instance]]
            if len(held):
                blocks.append(_held_back(gatherer, lobe, held, owner[held], slot))
    offsets = None if gatherer.solution is None or not with_offsets else gatherer.solution.offsets
    return edited_light(gatherer.field, receivers, blocks, offsets, albedo[touched])


def _pairs(
    gatherer: Gatherer,
    lobe: Lobe,
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
    tint = np.take(lobe.tint, some // lobe.n_rays, axis=0) / np.float32(lobe.n_rays)
    emitted = tint * throughput
    return PairLight(owner, field.casters(casters), seen, tint * brought, emitted, through, gatherer.is_part)


def _held_back(gatherer: Gatherer, lobe: Lobe, held: I64, owner: I64, slot: int) -> PairLight:
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
