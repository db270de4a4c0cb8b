"""The work on one light of a view: a first look at once, then step by step up to its final quality."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels.random import hash_combine
from icheat_usd.kernels.rows import mean_over_segments
from icheat_usd.kernels.workers import beside
from icheat_usd.lighting import (
    build_light_sampler,
    irradiance,
    prepare_light_sampler,
    reflected_direct,
    samples_per_light,
)
from icheat_usd.lighting.controls import darken, hidden_instances, receives, tracer_for
from icheat_usd.lighting.domes import BinnedSky, SeenSky, see_sky, white_sky
from icheat_usd.lighting.guide import LITTLE
from icheat_usd.lighting.points import has_points
from icheat_usd.lighting.quick import (
    LastLook,
    Look,
    Places,
    Shadows,
    Shining,
    build_shadows,
    direct_at,
    look_and_tell,
    prepare_places,
    shining_points,
)
from icheat_usd.lighting.sampler import LightSampler
from icheat_usd.materials import effective_albedo, is_glossy, take_points
from icheat_usd.relight.closer_look import N_BESIDE, CloserLook, runs_beside
from icheat_usd.relight.grain import Grain, order_of_tiles
from icheat_usd.relight.known_noise import KnownNoise
from icheat_usd.relight.view_light import ROUNDS, ROUNDS_AT_GRAIN, look_in_rounds
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I32, I64, Bool, LightKind, SceneSnapshot
from icheat_usd.steps import Steps
from icheat_usd.tracing import Tracer
from icheat_usd.tracing.embree import EmbreeTracer
from icheat_usd.transport import Bounces
from icheat_usd.transport.bounces import bounce_by_bounce
from icheat_usd.transport.quick_bounces import PARTS, QuickBounces, build_quick_bounces, suit_to_light
from icheat_usd.transport.sparse import SparseRows

# Smoother lobes are found by rays of their own at rest: points of the light miss them.
_SMOOTH = 0.3

_RAYS_PER_STEP = 1 << 16  # of the general way

# Cells next to a light have most of its light and of its noise: they get up to so many times the rounds, if that is no
# more rays in all than this.
_MORE_NEAR, _RAYS_NEAR = 4, 1 << 20

# Places nearer to a light than so many of its extents are lit by what samples solid angles: of points spread evenly
# over a light, those next to a place are too few and too bright.
_NEAR = 1.0

# So many times the rounds at grainy view samples: those at borders of shadows.
_MORE = 4

# Rounds from which on a light is known well enough to tell what is noise in a look at it.
_KNOWN_ROUNDS = 4

# Noise of runs of cells and of view samples, beside their light, below which it is left: of what moves less is seen.
_LEAST_AT_CELLS, _LEAST_AT_VIEW = 0.01, 0.03

# Rays to the sky of each patch point and view sample, for domes on the move.
_SKY_OF_CELLS, _SKY_OF_VIEW = 16, 8

# The same where the view is sparse, of few cells and few samples.
_SKY_OF_FEW_CELLS, _SKY_OF_FEW = 6, 48


class SparseView(NamedTuple):
    """View samples from which the sky is looked at, where all would take too long; the others follow from them."""

    samples: I32  #: (n,)
    interpolation: SparseRows  #: (n_view x n)


@dataclass(eq=False)
class Surroundings:
    """What every light of a view shines on; made once, but that `bounces` may be taken from more rays later.

    Quick bounces are suited to other light when lights rest.
    """

    snapshot: SceneSnapshot
    tracer: Tracer
    view: ViewSamples
    gather: GatherSamples
    bounces: Bounces
    n_bounces: int
    patch_tint: F32  #: (n_patches, 3) effective albedo over pi
    quick_bounces: QuickBounces | None  #: None for a single bounce
    shadows: Shadows | None  #: None: the tracer can't be called from compiled loops
    cells: Places | None  #: one patch point of each cell
    patches: Places | None
    beside: I64  #: runs of patches next to each, `closer_look.runs_beside`
    tiles: Places | None  #: view samples in the order of tiles of 8 x 8 pixels
    smooth: I64  #: view samples with narrow lobes

    seed: int
    sparse: SparseView | None = None
    influence: F32 | None = None  #: (n_gather,) of the cells on the view, `transport.influence`, once that is known
    #: Of cells and view, once a dome asks for them; by what the domes' controls say.
    _skies: dict[tuple[bytes, bytes], list[SeenSky]] = field(default_factory=dict)
    _others: dict[bytes, Shadows] = field(default_factory=dict)  #: without what does not block some lights

    def shadows_of(self, alone: SceneSnapshot) -> Shadows:
        """For shadow rays to the light of a one-light snapshot; lights that are blocked alike share them."""
        assert self.shadows is not None and isinstance(self.tracer, EmbreeTracer)
        hidden = hidden_instances(alone, 0)
        if hidden is None:
            return self.shadows
        key = hidden.tobytes()
        if key not in self._others:
            self._others[key] = build_shadows(self.snapshot, self.tracer, hidden)
        return self._others[key]

    def sky(self, alone: SceneSnapshot) -> list[SeenSky]:
        """What the cells and the view samples see of the sky of a dome; found when first needed, which takes seconds.

        Domes with the same blockers and receivers share it.
        """
        hidden, receivers = hidden_instances(alone, 0), alone.controls(0).receivers
        key = (b"" if hidden is None else hidden.tobytes(), b"" if receivers is None else receivers.tobytes())
        if key not in self._skies:
            self._skies[key] = self._see_sky(alone)
        return self._skies[key]

    def _see_sky(self, alone: SceneSnapshot) -> list[SeenSky]:
        gather, view = self.gather, self.view
        effort = None if self.sparse is None else LITTLE
        tracer = tracer_for(alone, self.tracer, 0)
        even, sampler = white_sky(self.snapshot, tracer, gather.patch_points, self.seed, effort)
        n_of_cells = _SKY_OF_CELLS if self.sparse is None else _SKY_OF_FEW_CELLS
        ways = (even, sampler, self.shadows_of(alone))
        tint = self.cell_means(self.patch_tint)
        lit = receives(alone, 0, gather.patch_points.instance)
        patches, begin = gather.patch_points, gather.cell_begin
        of_cells = see_sky(*ways, patches, tint, None, n_of_cells, self.seed, begin, lit)
        if self.sparse is None:
            view_tint = view.points.albedo / np.float32(np.pi)
            return [of_cells, see_sky(*ways, view.points, view_tint, view.to_eye, _SKY_OF_VIEW, self.seed + 1)]
        few = take_points(view.points, self.sparse.samples.astype(np.int64))
        white = np.full((len(few.instance), 3), 1.0 / np.pi, np.float32)
        return [of_cells, see_sky(*ways, few, white, None, _SKY_OF_FEW, self.seed + 1)]

    def light_view(self, alone: SceneSnapshot, sky: F32, out: F32) -> None:
        """What the view samples reflect of a dome's binned sky; diffusely, if it is looked at from few of them."""
        of_view, controls = self.sky(alone)[1], alone.controls(0)
        if self.sparse is None:
            of_view.light(sky, out, controls)
        else:
            few = np.empty((len(self.sparse.samples), 3), np.float32)
            of_view.light(sky, few, controls)
            np.multiply(self.sparse.interpolation.matmul(few), self.view.points.albedo, out=out)
        darken(alone, 0, self.view.points.instance, out)

    def can_move(self, alone: SceneSnapshot) -> bool:
        """Whether the light of a one-light snapshot has the quick way."""
        return self.shadows is not None and has_points(int(alone.lights.kind[0]))

    def bounce(self, direct: F32, radiance: F32, before: F32 | None, part: tuple[int, int] = (0, 1)) -> None:
        """Bring light that leaves the cells up to date with their direct light, quickly.

        Parameters
        ----------
        radiance : (n_gather, 3)
            Changed. The closer to what it becomes, the better.
        before : (n_gather, 3) or None
            Direct light of which it came.
        part : (int, int)
            See `QuickBounces.follow`.
        """
        if self.quick_bounces is None:
            radiance[:] = direct
        elif before is None:
            self.quick_bounces.solve(direct, radiance)
        else:
            self.quick_bounces.follow(radiance, before, direct, radiance, part)

    def suit_bounces(self, importance: F32) -> Steps[None]:
        """Thin the rows of quick bounces anew, for light like `importance` (n_gather,)."""
        if self.quick_bounces is not None:
            suiting = suit_to_light(self.quick_bounces, self.bounces, self.n_bounces, importance)
            self.quick_bounces = yield from suiting

    def lit_cells(self, alone: SceneSnapshot, sampler: LightSampler, cells: I64, seed: int, n: int) -> F32:
        """What some cells (m,) reflect of the light of a one-light snapshot, `n` shadow rays a patch point: (m, 3)."""
        patches, ends = self.gather.patches_of(cells)
        points = take_points(self.gather.patch_points, patches)
        arriving = irradiance(alone, self.tracer, sampler, points, seed, n)[0]
        means = np.empty((len(cells), 3), np.float32)
        mean_over_segments(ends, arriving * self.patch_tint[patches], means)
        return means

    def lit_view(self, alone: SceneSnapshot, sampler: LightSampler, samples: I64, seed: int, n: int) -> F32:
        """The same for some view samples (m,): (m, 3)."""
        points = take_points(self.view.points, samples)
        return reflected_direct(alone, self.tracer, sampler, points, self.view.to_eye[samples], seed, n)[0]

    def cell_means(self, of_patches: F32) -> F32:
        """Means over the patch points of each cell."""
        out = np.empty((self.gather.n, 3), np.float32)
        mean_over_segments(self.gather.cell_begin, of_patches, out)
        return out


