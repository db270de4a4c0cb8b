"""Direct light at fixed places from lights that move: what is kept for the places, and one light at them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels.bsdf import LEAST_ALPHA
from icheat_usd.kernels.clear_light import BALL
from icheat_usd.kernels.place_columns import ALPHA, COLUMNS, RUN, SHADING, SPECULAR, copy_places
from icheat_usd.kernels.see_through import cross_layers, dim_places
from icheat_usd.kernels.shadow import PART, SHARED_PART, STRIDE, TURNED, light_places, tell_points
from icheat_usd.kernels.shaping import shape_places
from icheat_usd.lighting.clear_boxes import boxes_around
from icheat_usd.lighting.controls import darken, emission_frame, without
from icheat_usd.lighting.points import light_form, light_points
from icheat_usd.materials import is_glossy
from icheat_usd.scene import F32, I32, I64, Bool, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import build_tracer, spawn_points
from icheat_usd.tracing.embree import EmbreeTracer
from icheat_usd.tracing.paths import passing_materials

_POINT_COLUMNS = [0, 1, 2, 3, 4, 5, 9]  # of the table of a light's points: place, normal, what it brings
_CANDIDATES = 4  # points of the light that a place looks at
_FEW_CANDIDATES = 2  # where places share rays
_PIECE = 256  # runs of a look that a thread takes at a time
_NO_POINTS = np.zeros(0, np.int32)
_NO_FORM = np.zeros(0, np.float32)
_NO_BOXES = np.zeros((0, 6), np.float32)
# A point has turned if more than this share of the places that see it, now or before, met something else; what is said
# of nearly all places may be wrong of so many; and from how many rays on either is said.
_TURNED_SHARE, _ALL_BUT, _LEAST_LOOKS = 0.2, 0.03, 3
_FEW_TURNED = 1 / 64  # of the points: no more are left to rays, as they cost less than to tell and to look again
_TELLING = 8  # one of so many runs sends all rays where it is to tell the others


@dataclass(frozen=True, eq=False)
class Shadows:
    """Tracers for shadow rays that need no look at the surfaces they meet: opaque ones apart from all others."""

    opaque: EmbreeTracer
    passing: EmbreeTracer | None  #: triangles that may let light through; None: there are none
    boxes: F32  #: (n, 6) around these

    def crossing(self, snapshot: SceneSnapshot, origin: F32, direction: F32, limit: float) -> F32:
        """Share of light (n,) that crosses the see-through triangles up to `limit`; see `tracing.transmittance`."""
        out = np.ones(len(origin), np.float32)
        if self.passing is not None:
            ends = np.ascontiguousarray(origin, np.float32), np.ascontiguousarray(direction, np.float32)
            given: tuple[Any, ...] = (*self._layers(snapshot), *ends, limit, out)
            cross_layers(*given)
        return out

    def dim(
        self,
        snapshot: SceneSnapshot,
        shining: Shining,
        places: Places,
        runs: I32,
        through: I32,
        crossing: F32,
        out: F32,
    ) -> None:
        """Dim what places of some runs, ascending, get through see-through surfaces; see `see_through.dim_places`."""
        if self.passing is not None:
            light = shining.table, shining.distant
            of_places = *places.table, places.row, runs, through, crossing, out
            given: tuple[Any, ...] = (*self._layers(snapshot), *light, *of_places)
            dim_places(*given)

    def _layers(self, snapshot: SceneSnapshot) -> tuple[Any, ...]:
        """What kernels need to find the surfaces on a ray's way."""
        assert self.passing is not None
        geometry = snapshot.geometry
        surfaces = geometry.mesh_begin, geometry.instance_mesh, geometry, snapshot.materials, snapshot.textures
        return *self.passing.address_of("rtcIntersect1"), *surfaces


def build_shadows(snapshot: SceneSnapshot, tracer: EmbreeTracer, hidden: Bool | None = None) -> Shadows:
    """Tracers of the opaque and of the other triangles; `tracer` itself where all are opaque.

    Parameters
    ----------
    hidden : (n_instances,) bool, optional
        Instances that cast no shadow.
    """
    passes = passing_materials(snapshot.materials)[snapshot.geometry.material]
    if not passes.any():
        opaque = without(snapshot, tracer, hidden)
        assert isinstance(opaque, EmbreeTracer)
        return Shadows(opaque, None, _NO_BOXES)
    boxes = boxes_around(snapshot.geometry, passes, hidden)
    return Shadows(_tracer_of(snapshot, ~passes, hidden), _tracer_of(snapshot, passes, hidden), boxes)


