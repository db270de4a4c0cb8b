"""Where rows are kept: few places where an edit changes little over a surface, many where it changes fast."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.encodings.rows import NORMAL_REACH
from icheat_usd.kernels import row_sites
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, F64, I64, Bool, SceneSnapshot

#: Pixels between sites: as coarse as that to begin with, halved where they do not suffice.
COARSEST = 32
#: A site speaks for its surroundings as far as the samples that it is nearest to, and half of that again.
_MARGIN = 1.5
_PASSES_BY_SAMPLE = 2


class ChosenSites(NamedTuple):
    """View samples whose rows are kept."""

    samples: I64  #: ascending
    reach: F32  #: (n,) metres
    error: float  #: largest difference between rows and what is interpolated, at any view sample; in tolerances


def pixel_footprint(view: ViewSamples, snapshot: SceneSnapshot) -> F32:
    """About how far apart neighbouring view samples lie on the surface, metres, (n,)."""
    camera = snapshot.camera
    left, right, bottom, top = camera.window
    step = max((right - left) / camera.width, (top - bottom) / camera.height)
    width = np.full(view.n, step) if camera.orthographic else view.depth * step
    cosine = np.abs(np.einsum("nc,nc->n", view.points.normal, view.to_eye))
    return (width / np.maximum(cosine, 0.1)).astype(np.float32)


def choose_sites(
    view: ViewSamples,
    footprint: F32,
    wanted: Bool,
    values: F32,
    progress: Progress = silent,
) -> ChosenSites:
    """Thin out view samples as far as interpolation between the rest gives back `values`.

    Parameters
    ----------
    wanted : (n,) samples whose side of a surface is edited at all
    values : (n, t) float32
        What rows are judged by, in units of the difference that is allowed.
    """
    some = np.flatnonzero(wanted)
    if len(some) == 0:
        return ChosenSites(some, np.zeros(0, np.float32), 0.0)
    values = values[some]
    pixel = view.pixel[some].astype(np.int64)
    x, y = pixel % view.width, pixel // view.width
    side = 2 * view.points.instance[some].astype(np.int64) + view.points.side[some]
    group = np.unique(side, return_inverse=True)[1].reshape(-1)
    position = view.points.position[some].astype(np.float64)
    normal = np.ascontiguousarray(view.points.shading_normal[some])
    spacing = COARSEST
    chosen = (x % spacing == 0) & (y % spacing == 0)
    error = np.full(len(some), np.inf)
    reach = np.zeros(len(some))
    passes = 0
    while True:
        reach, error = _judge(position, normal, group, chosen, footprint[some], values)
        failing = error > 1
        progress("choose rows", 1 - spacing / (COARSEST + 1))
        left = failing & ~chosen
        if not failing.any() or (spacing == 1 and not left.any()):
            break
        if spacing > 1:
            block = _blocks(x, y, side, spacing, failing)
            spacing //= 2
            chosen |= block & (x % spacing == 0) & (y % spacing == 0)
        else:
            # A new site takes neighbours from others, which may then fail: blocks grow until all are sites in them.
            chosen |= left if passes < _PASSES_BY_SAMPLE else _blocks(x, y, side, passes, left)
            passes += 1
    return ChosenSites(some[chosen], reach[chosen].astype(np.float32), float(error.max()))


def _blocks(x: I64, y: I64, side: I64, spacing: int, failing: Bool) -> Bool:
    """Samples in blocks of pixels, on one side of a surface, in which a sample fails."""
    block = (side * (1 << 20) + y // spacing) * (1 << 20) + x // spacing
    return np.isin(block, block[failing])


def _judge(position: F64, normal: F32, group: I64, chosen: Bool, footprint: F32, values: F32) -> tuple[F64, F64]:
    """Reach of the chosen sites, and how far the values that they give are off at every sample."""
    sites = np.flatnonzero(chosen)
    sites = sites[np.argsort(group[sites], kind="stable")]
    n, n_groups = len(position), int(group.max()) + 1
    begin = np.searchsorted(group[sites], np.arange(n_groups + 1)).astype(np.int64)
    m = row_sites.NEIGHBOURS
    rows, weights = np.empty((n, m), np.int32), np.empty((n, m), np.float32)
    confidence, nearest = np.empty(n, np.float32), np.empty((n, 2), np.float64)
    reach = np.zeros(n)
    # Twice: how far sites must reach is known once it is known what they are nearest to.
    for last in (False, True):
        size = reach[sites] if last else footprint[sites]
        turn = NORMAL_REACH * np.bincount(group[sites], size, n_groups) / np.maximum(np.diff(begin), 1)
        place = np.concatenate([position, normal * turn[group, None]], axis=1)
        order, key, axis = sites.copy(), place[sites], np.zeros(len(sites), np.int64)
        row_sites.build_search(key, begin, order, axis)
        row_sites.mixtures(
            key,
            axis,
            begin,
            np.ascontiguousarray(normal[order]),
            np.ascontiguousarray(reach[order]),
            order.astype(np.int32),
            turn,
            group,
            np.ascontiguousarray(position),
            np.ascontiguousarray(normal),
            rows,
            weights,
            confidence,
            nearest,
        )
        if not last:
            found = nearest[:, 0] >= 0
            np.maximum.at(reach, order[nearest[found, 0].astype(np.int64)], nearest[found, 1])
            reach = _MARGIN * np.maximum(reach, footprint)
    mixed = np.zeros_like(values)
    for s in range(rows.shape[1]):
        mixed += weights[:, s, None] * values[np.maximum(rows[:, s], 0)] * (rows[:, s, None] >= 0)
    return reach, np.abs(mixed - values).max(axis=1)