def build_surroundings(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    gather: GatherSamples,
    bounces: Bounces,
    n_bounces: int,
    seed: int,
    sparse: SparseView | None = None,
) -> Surroundings:
    """Prepare the places where lights shine."""
    albedo = effective_albedo(gather.patch_points)
    shadows = cells = patches = tiles = None
    beside = np.empty((0, N_BESIDE), np.int64)
    if isinstance(tracer, EmbreeTracer):
        shadows = build_shadows(snapshot, tracer)
        patches = prepare_places(snapshot, gather.patch_points, albedo, None)
        beside = runs_beside(gather.patch_points.position)
        count = np.diff(gather.cell_begin)
        chosen = np.random.default_rng(seed).integers(0, count) + gather.cell_begin[:-1]
        cells = prepare_places(snapshot, take_points(gather.patch_points, chosen), albedo[chosen], None)
        tiles = prepare_places(snapshot, view.points, view.points.albedo, view.to_eye, order_of_tiles(view))
    return Surroundings(
        snapshot,
        tracer,
        view,
        gather,
        bounces,
        n_bounces,
        albedo / np.float32(np.pi),
        build_quick_bounces(bounces, gather.tree, n_bounces) if n_bounces > 1 else None,
        shadows,
        cells,
        patches,
        beside,
        tiles,
        np.flatnonzero(is_glossy(view.points) & (view.points.roughness < _SMOOTH)),
        seed,
        sparse,
    )


