"""Which view samples of a light at rest are grainy: at the borders of shadows, for which few rays are too few."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.place_columns import RUN
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, F64, I32, I64, Bool

#: Noise of a run of view samples, 8 x 8 pixels, beside the light there and a part of that of all, above which it shows.
LEAST_GRAIN, OF_ALL = 0.015, 0.1


def order_of_tiles(view: ViewSamples) -> I64:
    """View samples by tiles of 8 x 8 pixels, within them by quarters of quarters."""
    y, x = np.divmod(view.pixel.astype(np.int64), view.width)
    key = (y // 8 * (view.width // 8 + 1) + x // 8) * 64
    for bit in range(3):
        key += ((x >> bit & 1) << (2 * bit)) + ((y >> bit & 1) << (2 * bit + 1))
    return np.argsort(key, kind="stable")


class Grain:
    """Sums over rounds of shadow rays, as many for each view sample, and what they say of the noise that is left.

    Parameters
    ----------
    order : (n_view,)
        All view samples, each once, so that runs of them lie together.
    """

    def __init__(self, order: I32 | I64) -> None:
        self._row, n = order, len(order)
        self._sum: F32 = np.zeros((n, 3), np.float32)
        self._squares: F32 = np.zeros(n, np.float32)
        self._n: I32 = np.zeros(n, np.int32)  # rounds

    @property
    def runs(self) -> I32:
        """All runs."""
        return np.arange(-(-len(self._row) // RUN), dtype=np.int32)

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

    def grainy(self, runs: I32, known: Bool, most: int | None = None) -> I32:
        """Those of some runs, ascending, that are grainy after all rounds so far, of which there must be two.

        Rounds are taken to be independent. They are spread over the light, so that less noise is left.

        Parameters
        ----------
        known : (n_view,) bool
            Samples whose noise does not matter.
        most
            Of the grainiest, if there are more; all by default.
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
        grainy = np.flatnonzero(noise > LEAST_GRAIN * light)
        if most is not None:
            grainy = np.sort(grainy[np.argsort(-noise[grainy] / light[grainy], kind="stable")[:most]])
        return runs[grainy]
