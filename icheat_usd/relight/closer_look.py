"""A closer look at the gather cells whose light a single shadow ray gets wrong, while a light moves."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.closer_look import noise_of_runs, take_closer_looks
from icheat_usd.kernels.shadow_lanes import RUN
from icheat_usd.kernels.workers import take_back
from icheat_usd.lighting.quick import LastLook, Places, Shadows, Shining, direct_at
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, F64, I32, I64, SceneSnapshot

#: Runs of patch points that are looked at in a frame, and with them their neighbours: some 35,000 points.
MOST_RUNS = 256
#: Of these, the noisiest, such as those next to a small light, are looked at so many times, if most of the noise that
#: is left, in all runs, is theirs.
WORST_RUNS, TURNS = 16, 4
#: Noise of all cells, beside all light of theirs, below which no run is worth a look; and what looks may leave of more.
#: Light that lies on many cells averages: at .0015 an image was .4 % off, at .0065, from a sun in a window, 22 %.
LITTLE_NOISE, LEFT_NOISE = 2e-3, 5e-4
#: What a look leaves as it was was no noise: light that differs between cells. Of differences that were looked at, the
#: share that looks change counts from then on, and after so many frames without a look most of them do again.
_FORGOTTEN_IN = 32


class CloserLook:
    """Looks at all patch points of runs of cells, of those between which the light differs most."""

    def __init__(self, patches: Places, gather: GatherSamples) -> None:
        first = np.arange(0, patches.n, RUN)
        last = np.minimum(first + RUN, patches.n) - 1
        self._patches, self._gather = patches, gather
        self._begin, self._end = (  # cells of each run
            np.searchsorted(gather.cell_begin, first, side="right").astype(np.int64) - 1,
            np.searchsorted(gather.cell_begin, last, side="right").astype(np.int64),
        )
        self._last = LastLook(patches)
        self._looked_at = np.zeros(len(first), np.uint8)
        self._believed = np.ones(len(first))  # share of the squared differences of each run that is noise
        self._found: F32 = np.empty((patches.n, 3), np.float32)

    def improve(
        self,
        alone: SceneSnapshot,
        shadows: Shadows,
        seed: int,
        shining: Shining,
        direct: F32,
        told: I32 | None = None,
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
        """
        differences, light = self._differences(direct)
        noise = differences * self._believed
        runs = _noisy_runs(noise, light)
        before, self._looked_at = self._looked_at, np.zeros_like(self._looked_at)
        self._looked_at[runs] = 1
        # What was not looked at in the frame before may be far from what it was.
        self._last.forget(np.flatnonzero(self._looked_at > before))
        if not len(runs):
            self._believe(runs, differences[runs], differences[runs])
            return
        take_back()
        direct_at(alone, shadows, self._patches, seed, False, self._found, 0, self._last, shining, runs, told)
        elsewhere = float(noise.sum() - noise[runs].sum())
        self._believe(runs, differences[runs], self._take(runs, direct))
        take_back()
        worst = self._worst_runs(direct, light, runs, elsewhere)
        if len(worst):
            places = (worst[:, None] * RUN + np.arange(RUN)).ravel()
            places = places[places < self._patches.n]
            total, more = self._found[places], np.empty_like(self._found)
            for turn in range(1, TURNS):
                direct_at(alone, shadows, self._patches, seed, False, more, turn, None, shining, worst)
                total += more[places]
            self._found[places] = total / np.float32(TURNS)
            self._take(worst, direct)

    def _differences(self, direct: F32, runs: I32 | slice = slice(None)) -> tuple[F64, float]:
        """Squared differences in each of some runs, and their light."""
        begin, end = self._begin[runs], self._end[runs]
        found = np.empty((2, len(begin)))
        noise_of_runs(direct, self._gather.area, begin, end, found)
        return found[0], float(found[1].sum())

    def _worst_runs(self, direct: F32, light: float, runs: I32, elsewhere: float) -> I32:
        """Those of some runs that are still noisy, ascending; none if that does not matter beside noise elsewhere."""
        noise = self._differences(direct, runs)[0] * self._believed[runs]
        worst = _largest(noise, WORST_RUNS)
        left = noise.sum() + elsewhere
        matters = left > (LEFT_NOISE * light) ** 2 and 2.0 * noise[worst].sum() > left
        return np.sort(runs[worst]) if matters else runs[:0]

    def _believe(self, runs: I32, differences: F64, change: F64) -> None:
        """How much of the squared differences (n_runs,) of some runs was noise, by what a look at them changed."""
        self._believed += (1.0 - self._believed) / _FORGOTTEN_IN
        self._believed[runs] = np.where(change < differences, change / np.maximum(differences, 1e-300), 1.0)

    def _take(self, runs: I32, direct: F32) -> F64:
        """Give cells of runs what was found; squared changes of each run."""
        cells = self._begin, self._end, self._gather.cell_begin
        change = np.empty(len(runs))
        take_closer_looks(runs, *cells, RUN, self._looked_at, self._found, self._gather.area, direct, change)
        return change


def _noisy_runs(noise: F64, light: float) -> I32:
    """Runs that are worth a look, ascending, by the squared noise of each (n_runs,), beside the light of all cells."""
    total = noise.sum()
    if total <= (LITTLE_NOISE * light) ** 2:
        return np.empty(0, np.int32)
    most = _largest(noise, MOST_RUNS)
    left = total - np.cumsum(noise[most])
    most = most[: 1 + np.searchsorted(-left, -((LEFT_NOISE * light) ** 2))]
    # Beside what is seen to differ lies what one look has missed, such as the border of a patch of sun.
    wanted = np.zeros(len(noise) + 2, np.bool_)
    for beside in range(3):
        wanted[most + beside] = True
    return np.flatnonzero(wanted[1:-1]).astype(np.int32)


def _largest(values: F64, n: int) -> I64:
    """Numbers of the `n` largest values, largest first."""
    most = np.argpartition(-values, n)[:n] if len(values) > n else np.arange(len(values))
    return most[np.argsort(-values[most], kind="stable")]
