"""What an operation may ask about the scene and the selections that it is bound to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.edits.selection import BoundSelection
from icheat_usd.kernels import samples as kernels
from icheat_usd.kernels.distances import mean_distance
from icheat_usd.materials import points_on_surface
from icheat_usd.samples import instance_areas
from icheat_usd.scene import F64, I64, SceneSnapshot

#: Places at which a selection is looked at, where it is not the same all over its surfaces.
_N_PLACES = 65536
#: The same, where it is enough to know about where it lies.
_N_ROUGH_PLACES = 16384
#: Places on either side between which distances are averaged.
_N_ENDS = 1024
_SEED = 0x1CEA7


@dataclass(frozen=True, eq=False)
class Measures:
    """Measures of one key of an edit; computed when asked for.

    They depend on surfaces and selections alone, not on the camera, the lights
    or how finely the scene is sampled for rendering.
    """

    snapshot: SceneSnapshot
    receivers: BoundSelection
    casters: BoundSelection

    def mean_distance(self) -> float:
        """Mean distance of receivers and casters, metres; 0 where one of them is nowhere.

        The mean is over all pairs of places by area times weight, in sight of
        each other or not.
        """
        sides = (self.receivers, self.casters)
        ends = [_choose(*_weighted_places(self.snapshot, side, _N_ROUGH_PLACES)) for side in sides]
        if not all(len(end) for end in ends):
            return 0.0
        return float(mean_distance(*ends))

    def caster_area(self) -> float:
        """Area of the casters, weighted by their masks, square metres.

        Surfaces count once: a wall that shines on one side has the mean radiance of that side.
        """
        if self.casters.constant_on_instances:
            return float(instance_areas(self.snapshot) @ self.casters.on_instances)
        _, weight = _weighted_places(self.snapshot, self.casters, _N_PLACES)
        return float(weight.sum())


def _weighted_places(snapshot: SceneSnapshot, selection: BoundSelection, n: int) -> tuple[F64, F64]:
    """About n places (n, 3) spread over the surfaces that may be selected, and the selected area of each (n,)."""
    area = instance_areas(snapshot)
    instances = np.flatnonzero((selection.on_instances > 0) & (area > 0))
    if not len(instances):
        return np.zeros((0, 3)), np.zeros(0)
    share = area[instances] / area[instances].sum()
    count: I64 = np.maximum(np.ceil(share * n), 1).astype(np.int64)
    begin = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    triangle = np.empty(begin[-1], np.int32)
    uv = np.empty((begin[-1], 2), np.float32)
    geometry = snapshot.geometry
    kernels.spread_by_area(
        geometry.points,
        geometry.mesh_begin,
        geometry.instance_mesh,
        geometry.instance_to_world,
        area,
        instances.astype(np.int32),
        begin,
        (instances * 0x2545F491 + _SEED) & 0xFFFFFFFF,
        triangle,
        uv,
    )
    instance = np.repeat(instances.astype(np.int32), count)
    points = points_on_surface(snapshot, instance, triangle, uv, np.zeros(len(instance), np.uint8))
    each = np.repeat(area[instances] / count, count)
    return points.position.astype(np.float64), selection.at(points) * each


def _choose(place: F64, weight: F64) -> F64:
    """At most `_N_ENDS` of the places, by weight: one from each of so many equal parts of the whole weight."""
    reached = np.cumsum(weight)
    if not len(reached) or reached[-1] <= 0:
        return place[:0]
    # Jittered: every n-th place of a low-discrepancy sequence need not be spread evenly.
    jitter = np.random.default_rng(_SEED).random(_N_ENDS)
    return place[np.searchsorted(reached, (np.arange(_N_ENDS) + jitter) / _N_ENDS * reached[-1])]
