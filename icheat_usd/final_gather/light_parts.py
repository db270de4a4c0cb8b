"""Light of groups of lights apart: what each of them has of a frame's layers.

Edits look at all light and are the same for every group; what they make of a group's light is its part. Light is
linear in lights, so that parts add up to the whole. What edits add that left no light is in no part.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from icheat_usd.edits.offsets import offset_casters
from icheat_usd.final_gather.gatherer import GatheredLight, Gatherer
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, RecordValues
from icheat_usd.final_gather.record_rays import take_rays
from icheat_usd.lighting.change import join_lights, one_light
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.samples.view import sky_behind
from icheat_usd.scene import F32, F64, Bool, LightKind, SceneSnapshot
from icheat_usd.transport import sum_groups

#: What a group of lights has a part of: what is seen of the lights themselves, reflected straight from them, and
#: reflected from other surfaces, without and with edits.
KINDS = ("seen", "direct", "indirect", "indirect_edited")

_RAYS_AT_ONCE = 1 << 19


def members(snapshot: SceneSnapshot, paths: tuple[str, ...]) -> Bool:
    """(n_lights,) which lights have one of these paths."""
    return np.array([path in paths for path in snapshot.light_paths], np.bool_)


def with_parts(gatherer: Gatherer, groups: Mapping[str, tuple[str, ...]], per_light: F32 | None) -> Gatherer:
    """A gatherer that also finds the light of each group of lights alone.

    Parameters
    ----------
    groups : paths of lights by name
    per_light : (n_lights, n_gather, 3) float32, optional
        The gather-sample solution, if the gatherer has one.
    """
    field, parts = gatherer.field, []
    for paths in groups.values():
        lights = members(gatherer.snapshot, paths)
        solution = gatherer.solution
        if solution is not None and per_light is not None:
            sent = sum_groups(per_light * lights[:, None, None], field.light_group, field.n_groups)
            gather = solution.gather
            offsets = offset_casters(field, field.casters(gather.points), solution.b, gather.area, sent)
            solution = replace(solution, offsets=offsets, sent=sent)
        parts.append(replace(gatherer, solution=solution, lights=lights, prefixes=()))
    return replace(gatherer, parts=tuple(parts))


def light_of_records(cache: IrradianceCache, cells: F32) -> RecordValues:
    """Values of all records of a cache that has kept its rays, when cells send `cells` (n_cells + 1, C)."""
    channels = cells.shape[1]
    shape = (cache.n, channels)
    found = RecordValues(np.zeros(shape, np.float32), *(np.zeros((*shape, 3), np.float32) for _ in range(2)))
    if cache.n == 0:
        return found
    at_once = max(1, 3 * _RAYS_AT_ONCE // (channels * cache.rays.n_rays))
    for begin in range(0, len(cache.owner), at_once):
        some = np.arange(begin, min(begin + at_once, len(cache.owner)))
        rays = take_rays(cache.rays, some)
        values, _ = cache.sums(rays, rays.radiance(cells))
        for column, part in zip(found, values, strict=True):
            np.add.at(column, cache.owner[some], part)
    share = (1 / np.bincount(cache.owner, minlength=cache.n)).astype(np.float32)
    for column in found:
        column *= share.reshape(-1, *(1,) * (column.ndim - 1))
    found.by_move[...] *= cache.shrink[:, None, None]
    return found


def part_layers(
    groups: Mapping[str, tuple[str, ...]],
    snapshot: SceneSnapshot,
    per_light: F32,
    light: GatheredLight,
    view: ViewSamples,
    pixels: tuple[int, int],
) -> dict[tuple[str, str], F64]:
    """Parts of a band of pixels by kind and name, (n_pixels, 3) each; of indirect light if `light` has parts.

    Parameters
    ----------
    per_light : (n_lights, n, 3) float32
        What the samples reflect straight from each light.
    """
    found: dict[tuple[str, str], F64] = {}
    for number, (name, paths) in enumerate(groups.items()):
        lights = members(snapshot, paths)
        direct: F32 = per_light[lights].sum(axis=0, dtype=np.float32)
        found["seen", name] = _seen(snapshot, lights, view, pixels)
        found["direct", name] = develop(view, direct, pixels)
        if light.parts:
            base, edited = light.parts[number]
            found["indirect", name] = develop(view, base, pixels)
            found["indirect_edited", name] = develop(view, edited, pixels)
    return found


def _seen(snapshot: SceneSnapshot, lights: Bool, view: ViewSamples, pixels: tuple[int, int]) -> F64:
    """Light that reaches the eye straight from meshes that glow and from domes."""
    kind = snapshot.lights.kind
    glowing = snapshot.lights.surface[lights & (kind == LightKind.MESH)]
    own = np.isin(snapshot.geometry.instance_surface[view.points.instance], glowing)
    seen = develop(view, np.where(own[:, None], view.points.emission, np.float32(0)), pixels)
    domes = np.flatnonzero(lights & (kind == LightKind.DOME)).tolist()
    if domes:
        alone = join_lights(snapshot, [one_light(snapshot, row) for row in domes])
        seen += sky_behind(alone, view.sky, view.width * view.height)[slice(*pixels)]
    return seen
