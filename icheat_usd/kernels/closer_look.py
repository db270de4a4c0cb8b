"""Where one look at each gather cell leaves noise, and what looks at its patch points make of that.

The light of a cell is the mean over its patch points. A look at one of them is
off by as much as the light differs within the cell, of which the differences
between neighbouring cells tell.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def _level(direct: np.ndarray, cell: int) -> float:
    return np.float64(direct[cell, 0] + direct[cell, 1] + direct[cell, 2])


@parallel_kernel
def noise_of_runs(direct: np.ndarray, weight: np.ndarray, begin: np.ndarray, end: np.ndarray, out: np.ndarray) -> None:
    """Squared differences of the light that runs of cells send from their weighted mean, summed.

    Parameters
    ----------
    direct : (n_cells, 3), weight : (n_cells,)
    begin, end : (n_runs,) int64
        Cells of each run, which may share the one between them.
    out : (2, n_runs) float64, set
        Sums of ``(weight * (level - mean)) ** 2``, and of ``weight * level``.
    """
    for run in prange(len(begin)):
        total, size = 0.0, 0.0
        for cell in range(begin[run], end[run]):
            total += weight[cell] * _level(direct, cell)
            size += weight[cell]
        mean, noise = total / size if size > 0.0 else 0.0, 0.0
        for cell in range(begin[run], end[run]):
            noise += (weight[cell] * (_level(direct, cell) - mean)) ** 2
        out[0, run], out[1, run] = noise, total


@parallel_kernel
def add_changes_of_runs(
    direct: np.ndarray, before: np.ndarray, weight: np.ndarray, begin: np.ndarray, end: np.ndarray, out: np.ndarray
) -> None:
    """Add the squared differences of the light of runs of cells from what it was.

    Parameters
    ----------
    direct, before : (n_cells, 3), weight : (n_cells,)
    begin, end : (n_runs,) int64
        As `noise_of_runs` has them.
    out : (n_runs,) float64
        Sums of ``(weight * (level - level before)) ** 2`` are added.
    """
    for run in prange(len(begin)):
        change = 0.0
        for cell in range(begin[run], end[run]):
            change += (weight[cell] * (_level(direct, cell) - _level(before, cell))) ** 2
        out[run] += change


@parallel_kernel
def copy_runs(runs: np.ndarray, begin: np.ndarray, end: np.ndarray, source: np.ndarray, out: np.ndarray) -> None:
    """Copy the light (n_cells, 3) of some runs of cells."""
    for i in prange(len(runs)):
        for cell in range(begin[runs[i]], end[runs[i]]):
            # A cell that two runs share gets the same from both.
            for channel in range(3):
                out[cell, channel] = source[cell, channel]


@parallel_kernel
def take_closer_looks(
    runs: np.ndarray, begin: np.ndarray, end: np.ndarray, cell_begin: np.ndarray, per_run: int, looked_at: np.ndarray,
    of_patches: np.ndarray, direct: np.ndarray,
) -> None:  # fmt: skip
    """Give cells the mean over those of their patch points that were looked at.

    Parameters
    ----------
    runs : (n,) int32, runs that were looked at
    begin, end : (n_runs,) int64, cells of each run
    cell_begin : (n_cells + 1,) int64, first patch point of each cell
    per_run : int
        Patch points of a run.
    looked_at : (n_runs,) uint8, 1 for those of `runs`
    of_patches : (n_patches, 3), what they reflect
    direct : (n_cells, 3), changed
    """
    for i in prange(len(runs)):
        # A cell that two runs share gets the same from both.
        for cell in range(begin[runs[i]], end[runs[i]]):
            n = 0
            r = g = b = np.float32(0.0)
            for patch in range(cell_begin[cell], cell_begin[cell + 1]):
                if looked_at[patch // per_run] != 0:
                    r, g, b = r + of_patches[patch, 0], g + of_patches[patch, 1], b + of_patches[patch, 2]
                    n += 1
            share = np.float32(1.0 / n)
            direct[cell, 0], direct[cell, 1], direct[cell, 2] = r * share, g * share, b * share
