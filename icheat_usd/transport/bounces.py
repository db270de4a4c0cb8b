"""Light between gather cells: every bounce but the last."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from icheat_usd.kernels import rows as row_kernels
from icheat_usd.lighting import LightSampler, build_light_sampler
from icheat_usd.materials import effective_albedo
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, cell_direct
from icheat_usd.scene import F32, I64, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport.rays import MeasuredRows, RowBuilder
from icheat_usd.transport.sparse import SparseRows

_CONVERGED = 1e-4  # relative change per bounce: far below what a display shows


@dataclass(frozen=True)
class Bounces:
    """Light from gather cells to gather cells; no view in it, so cameras share it."""

    rows: SparseRows  #: (n_gather x n_gather) form factors without albedo; row sums at most 1
    albedo: F32  #: (n_gather, 3) mean reflectance of the cells


@dataclass(frozen=True, eq=False)
class CellLight:
    """Radiance that leaves the gather cells diffusely, per light; emission is not in it."""

    direct: F32  #: (n_lights, n_gather, 3) after one reflection
    radiance: F32  #: (n_lights, n_gather, 3) after all reflections but the last

    def total(self) -> F32:
        """All lights together, the `b` of the transport: (n_gather, 3)."""
        return sum_lights(self.radiance)


def sum_lights(per_light: F32) -> F32:
    """Sum (n_lights, n, 3) over the lights, in their order."""
    total = np.zeros(per_light.shape[1:], np.float32)
    for values in per_light:
        total += values
    return total


def sum_groups(per_light: F32, group: I64, n_groups: int) -> F32:
    """Sum (n_lights, n, 3) over the lights of each group, in their order: (n_groups, n, 3)."""
    total = np.zeros((n_groups, *per_light.shape[1:]), np.float32)
    for values, into in zip(per_light, group, strict=True):
        total[into] += values
    return total


def build_bounces(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    *,
    rays_per_row: int = 256,
    seed: int = 0,
    progress: Progress = silent,
) -> Bounces:
    """Measure with gather rays what the cells receive from each other.

    Rays start from the patch points, so that a row is the mean over its cell.
    """
    builder = RowBuilder(snapshot, tracer, gather, seed)
    points = gather.patch_points, gather.cell_begin, gather.number
    rows = builder.diffuse_rows(*points, rays_per_row, 1, progress, "bounce rays")
    albedo = np.empty((gather.n, 3), np.float32)
    row_kernels.mean_over_segments(gather.cell_begin, effective_albedo(gather.patch_points), albedo)
    return Bounces(rows, albedo)


def more_bounces(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    bounces: Bounces,
    n_rays: int,
    n_more: int,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> Bounces:
    """Bounces whose rows were measured with `n_rays` rays, by `n_more` others besides."""
    points = gather.patch_points, gather.cell_begin, gather.number
    builder = RowBuilder(snapshot, tracer, gather, seed)
    # A sequence of their own, since either is spread over all points of a cell.
    more = builder.measure(*points, n_more, 4, progress, "more bounce rays")
    return replace(bounces, rows=MeasuredRows(bounces.rows, n_rays).continued(more).cells)


def solve_bounces(bounces: Bounces, direct: F32, n_bounces: int) -> F32:
    """Radiance that leaves the cells after one to `n_bounces` diffuse reflections.

    Jacobi steps of ``g = b + albedo * (R g)``, stopped when a step changes less
    than 1e-4 of the total.

    Parameters
    ----------
    direct : (n_lights, n_gather, 3) float32
        Reflected direct radiance b, per light.
    n_bounces
        1 returns `direct` as it is.

    Returns
    -------
    (n_lights, n_gather, 3) float32

    Raises
    ------
    ValueError
        `n_bounces` is less than 1, or `direct` belongs to another gather set.
    """
    if n_bounces < 1:
        raise ValueError(f"light needs at least one reflection on the way to a gather cell, not {n_bounces}")
    if direct.ndim != 3 or direct.shape[1:] != (bounces.rows.n_rows, 3):
        raise ValueError(f"direct light of shape {direct.shape} for {bounces.rows.n_rows} gather cells")
    out = direct.astype(np.float32, copy=True)
    for light in range(len(direct)):
        for radiance in bounce_by_bounce(bounces, direct[light], n_bounces):
            out[light] = radiance
    return out


def bounce_by_bounce(bounces: Bounces, direct: F32, n_bounces: int) -> Iterator[F32]:
    """The steps of `solve_bounces` for one light (n_gather, 3): the same array after each bounce, until it is done."""
    out, last = direct.astype(np.float32, copy=True), direct
    for _ in range(n_bounces - 1):
        last = bounces.albedo * bounces.rows.matmul(last)
        out += last
        yield out
        if np.abs(last).sum(dtype=np.float64) <= _CONVERGED * np.abs(out).sum(dtype=np.float64):
            break


def light_cells(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    bounces: Bounces,
    *,
    n_bounces: int = 16,
    light_samples: int = 16,
    seed: int = 0,
    sampler: LightSampler | None = None,
    progress: Progress = silent,
) -> CellLight:
    """Light the gather cells and solve the bounces between them.

    Parameters
    ----------
    n_bounces : int
        Diffuse reflections before the last one; 1 is direct light once reflected.
    light_samples : int
        Shadow rays per light and patch point.
    sampler : LightSampler, optional
        One that knows where around the patches lights can be seen; learnt here by default.
    """
    progress("light the gather samples", 0.0)
    sampler = sampler or build_light_sampler(snapshot, tracer, gather.patch_points, seed)
    direct = cell_direct(snapshot, tracer, sampler, gather, light_samples, seed)
    progress("solve the bounces", 0.0)
    return CellLight(direct, solve_bounces(bounces, direct, n_bounces))
