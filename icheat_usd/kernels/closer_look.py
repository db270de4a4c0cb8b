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


@kernel
def weighted_light(direct: np.ndarray, weight: np.ndarray) -> float:
    """Light of all cells (n_cells, 3) by a weight of them (n_cells,), the sum of the three channels."""
    total = 0.0
    for cell in range(len(weight)):
        total += np.float64(weight[cell]) * _level(direct, cell)
    return total


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


@parallel_kernel
def shadow_noise_of_cells(
    runs: np.ndarray, begin: np.ndarray, end: np.ndarray, cell_begin: np.ndarray, per_run: int, looked_at: np.ndarray,
    of_patches: np.ndarray, whole: np.ndarray, weight: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Squared noise of the light of cells after one shadow ray of each patch point, which met something or did not.

    A patch point whose ray is not blocked with a probability p has the variance p (1 - p) of the light that it gets
    if nothing is in the way. Of p a cell knows as much as its rays say, and what its run says besides, which counts as
    one ray: what is used is the mean of p (1 - p) over the beta distribution that this leaves. So cells all of whose
    rays were clear, but those beside them were not, have noise, too. A run has half a ray of either kind besides its
    own, for a shadow that no ray has met.

    Parameters
    ----------
    runs, begin, end, cell_begin, per_run, looked_at, of_patches
        As `take_closer_looks` has them; no cell has as many patch points as a run.
    whole : (n_patches or more,) float32
        What each patch point of `runs` reflects of the light if nothing hides it, the sum of the channels; 0 where
        that is not known. Those that get no light either way have no noise: they face away, or are hidden where the
        light has no closed form, of which too little noise is told then. Empty where it is known of none: then hidden
        points are as bright as those that are not, also those that face away.
    weight : (n_cells,)
    out : (n_cells,) float64, changed
        Of the cells of `runs`: variance of the weighted sum of the three channels.
    """
    for i in prange(len(runs)):
        run = np.int64(runs[i])
        last_of_run = min((run + 1) * per_run, len(of_patches))
        n_clear, n_rays, n_bright, light = _clear_rays(run * per_run, last_of_run, of_patches, whole)
        p, mean = (n_clear + 0.5) / (n_rays + 1.0), light / max(n_bright, 1)
        for cell in range(begin[run], end[run]):
            # A cell that the run before has a part of is that one's, if it was looked at.
            first, last = cell_begin[cell], cell_begin[cell + 1]
            if first < run * per_run:
                if looked_at[run - 1] != 0:
                    continue
                first = run * per_run
            if last > (run + 1) * per_run and looked_at[run + 1] == 0:
                last = (run + 1) * per_run
            clear, rays, bright, level = _clear_rays(first, last, of_patches, whole)
            if rays > 0:
                level = level / bright if bright > 0 else mean
                hidden = (clear + p) * (rays - clear + 1.0 - p) / ((rays + 1.0) * (rays + 2.0))
                out[cell] = (weight[cell] * level / (last - first)) ** 2 * hidden * rays


@kernel
def _clear_rays(first: int, last: int, of_patches: np.ndarray, whole: np.ndarray) -> tuple[int, int, int, float]:
    """Of patch points from one to another: how many see light, and how many may; of how many is known how much they
    may see, and how much all these may.
    """
    n_clear, n_rays, n_bright, light = 0, 0, 0, 0.0
    for patch in range(first, last):
        level = _level(of_patches, patch)
        most = level if len(whole) == 0 or whole[patch] <= 0.0 else np.float64(whole[patch])
        n_clear += 1 if level > 0.0 else 0
        n_rays += 1 if most > 0.0 or len(whole) == 0 else 0
        n_bright += 1 if most > 0.0 else 0
        light += most
    return n_clear, n_rays, n_bright, light
