"""The linear operator from gather samples to view samples, and from gather samples to themselves."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I32, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport.sparse import SparseRows


@dataclass(frozen=True)
class Lobe:
    """One part of the view samples' reflection, with its colour outside the rows."""

    name: str  #: "diffuse", "specular_base" or "specular_edge"
    rows: SparseRows  #: (n_rows x n_gather); rows of samples without this lobe are empty
    tint: F32  #: (n_view, 3) multiplies the product: albedo; specular colour; specular edge


@dataclass(frozen=True)
class Transport:
    """Direct-to-indirect transfer of one view [1]_.

    References
    ----------
    .. [1] Hasan, Pellacini, Bala: Direct-to-Indirect Transfer for Cinematic Relighting, SIGGRAPH 2006.
    """

    lobes: tuple[Lobe, ...]
    bounce: SparseRows  #: (n_gather x n_gather) form factors without albedo; row sums at most 1
    gather_albedo: F32  #: (n_gather, 3) mean reflectance of the cells
    row_view: I32  #: (n_rows,) the view sample that each row was computed at
    interpolation: SparseRows | None  #: (n_view x n_rows); None where rows are view samples

    def to_view(self, radiance: F32) -> F32:
        """Indirect radiance of the view samples for `radiance` (n_gather, 3) that leaves the cells: (n_view, 3)."""
        raise NotImplementedError


def build_transport(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    gather: GatherSamples,
    *,
    rays_per_row: int = 256,
    rays_per_bounce_row: int = 256,
    row_spacing: int = 1,
    seed: int = 0,
    progress: Progress = silent,
) -> Transport:
    """Measure the transport with gather rays."""
    raise NotImplementedError


def solve_bounces(transport: Transport, direct: F32, n_bounces: int) -> F32:
    """Radiance that leaves the cells after up to `n_bounces` diffuse reflections: (n_lights, n_gather, 3)."""
    raise NotImplementedError
