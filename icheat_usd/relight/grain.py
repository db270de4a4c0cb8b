"""Which view samples of a light at rest are grainy: at the borders of shadows, for which few rays are too few."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.shadow_lanes import RUN
from icheat_usd.lighting.quick import Places
from icheat_usd.scene import F32, F64, I32, I64, Bool

#: Noise of a run of view samples, 8 x 8 pixels, beside the light there and a part of that of all, above which it shows.
LEAST_GRAIN, OF_ALL = 0.015, 0.1


class Grain:
    """Sums over rounds of one shadow ray for each view sample, and what they say of the noise that is left.

    Parameters
    ----------
    tiles
        All view samples, each once.
    """

    def __init__(self, tiles: Places) -> None:
        self._row = tiles.row
        self._sum: F32 = np.zeros((tiles.n, 3), np.float32)
        self._squares: F32 = np.zeros(tiles.n, np.float32)
        self._n: I32 = np.zeros(tiles.n, np.int32)  # rounds

    def samples(self, runs: I32) -> I64:
        """View samples of some runs."""
        place = (runs.astype(np.int64)[:, None] * RUN + np.arange(RUN)).ravel()
        found: I64 = self._row[place[place < len(self._row)]].astype(np.int64)
        return found

    def add(self, found: F32, samples: I64 | slice = slice(None)) -> F32:
        """Add what a round has found, (n_view, 3), for some samples; their sums over all rounds so far."""
        new = found[samples]
        self._sum[samples] += new
        self._squares[samples] += np.square(new.mean(axis=1))
        self._n[samples] += 1
        return self._sum[samples]

    def grainy(self, runs: I32, known: Bool) -> I32:
        """Those of some runs, ascending, that are grainy after all rounds so far, of which there must be two.

        Rounds are taken to be independent. They are spread over the light, so that less noise is left.

        Parameters
        ----------
        known : (n_view,) bool
            Samples whose noise does not matter.
        """
        if not len(runs):
            return runs
        samples, begin = self.samples(runs), np.arange(len(runs)) * RUN
        of_all = float((self._sum.mean(axis=1, dtype=np.float64) / np.maximum(self._n, 1)).mean())
        n = np.maximum(self._n[samples], 1)
        mean = self._sum[samples].mean(axis=1, dtype=np.float64) / n
        # Of the mean over the rounds, from how they differ.
        variance = np.maximum(self._squares[samples] / n - mean * mean, 0) / np.maximum(n - 1, 1)
        variance[known[samples]] = 0
        size = np.diff(np.append(begin, len(samples)))
        light = np.add.reduceat(mean, begin) / size + OF_ALL * of_all
        noise: F64 = np.sqrt(np.add.reduceat(variance, begin) / size)
        return runs[noise > LEAST_GRAIN * light]
