"""A converged gather at some pixels: rows of so many rays that what they add up to is a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icheat_usd.materials import is_glossy, take_points
from icheat_usd.progress import silent
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I64, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport import Lobe, SparseRows, Transport
from icheat_usd.transport.rays import RowBuilder

_RAYS_AT_ONCE = 512 * 16_384  # bounds memory: a row holds up to as many entries as rays


@dataclass(frozen=True)
class Probe:
    """Pixels, one out of each block of the image, and the view samples that they show."""

    pixel: I64  #: (n,)
    samples: I64  #: (m,) view samples, grouped by pixel
    owner: I64  #: (m,) position in `pixel`
    throughput: F32  #: (m, 3)
    width: int  #: of the image
    grid: tuple[int, int]  #: rows and columns of the blocks
    block: int  #: pixels along a side of one

    def to_pixels(self, radiance: F32) -> F32:
        """What the pixels show when the samples send this: (m, 3) to (n, 3)."""
        out = np.zeros((len(self.pixel), 3))
        np.add.at(out, self.owner, self.throughput.astype(np.float64) * radiance)
        return out.astype(np.float32)

    def part(self, n: int, seed: int = 0) -> Probe:
        """Some of the pixels."""
        if n >= len(self.pixel):
            return self
        kept = np.sort(np.random.default_rng([seed, 0x9A87]).choice(len(self.pixel), n, replace=False))
        position = np.full(len(self.pixel), -1, np.int64)
        position[kept] = np.arange(n)
        mine = np.flatnonzero(position[self.owner] >= 0)
        return replace(
            self,
            pixel=self.pixel[kept],
            samples=self.samples[mine],
            owner=position[self.owner[mine]],
            throughput=self.throughput[mine],
        )


def choose_pixels(view: ViewSamples, n: int, seed: int = 0) -> Probe:
    """About `n` pixels, one at random out of each square block; blocks where nothing is seen stay empty."""
    block = max(1, int(np.sqrt(view.width * view.height / max(n, 1))))
    columns, rows = -(-view.width // block), -(-view.height // block)
    x, y = view.pixel % view.width, view.pixel // view.width
    pixels, first = np.unique(view.pixel, return_index=True)
    rng = np.random.default_rng([seed, 0x9188])
    shuffled = rng.permutation(len(pixels))
    of_block = ((y[first] // block) * columns + x[first] // block)[shuffled]
    _, chosen = np.unique(of_block, return_index=True)
    return probe_of(view, np.sort(pixels[shuffled[chosen]]), (rows, columns), block)


def probe_of(view: ViewSamples, pixel: I64, grid: tuple[int, int], block: int) -> Probe:
    """The view samples of given pixels, ascending."""
    position = np.full(view.width * view.height, -1, np.int64)
    position[pixel] = np.arange(len(pixel))
    owner = position[view.pixel]
    samples = np.flatnonzero(owner >= 0)
    return Probe(
        np.asarray(pixel, np.int64), samples, owner[samples], view.throughput[samples], view.width, grid, block
    )


def view_of(view: ViewSamples, samples: I64) -> ViewSamples:
    """Some of the view samples as a view of their own."""
    return replace(
        view,
        pixel=view.pixel[samples],
        throughput=view.throughput[samples],
        points=take_points(view.points, samples),
        to_eye=view.to_eye[samples],
        depth=view.depth[samples],
    )


def converged_transport(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    view: ViewSamples,
    n_rays: int,
    seed: int,
) -> Transport:
    """Rows of their own for every sample of `view`, uncompressed.

    Memory: 8 bytes for each of at most `n_rays` entries a row and lobe.
    """
    builder = RowBuilder(snapshot, tracer, gather, seed)
    stream = np.arange(view.n, dtype=np.int64)
    one_each = np.arange(view.n + 1, dtype=np.int64)
    diffuse = builder.diffuse_rows(view.points, one_each, stream, n_rays, 0, silent, "")
    lobes = [Lobe("diffuse", diffuse, view.points.albedo)]
    glossy = np.flatnonzero(is_glossy(view.points))
    if len(glossy):
        base, edge = builder.specular_rows(view.points, view.to_eye, stream, glossy, n_rays, silent)
        lobes.append(Lobe("specular_base", base, view.points.specular))
        lobes.append(Lobe("specular_edge", edge, view.points.specular_edge))
    return Transport(tuple(lobes), stream.astype(np.int32), None, n_rays, seed)


def converged_products(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    view: ViewSamples,
    n_rays: int,
    seed: int,
    radiance: F32,
) -> F32:
    """Indirect light of every sample of `view` under several lights; rows are dropped as soon as they are used.

    Parameters
    ----------
    radiance : (n_lights, n_gather, 3) float32

    Returns
    -------
    (n_lights, view.n, 3) float32
    """
    out = np.empty((len(radiance), view.n, 3), np.float32)
    at_once = max(1, _RAYS_AT_ONCE // n_rays)
    for first in range(0, view.n, at_once):
        part = np.arange(first, min(first + at_once, view.n))
        rows = converged_transport(snapshot, tracer, gather, view_of(view, part), n_rays, seed + 7919 * (1 + first))
        for light, b in enumerate(radiance):
            out[light, part] = rows.to_view(b)
    return out


class InterpolationReference(NamedTuple):
    """What interpolation makes of converged rows at the records that the samples of a probe need."""

    records: I64  #: rows of the transport
    weights: SparseRows  #: (m x n_records)

    def to_samples(self, products: list[F32], tints: list[F32]) -> F32:
        """Indirect light of the samples from products at the records, one array per lobe."""
        total = np.zeros((self.weights.n_rows, 3), np.float32)
        for product, tint in zip(products, tints, strict=True):
            total += tint * self.weights.matmul(product)
        return total


def records_of(interpolation: SparseRows, samples: I64) -> InterpolationReference:
    """The records that some view samples are interpolated from."""
    begin, end = interpolation.indptr[samples], interpolation.indptr[samples + 1]
    place = np.concatenate([np.arange(b, e) for b, e in zip(begin.tolist(), end.tolist(), strict=True)] or [[]])
    place = place.astype(np.int64)
    records, column = np.unique(interpolation.indices[place], return_inverse=True)
    indptr = np.concatenate([[0], np.cumsum(end - begin)]).astype(np.int64)
    weights = SparseRows(indptr, column.astype(np.int32), interpolation.weights[place], len(records))
    return InterpolationReference(records.astype(np.int64), weights)


def points_with_eye(view: ViewSamples, transport: Transport, records: I64) -> ViewSamples:
    """The view samples at which records stand."""
    return view_of(view, transport.row_view[records].astype(np.int64))