def _is_near(position: F32, shining: Shining) -> Bool:
    """Which places (n, 3) are near a light of these points."""
    if shining.distant:
        return np.zeros(len(position), np.bool_)
    low, high = shining.bounds[:2]
    gap = np.maximum(np.maximum(low - position, position - high), 0)
    near: Bool = np.linalg.norm(gap, axis=1) < _NEAR * np.linalg.norm(high - low)
    return near


class ExactBounces:
    """The bounces of one light as `solve_bounces` has them, one per step."""

    def __init__(self, around: Surroundings, direct: F32) -> None:
        self._bounces: Iterator[F32] | None = bounce_by_bounce(around.bounces, direct, around.n_bounces)
        self._radiance = direct

    def step(self, radiance: F32) -> bool:
        """Another bounce; False once all are done, and in `radiance`."""
        if self._bounces is not None:
            found = next(self._bounces, None)
            if found is not None:
                self._radiance = found
                return True
            radiance[:] = self._radiance
            self._bounces = None
        return False


class KnownLight:
    """A light at rest whose bounces alone are solved anew."""

    is_known = True

    def __init__(self, around: Surroundings, direct: F32) -> None:
        self._around, self.direct = around, direct
        self._exact = ExactBounces(around, direct)

    def step(self, radiance: F32, view_direct: F32) -> bool:
        """Another bounce; False once all are done."""
        return self._exact.step(radiance)

    def restart_bounces(self) -> None:
        """Bounces are to be solved with other rows."""
        self._exact = ExactBounces(self._around, self.direct)


