"""Indirect light of camera samples from an irradiance cache: diffuse interpolated, glossy gathered, edits mixed in.

Samples that no record reaches gather for themselves: with a cache that has no records, all of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.offsets import offset_radiance
from icheat_usd.final_gather.edited_records import EditedRecords, MaskedRecords, edited_records
from icheat_usd.final_gather.gatherer import (
    GatheredLight,
    Gatherer,
    Lobe,
    clamped_like,
    diffuse_lobe,
    light_of_pairs,
    relit,
    specular_lobe,
)
from icheat_usd.final_gather.hemispheres import Hemispheres, Part
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup, Places
from icheat_usd.final_gather.light_parts import light_of_records
from icheat_usd.final_gather.receiver_sets import MOST_SOFT, Touched, soft_masks, touched
from icheat_usd.final_gather.row_records import RowRecords
from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.record_mixtures import lay_change, lay_positive
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I64, SurfacePoints

_INVERSE_PI = np.float32(1.0 / np.pi)


class CachedGather:
    """A cache that no more records are added to, and what reads it.

    Parameters
    ----------
    cache : IrradianceCache
        With rays, if the stack has edits.
    glossy_rays : int
        Per point with a specular lobe.
    own_strata : (int, int)
        Rings and sectors of the rays of camera samples that no record reaches.
    is_kept : bool
        Whether to keep `samples` and `receivers`, what was found at every call of `light`, for other stacks.
    """

    def __init__(
        self,
        gatherer: Gatherer,
        cache: IrradianceCache,
        glossy_rays: int,
        own_strata: tuple[int, int],
        *,
        is_kept: bool = False,
    ) -> None:
        self._gatherer, self.cache, self._glossy_rays = gatherer, cache, glossy_rays
        self._is_kept, self._own_strata = is_kept, own_strata
        self.samples: list[Sampled] = []
        self.receivers: list[Touched] = []
        self._parts = CachedParts(gatherer.parts, cache)
        self.hemispheres = hemispheres_of(cache)
        self.hemispheres.is_kept = is_kept
        self._parts.take_edits(self.hemispheres)
        stacks = () if gatherer.field.is_identity else (*gatherer.prefixes, gatherer)
        self._stacks = [(stack, edited_records(stack, cache, self.hemispheres)) for stack in stacks]

    def light(self, places: Places, to_eye: F32, stream: I64, draws: I64, seed: int) -> GatheredLight:
        """Radiance towards the eye; points that no edit touches have the same bits in both results."""
        sample = self._sample(places, to_eye, stream, draws, seed)
        if self._is_kept:
            self.samples.append(sample)
        if not self._stacks:
            return GatheredLight(sample.base, sample.base.copy(), (), self._parts.light(sample, sample.base))
        *before, (gatherer, last) = self._stacks
        steps = [under_stack(stack, records, sample) for stack, records in before]
        receivers = touched(gatherer.field, places.points)
        if self._is_kept:
            self.receivers.append(receivers)
        edited = under_stack(gatherer, last, sample, receivers)
        return GatheredLight(sample.base, edited, tuple(steps), self._parts.light(sample, edited))

    def _sample(self, places: Places, to_eye: F32, stream: I64, draws: I64, seed: int) -> Sampled:
        points = places.points
        position, normal = points.position, points.shading_normal
        found = self.cache.find(places)
        irradiance = np.maximum(self.cache.interpolate(found, position, normal), np.float32(0))
        # What the coarser look at the scene has missed, less than a pixel wide, is gathered where it is.
        alone, own_rays = np.flatnonzero(found.number == 0), None
        if len(alone):
            own_rays = self.cache.tracer.trace(take_points(points, alone), _ALONE + stream[alone], self._own_strata)
            irradiance[alone] = np.pi * own_rays.mean_radiance(self.cache.cells)
        base = (points.albedo * (irradiance * _INVERSE_PI)).astype(np.float32, copy=False)
        shiny = specular_lobe(self._gatherer, points, to_eye, draws, self._glossy_rays, seed)
        if shiny is not None:
            base[shiny.where] += shiny.mean()
        own = None
        if own_rays is not None:
            some = Part(own_rays, take_points(points, alone), np.arange(len(alone)))
            own = Hemispheres([some], np.ones(len(alone), np.float32), self._is_kept)
        return Sampled(points, stream, seed, found, base, shiny, alone, own)


def hemispheres_of(cache: IrradianceCache) -> Hemispheres:
    """Rays of a cache's records, none if it keeps none."""
    return Hemispheres([Part(*part) for part in cache.parts], cache.shrink)


class Sampled(NamedTuple):
    """Camera samples and their light before any edit."""

    points: SurfacePoints
    stream: I64
    seed: int
    found: Lookup
    base: F32
    shiny: Lobe | None
    alone: I64  #: (k,) ascending, samples without records
    own_rays: Hemispheres | None  #: of these


