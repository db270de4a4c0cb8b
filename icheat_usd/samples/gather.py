"""Gather samples: the surface cells that send light to view samples."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.lighting import LightSampler
from icheat_usd.samples.locate import Locator
from icheat_usd.samples.tree import ClusterTree
from icheat_usd.samples.view import ViewSamples
from icheat_usd.scene import F32, I32, I64, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer


@dataclass(frozen=True)
class GatherSamples:
    """Points on surfaces, each standing for the cell of places nearer to it than to any other.

    Light of a cell is an average over its patch points, so that a texture or a
    shadow edge inside a cell counts with its area.
    """

    points: SurfacePoints  #: (n,) in the order of the tree's leaves
    area: F32  #: (n,) of the cells, square metres
    tree: ClusterTree
    patch_points: SurfacePoints  #: (p,) spread over the cells by area, sorted by cell
    patch_cell: I32  #: (p,) cell of each patch point, ascending
    cell_begin: I64  #: (n + 1,) first patch point of each cell; every cell has one or more
    locator: Locator
    n_shared_clusters: int  #: cells that stand for several sides of surfaces, because `n` was too small
    n_surfaces_without_own: int  #: instances that have no cell of their own

    @property
    def n(self) -> int:
        return len(self.area)

    def locate(self, points: SurfacePoints) -> I32:
        """Cell of each point; -1 where a point is no hit (``instance == -1``)."""
        return self.locator.locate(points.position, points.normal, points.instance, points.side)


def gather_samples(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    *,
    n: int = 65536,
    seed: int = 0,
    n_patches_per_cell: int = 8,
) -> GatherSamples:
    """Spread gather samples where they matter to the view."""
    raise NotImplementedError


def cell_direct(
    snapshot: SceneSnapshot, tracer: Tracer, sampler: LightSampler, gather: GatherSamples, n_samples: int, seed: int
) -> F32:
    """Direct light that each cell reflects diffusely, per light: (n_lights, n_gather, 3) radiance."""
    raise NotImplementedError