def _tracer_of(snapshot: SceneSnapshot, kept: np.ndarray, hidden: Bool | None) -> EmbreeTracer:
    """Tracer of some triangles; the others shrink to points, which no ray meets, so that all keep their numbers."""
    points = snapshot.geometry.points.copy()
    points[~kept] = points[~kept][:, :1]
    tracer = build_tracer(replace(snapshot, geometry=snapshot.geometry._replace(points=points)), hidden=hidden)
    assert isinstance(tracer, EmbreeTracer)
    return tracer


@dataclass(frozen=True, eq=False)
class Places:
    """Surface points made ready for `direct_at`, in runs; see `kernels.shadow.light_places`."""

    row: I32  #: (n,) point of each place
    instance: I32  #: (n,) of each point
    bounds: F32  #: (n_runs, 4, 3)
    columns: F32  #: (n_columns, RUN)
    column: I32  #: (n_runs, COLUMNS), those of each run
    lobes: Bool  #: (n_runs,)

    @property
    def n(self) -> int:
        """How many there are."""
        return len(self.row)

    @property
    def n_runs(self) -> int:
        """In how many runs."""
        return len(self.column)

    @property
    def table(self) -> tuple[F32, I32]:
        """Columns, and which of them each run has."""
        return self.columns, self.column


class LastLook:
    """What was between places and a light when it was last looked at; goes with one `Places`."""

    def __init__(self, places: Places) -> None:
        self.known = np.full(places.n, -1, np.int16)
        self.crossing: F32 = np.ones(places.n, np.float32)  #: share of light, where see-through surfaces are in the way
        self.n = 0  #: looks so far
        self.told: I32 = _NO_POINTS  #: by the last `look_and_tell`

    def tell_points(self, before: NDArray[np.int16], sent: I64, n_points: int) -> I32:
        """What this look tells of the light's points (n_points,), for looks from other places; see `kernels.shadow`.

        Nothing where hardly any have turned.

        Parameters
        ----------
        before : (n,)
            What `known` was in the look before.
        sent : (n_sent,)
            Places that sent a ray, whatever others saw.
        """
        told = np.zeros(n_points, np.int32)
        tell_points(before, self.known, sent, _TURNED_SHARE, _ALL_BUT, _LEAST_LOOKS, told)
        return told if np.count_nonzero(told & TURNED) > _FEW_TURNED * n_points else _NO_POINTS

    def forget(self, runs: I64) -> None:
        """Nothing is known of the places of some runs any more."""
        for run in runs:
            self.known[run * RUN : (run + 1) * RUN] = -1


def prepare_places(
    snapshot: SceneSnapshot, points: SurfacePoints, albedo: F32, to_eye: F32 | None, order: I64 | None = None
) -> Places:
    """Gather what does not depend on lights.

    Parameters
    ----------
    albedo : (n, 3), 0 for points that reflect nothing
    to_eye : (n, 3), unit; None: diffuse reflection alone
    order : (n,), by default as the points come
    """
    place = np.concatenate([spawn_points(snapshot, points, points.normal), points.normal, points.shading_normal], 1)
    place[points.instance < 0] = 0.0
    row = np.arange(len(place), dtype=np.int32) if order is None else order.astype(np.int32)
    surface = _runs(np.concatenate([place, albedo / np.float32(np.pi)], axis=1), order)
    gloss: F32 = np.zeros((0, COLUMNS - SPECULAR, RUN), np.float32)
    lobes: Bool = np.zeros(len(surface), np.bool_)
    if to_eye is not None and is_glossy(points).any():
        gloss = _runs(_lobes(points, to_eye), order)
        lobes = np.any(gloss[:, ALPHA - SPECULAR], axis=1)
        gloss = gloss[lobes]
    columns, (of_surface, of_lobe) = _share_columns((surface, gloss))
    column = np.zeros((len(surface), COLUMNS), np.int32)
    column[:, :SPECULAR], column[lobes, SPECULAR:] = of_surface, of_lobe
    return Places(row, points.instance, _bounds(surface[:, :SHADING]), columns, column, lobes)