class Following:
    """What is kept of a light from one first look to the next, while it moves."""

    def __init__(self, around: Surroundings) -> None:
        self.n = 0  #: first looks so far
        self._noise: tuple[KnownNoise, KnownNoise] | None = None  # of first looks at cells and at view samples
        self.cells = None if around.cells is None else LastLook(around.cells)
        self.view = None if around.tiles is None else LastLook(around.tiles)
        self.patches = None if around.patches is None else CloserLook(around.patches, around.gather, around.beside)

    def next_part(self) -> tuple[int, int]:
        """Of the cells, whose bounces are looked at this time; all of them at first."""
        self.n += 1
        return (0, 1) if self.n == 1 else (self.n % PARTS, PARTS)

    def know(self, around: Surroundings, alone: SceneSnapshot, look: tuple[F32, F32], known: tuple[F32, F32]) -> None:
        """Take from later first looks what is noise in one, at cells and at view samples, by what is known there.

        `alone` is the light as it was then.
        """
        assert around.tiles is not None
        # Smoothed, a sun's patch would leave ghosts of its borders where these were.
        smooths = int(alone.lights.kind[0]) != LightKind.DISTANT
        every = np.arange(around.gather.n, dtype=np.int32)
        self._noise = (
            KnownNoise(every, look[0], known[0], least=_LEAST_AT_CELLS, smooths=False),
            KnownNoise(around.tiles.row, look[1], known[1], least=_LEAST_AT_VIEW, smooths=smooths),
        )
        if self.patches is not None:
            self.patches.know(known[0])

    def clean_cells(self, direct: F32) -> None:
        """Take known noise from a first look at the cells."""
        if self._noise is not None:
            self._noise[0].take_from(direct)

    def clean_view(self, view_direct: F32) -> None:
        """The same for the view samples."""
        if self._noise is not None:
            self._noise[1].take_from(view_direct)


