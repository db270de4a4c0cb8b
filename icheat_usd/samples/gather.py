"""Gather samples: the surface cells that send light to view samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icheat_usd.kernels import samples as kernels
from icheat_usd.kernels.rows import mean_over_segments
from icheat_usd.lighting import LightSampler, irradiance
from icheat_usd.materials import concatenate_points, effective_albedo, points_on_surface, take_points
from icheat_usd.samples.cell_map import HitCells
from icheat_usd.samples.locate import Locator, build_locator
from icheat_usd.samples.tree import ClusterTree, build_tree, split_samples
from icheat_usd.samples.view import ViewSamples
from icheat_usd.scene import F32, F64, I32, I64, Bool, Camera, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer, first_surfaces, spawn_points

_PILOT_POINTS = 16384  # at most, of the view that a pilot starts from
_PILOT_RAYS = 1 << 17  # in all: enough to find a surface that fills a 10,000th of what all points see
_SEEN_PER_CELL = 4  # rays of the pilot at least, first ones
_BY_AREA = 1  # patch points of a cell that lie anywhere in it, beside the places that were seen
_AREA_SHARE = 0.2  # of the samples by area alone: what the pilot missed still gets some
_UNSEEN_SHARE = 0.25  # of the samples at most, for sides that the pilot never saw
_CELLS_AT_ONCE = 16384  # of direct light, to bound memory


@dataclass(frozen=True)
class GatherSamples:
    """Points on surfaces, each standing for the cell of places nearer to it than to any other.

    Light of a cell is an average over its patch points, most of which are places
    that send light to what the view shows: a texture or a shadow edge inside a
    cell counts as it is seen. Where the sun strikes the outside of a window's
    frame and the room sees the inside, an average over the cell's area would
    bring the sun into the room (measured: a room with four windows became 17 %
    too bright with 16,384 cells, now 2 %). Places that nothing sees count for
    little: where an edit takes an occluder away, the cells at its foot are
    those that were in sight.
    """

    points: SurfacePoints  #: (n,) in the order of the tree's leaves
    area: F32  #: (n,) of the cells, square metres
    importance: F32  #: (n,) part of what the view receives that comes from each cell, by the pilot, if all shine alike
    number: I64  #: (n,) what random numbers go by: the same when other surfaces get more samples, or less
    tree: ClusterTree
    patch_points: SurfacePoints  #: (p,) sorted by cell: places that were seen, and some by area
    patch_cell: I32  #: (p,) cell of each patch point, ascending
    cell_begin: I64  #: (n + 1,) first patch point of each cell; every cell has one or more
    locator: Locator
    n_shared_clusters: int  #: cells that stand for several sides of surfaces, because `n` was too small
    n_surfaces_without_own: int  #: instances with area that have no cell of their own

    @property
    def n(self) -> int:
        return len(self.area)

    @cached_property
    def hit_cells(self) -> HitCells:
        """Finds cells of hits faster than `locate`."""
        return HitCells(self.locator)

    def locate(self, points: SurfacePoints) -> I32:
        """Cell of each point; -1 where a point is no hit (``instance == -1``)."""
        return self.locator.locate(points.position, points.normal, points.instance, points.side)

    def patches_of(self, cells: I64) -> tuple[I64, I64]:
        """Patch points of some cells (m,), one cell after the other, and where each begins among them (m + 1,)."""
        begin = self.cell_begin[cells]
        size = self.cell_begin[cells + 1] - begin
        ends = np.concatenate([[0], np.cumsum(size)]).astype(np.int64)
        return np.repeat(begin - ends[:-1], size) + np.arange(ends[-1]), ends


@dataclass(frozen=True)
class _Slots:
    """Groups of samples in tree order: a side of an instance each, or several sides that share a cluster."""

    names: list[tuple[str, ...]]
    count: I64  #: (n_slots,) samples of each
    area: F64  #: (n_slots,) square metres, both sides of a surface counted
    members: list[I64]  #: sides ``2 * instance + side`` of each slot
    of_side: I32  #: (2 * n_instances,) slot of each side
    shared: int
    without_own: int


def gather_samples(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    *,
    n: int = 65536,
    seed: int = 0,
    n_patches_per_cell: int = 8,
) -> GatherSamples:
    """Spread gather samples where they matter to the view.

    A pilot of gather rays from the samples of `pilot_pixels`, and one more bounce,
    measures how much of what the view receives comes from each side of each
    instance, and where in the cells from. Samples are shared out by that (and a fifth by area); on a side
    they are uniform in area. Every side has one sample or more as long as `n`
    allows; what it does not allow shares clusters, which are counted.

    Parameters
    ----------
    view
        Of all pixels, or of the pilot's alone: the result is the same.
    n
        Cells wanted; there are never more.
    n_patches_per_cell
        Patch points of a cell at most.

    Raises
    ------
    ValueError
        `n` is not positive, or nothing in the scene has an area.
    """
    if n < 1:
        raise ValueError(f"a gather set needs at least one sample, not {n}")
    area = instance_areas(snapshot)
    if not np.any(area > 0):
        raise ValueError("no surface of the scene has an area, so nothing can reflect light")
    seen, weight, number = _pilot(snapshot, tracer, view, max(_PILOT_RAYS, _SEEN_PER_CELL * n), seed)
    side = 2 * seen.instance.astype(np.int64) + seen.side
    importance = np.bincount(side, weight, 2 * snapshot.n_instances).astype(np.float64)
    slots = _share_out(snapshot, area, importance, n)

    slot_begin = np.concatenate([[0], np.cumsum(slots.count)]).astype(np.int64)
    points = _spread(snapshot, area, slots, slots.count, seed, 1)
    shape = split_samples(slots.names, slot_begin, points.position, points.normal)
    points = take_points(points, shape.order)
    locator = build_locator(
        points.position, points.normal, shape, _depth_bound(n), slots.of_side, slot_begin, slots.area
    )

    patches = _spread(snapshot, area, slots, slots.count * n_patches_per_cell, seed, 2)
    cell = locator.locate(patches.position, patches.normal, patches.instance, patches.side)
    count = np.bincount(cell, minlength=len(points.instance))
    lonely = np.flatnonzero(count == 0)
    patches = concatenate_points(patches, take_points(points, lonely))
    cell = np.concatenate([cell, lonely.astype(np.int32)])
    count = np.maximum(count, 1)
    slot_of = np.repeat(np.arange(len(slots.count)), slots.count)
    cell_area = slots.area[slot_of] * count / np.bincount(slot_of, count)[slot_of]

    identity = "\n".join("/".join(name) for name in slots.names).encode()
    identity += slot_of.astype("<i4").tobytes() + points.face.astype("<i4").tobytes()
    identity += points.face_uv.astype("<f4").tobytes()
    tree = build_tree(shape, cell_area, identity)
    cell_seen = locator.locate(seen.position, seen.normal, seen.instance, seen.side)
    received = np.bincount(cell_seen, weight, minlength=len(count))
    used_seen, used = _patches_used(cell_seen, number, cell, n_patches_per_cell)
    patches = concatenate_points(take_points(seen, used_seen), take_points(patches, used))
    cell = np.concatenate([cell_seen[used_seen], cell[used]])
    by_cell = np.argsort(cell, kind="stable")
    count = np.bincount(cell, minlength=len(count))
    return GatherSamples(
        points=points,
        area=cell_area.astype(np.float32),
        importance=(received / max(received.sum(), 1e-30)).astype(np.float32),
        number=_numbers(slots)[shape.order],
        tree=tree,
        patch_points=take_points(patches, by_cell),
        patch_cell=cell[by_cell],
        cell_begin=np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
        locator=locator,
        n_shared_clusters=slots.shared,
        n_surfaces_without_own=slots.without_own,
    )


def cell_direct(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    sampler: LightSampler,
    gather: GatherSamples,
    n_samples: int | Sequence[int],
    seed: int,
) -> F32:
    """Direct light that each cell reflects diffusely, averaged over its patch points.

    Parameters
    ----------
    n_samples : int or one int per light
        Shadow rays per patch point and light.

    Returns
    -------
    (n_lights, n_gather, 3) float32, radiance, scene-linear
        Effective albedo times irradiance over pi. Emission is not in it.
    """
    out = np.empty((len(snapshot.lights.kind), gather.n, 3), np.float32)
    for first in range(0, gather.n, _CELLS_AT_ONCE):
        last = min(first + _CELLS_AT_ONCE, gather.n)
        begin = gather.cell_begin[first : last + 1]
        points = take_points(gather.patch_points, np.arange(begin[0], begin[-1]))
        # Patches of a cell share its sequence: together they are stratified, and what happens in another cell is
        # nothing to it.
        cell = gather.patch_cell[begin[0] : begin[-1]].astype(np.int64)
        sequence = np.stack([gather.number[cell], np.arange(begin[0], begin[-1]) - gather.cell_begin[cell]], axis=1)
        arriving = irradiance(snapshot, tracer, sampler, points, seed, n_samples, sequence)
        reflected = arriving * (effective_albedo(points) / np.float32(np.pi))
        for light, values in enumerate(reflected):
            mean_over_segments(begin - begin[0], np.ascontiguousarray(values), out[light, first:last])
    return out


def pilot_pixels(camera: Camera, samples_per_pixel: int = 1) -> I64:
    """Pixels of a view that gather samples are spread by, ascending."""
    pixels = np.arange(camera.width * camera.height, dtype=np.int64)
    return pixels[_is_pilot(len(pixels), samples_per_pixel, pixels)]


def _is_pilot(n_pixels: int, samples_per_pixel: int, pixel: I32 | I64) -> Bool:
    step = max(1, -(-n_pixels * samples_per_pixel // _PILOT_POINTS))
    return np.asarray(pixel % step == step // 2)


def _depth_bound(n: int) -> int:
    """Nodes on the way down within a slot, which is split at its median."""
    return int(n).bit_length() + 1


def _pilot(
    snapshot: SceneSnapshot, tracer: Tracer, view: ViewSamples, n_wanted: int, seed: int
) -> tuple[SurfacePoints, F64, I64]:
    """Places that send light to what the view shows, directly and over one reflection, what each counts, its number.

    Numbers go by pixels, so that places keep theirs when another object moves.

    Parameters
    ----------
    n_wanted : int
        First rays, about.
    """
    found = [take_points(view.points, np.zeros(0, np.int64))]
    weights, numbers = [np.zeros(0)], [np.zeros(0, np.int64)]
    pilot = np.flatnonzero(_is_pilot(view.width * view.height, view.samples_per_pixel, view.pixel))
    points, weight, stream = take_points(view.points, pilot), np.ones(len(pilot)), view.stream[pilot].astype(np.int64)
    rays_per_point = min(1024, max(1, n_wanted // max(1, len(weight))))
    for bounce, n_rays in enumerate((rays_per_point, 1)):
        if not len(weight):
            break
        n = len(weight)
        origins, directions = np.empty((n * n_rays, 3), np.float32), np.empty((n * n_rays, 3), np.float32)
        start = np.empty(n * n_rays, np.int64)
        kernels.cosine_rays(
            spawn_points(snapshot, points, points.normal),
            points.shading_normal,
            points.normal,
            np.arange(n + 1),
            n_rays,
            (seed * 2 + bounce) & 0xFFFFFFFF,
            stream,
            start,
            origins,
            directions,
        )
        ends = first_surfaces(snapshot, tracer, origins, directions, seed)
        weight = weight[start] * ends.throughput.mean(axis=1)
        hit = np.flatnonzero((ends.points.instance >= 0) & (weight > 0))
        points, weight = take_points(ends.points, hit), weight[hit]
        stream = (stream[:, None] * n_rays + np.arange(n_rays)).ravel()[hit]
        found.append(points)
        weights.append(weight)
        numbers.append(stream)
        weight = weight * effective_albedo(points).max(axis=1)
    return concatenate_points(*found), np.concatenate(weights), np.concatenate(numbers)


def _patches_used(cell_seen: I32, number: I64, cell: I32, most: int) -> tuple[I64, I64]:
    """Which of the seen places, by their numbers, and of those spread by area stand for their cells.

    A cell has up to `most` patch points: seen places, and `_BY_AREA` where there are fewer, so that a cell which was
    seen once is more than that one place; all are by area where none was seen.
    """
    n_cells = int(cell.max()) + 1
    n_seen = np.bincount(cell_seen, minlength=n_cells)
    by_area = np.where(n_seen == 0, most, np.clip(most - n_seen, 0, _BY_AREA))
    # The least fractions of multiples of the golden ratio belong to numbers that are evenly spread.
    turn = number.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return _first_of_each(cell_seen, turn, np.full(n_cells, most)), _first_of_each(cell, np.zeros_like(cell), by_area)


def _first_of_each(cell: I32, key: np.ndarray, most: I64) -> I64:
    """Up to ``most[c]`` of the entries of each cell c, those with the least keys."""
    order = np.lexsort((key, cell))
    own = cell[order]
    count = np.bincount(own, minlength=len(most))
    rank = np.arange(len(own)) - (np.cumsum(count) - count)[own]
    return order[rank < most[own]]


def _share_out(snapshot: SceneSnapshot, area: F64, importance: F64, n: int) -> _Slots:
    """Decide which sides have samples of their own, and how many."""
    sides = np.flatnonzero(np.repeat(area > 0, 2))
    seen = importance[sides] > 0
    hidden = ~np.repeat(importance.reshape(-1, 2).sum(axis=1) > 0, 2)[sides]
    # First what was seen, most important first; then fronts of surfaces no side of which was seen; then the rest.
    ranked = sides[np.lexsort((sides, sides % 2, ~hidden, -importance[sides], ~seen))]
    wanted = int(seen.sum()) + min(int((~seen).sum()), int(n * _UNSEEN_SHARE))
    shared = 0
    if wanted < len(ranked) or wanted > n:
        shared = max(1, n // 8)
        wanted = min(wanted, n - shared)
        shared = min(shared, len(ranked) - wanted)
    own, rest = ranked[:wanted], np.sort(ranked[wanted:])

    name = [_name(snapshot, side) for side in own.tolist()]
    members = [own[i : i + 1] for i in range(len(own))]
    if shared:
        rest = np.array(sorted(rest.tolist(), key=lambda side: _name(snapshot, side)))
        for cluster, group in enumerate(np.array_split(rest, shared)):
            name.append(("~shared", f"{cluster:08d}"))
            members.append(group)
    order = sorted(range(len(name)), key=name.__getitem__)
    members = [members[i] for i in order]
    of_side = np.zeros(2 * len(area), np.int32)
    for slot, group in enumerate(members):
        of_side[group] = slot
    slot_area = np.array([area[group // 2].sum() for group in members])
    slot_importance = np.array([importance[group].sum() for group in members])
    is_shared = np.array([i >= len(own) for i in order])

    weight = np.where(is_shared, 0.0, slot_area)
    if slot_importance.sum() > 0:
        by_area = np.where(slot_importance > 0, slot_area, 0.0)
        weight = (1 - _AREA_SHARE) * slot_importance / slot_importance.sum() + _AREA_SHARE * by_area / by_area.sum()
        weight[is_shared] = 0
    count = np.ones(len(members), np.int64)
    free = n - len(members)
    if free > 0 and weight.sum() > 0:
        exact = free * weight / weight.sum()
        count += np.floor(exact).astype(np.int64)
        left = n - count.sum()
        count[np.lexsort((np.arange(len(exact)), -(exact % 1)))[:left]] += 1
    without_own = np.zeros(len(area), bool)
    without_own[area > 0] = True
    without_own[own // 2] = False
    return _Slots([name[i] for i in order], count, slot_area, members, of_side, shared, int(without_own.sum()))


def _numbers(slots: _Slots) -> I64:
    """A number for each sample as they are spread, by its side and its place among those of this side."""
    side = np.array([group[0] for group in slots.members])
    place = np.concatenate([np.arange(count) for count in slots.count.tolist()])
    return (np.repeat(side, slots.count) * 0x2545F491 + place) & 0x7FFFFFFF


def _name(snapshot: SceneSnapshot, side: int) -> tuple[str, ...]:
    """Levels above a side: prims, id of the placement, part, instance, side."""
    instance = int(side) // 2
    surface = snapshot.surfaces[snapshot.geometry.instance_surface[instance]]
    prims = surface.path.strip("/").split("/")
    return (*prims, f"#{surface.instance_id + 1:010d}", surface.part, f"{instance:010d}", str(int(side) % 2))


def instance_areas(snapshot: SceneSnapshot) -> F64:
    """World area of each instance, one side, square metres."""
    geometry = snapshot.geometry
    area = np.zeros(snapshot.n_instances, np.float64)
    kernels.instance_areas(
        geometry.points, geometry.mesh_begin, geometry.instance_mesh, geometry.instance_to_world, area
    )
    return area


def _spread(snapshot: SceneSnapshot, area: F64, slots: _Slots, count: I64, seed: int, stream: int) -> SurfacePoints:
    """Area-uniform places, slot after slot; a shared slot spreads them over its members."""
    sides, counts = [], []
    for group, wanted in zip(slots.members, count.tolist(), strict=True):
        if len(group) == 1:
            sides.append(int(group[0]))
            counts.append(wanted)
        else:
            reached = np.cumsum(area[group // 2])
            chosen = np.searchsorted(reached, (np.arange(wanted) + 0.5) / wanted * reached[-1])
            for member, number in zip(*np.unique(chosen, return_counts=True), strict=True):
                sides.append(int(group[member]))
                counts.append(int(number))
    side = np.array(sides, np.int64)
    begin = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    # By side, so that a surface's samples stay where they are when another surface comes or goes.
    slot_seed = (side * 0x2545F491 + ((seed * 0x9E3779B1 + stream * 0x85EBCA6B) & 0xFFFFFFFF)) & 0xFFFFFFFF
    triangle = np.empty(begin[-1], np.int32)
    uv = np.empty((begin[-1], 2), np.float32)
    geometry = snapshot.geometry
    kernels.spread_by_area(
        geometry.points,
        geometry.mesh_begin,
        geometry.instance_mesh,
        geometry.instance_to_world,
        area,
        (side // 2).astype(np.int32),
        begin,
        slot_seed,
        triangle,
        uv,
    )
    number = np.diff(begin)
    instance = np.repeat((side // 2).astype(np.int32), number)
    return points_on_surface(snapshot, instance, triangle, uv, np.repeat((side % 2).astype(np.uint8), number))