def diffuse_places(places: Places, which: I64) -> Places:
    """Some of the places (n,), once or several times each, in runs of their own, but without their lobes."""
    surface = _in_lines((-(-len(which) // RUN) * SPECULAR, RUN)).reshape(-1, SPECULAR, RUN)
    copy_places(*places.table, which, surface)
    column = np.zeros((len(surface), COLUMNS), np.int32)
    column[:, :SPECULAR] = np.arange(len(surface) * SPECULAR).reshape(-1, SPECULAR)
    lobes, bounds = np.zeros(len(surface), np.bool_), _bounds(surface[:, :SHADING])
    row, instance = np.arange(len(which), dtype=np.int32), places.instance[places.row[which]]
    return Places(row, instance, bounds, surface.reshape(-1, RUN), column, lobes)


def _share_columns(tables: Sequence[F32]) -> tuple[F32, list[I32]]:
    """Columns (n, RUN) of tables (n_runs, k, RUN), and the numbers (n_runs, k) that each table's columns have.

    A column of one value, as normals of a wall are, is there once for all runs: what streams through the caches in
    every frame is half as much.
    """
    every = np.concatenate([table.reshape(-1, RUN) for table in tables])
    is_even = (every == every[:, :1]).all(axis=1)
    values, shared = np.unique(every[is_even, 0], return_inverse=True)
    number = np.empty(len(every), np.int32)
    number[is_even], number[~is_even] = shared, len(values) + np.arange(np.count_nonzero(~is_even))
    columns = _in_lines((len(values) + int(np.count_nonzero(~is_even)), RUN))
    columns[: len(values)], columns[len(values) :] = values[:, None], every[~is_even]
    ends = np.cumsum([table.shape[0] * table.shape[1] for table in tables])
    parts = np.split(number, ends[:-1])
    return columns, [part.reshape(table.shape[:2]) for part, table in zip(parts, tables, strict=True)]


def _in_lines(shape: tuple[int, int]) -> F32:
    """Room for numbers that begins with a line of the cache."""
    room = np.empty(shape[0] * shape[1] + 16, np.float32)
    first = -room.ctypes.data % 64 // 4
    return room[first : first + shape[0] * shape[1]].reshape(shape)


def _bounds(runs: F32) -> F32:
    """Least and largest origin and geometric normal (n_runs, 4, 3) of the places of each run that have a normal."""
    there: Bool = np.any(runs[:, 3:6] != 0.0, axis=1)
    least = np.min(runs[:, :6], axis=2, initial=np.inf, where=there[:, None])
    largest = np.max(runs[:, :6], axis=2, initial=-np.inf, where=there[:, None])
    bounds = np.stack([least[:, :3], largest[:, :3], least[:, 3:], largest[:, 3:]], axis=1)
    bounds[~there.any(axis=1)] = 0.0
    return bounds


def _runs(table: F32, order: I64 | None) -> F32:
    """Rows (n, k) of places as a table (k, RUN) for each run of them; 0 behind the last."""
    if order is not None:
        table = table[order]
    runs = np.zeros((-(-len(table) // RUN) * RUN, table.shape[1]), np.float32)
    runs[: len(table)] = table
    return np.ascontiguousarray(runs.reshape(-1, RUN, table.shape[1]).transpose(0, 2, 1))


def _lobes(points: SurfacePoints, to_eye: F32) -> F32:
    glossy = is_glossy(points)
    alpha = np.maximum(points.roughness.astype(np.float64) ** 2, LEAST_ALPHA)
    cosine = np.maximum(np.einsum("ij,ij->i", points.shading_normal, to_eye, dtype=np.float64), 1e-4)
    square = np.minimum(cosine * cosine, 1.0)
    smith = 0.5 * (np.sqrt(1.0 + alpha * alpha * (1.0 - square) / square) - 1.0)
    scalars = np.stack([alpha * glossy, cosine, smith], axis=1)
    table = np.concatenate([points.specular, points.specular_edge, scalars, to_eye], axis=1).astype(np.float32)
    table[~glossy, :7] = 0.0
    return table


class LightGroups(NamedTuple):
    """Points of a light as successive places look at them; see `kernels.shadow.light_places`."""

    points: F32
    first: I32
    colors: F32


class Shining:
    """Points of a light, and what all looks at them need.

    Parameters
    ----------
    table, distant, form
        As `light_points` and `light_form` of `lighting.points` have them.
    """

    def __init__(self, table: F32, distant: bool, form: F32 = _NO_FORM) -> None:
        self.table, self.distant, self.form = table, distant, form
        least, largest = table[:, :6].min(axis=0), table[:, :6].max(axis=0)
        #: Least and largest place and normal of the points, (4, 3).
        self.bounds: F32 = np.stack([least[:3], largest[:3], least[3:6], largest[3:6]])
        colors = table[:, 6:9]
        self._colors = np.ascontiguousarray(colors if (colors != 1.0).any() else colors[:0])
        self._points = np.ascontiguousarray(table[:, _POINT_COLUMNS])

    def groups(self, candidates: int, turn: int) -> LightGroups:
        """Groups of so many points; successive places look at different parts of the light.

        In as many turns as there are groups a place looks at every point once.
        """
        group, first = _order_of_groups(len(self.table), candidates, turn)
        points = self._points.reshape(-1, candidates, len(_POINT_COLUMNS))[group]
        return LightGroups(np.ascontiguousarray(points.transpose(1, 2, 0)), first, self._colors)


@lru_cache(maxsize=64)
def _order_of_groups(n_points: int, candidates: int, turn: int) -> tuple[I64, I32]:
    """Which group of points successive places look at, and the first point of each."""
    n = n_points // candidates
    group = (np.arange(n + RUN) * STRIDE ^ turn) & (n - 1)
    return group, (group * candidates).astype(np.int32)


def shining_points(snapshot: SceneSnapshot, seed: int, *, by_form: bool = False) -> Shining:
    """Points of the one light of a snapshot.

    Parameters
    ----------
    by_form
        Places that have all of a ball above their horizon get what all of it brings, if the point that they look at is
        not hidden, and those that share no rays what all of a rectangle brings, if all next to them see their points:
        without the noise of points, but at borders of shadows the mean over turns is not quite the light there.
    """
    form = light_form(snapshot) if by_form else _NO_FORM
    return Shining(*light_points(snapshot, seed, opposite=_is_ball(form)), form)


def _is_ball(form: F32) -> bool:
    return len(form) > 0 and bool(form[0] == BALL)


class Look:
    """One look from places at the light of a one-light snapshot: run by run, in any order, by one thread or several.

    Parameters
    ----------
    snapshot, shadows, places, shining, seed, share_rays, out, turn, last, told
        As `direct_at` has them.
    """

    def __init__(
        self,
        snapshot: SceneSnapshot,
        shadows: Shadows,
        places: Places,
        shining: Shining,
        seed: int,
        share_rays: bool,
        out: F32,
        turn: int,
        last: LastLook | None,
        told: I32 | None,
    ) -> None:
        self._snapshot, self._shadows, self._places, self._shining, self._out = snapshot, shadows, places, shining, out
        controls = snapshot.controls(0)
        self._diffuse, self._specular = controls.diffuse, controls.specular
        self._seed, self._share_rays, self._turn = seed, share_rays, turn
        # A ball hides half of its points; what those of a rectangle bring differs little beside the noise of shadows
        # that rays are shared for.
        is_few = share_rays and not _is_ball(shining.form)
        self._form = _NO_FORM if is_few else shining.form
        self._groups = shining.groups(_FEW_CANDIDATES if is_few else _CANDIDATES, turn)
        self._through = np.empty(0 if shadows.passing is None else places.n, np.int32)
        self._phase, self._known = -1, np.full(0 if controls.shaping is None else places.n, -1, np.int16)
        self._crossing = np.empty(len(self._through), np.float32) if last is None else last.crossing
        self.told = _NO_POINTS if told is None else told  #: of the light's points, for what is looked at from now on
        if last is not None:
            self._known = last.known
            self._phase = last.n % SHARED_PART if last.n else -1
            last.n += 1

    def pieces(self) -> list[Callable[[], None]]:
        """All runs, some at a time."""
        every = np.arange(self._places.n_runs, dtype=np.int32)
        return [partial(self.light, every[first : first + _PIECE]) for first in range(0, len(every), _PIECE)]

    def light(self, runs: I32, every_ray: bool = False) -> None:
        """Find what the places of some runs (n_runs,) reflect, but for what dims it in `finish`.

        With `every_ray`, whatever is known of them.
        """
        shadows, places, groups = self._shadows, self._places, self._groups
        function, opaque = shadows.opaque.address_of("rtcOccluded16")
        passing = 0 if shadows.passing is None else shadows.passing.address_of("rtcOccluded16")[1]
        # Rays of all places that lie together are alike; a part of them, or of places that share none, is not.
        are_alike = self._share_rays and (every_ray or self._phase < 0)
        light_places(
            function,
            shadows.opaque.compiled().arguments if are_alike else 0,
            opaque,
            passing,
            shadows.boxes,
            groups.points,
            groups.first,
            groups.colors,
            self._form,
            self._shining.bounds,
            self._shining.distant,
            self._seed,
            self._turn,
            places.bounds,
            *places.table,
            places.lobes,
            np.float32(self._diffuse),
            np.float32(self._specular),
            self._share_rays,
            -1 if every_ray else self._phase,
            self._known,
            self.told,
            places.row,
            runs,
            self._out,
            self._through,
        )
        shadows.dim(self._snapshot, self._shining, places, runs, self._through, self._crossing, self._out)

    def finish(self) -> None:
        """Dim all that is lit: the light's shaping, and surfaces that it does not light. Every run is lit before."""
        snapshot, places, out = self._snapshot, self._places, self._out
        table, distant = self._shining.table, self._shining.distant
        shaping = snapshot.controls(0).shaping
        if shaping is not None:
            # The choice among points was made without it, which the mean over choices does not notice.
            frame = emission_frame(snapshot, 0)
            shape_places(shaping, *frame, table, distant, *places.table, self._known, places.row, out)
        darken(snapshot, 0, places.instance, out)


def look_and_tell(
    snapshot: SceneSnapshot,
    shadows: Shadows,
    places: Places,
    seed: int,
    out: F32,
    last: LastLook,
    shining: Shining,
) -> I32:
    """`direct_at` for places that tell others of the points of a light that moves.

    Where points have turned in the look before, some runs send all rays, and tell the others first. Where they turn
    for the first time, all look again, so that the next look knows what was there in this one.

    Returns
    -------
    (n_points,) int32
        See `kernels.shadow.tell_points`; empty where hardly any point has turned.
    """
    before, n_points, every = last.known.copy(), len(shining.table), np.arange(places.n_runs, dtype=np.int32)
    look = Look(snapshot, shadows, places, shining, seed, False, out, 0, last, None)
    if len(last.told):
        telling = every[::_TELLING].copy()  # for an array with gaps all would be compiled once more
        look.light(telling, every_ray=True)
        sent = (telling[:, None].astype(np.int64) * RUN + np.arange(RUN)).ravel()
        look.told = last.told = last.tell_points(before, sent[sent < places.n], n_points)
        look.light(every[every % _TELLING != 0])
    else:
        look.light(every)
        sent = np.arange((last.n - 1) % PART, places.n, PART)
        look.told = last.told = last.tell_points(before, sent, n_points)
        if len(last.told):
            last.known[:] = before
            look.light(every)
    look.finish()
    return last.told


def direct_at(
    snapshot: SceneSnapshot,
    shadows: Shadows,
    places: Places,
    seed: int,
    share_rays: bool,
    out: F32,
    turn: int = 0,
    last: LastLook | None = None,
    shining: Shining | None = None,
    runs: I32 | None = None,
    told: I32 | None = None,
) -> None:
    """Light of a one-light snapshot that places reflect, one shadow ray each, into `out` (n, 3) in the points' order.

    The mean over turns 0, 1, 2, ... converges: every turn looks at other points of the light.
    Kinds with a surface of their own and distant lights only. Surfaces that let light through dim it as for all
    shadow rays.

    Parameters
    ----------
    shadows
        Without what does not block the light; see `lighting.controls.hidden_instances`.
    last : LastLook, optional
        Of the same light and turn somewhere near: most places take their shadow from it. It is brought up to date.
    shining : Shining, optional
        What `shining_points` has for the snapshot and the seed, if that is known.
    runs : (n_runs,), optional
        Runs of places that are meant, by default all; what others have in `out` means nothing then.
    told : (n_points,), optional
        What `look_and_tell` found at other places, of points that `last` knows as they were before.
    """
    shining = shining or shining_points(snapshot, seed)
    look = Look(snapshot, shadows, places, shining, seed, share_rays, out, turn, last, told)
    look.light(np.arange(places.n_runs, dtype=np.int32) if runs is None else runs)
    look.finish()
