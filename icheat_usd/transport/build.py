"""The linear operator from gather samples to view samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.materials import is_glossy, take_points
from icheat_usd.progress import Progress, silent
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I32, I64, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer
from icheat_usd.transport.allotment import Counts
from icheat_usd.transport.interpolate import sparse_rows_of_view
from icheat_usd.transport.rays import RowBuilder
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
    row_view: I32  #: (n_rows,) the view sample that each row was computed at
    interpolation: SparseRows | None  #: (n_view x n_rows); None where rows are view samples
    rays_per_row: int = 256  #: that the rows were measured with
    seed: int = 0  #: of these rays
    stream: I64 | None = None  #: (n_rows,) sequence that each row's rays are from; None: its view sample's number
    counts: Counts | None = None  #: rays of each row, where they differ; `rays_per_row` is their mean then

    def to_view(self, radiance: F32) -> F32:
        """Indirect radiance that view samples send to the eye.

        Parameters
        ----------
        radiance : (n_gather, 3) float32
            What leaves the cells.

        Returns
        -------
        (n_view, 3) float32
        """
        out = np.zeros((len(self.lobes[0].tint), 3), np.float32)
        for lobe in self.lobes:
            if lobe.rows.n_entries:
                product = lobe.rows.matmul(radiance)
                out += lobe.tint * (product if self.interpolation is None else self.interpolation.matmul(product))
        return out


def build_transport(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    gather: GatherSamples,
    *,
    rays_per_row: int = 256,
    row_spacing: int = 1,
    shared_rays: bool = False,
    seed: int = 0,
    progress: Progress = silent,
) -> Transport:
    """Measure the transport with gather rays.

    A diffuse weight is the share of a point's cosine-distributed rays that end
    in a cell; albedo stays outside, so textures stay sharp. Mirrors, glass and
    cut-outs on the way are followed and their mean throughput counted in.
    Rays that leave the scene add nothing: domes are direct light.

    Parameters
    ----------
    rays_per_row
        Rays per view sample and lobe; powers of two stratify best.
    row_spacing
        1 computes a row at every view sample. Larger values compute rows on a
        pixel grid of this spacing (and wherever no row nearby fits) and
        interpolate between them.
    shared_rays
        One sequence of rays for all rows: what is noise else is then a shade that moves slowly over a surface.

    Notes
    -----
    Bitwise the same for any number of threads.
    """
    row_view: I32 = np.arange(view.n, dtype=np.int32)
    interpolation = None
    if row_spacing > 1:
        row_view, interpolation = sparse_rows_of_view(view, snapshot.camera, row_spacing)
    builder = RowBuilder(snapshot, tracer, gather, seed)

    numbers = row_view.astype(np.int64)
    stream = np.zeros_like(numbers) if shared_rays else numbers
    points = take_points(view.points, numbers)
    rows = rows_of_points(builder, points, view.to_eye[row_view], stream, rays_per_row, progress)
    lobes = lobes_of_rows(rows, view.points)
    return Transport(lobes, row_view, interpolation, rays_per_row, seed, stream if shared_rays else None)


def rows_of_points(
    builder: RowBuilder,
    points: SurfacePoints,
    to_eye: F32,
    stream: I64,
    n_rays: int,
    progress: Progress = silent,
) -> dict[str, SparseRows]:
    """Rows of some points by the name of their lobe; those for gloss are there if one of the points has any.

    Parameters
    ----------
    to_eye : (n, 3) float32
    stream : (n,)
        Number of each row's sequence of rays.
    n_rays
        Per row and lobe.
    """
    one_each = np.arange(len(stream) + 1, dtype=np.int64)
    rows = {"diffuse": builder.diffuse_rows(points, one_each, stream, n_rays, 0, progress, "gather rays")}
    glossy = np.flatnonzero(is_glossy(points))
    if len(glossy):
        base, edge = builder.specular_rows(points, to_eye, stream, glossy, n_rays, progress)
        rows |= {"specular_base": base, "specular_edge": edge}
    return rows


def lobes_of_rows(rows: dict[str, SparseRows], points: SurfacePoints) -> tuple[Lobe, ...]:
    """Rows by the name of their lobe, with the colours of all view samples."""
    tints = {"diffuse": points.albedo, "specular_base": points.specular, "specular_edge": points.specular_edge}
    return tuple(Lobe(name, of_lobe, tints[name]) for name, of_lobe in rows.items())
