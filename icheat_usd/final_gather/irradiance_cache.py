"""An irradiance cache: records placed coarse to fine before anything is shown, then read by every camera sample.

Ward, Rubinstein, Clear 1988, A Ray Tracing Solution for Diffuse Interreflection; gradients, reach and neighbour
clamping as in `kernels.irradiance_cache`. Records do not depend on edits, nor on threads: a round finds the places
that no record reaches, traces all of them at once, and adds them in their order.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from icheat_usd.final_gather.record_rays import HemisphereTracer, RecordRays, concatenate_rays, without_hits
from icheat_usd.kernels import irradiance_cache as kernels
from icheat_usd.kernels import record_sums
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import F32, I32, I64, Bool, SurfacePoints

_COARSEST = 32  # pixels between the first places that are looked at
_USUAL_REACH = 10.0  # pixels
_RAYS_AT_ONCE = 1 << 19
_CREASE = 0.05  # pixels from the next surface, below which a record counts for little, so that better ones are made
_LEAST_TRUST = 1e-3
_NEXT_HEMISPHERE = 1 << 27  # between the streams of a record's hemispheres, see `kernels.record_rays`


@dataclass(frozen=True)
class CacheSettings:
    """How densely records are placed, and how well each is measured.

    Raises
    ------
    ValueError
        A value makes no sense.
    """

    n_theta: int = 12  #: rings of a hemisphere of rays; 3 times as many sectors
    #: Relative standard error that one hemisphere leaves in a record that reaches 10 pixels, from which it gets more
    #: of them: in proportion to the error, and to the reach.
    noise: float = 0.0125
    most_hemispheres: int = 32
    accuracy: float = 0.35  #: reach of a record, in harmonic mean distances of the surfaces around
    clearance: float = 1.0  #: and no more of the distance of the nearest one
    least_reach: float = 2.5  #: pixels
    #: Pixels. What a record says of places farther off is up to a tenth wrong where light falls on surfaces at grazing
    #: angles, and wide blots show once records are not noisy; with more noise than the usual, 24 is better.
    most_reach: float = 12.0
    most_turn: float = 20.0  #: degrees between normals
    tolerance: float = 0.1  #: relative error of a record's own prediction at another, from which it ends before that
    coverage: float = 0.5  #: sum of weights at a place, 1 at a record itself, from which it needs no record of its own
    #: Paths from each patch that is nearer than cells resolve, 0 for none. They take up to a quarter more time where
    #: light is uneven, and little elsewhere; a room with sun on its windows had twice the error without.
    near_paths: int = 4

    def __post_init__(self) -> None:
        if self.near_paths < 0:
            raise ValueError(f"near_paths is a number of paths, not {self.near_paths}")
        if self.n_theta < 4 or self.n_theta % 4:
            raise ValueError(f"n_theta is a multiple of 4, not {self.n_theta}")
        if not 0 < self.least_reach <= self.most_reach:
            raise ValueError(f"least_reach {self.least_reach} must be positive and at most most_reach")

    @property
    def n_phi(self) -> int:
        return 3 * self.n_theta


class Lookup(NamedTuple):
    """Records of m places."""

    number: I32  #: (m,) how many there are
    record: I32  #: (m, MAX_ENTRIES)
    weight: F32  #: (m, MAX_ENTRIES) add up to 1
    coverage: F32  #: (m,)

    def take(self, which: I64) -> Lookup:
        """Those of some places."""
        return Lookup(self.number[which], self.record[which], self.weight[which], self.coverage[which])


class RecordValues(NamedTuple):
    """Irradiance of records in C channels, and how it changes."""

    irradiance: F32  #: (n, C)
    by_turn: F32  #: (n, C, 3)
    by_move: F32  #: (n, C, 3) per metre


class Places(NamedTuple):
    """Where irradiance is wanted."""

    points: SurfacePoints  #: (m,)
    extent: F32  #: (m,) metres that a pixel spans there
    near: F32  #: (m,) metres to the nearest surface that a few rays have met, inf where they met none

    def take(self, which: I64) -> Places:
        """Some of them."""
        return Places(take_points(self.points, which), self.extent[which], self.near[which])

    def limit(self, settings: CacheSettings) -> F32:
        """(m,) metres beyond which no record is asked: in a narrow gap those outside of it know nothing."""
        return np.maximum(self.near, settings.least_reach * self.extent).astype(np.float32)


class Placed(NamedTuple):
    """Where n records were asked for, in the order of the cache."""

    pixel: I64  #: (n,) row-major
    extent: F32  #: (n,) metres that a pixel spans there
    spacing: I64  #: (n,) pixels between the places of the round that asked


def join_places(parts: list[Places]) -> Places:
    """All of them, one after another."""
    return Places(
        concatenate_points(*(part.points for part in parts)),
        np.concatenate([part.extent for part in parts]),
        np.concatenate([part.near for part in parts]),
    )


@dataclass(eq=False)
class IrradianceCache:
    """Records, and the light of each.

    Parameters
    ----------
    cells : (n_cells + 1, C) float32
        Radiance that gather cells send; the last row is zero.
    """

    tracer: HemisphereTracer
    cells: F32
    settings: CacheSettings
    is_kept: bool = False  #: whether rays are kept, so that edits can look at them
    keeps_hits: bool = True  #: and where on their surfaces they end, so that edits can look at painted casters
    table: kernels.RecordTable = field(init=False)
    values: RecordValues = field(init=False)
    shrink: F32 = field(default_factory=lambda: np.empty(0, np.float32))  #: (n,) what `by_move` was multiplied with
    _points: list[SurfacePoints] = field(default_factory=list)
    _rays: list[RecordRays] = field(default_factory=list)
    _owner: list[I64] = field(default_factory=list)
    _least: F32 = field(init=False)
    _index: kernels.RecordHash | None = None

    def __post_init__(self) -> None:
        n = self.cells.shape[1]
        none = np.empty((0, 3), np.float32)
        self.table = kernels.RecordTable(none, none.copy(), *(np.empty(0, np.float32) for _ in range(3)))
        gradients = np.empty((0, n, 3), np.float32)
        self.values = RecordValues(np.empty((0, n), np.float32), gradients, gradients.copy())
        self._least = np.empty(0, np.float32)

    @property
    def n(self) -> int:
        return len(self.table.reach)

    @property
    def rays(self) -> RecordRays:
        """Hemispheres of all records, one or more of each: see `owner`.

        Raises
        ------
        ValueError
            They were not kept.
        """
        if not self._rays:
            raise ValueError("the cache has no rays: make it with is_kept=True")
        if len(self._rays) > 1:
            self._rays = [concatenate_rays(self._rays)]
        return self._rays[0]

    @property
    def parts(self) -> list[tuple[RecordRays, SurfacePoints, I64]]:
        """Hemispheres as they were traced, where they stand, and the record that each belongs to; none if not kept."""
        if len({len(self._rays), len(self._points), len(self._owner)}) > 1:  # Someone wanted them joined.
            return [(self.rays, self.points, self.owner)]
        return list(zip(self._rays, self._points, self._owner, strict=True))

    @property
    def owner(self) -> I64:
        """(n_hemispheres,) the record that each of `rays` belongs to."""
        if len(self._owner) > 1:
            self._owner = [np.concatenate(self._owner)]
        return self._owner[0]

    @property
    def points(self) -> SurfacePoints:
        """(n_hemispheres,) where they stand."""
        if len(self._points) > 1:
            self._points = [concatenate_points(*self._points)]
        return self._points[0]

    def find(self, places: Places) -> Lookup:
        """Records that reach some places."""
        position, normal = places.points.position, places.points.shading_normal
        m = len(position)
        found = Lookup(
            np.zeros(m, np.int32),
            np.zeros((m, kernels.MAX_ENTRIES), np.int32),
            np.zeros((m, kernels.MAX_ENTRIES), np.float32),
            np.zeros(m, np.float32),
        )
        if self.n:
            limit = places.limit(self.settings)
            kernels.find_records(self._hash(), position, normal, limit, *found)
        return found

    def covers(self, places: Places) -> Bool:
        """(m,) whether records reach some places so well that these need none of their own."""
        out = np.zeros(len(places.extent), np.uint8)
        if self.n:
            position, normal = places.points.position, places.points.shading_normal
            wanted = np.float32(self.settings.coverage)
            kernels.find_covered(self._hash(), position, normal, places.limit(self.settings), wanted, out)
        return out != 0

    def interpolate(
        self, found: Lookup, position: F32, normal: F32, values: RecordValues | None = None, slot: I32 | None = None
    ) -> F32:
        """Irradiance at places, (m, C); of other values than the unedited ones where `values` and `slot` are given."""
        values = self.values if values is None else values
        out = np.empty((len(position), values.irradiance.shape[1]), np.float32)
        slot = np.arange(self.n, dtype=np.int32) if slot is None else slot
        kernels.interpolate(self.table.position, self.table.normal, *values, slot, position, normal, *found[:3], out)
        return out

    def sums(self, rays: RecordRays, radiance: F32) -> tuple[RecordValues, F32]:
        """Irradiance and gradients when rays bring `radiance` (n, n_rays, C), and the spread of distances."""
        n, _, channels = radiance.shape
        values = RecordValues(
            np.empty((n, channels), np.float32),
            np.empty((n, channels, 3), np.float32),
            np.empty((n, channels, 3), np.float32),
        )
        spread = np.empty((n, 3), np.float32)
        record_sums.record_sums(
            radiance,
            rays.distance,
            rays.shading_normal,
            rays.stream,
            rays.seed,
            rays.n_theta,
            rays.n_phi,
            *values,
            spread,
        )
        return values, spread

    def add(self, places: Places) -> None:
        """New records at all of these places."""
        at_once, first = self._hemispheres_at_once(), self.n
        tables, values = [], []
        for begin in range(0, len(places.extent), at_once):
            some = np.arange(begin, min(begin + at_once, len(places.extent)))
            points = take_points(places.points, some)
            found, spread = self._measure(points, places.extent[some], first + some)
            tables.append(self._reaches(points, places.extent[some], found, spread))
            values.append(found)
        self._judge(places, RecordValues(*(np.concatenate(column) for column in zip(*values, strict=True))))
        parts = [self.table, *(table for table, _ in tables)]
        self.table = kernels.RecordTable(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
        self._least = np.concatenate([self._least, *(least for _, least in tables)])
        order = np.argsort(self.table.position[:, 0], kind="stable")
        clamped = np.empty(self.n, np.float32)
        kernels.clamp_to_neighbours(
            np.take(self.table.position, order, axis=0),
            self.table.reach[order],
            (order < first).astype(np.uint8),
            clamped,
        )
        self.table.reach[order] = np.maximum(clamped, self._least[order])
        self.values = RecordValues(
            *(np.concatenate([old, *new]) for old, new in zip(self.values, zip(*values, strict=True), strict=True))
        )
        self._index = None

    def _measure(self, points: SurfacePoints, extent: F32, record: I64) -> tuple[RecordValues, F32]:
        """Values of new records and the spread of their distances, from as many hemispheres as their noise asks for.

        The error of a picture, the sum of ``area * noise^2 / number`` over records, is least for the rays that are
        traced in all where numbers go with the noise of one hemisphere and with the root of the area.
        """
        settings = self.settings
        rays = self.tracer.trace(points, record)
        values, spread = self.sums(rays, rays.radiance(self.cells))
        self._keep(rays, points, record)
        reach = np.clip(self._geometric(spread) / extent, settings.least_reach, settings.most_reach).astype(np.float64)
        wanted = np.rint(spread[:, 2] / settings.noise * (reach / _USUAL_REACH))
        number = np.clip(wanted, 1, settings.most_hemispheres).astype(np.int64)
        closeness = 1 / spread[:, 0].astype(np.float64)
        # All that follow the first, those of one record next to each other: a call takes as long as many rays.
        for rows in _in_pieces(number - 1, self._hemispheres_at_once()):
            more = number[rows] - 1
            first = np.cumsum(more) - more
            row, further = np.repeat(rows, more), np.arange(1, more.sum() + 1) - np.repeat(first, more)
            some = take_points(points, row)
            rays = self.tracer.trace(some, record[row] + further * _NEXT_HEMISPHERE)
            found, other = self.sums(rays, rays.radiance(self.cells))
            for column, new in zip(values, found, strict=True):
                column[rows] += np.add.reduceat(new, first)
            closeness[rows] += np.add.reduceat(1 / other[:, 0].astype(np.float64), first)
            spread[rows, 1] = np.minimum(spread[rows, 1], np.minimum.reduceat(other[:, 1], first))
            self._keep(rays, some, record[row])
        share = (1 / number).astype(np.float32)
        for column in values:
            column *= share.reshape(-1, *(1,) * (column.ndim - 1))
        with np.errstate(divide="ignore"):
            spread[:, 0] = number / closeness
        return values, spread

    def _hemispheres_at_once(self) -> int:
        return max(1, _RAYS_AT_ONCE // (self.settings.n_theta * self.settings.n_phi))

    def _keep(self, rays: RecordRays, points: SurfacePoints, record: I64) -> None:
        if self.is_kept:
            self._rays.append(rays if self.keeps_hits else without_hits(rays))
            self._points.append(points)
            self._owner.append(record)

    def _reaches(
        self, points: SurfacePoints, extent: F32, values: RecordValues, spread: F32
    ) -> tuple[kernels.RecordTable, F32]:
        settings = self.settings
        least = settings.least_reach * extent
        reach = self._geometric(spread)
        # Where light changes faster than surfaces tell.
        change = np.sqrt((values.by_move.astype(np.float64) ** 2).sum(axis=(1, 2)))
        size = np.sqrt((values.irradiance.astype(np.float64) ** 2).sum(axis=1))
        limit = np.divide(size, change, out=np.full(len(size), np.inf), where=change > 0)
        wide = np.minimum(reach, 0.5 * limit)
        wide = np.clip(wide, least, settings.most_reach * extent).astype(np.float32)
        # A gradient that holds for `reach` says nothing further out.
        shrink = np.minimum(1.0, np.maximum(reach, 1e-30) / wide).astype(np.float32)
        values.by_move[...] *= shrink[:, None, None]
        self.shrink = np.concatenate([self.shrink, shrink])
        turn = np.full(len(extent), 1.0 - np.cos(np.radians(settings.most_turn)), np.float32)
        trust = np.clip(spread[:, 1] / (_CREASE * extent), _LEAST_TRUST, 1.0).astype(np.float32)
        table = kernels.RecordTable(
            np.ascontiguousarray(points.position), np.ascontiguousarray(points.shading_normal), wide, turn, trust
        )
        return table, least.astype(np.float32)

    def _geometric(self, spread: F32) -> F32:
        """Reach of records by the surfaces around, (n,) metres."""
        return np.minimum(self.settings.accuracy * spread[:, 0], self.settings.clearance * spread[:, 1])

    def _judge(self, places: Places, fresh: RecordValues) -> None:
        """Old records end before new ones that they predict badly."""
        if self.n == 0:
            return
        found = self.find(places)
        joined = RecordValues(*(np.concatenate(pair) for pair in zip(self.values, fresh, strict=True)))
        place = [np.concatenate([self.table.position, places.points.position])]
        place.append(np.concatenate([self.table.normal, places.points.shading_normal]))
        table = self.table._replace(position=place[0], normal=place[1])
        wrong = np.zeros((len(found.number), kernels.MAX_ENTRIES), np.float32)
        floor = 0.02 * float(self.values.irradiance.sum(axis=1).mean())
        kernels.differences(table, *joined, self.n, found.number, found.record, floor, wrong)
        new, entry = np.nonzero(wrong > self.settings.tolerance)
        old = found.record[new, entry]
        distance = np.linalg.norm(places.points.position[new] - self.table.position[old], axis=1).astype(np.float32)
        np.minimum.at(self.table.reach, old, np.maximum(distance, self._least[old]))

    def _hash(self) -> kernels.RecordHash:
        if self._index is None:
            reach = self.table.reach
            level = np.ceil(np.log2(np.maximum(2.0 * reach.astype(np.float64), 1e-12))).astype(np.int64)
            key, record = np.empty(8 * self.n, np.int64), np.empty(8 * self.n, np.int32)
            n = kernels.list_keys(self.table.position, reach, level, key, record)
            order = np.argsort(key[:n], kind="stable")
            size = 1 << int(np.ceil(np.log2(2 * n + 1)))
            slot = np.full((size, 3), -1, np.int64)
            kernels.fill_hash(key[order], slot)
            row = np.zeros((self.n, kernels.ROW), np.float32)
            np.concatenate([c.reshape(self.n, -1) for c in self.table], axis=1, out=row[:, :9])
            self._index = kernels.RecordHash(np.unique(level), slot, record[order], row)
        return self._index


def _in_pieces(number: I64, most: int) -> list[I64]:
    """Rows with numbers above 0, in pieces whose numbers add up to about `most`."""
    rows = np.flatnonzero(number)
    piece = (np.cumsum(number[rows]) - 1) // most
    return [part for part in np.split(rows, np.flatnonzero(np.diff(piece)) + 1) if len(part)]


def overture(cache: IrradianceCache, places: Places, pixel: I32, width: int, progress: Progress = silent) -> Placed:
    """Place records so that all places are covered: on a grid of pixels, then ever finer ones between.

    Parameters
    ----------
    places : of m view samples
    pixel : (m,)
        Their pixels, row-major in an image `width` wide.
    """
    asked, spacing = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    x, y = pixel % width, pixel // width
    waiting = np.ones(len(pixel), bool)
    step = _COARSEST
    rounds = [(step, 0)]
    while step > 1:
        rounds += [(step, step // 2), (step // 2, 0)]
        step //= 2
    for number, (step, shift) in enumerate(rounds):
        progress("place records", number / len(rounds))
        due = np.flatnonzero(waiting & (x % step == shift) & (y % step == shift))
        waiting[due] = False
        asked.append(fill(cache, places, due))
        spacing.append(np.full(len(asked[-1]), step, np.int64))
    progress("place records", 1.0)
    which = np.concatenate(asked)
    return Placed(pixel[which].astype(np.int64), places.extent[which], np.concatenate(spacing))


def fill(cache: IrradianceCache, places: Places, due: I64) -> I64:
    """Records for those of some places that are not covered, which are returned."""
    if len(due) == 0:
        return due
    some = places.take(due)
    new = np.flatnonzero(~cache.covers(some))
    if len(new):
        cache.add(some.take(new))
    return due[new]
