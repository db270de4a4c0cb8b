"""A closer look at the gather cells whose light a single shadow ray gets wrong, while a light moves."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from icheat_usd.kernels.closer_look import (
    add_changes_of_runs,
    copy_runs,
    noise_of_runs,
    shadow_noise_of_cells,
    take_closer_looks,
    weighted_light,
)
from icheat_usd.kernels.even_look import light_of_clear_places
from icheat_usd.kernels.place_columns import RUN
from icheat_usd.kernels.rows import mean_over_segments
from icheat_usd.kernels.workers import take_back
from icheat_usd.lighting.controls import darken
from icheat_usd.lighting.even import can_look_evenly, look_evenly
from icheat_usd.lighting.quick import LastLook, Places, Shadows, Shining, diffuse_places, direct_at
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, F64, I32, I64, SceneSnapshot

#: Runs of patch points that are looked at in a frame, and with them the run before and the one behind: some 30,000
#: points.
MOST_RUNS = 256
#: All runs that are looked at of suns, which cost less, while borders of their patches need more.
MOST_RUNS_OF_SUN = 1536
#: Of suns, noise of so many runs next to each counts for it, so much of their mean.
N_BESIDE, BESIDE = 7, 0.1
#: Of these, the runs with most noise of shadows, such as those next to a small light, are looked at so many times.
WORST_RUNS, TURNS = 16, 4
#: At a rectangle so many cells are instead, by so many rays of each patch point, spread over what that sees of it; or
#: fewer cells several times, up to `MOST_LOOKS`, the noisier the more.
WORST_CELLS, N_EVEN, MOST_LOOKS = 256, 4, 16
#: Noise of all cells, beside all light of theirs, below which no run is worth a look; and what looks may leave of more.
#: Light that lies on many cells averages: at .0015 an image was .4 % off, at .0065, from a sun in a window, 22 %.
LITTLE_NOISE, LEFT_NOISE, LEFT_NOISE_OF_SUN = 2e-3, 5e-4, 2e-4
#: What looks at the worst cells may leave of it, by what the view gets from each.
LEFT_NOISE_OF_SHADOWS = 1e-4

# A cell whose share is less than this of one look gets none.
_LEAST_LOOKS = 0.7

_NOTHING = np.empty(0, np.float32)


class CloserLook:
    """Looks at all patch points of runs of cells, of those between which the light differs most.

    Parameters
    ----------
    beside : (n_runs, N_BESIDE) int64
        Of these places, `runs_beside`.
    """

    def __init__(self, patches: Places, gather: GatherSamples, beside: I64) -> None:
        first = np.arange(0, patches.n, RUN)
        last = np.minimum(first + RUN, patches.n) - 1
        self._patches, self._gather, self._beside = patches, gather, beside
        self._begin, self._end = (  # cells of each run
            np.searchsorted(gather.cell_begin, first, side="right").astype(np.int64) - 1,
            np.searchsorted(gather.cell_begin, last, side="right").astype(np.int64),
        )
        self._last = LastLook(patches)
        self._looked_at = np.zeros(len(first), np.uint8)
        self._found: F32 = np.empty((patches.n, 3), np.float32)
        self._whole: F32 = np.empty(len(first) * RUN, np.float32)
        self._noise_of_cells, self._run_of_cell = np.zeros(gather.n), gather.cell_begin[:-1] // RUN
        self._known: F32 | None = None  # of all cells, from when each was looked at closely for the last time

    def know(self, direct: F32) -> None:
        """Light of all cells (n_cells, 3) is known to be this, from many rays: what has changed is worth a look."""
        self._known = direct.copy()

    def improve(
        self,
        alone: SceneSnapshot,
        shadows: Shadows,
        seed: int,
        shining: Shining,
        direct: F32,
        told: I32 | None = None,
        influence: F32 | None = None,
    ) -> None:
        """Make the light of noisy cells that of their patch points.

        Parameters
        ----------
        alone, shadows, seed, shining
            As `direct_at` has them.
        direct : (n_cells, 3), changed
            From one look at each cell.
        told
            As `direct_at` has it.
        influence : (n_cells,), optional
            Of the cells on the view, if that is known. Areas, and what the view receives from each, stand for it else.
        """
        area, importance = self._gather.area, self._gather.importance
        if influence is not None and not shining.distant:
            area = importance = influence
        runs = self._border_runs(direct) if shining.distant else self._noisy_runs(direct, area)
        before, self._looked_at = self._looked_at, np.zeros_like(self._looked_at)
        self._looked_at[runs] = 1
        # What was not looked at in the frame before may be far from what it was.
        self._last.forget(np.flatnonzero(self._looked_at > before))
        if not len(runs):
            return
        take_back()
        # Borders of a sun's patch go by faster than rays of a part of the points find them.
        last = None if shining.distant else self._last
        direct_at(alone, shadows, self._patches, seed, False, self._found, 0, last, shining, runs, told)
        self._take(runs, direct)
        take_back()
        # Few cells next to a light, from which the view gets much, may have most of what is wrong in an image.
        noise, left = self._noise_of_shadows(alone, direct, runs, shining, area if shining.distant else importance)
        if can_look_evenly(alone, shining):
            cells = _largest_but(noise, WORST_CELLS, left)
            n_looks = share_out_looks(np.sqrt(noise[cells]), WORST_CELLS)
            order = np.argsort(cells[n_looks > 0])
            self._look_evenly(alone, shadows, seed, shining, cells[order], n_looks[order], direct)
        else:
            of_runs = np.bincount(self._run_of_cell, noise, len(self._begin)).astype(np.float64)
            worst = np.sort(runs[_largest_but(of_runs[runs], WORST_RUNS, left)])
            self._look_again(alone, shadows, seed, shining, worst)
            self._take(worst, direct)
        if shining.distant and self._known is not None:
            copy_runs(runs, self._begin, self._end, direct, self._known)

    def _look_evenly(
        self, alone: SceneSnapshot, shadows: Shadows, seed: int, shining: Shining, cells: I64, n_looks: I64, direct: F32
    ) -> None:
        """Make the light of some cells (n,) what so many times `N_EVEN` rays say of each patch point looked at."""
        if not len(cells):
            return
        which, ends = self._gather.patches_of(cells)
        # Of a cell between two runs one part may not have been looked at, of which nothing is known.
        is_known = self._looked_at[which // RUN] != 0
        n_of_patch = np.repeat(n_looks, np.diff(ends)) * is_known
        first = np.cumsum(n_of_patch) - n_of_patch
        ends = np.append(first[ends[:-1]], n_of_patch.sum())
        which = np.repeat(which, n_of_patch)
        turn = np.arange(len(which)) - np.repeat(first, n_of_patch)
        found = self._found[which]
        places = diffuse_places(self._patches, which)
        sequence = np.stack([which, N_EVEN * turn], axis=1)
        look_evenly(alone, shadows, places, shining, seed, N_EVEN, sequence, found)
        means = np.empty((len(cells), 3), np.float32)
        mean_over_segments(ends, found, means)
        direct[cells] = means

    def _look_again(self, alone: SceneSnapshot, shadows: Shadows, seed: int, shining: Shining, runs: I32) -> None:
        """Make of what is found at the patch points of some runs what `TURNS` looks at each say."""
        if not len(runs):
            return
        places = (runs[:, None] * RUN + np.arange(RUN)).ravel()
        places = places[places < self._patches.n]
        total, more = self._found[places], np.empty_like(self._found)
        for turn in range(1, TURNS):
            direct_at(alone, shadows, self._patches, seed, False, more, turn, None, shining, runs)
            total += more[places]
        self._found[places] = total / np.float32(TURNS)

    def _noise(self, direct: F32, weight: F32) -> tuple[F64, float]:
        """Squared noise of each run, and the light of all, by a weight of cells (n_cells,)."""
        found = np.empty((2, len(self._begin)))
        noise_of_runs(direct, weight, self._begin, self._end, found)
        return found[0], float(found[1].sum())

    def _noisy_runs(self, direct: F32, weight: F32) -> I32:
        """Runs that are worth a look, by a weight of cells (n_cells,), ascending."""
        noise, light = self._noise(direct, weight)
        most = _worth_a_look(noise, MOST_RUNS, light, LEFT_NOISE)
        # Beside what is seen to differ lies what one look has missed, such as the border of a shadow.
        wanted = np.zeros(len(noise) + 2, np.bool_)
        for beside in range(3):
            wanted[most + beside] = True
        return np.flatnonzero(wanted[1:-1]).astype(np.int32)

    def _border_runs(self, direct: F32) -> I32:
        """The same of a sun: where its patch may end, though a look may have seen no light there.

        That is where light was when it was looked at closely, and next to what differs. It is not in the order of the
        cells: a patch has borders on all sides.
        """
        noise, light = self._noise(direct, self._gather.area)
        if self._known is not None:
            add_changes_of_runs(direct, self._known, self._gather.area, self._begin, self._end, noise)
        noise += BESIDE * noise[self._beside].mean(axis=1)
        return np.sort(_worth_a_look(noise, MOST_RUNS_OF_SUN, light, LEFT_NOISE_OF_SUN)).astype(np.int32)

    def _noise_of_shadows(
        self, alone: SceneSnapshot, direct: F32, runs: I32, shining: Shining, weight: F32
    ) -> tuple[F64, float]:
        """Squared noise (n_cells,) of shadows in cells of some runs, just looked at; and what may be left of it.

        Both by a weight of cells (n_cells,).
        """
        noise, controls, whole = self._noise_of_cells, alone.controls(0), _NOTHING
        noise[:] = 0.0
        if len(shining.form) and controls.shaping is None:
            whole = self._whole
            color = np.ascontiguousarray(shining.table[0, 6:9])
            light_of_clear_places(shining.form, color, *self._patches.table, runs, float(controls.diffuse), whole)
            darken(alone, 0, self._patches.instance, whole[: self._patches.n])
        cells = self._begin, self._end, self._gather.cell_begin
        shadow_noise_of_cells(runs, *cells, RUN, self._looked_at, self._found, whole, weight, noise)
        return noise, (LEFT_NOISE_OF_SHADOWS * weighted_light(direct, weight)) ** 2

    def _take(self, runs: I32, direct: F32) -> None:
        cells = self._begin, self._end, self._gather.cell_begin
        take_closer_looks(runs, *cells, RUN, self._looked_at, self._found, direct)


def share_out_looks(noise: F64, n: int) -> I64:
    """How often each of some cells is looked at, so that at most `n` looks in all leave least noise.

    Parameters
    ----------
    noise : (n_cells,)
        Root mean square of each after one ray of every patch point, largest first.

    Returns
    -------
    (n_cells,) int64
        Powers of two up to `MOST_LOOKS`, or 0: by the noise (Neyman 1934, of strata), as far as they are that.
    """
    if not len(noise):
        return np.empty(0, np.int64)
    share = noise / noise[0]
    # The more looks the noisiest would have, the more have others.
    most = np.exp2(np.arange(0.0, np.log2(MOST_LOOKS * WORST_CELLS + 1.0), 0.25))
    wanted = most[:, None] * share
    looks = np.exp2(np.minimum(np.rint(np.log2(np.maximum(wanted, 1.0))), np.log2(MOST_LOOKS)))
    looks[wanted < _LEAST_LOOKS] = 0
    fits = np.flatnonzero(looks.sum(axis=1) <= n)
    if not len(fits):  # too many are as noisy as the first
        return (np.arange(len(noise)) < n).astype(np.int64)
    found: I64 = looks[fits[-1]].astype(np.int64)
    return found


def runs_beside(places: F32) -> I64:
    """Of each run of places (n, 3), in their order, the `N_BESIDE` next to it: (n_runs, N_BESIDE).

    Where there are fewer, the run itself is among them.
    """
    first = np.arange(0, len(places), RUN)
    size = np.diff(np.append(first, len(places)))
    centre = np.add.reduceat(places.astype(np.float64), first, axis=0) / size[:, None]
    found = cKDTree(centre).query(centre, k=N_BESIDE + 1)[1][:, 1:]
    return np.where(found < len(first), found, np.arange(len(first))[:, None]).astype(np.int64)


def _worth_a_look(noise: F64, n: int, light: float, left_noise: float) -> I64:
    """At most `n` runs that are the noisiest, so that what others have does not matter beside the light of all."""
    if noise.sum() <= (LITTLE_NOISE * light) ** 2:
        return np.empty(0, np.int64)
    return _largest_but(noise, n, (left_noise * light) ** 2)


def _largest_but(values: F64, n: int, left: float) -> I64:
    """Numbers of at most `n` of the largest values, largest first, so that all others are `left` together or less."""
    most = np.flatnonzero(values > 0.0)
    if len(most) > n:
        most = most[np.argpartition(-values[most], n)[:n]]
    most = most[np.argsort(-values[most], kind="stable")]
    others = np.concatenate([[values.sum()], values.sum() - np.cumsum(values[most])])
    return most[: np.searchsorted(-others, -left)]
