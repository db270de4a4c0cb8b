"""What a final gather can tell beside its usual layers; none of it costs anything unless it is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import offset_casters
from icheat_usd.final_gather.gatherer import GatheredLight, Gatherer
from icheat_usd.image.cryptomatte import Coverage, coverage, name_id
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F64, I64, SceneSnapshot


@dataclass(frozen=True)
class Extras:
    """What to compute beside the usual layers."""

    contributions: bool = False  #: of each edit
    light_groups: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: MappingProxyType({}))
    #: paths of lights by the name of the group whose light is wanted
    indirect: bool = False  #: whether their indirect light is, too
    objects: bool = False  #: which prims each pixel shows
    edits: bool = False  #: which edits each pixel receives


NO_EXTRAS = Extras()


def with_prefixes(gatherer: Gatherer) -> Gatherer:
    """A gatherer that also finds the light under the first edits of the stack: one, two, and so on but for all."""
    found = []
    for n in range(1, len(gatherer.field.edits)):
        first = replace(gatherer.field, edits=gatherer.field.edits[:n])
        solution = gatherer.solution
        if solution is not None:
            casters = first.casters(solution.gather.points)
            offsets = offset_casters(first, casters, solution.b, solution.gather.area)
            solution = replace(solution, offsets=offsets)
        found.append(replace(gatherer, field=first, solution=solution))
    return replace(gatherer, prefixes=tuple(found))


def contribution_layers(
    edits: EditField, light: GatheredLight, view: ViewSamples, pixels: tuple[int, int]
) -> dict[str, F64]:
    """What each edit changes over the edits before it, by its path; (n_pixels, 3) each.

    They sum to the difference that all edits make, but for rounding.
    """
    if edits.is_identity:
        return {}
    steps = [develop(view, step, pixels) for step in (light.base, *light.steps, light.edited)]
    paths = [bound.edit.path for bound in edits.edits]
    return {path: after - before for path, before, after in zip(paths, steps[:-1], steps[1:], strict=True)}


def covered(
    extras: Extras, snapshot: SceneSnapshot, edits: EditField, view: ViewSamples, pixels: tuple[int, int]
) -> dict[str, Coverage]:
    """Which prims (``object``) and which edits (``edit``) each pixel shows, and how much of it.

    Notes
    -----
    A sample covers its share of the light of a white world that its pixel would show: pixel filter, opacity and the
    reflectance of mirrors weigh it. As all layers do, mattes show what is seen in mirrors and through glass. An edit
    covers what it receives, times its receiver mask.
    """
    found: dict[str, Coverage] = {}
    if not (extras.objects or extras.edits):
        return found
    share = _shares(view, pixels)
    pixel = view.pixel.astype(np.int64)
    if extras.objects:
        ids = np.array([name_id(surface.path) for surface in snapshot.surfaces], np.uint32)
        seen = ids[snapshot.geometry.instance_surface[view.points.instance]]
        found["object"] = coverage(pixel, seen, share)
    if extras.edits:
        masks = edits.receivers(view.points).masks
        parts = []
        for index, bound in enumerate(edits.edits):
            mask = np.asarray(bound.key_weights, np.float64) @ masks[edits.rows_of(index)]
            some = np.flatnonzero(mask > 0)
            ids = np.full(len(some), name_id(bound.edit.path), np.uint32)
            parts.append((pixel[some], ids, share[some] * np.minimum(mask[some], 1.0)))
        nothing = np.empty(0, np.int64), np.empty(0, np.uint32), np.empty(0, np.float64)
        found["edit"] = coverage(*(np.concatenate(column) for column in zip(nothing, *parts, strict=True)))
    return found


def _shares(view: ViewSamples, pixels: tuple[int, int]) -> F64:
    """Share of its pixel that each sample is; what leaves the scene has the rest."""
    first, end = pixels
    weight = view.throughput.astype(np.float64).mean(axis=1)
    total: F64 = np.zeros(end - first)
    total += np.bincount(view.pixel - first, weight, end - first)
    escaped = view.sky.throughput.astype(np.float64).mean(axis=1)
    total += np.bincount(view.sky.pixel - first, escaped, end - first)
    place: I64 = view.pixel.astype(np.int64) - first
    return weight / np.where(total > 0, total, 1.0)[place]