class MovingLight:
    """A light with a surface of its own, or a distant one: rounds of one shadow ray per patch point and view sample.

    More of them where the image would be grainy.
    """

    def __init__(
        self, around: Surroundings, alone: SceneSnapshot, seed: int, light_samples: int, dome_samples: int | None
    ) -> None:
        self._around, self._alone, self._seed, self._rounds = around, alone, seed, light_samples
        self._shining = shining_points(alone, seed, by_form=True)
        self._step = self._n_found = self._n_near = 0
        self._near: I64 | None = None  # cells next to the light, from the last round on
        self._n_rays_near = light_samples  # of each of their patch points
        #: View samples next to it or with narrow lobes, and how many rays these get, once the bounces are done.
        self._exposed: list[tuple[I64, int]] | None = None
        self._n_at_grain = light_samples  # rounds at what is grainy, those at all view samples among them
        self._grainy: I32 = np.empty(0, np.int32)  # runs of view samples
        self._is_exposed: Bool = np.zeros(0, np.bool_)  # of each view sample
        self._sampler: LightSampler | None = None
        self._exact: ExactBounces | None = None
        self.direct: F32 | None = None  #: at the cells, of which the radiance came; set from before to spare work
        self.following: Following | None = None  #: set from before to spare work
        self._cells = np.empty((0, 3), np.float32)  # from the first step on
        self._grain: Grain | None = None  # the same

    @property
    def is_known(self) -> bool:
        """Whether enough rounds were made for `show` to know noise by what they found."""
        return self._step >= 2 * min(_KNOWN_ROUNDS, self._rounds)

    def show(self, radiance: F32, view_direct: F32, known: SceneSnapshot | None = None) -> None:
        """First look: a shadow ray per cell, more where that leaves noise, and one per view sample at shadows' edges.

        Near the look before, a part of these rays is enough.

        Parameters
        ----------
        known : SceneSnapshot, optional
            The light as it was when many rays found `self.direct` and `view_direct`: noise of a look there is taken
            from looks from now on.
        """
        around = self._around
        self.following = last = self.following or Following(around)
        if known is not None and self.direct is not None:
            look = np.empty_like(self.direct), np.empty_like(view_direct)
            MovingLight(around, known, self._seed, self._rounds, None)._look(last, *look)
            last.know(around, known, look, (self.direct, view_direct))
        direct = np.empty((around.gather.n, 3), np.float32)

        def bounce() -> None:
            last.clean_cells(direct)
            around.bounce(direct, radiance, self.direct, last.next_part())

        self._look(last, direct, view_direct, bounce)
        last.clean_view(view_direct)
        self.direct = direct

    def _look(
        self, last: Following, direct: F32, view_direct: F32, at_cells: Callable[[], None] = lambda: None
    ) -> None:
        """A few rays to each place; `at_cells` is called once `direct` is found, beside the look at the view."""
        around = self._around
        assert around.cells is not None and around.tiles is not None
        assert last.cells is not None and last.patches is not None
        shadows = around.shadows_of(self._alone)
        told = look_and_tell(self._alone, shadows, around.cells, self._seed, direct, last.cells, self._shining)
        tiles, closer = around.tiles, last.patches
        # Borders of a sun's patch go by faster than a part of the rays finds them.
        before = None if self._shining.distant else last.view
        look = Look(self._alone, shadows, tiles, self._shining, self._seed, True, view_direct, 0, before, told)

        def work() -> None:
            closer.improve(self._alone, shadows, self._seed, self._shining, direct, told, around.influence)
            at_cells()

        beside(work, look.pieces())
        look.finish()

    def step(self, radiance: F32, view_direct: F32) -> bool:
        """Another round at the cells or at the view; False after the last."""
        around = self._around
        assert around.patches is not None and around.tiles is not None
        if self._grain is None:
            self._cells, self._grain = np.zeros((around.gather.n, 3), np.float32), Grain(around.tiles.row)
        turn, at_view = divmod(self._step, 2)
        self._step += 1
        if turn >= self._rounds:
            if self._light_near_cells():
                return True
            direct = self._cells / np.float32(self._rounds)
            self._exact = self._exact or ExactBounces(around, direct)
            if self._exact.step(radiance):
                return True
            self.direct = direct
            return self._light_grain(view_direct) or self._light_exposed(view_direct)
        share = np.float32(1.0 / (turn + 1))
        if at_view:
            np.multiply(self._grain.add(self._round(around.tiles, turn)), share, out=view_direct)
        else:
            self._cells += around.cell_means(self._round(around.patches, turn))
            direct = self._cells * share
            around.bounce(direct, radiance, self.direct)
            self.direct = direct
        return True

    def _round(self, places: Places, turn: int, runs: I32 | None = None) -> F32:
        """What places reflect, by one shadow ray each: (n, 3), which says nothing of others than some runs."""
        found = np.empty((places.n, 3), np.float32) if runs is None else np.zeros((places.n, 3), np.float32)
        shadows = self._around.shadows_of(self._alone)
        # Points of its own for every round: what lies next to a light sees how far they are apart.
        seed = int(hash_combine(self._seed, turn)) & 0x7FFFFFFF
        shining = shining_points(self._alone, seed)
        direct_at(self._alone, shadows, places, seed, False, found, turn, shining=shining, runs=runs)
        return found

    def restart_bounces(self) -> None:
        """Bounces are to be solved with other rows."""
        self._exact = None

    def _light_near_cells(self) -> bool:
        """Light some of the cells next to the light in the general way; False once all are."""
        gather = self._around.gather
        size = np.diff(gather.cell_begin)
        if self._near is None:
            self._near = np.flatnonzero(_is_near(gather.points.position, self._shining))
            self._sampler = build_light_sampler(self._alone)
            n_rays = max(1, int(size[self._near].sum())) * self._rounds
            more = max(1, min(_MORE_NEAR, _RAYS_NEAR // n_rays))
            # Rays of a power of two are spread best.
            self._n_rays_near = self._rounds * (1 << (more.bit_length() - 1))
        first, n = self._n_near, self._n_rays_near
        if first >= len(self._near):
            return False
        assert self._sampler is not None
        ends = np.cumsum(size[self._near[first:]])
        some = self._near[first : first + max(1, int(np.searchsorted(ends, _RAYS_PER_STEP // n)))]
        self._n_near += len(some)
        seed = int(hash_combine(self._seed, first)) & 0x7FFFFFFF
        # as the sum of all rounds
        found = self._around.lit_cells(self._alone, self._sampler, some, seed, n)
        self._cells[some] = found * np.float32(self._rounds)
        return True

    def _light_grain(self, view_direct: F32) -> bool:
        """Another round at the view samples that are grainy; False when none is, or all rounds are done."""
        around, grain, n = self._around, self._grain, self._n_at_grain
        assert around.tiles is not None and grain is not None
        if self._exposed is None:
            self._is_exposed = _is_near(around.view.points.position, self._shining)
            self._is_exposed[around.smooth] = True
            self._grainy = grain.runs
            self._exposed = self._steps_of_exposed(
                grain.samples(grain.grainy(self._grainy, np.zeros_like(self._is_exposed)))
            )
        if n in (self._rounds, 2 * self._rounds):
            self._grainy = grain.grainy(self._grainy, self._is_exposed)
        if n >= _MORE * self._rounds or not len(self._grainy):
            return False
        samples = grain.samples(self._grainy)
        total = grain.add(self._round(around.tiles, n, self._grainy), samples)
        self._n_at_grain += 1
        view_direct[samples] = total / np.float32(n + 1)
        return True

    def _steps_of_exposed(self, grainy: I64) -> list[tuple[I64, int]]:
        """View samples to be lit in each step, and rays of each of them, which are more for the `grainy` ones."""
        is_grainy = np.zeros(len(self._is_exposed), np.bool_)
        is_grainy[grainy] = True
        steps: list[tuple[I64, int]] = []
        for some, n_rays in ((~is_grainy, self._rounds), (is_grainy, _MORE * self._rounds)):
            samples = np.flatnonzero(self._is_exposed & some)
            at_once = max(1, _RAYS_PER_STEP // n_rays)
            steps += [(samples[first : first + at_once], n_rays) for first in range(0, len(samples), at_once)]
        return steps

    def _light_exposed(self, view_direct: F32) -> bool:
        """Light some more of the view samples next to the light or with narrow lobes; False after the last."""
        assert self._exposed is not None
        if self._n_found < len(self._exposed):
            assert self._sampler is not None
            rows, n_rays = self._exposed[self._n_found]
            seed = int(hash_combine(self._seed, self._n_found)) & 0x7FFFFFFF
            view_direct[rows] = self._around.lit_view(self._alone, self._sampler, rows, seed, n_rays)
            self._n_found += 1
        return self._n_found < len(self._exposed)


class AnyLight:
    """Any kind of light, the general way: part after part of the cells and of the view, shown when all had a turn."""

    def __init__(
        self, around: Surroundings, alone: SceneSnapshot, seed: int, light_samples: int, dome_samples: int | None
    ) -> None:
        self._around, self._alone, self._seed = around, alone, seed
        # What a dome shines on through a window is few cells, whose noise is that of the image.
        self._n_cells = samples_per_light(alone, light_samples, None)[0]
        self._n_view = samples_per_light(alone, light_samples, dome_samples)[0]
        self._samplers: list[LightSampler] = []
        self._learning: Steps[LightSampler] | None = None
        self._cell = 0
        self._exact: ExactBounces | None = None
        self._looks: Iterator[float] | None = None  # at the view
        self.is_known = False  #: whether enough rounds were made for `show` to know noise by what they found
        self.bins: BinnedSky | None = None  #: of a dome; may be set to spare finding them again
        self.direct: F32 | None = None  #: at the cells, of which the radiance came; set from before to spare work
        self._cells = np.empty((0, 3), np.float32)  # from the first step on
        self._view = np.empty((1, 0, 3), np.float32)  # from the first look at it on
        self.following: Following | None = None  #: set from before to spare work

    def show(self, radiance: F32, view_direct: F32, known: SceneSnapshot | None = None) -> None:
        """First look: domes by what is seen of the sky, others by one shadow ray per cell and view sample.

        `known` is that of `MovingLight.show`, for domes.
        """
        around = self._around
        if around.shadows is not None and self._alone.lights.kind[0] == LightKind.DOME:
            self.bins = self.bins or BinnedSky(self._alone)
            self.following = last = self.following or Following(around)
            if known is not None and self.direct is not None:
                look = np.empty_like(self.direct), np.empty_like(view_direct)
                self._look_at_sky(known, *look)
                last.know(around, known, look, (self.direct, view_direct))
            direct = np.empty((around.gather.n, 3), np.float32)
            self._look_at_sky(self._alone, direct, view_direct)
            last.clean_cells(direct)
            around.bounce(direct, radiance, self.direct, last.next_part())
            self.direct = direct
            last.clean_view(view_direct)
            return
        patch = around.gather.cell_begin[:-1]
        points = take_points(around.gather.patch_points, patch)
        arriving = irradiance(self._alone, around.tracer, self._sampler(0), points, self._seed, 1)[0]
        self.direct = arriving * around.patch_tint[patch]
        around.bounce(self.direct, radiance, None)
        view_direct[:] = reflected_direct(
            self._alone, around.tracer, self._sampler(1), around.view.points, around.view.to_eye, self._seed, 1
        )[0]

    def _look_at_sky(self, alone: SceneSnapshot, direct: F32, view_direct: F32) -> None:
        """Light of a dome at cells and view samples, by what they see of the sky."""
        assert self.bins is not None
        around, sky = self._around, self.bins.under(alone)
        around.sky(alone)[0].light(sky, direct, alone.controls(0))
        around.light_view(alone, sky, view_direct)

    def step(self, radiance: F32, view_direct: F32) -> bool:
        """The next part of the cells, then of the view; False after the last."""
        around = self._around
        if not len(self._cells):
            self._cells = np.zeros((around.gather.n, 3), np.float32)
        if self._cell < around.gather.n:
            if self._samplers:
                self._light_cells()
            else:
                self._learn()
            return True
        self._exact = self._exact or ExactBounces(around, self._cells)
        if self._exact.step(radiance):
            return True
        self.direct = self._cells
        if not around.view.n:
            return False
        if len(self._samplers) < 2:
            self._learn()
            return True
        if self._looks is None:
            # Of its own, as that of all lights is another when one comes or goes.
            self._view = view_direct[None].copy()
            scene = self._alone, around.tracer, self._samplers[1], around.view
            self._looks = look_in_rounds(*scene, self._seed, [self._n_view], self._view)
        done = next(self._looks, None)
        view_direct[:] = self._view[0]
        # What the first rounds found is there once more are made where it is grainy.
        self.is_known = done is None or done > ROUNDS / ROUNDS_AT_GRAIN
        return done is not None

    def restart_bounces(self) -> None:
        """Bounces are to be solved with other rows."""
        self._exact = None

    def _sampler(self, which: int) -> LightSampler:
        """Of the cells (0) and of the view (1), learnt when first needed."""
        while len(self._samplers) <= which:
            self._learn()
        return self._samplers[which]

    def _learn(self) -> None:
        """One step of learning the next sampler."""
        if self._learning is None:
            around = self._around
            points = around.view.points if self._samplers else around.gather.patch_points
            self._learning = prepare_light_sampler(self._alone, around.tracer, points, self._seed)
        try:
            next(self._learning)
        except StopIteration as end:
            self._samplers.append(end.value)
            self._learning = None

    def _light_cells(self) -> None:
        around, begin = self._around, self._around.gather.cell_begin
        first = self._cell
        wanted = int(begin[first]) + max(1, _RAYS_PER_STEP // self._n_cells)
        last = min(max(int(np.searchsorted(begin, wanted)), first + 1), around.gather.n)
        cells, seed = np.arange(first, last), int(hash_combine(self._seed, first)) & 0x7FFFFFFF
        self._cells[first:last] = around.lit_cells(self._alone, self._sampler(0), cells, seed, self._n_cells)
        self._cell = last