def under_stack(
    g: Gatherer,
    records: MaskedRecords | RowRecords | EditedRecords,
    sampled: Sampled,
    receivers: Touched | None = None,
) -> F32:
    """Light of camera samples under the stack of a gatherer, (n, 3); where no edit acts the bits of `base`.

    Parameters
    ----------
    receivers : Touched, optional
        Those of the samples, if they are known.
    """
    points, base, shiny = sampled.points, sampled.base, sampled.shiny
    edited = base.copy()
    if receivers is None:
        receivers = touched(g.field, points)
    where = receivers.where
    if len(where) == 0:
        return edited
    # Curves, light from behind occluders, and mixtures of too many soft masks look at pairs of their own; the
    # cache corrects what their few rays brought.
    has_records = sampled.found.number[where] > 0
    by_pairs = np.zeros(len(where), np.bool_)
    if not records.takes_soft_masks:
        by_pairs = has_records & (soft_masks(receivers.columns) > MOST_SOFT)[receivers.which]
    if g.field.aggregates or g.field.throughs:
        by_pairs[:] = True
    lobes = [] if shiny is None else [shiny]
    light = np.empty((len(where), 3), np.float32)
    which = where[by_pairs]
    if len(which):
        own = diffuse_lobe(g, points, which, sampled.stream, int(hash_combine(sampled.seed, 23)))
        brought = _brought(len(base), [own, *lobes])
        ends = receivers.take(np.flatnonzero(by_pairs)).ends()
        light[by_pairs] = light_of_pairs(g, ends, which, [own, *lobes], points.albedo)
        light[by_pairs] += base[which] - brought[which]
    rest = np.flatnonzero(~by_pairs)
    if len(rest):
        some = receivers if len(rest) == len(where) else receivers.take(rest)
        at = some.where
        near, lost = np.flatnonzero(has_records[rest]), np.flatnonzero(~has_records[rest])
        if len(near):
            reached = some if len(near) == len(rest) else some.take(near)
            change = records.change(sampled.found, points, reached)
            lay_change(base, points.albedo, at[near], change, rest[near], light)
        if len(lost):
            assert sampled.own_rays is not None
            rows = np.searchsorted(sampled.alone, at[lost])
            change = records.change_alone(points, sampled.own_rays, rows, some.take(lost))
            lay_change(base, points.albedo, at[lost], change, rest[lost], light)
        if shiny is not None:
            reflected = light_of_pairs(g, some.ends(), at, lobes, points.albedo, with_offsets=False)
            light[rest] += reflected - _brought(len(base), lobes)[at]
        if g.solution is not None and g.solution.offsets is not None:
            albedo = np.take(points.albedo, at, axis=0)
            light[rest] += offset_radiance(g.field, g.solution.offsets, some.ends(), albedo)
    lines = receivers.view_lines()
    if lines is None and not g.is_part:
        lay_positive(light, where, edited)  # as `seen` has it, in one pass
    else:
        edited[where] = g.field.seen(light, lines, is_part=g.is_part)
    return edited


def _brought(n: int, lobes: list[Lobe]) -> F32:
    """Light of lobes before any edit, (n, 3)."""
    total = np.zeros((n, 3), np.float32)
    for lobe in lobes:
        total[lobe.where] += lobe.mean()
    return total


class CachedParts:
    """Light of some lights alone, for each of `Gatherer.parts`, from the rays that the cache has kept."""

    def __init__(self, parts: tuple[Gatherer, ...], cache: IrradianceCache) -> None:
        self._parts, self._cache = parts, cache
        if not parts:
            return
        sent = []
        for part in parts:
            assert part.solution is not None and part.solution.sent is not None
            sent.append(part.solution.sent.sum(axis=0))
        cells = np.concatenate(sent, axis=1)
        self._cells = np.concatenate([cells, np.zeros((1, cells.shape[1]), np.float32)])
        self._values = light_of_records(cache, self._cells)
        self._records: list[MaskedRecords | RowRecords | EditedRecords | None] = [None for _ in parts]

    def take_edits(self, hemispheres: Hemispheres) -> None:
        """Edit the light of the parts, too."""
        for number, part in enumerate(self._parts):
            if not part.field.is_identity:
                self._records[number] = edited_records(part, self._cache, hemispheres)

    def light(self, sampled: Sampled, whole: F32) -> tuple[tuple[F32, F32], ...]:
        """Radiance towards the eye, without edits and with them, of each part; `whole` is the edited light of all."""
        if not self._parts:
            return ()
        points = sampled.points
        diffuse = self._diffuse(sampled)
        found = []
        for part, records, light in zip(self._parts, self._records, diffuse, strict=True):
            base = points.albedo * (light * _INVERSE_PI)
            shiny = None if sampled.shiny is None else relit(part, sampled.shiny)
            if shiny is not None:
                base[shiny.where] += shiny.mean()
            if records is None:
                found.append((base, base.copy()))
                continue
            edited = under_stack(part, records, sampled._replace(base=base, shiny=shiny))
            found.append((base, clamped_like(whole, edited)))
        return tuple(found)

    def _diffuse(self, sampled: Sampled) -> F32:
        """Irradiance, (n_parts, n, 3); where gradients lead below zero, the other parts give what is missing."""
        points, alone = sampled.points, sampled.alone
        light = self._cache.interpolate(sampled.found, points.position, points.shading_normal, self._values)
        if sampled.own_rays is not None:
            light[alone] = np.pi * sampled.own_rays.parts[0].rays.mean_radiance(self._cells)
        parts = light.reshape(len(light), len(self._parts), 3).transpose(1, 0, 2)
        wanted, positive = np.maximum(parts.sum(axis=0), 0), np.maximum(parts, 0)
        there = positive.sum(axis=0)
        return np.asarray(positive * np.divide(wanted, there, out=np.zeros_like(there), where=there > 0), np.float32)


#: Added to the numbers of camera samples, so that their rays are none of a record's.
_ALONE = np.int64(1 << 31)
