"""Learning from where the light of a dome can be seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels.guide import (
    BANDS,
    CLASSES,
    COLUMNS,
    Guide,
    accumulate_planes,
    fill_pilot,
    find_keys,
    plane_places,
    smooth_planes,
)
from icheat_usd.kernels.lights import LightTables
from icheat_usd.kernels.random import hash_combine
from icheat_usd.lighting.controls import tracer_for
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, F64, I32, I64, LightKind, SceneSnapshot, SurfacePoints
from icheat_usd.steps import Steps
from icheat_usd.tracing import Tracer, spawn_points, transmittance

_CELLS = BANDS * COLUMNS

_POINTS = 1 << 15  # that vote for the leaves: more only make the tree slower to build
_PLACES = 64  # in each cell of a plane, that its rays go to: looking up an image costs more than tracing
_GROUPS_AT_ONCE = 64  # densities learnt together: an eighth of a million rays


class Effort(NamedTuple):
    """How much is learnt."""

    leaves: int = 512  #: places that are told apart; with normals about three times as many densities
    rays: int = 3  #: per cell of a plane, from as many points of the place


#: For a first look: a thirtieth of the rays.
LITTLE = Effort(48, 1)

# Share of a guided image dome's samples that stays proportional to the image: what the few pilot rays
# of a cell missed is still found.
_PLAIN_SHARE = 0.15

# Share of a density that comes from the leaves around: a pilot of one ray a cell is a noisy witness.
_AROUND = 0.25

# A density must promise to lower the variance by this factor, or the plain sampler, whose points are
# better spread, stays.
_WORTHWHILE = 1.5


def no_guide(n_lights: int) -> Guide:
    """The guide that leaves every light to its plain sampler."""
    return Guide(
        axis=np.full(1, -1, np.int32),
        split=np.zeros(1, np.float32),
        child=np.zeros(1, np.int32),
        row=np.zeros((n_lights, 0), np.int32),
        bands=np.ones((1, BANDS), np.float32),
        columns=np.ones((1, _CELLS), np.float32),
    )


def learn_guide(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    tables: LightTables,
    points: SurfacePoints,
    seed: int,
    effort: Effort = Effort(),  # noqa: B008 (a constant)
) -> Steps[Guide]:
    """Measure with pilot rays which cells of each dome's plane light the places around some points.

    Places are the leaves of a tree over the points, told apart by the normal's largest component as
    well. The density over a cell follows the root mean square of what it brings, which is best for
    cells that are partly blocked, in the manner of [1]_. Each step takes about a tenth of a second.

    Parameters
    ----------
    points : SurfacePoints
        Where light will be asked for, roughly; at most about 32,000 are looked at.

    References
    ----------
    .. [1] Rath et al. 2020, Variance-Aware Path Guiding.
    """
    lights = snapshot.lights
    domes = np.flatnonzero((lights.kind == LightKind.DOME) & lights.radiance.any(axis=1))
    real = np.flatnonzero(points.instance >= 0)
    real = real[:: max(1, -(-len(real) // _POINTS))]
    if not len(domes) or not len(real):
        return no_guide(len(lights.kind))
    points = take_points(points, real)
    axis, split, child, n_leaves = _tree(points.position, effort.leaves)
    key = np.empty(len(real), np.int64)
    find_keys(axis, split, child, points.position, points.shading_normal, key)
    points = take_points(points, np.argsort(key, kind="stable"))
    keys, count = np.unique(key, return_counts=True)
    begin = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)

    start = spawn_points(snapshot, points, points.normal)
    yield
    rows = np.full((len(lights.kind), n_leaves * CLASSES), -1, np.int32)
    weights: list[F32] = []
    n_rows = 0
    for light in domes.tolist():
        square = np.zeros((len(keys), _CELLS), np.float32)
        to_light = tracer_for(snapshot, tracer, light)
        towards, level = np.empty((_CELLS, _PLACES, 3), np.float32), np.empty((_CELLS, _PLACES), np.float32)
        plane_places(snapshot.lights, snapshot.textures, tables, light, seed & 0xFFFFFFFF, towards, level)
        for turn in range(effort.rays):
            own_seed = int(hash_combine(hash_combine(seed, light), turn))
            for first in range(0, len(keys), _GROUPS_AT_ONCE):
                part = begin[first : first + _GROUPS_AT_ONCE + 1]
                found = _pilot(snapshot, to_light, towards, level, points, start, part, first, own_seed)
                square[first : first + len(part) - 1] += found / np.float32(effort.rays)
                yield
        weight, useful = _weights(square, keys, textured=bool(lights.texture[light] >= 0))
        rows[light, keys[useful]] = n_rows + np.arange(len(useful), dtype=np.int32)
        weights.append(weight[useful])
        n_rows += len(useful)
        yield
    weight = np.concatenate(weights)
    bands, columns = np.ones((max(n_rows, 1), BANDS), np.float32), np.ones((max(n_rows, 1), _CELLS), np.float32)
    accumulate_planes(weight, bands[:n_rows], columns[:n_rows])
    return Guide(axis, split, child, rows, bands, columns)


def _tree(position: F32, leaves: int) -> tuple[I32, F32, I32, int]:
    """Split points at the median of their longest side until a leaf holds few; nodes and number of leaves."""
    smallest = max(16, len(position) // leaves)
    axis, split, child = [-1], [0.0], [0]
    pending: list[tuple[int, NDArray[np.int64]]] = [(0, np.arange(len(position)))]
    n_leaves = 0
    while pending:
        node, rows = pending.pop()
        place = position[rows]
        low, high = place.min(axis=0), place.max(axis=0)
        longest = int(np.argmax(high - low))
        value = np.sort(place[:, longest])[len(rows) // 2]
        below = place[:, longest] < value
        if len(rows) < 2 * smallest or not below.any():
            child[node] = n_leaves
            n_leaves += 1
            continue
        axis[node], split[node], child[node] = longest, float(value), len(axis)
        axis += [-1, -1]
        split += [0.0, 0.0]
        child += [0, 0]
        pending += [(child[node] + 1, rows[~below]), (child[node], rows[below])]
    return np.array(axis, np.int32), np.array(split, np.float32), np.array(child, np.int32), n_leaves


def _pilot(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    towards: F32,
    level: F32,
    points: SurfacePoints,
    start: F32,
    begin: I64,
    first: int,
    seed: int,
) -> F32:
    """Squared contribution of each cell of the plane to some groups of points, (n_groups, cells).

    `towards` and `level` are of `plane_places`, `start` (n, 3) is where rays from the points start; `begin`
    (n_groups + 1,) of the groups, the first of which has the number `first`.
    """
    n = (len(begin) - 1) * _CELLS
    point, direction, value = np.zeros(n, np.int64), np.zeros((n, 3), np.float32), np.zeros(n, np.float32)
    fill_pilot(
        towards,
        level,
        begin,
        first,
        points.position,
        points.normal,
        points.shading_normal,
        seed,
        point,
        direction,
        value,
    )
    rays = np.flatnonzero(value > 0.0)
    seen = transmittance(snapshot, tracer, start[point[rays]], direction[rays], np.inf).mean(axis=1)
    value[:] = _spread(rays, value[rays] * seen, n)
    return (value * value).reshape(-1, _CELLS)


def _spread(rows: I64, values: F32, n: int) -> F32:
    out = np.zeros(n, np.float32)
    out[rows] = values
    return out


def _weights(square: F32, keys: I64, textured: bool) -> tuple[F32, I64]:
    """Weights of the plane's cells per group, and the groups for which they promise less noise."""
    smooth = np.empty_like(square)
    smooth_planes(square, smooth)
    around = _mean_around(smooth, keys)
    smooth = (1.0 - _AROUND) * smooth + _AROUND * around
    root = np.sqrt(smooth)
    mean = root.mean(axis=1, dtype=np.float64)
    plain = square.mean(axis=1, dtype=np.float64)
    if not textured:  # the plain sampler follows the cosine: E[f^2] = pi E[f cos] over directions
        plain = np.pi * np.sqrt(square).mean(axis=1, dtype=np.float64)
    useful = np.flatnonzero((mean > 0.0) & (plain > _WORTHWHILE * mean * mean))
    weight = root / np.maximum(mean, 1e-30)[:, None].astype(np.float32)
    if textured:
        weight = _PLAIN_SHARE + (1.0 - _PLAIN_SHARE) * weight
    return np.ascontiguousarray(weight, np.float32), useful


def _mean_around(smooth: F32, keys: I64) -> F32:
    """Mean over the groups with the same class of normals in eight leaves that follow one another in the tree."""
    family = (keys // CLASSES // 8) * CLASSES + keys % CLASSES
    _, member, count = np.unique(family, return_inverse=True, return_counts=True)
    order = np.argsort(member, kind="stable")
    sums: F64 = np.add.reduceat(smooth[order], np.concatenate([[0], np.cumsum(count)[:-1]]), axis=0, dtype=np.float64)
    return np.asarray((sums / count[:, None])[member], np.float32)
