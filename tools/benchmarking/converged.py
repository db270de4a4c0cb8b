"""A converged gather at some pixels: rows of so many rays that what they add up to is a reference."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icheat_usd.materials import take_points
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.samples.wavelets import haar_forward, haar_inverse
from icheat_usd.scene import F32, I64, Bool, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport import SparseRows, Transport
from icheat_usd.transport.build import lobes_of_rows, rows_of_points
from icheat_usd.transport.packed import LANES, PackedRows, PackedTransport
from icheat_usd.transport.rays import RowBuilder
from icheat_usd.transport.sparse import take_rows

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
    stream: I64 | None = None,
) -> Transport:
    """Rows of their own for every sample of `view`, uncompressed.

    `stream`, (view.n,), numbers the sequences of rays: equal numbers are equal rays.
    Memory: 8 bytes for each of at most `n_rays` entries a row and lobe.
    """
    builder = RowBuilder(snapshot, tracer, gather, seed)
    number = np.arange(view.n, dtype=np.int64)
    rows = rows_of_points(builder, view.points, view.to_eye, number if stream is None else stream, n_rays)
    return Transport(lobes_of_rows(rows, view.points), number.astype(np.int32), None, n_rays, seed)


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


def lossy_errors(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    gather: GatherSamples,
    view: ViewSamples,
    packed: PackedTransport,
    samples: I64,
    n_rays: int,
    seeds: tuple[int, int],
    radiance: F32,
) -> tuple[F32, F32]:
    """Light that interpolation, and both that and packing, give some view samples, less that of rows of their own.

    All rows have many rays, so that the noise of the transport's own is not in what is lost: the records' stand in
    the terms that packing kept of these, and what rounding did to those is added. A sample and the records that it is
    made from have the same rays: where they see the same, what is noise still is in both, and not in the difference.
    Every sample has other rays.

    Parameters
    ----------
    packed
        With the transport that it was made from.
    n_rays
        Per row and lobe.
    seeds
        Of two independent estimates.
    radiance : (n_lights, n_gather, 3) float32

    Returns
    -------
    (2, n_lights, len(samples), 3) float32 each
        By estimate.
    """
    transport = packed.source
    assert transport is not None and transport.interpolation is not None
    n_lights = len(radiance)
    b = np.ascontiguousarray(radiance.transpose(1, 0, 2).reshape(-1, 3 * n_lights))
    kept = {
        lobe.name: _KeptTerms(lobe.rows, exact.rows, b)
        for lobe, exact in zip(packed.lobes, transport.lobes, strict=True)
        if lobe.rows.index.size
    }
    out = np.zeros((2, 2, len(samples), 3 * n_lights), np.float32)
    at_once = max(1, _RAYS_AT_ONCE // (8 * n_rays))
    for first in range(0, len(samples), at_once):
        some = samples[first : first + at_once]
        own, here = np.arange(len(some)), slice(first, first + len(some))
        used = take_rows(transport.interpolation, some)
        record, n = used.indices.astype(np.int64), len(used.indices)
        spread = SparseRows(used.indptr, np.arange(n, dtype=np.int32), used.weights, n)
        seen = view_of(view, np.concatenate([some, transport.row_view[record].astype(np.int64)]))
        stream = first + np.concatenate([own, np.repeat(own, np.diff(used.indptr))])
        both = [
            {
                lobe.name: lobe
                for lobe in converged_transport(snapshot, tracer, gather, seen, n_rays, seed, stream).lobes
            }
            for seed in seeds
        ]
        for name, terms in kept.items():
            lobes = [lobes[name] for lobes in both if name in lobes]
            packed_products = terms.products(record, [lobe.rows.rows(len(some), len(some) + n) for lobe in lobes])
            for half, (lobe, at_records) in enumerate(zip(lobes, packed_products, strict=True)):
                exact = lobe.rows.matmul(b)
                tint = np.tile(lobe.tint[: len(some)], (1, n_lights))
                for kind, products in enumerate((np.ascontiguousarray(exact[len(some) :]), at_records)):
                    out[kind, half, here] += tint * (spread.matmul(products) - exact[: len(some)])
    interpolated, with_packing = out.reshape(2, 2, len(samples), n_lights, 3).transpose(0, 1, 3, 2, 4)
    return interpolated, with_packing


def changed_rows(before: SparseRows, after: SparseRows) -> Bool:
    """Which rows of two matrices with entries in the same places have other weights: (n_rows,)."""
    n_changed = np.concatenate([[0], np.cumsum(before.weights != after.weights)])
    return np.asarray(np.diff(n_changed[before.indptr]) > 0)


def samples_of_noisy_pixels(probe: Probe, losses: tuple[F32, F32], n: int) -> I64:
    """Positions in the probe's samples of the `n` pixels whose noise is the largest share of any light's.

    Parameters
    ----------
    losses
        Of `lossy_errors`, for the samples of the probe.
    """
    share = np.zeros(len(probe.pixel))
    for off in losses:
        for one, two in off.transpose(1, 0, 2, 3):
            noise = np.square(probe.to_pixels(one - two)).sum(axis=1)
            share = np.maximum(share, noise / max(float(noise.sum()), 1e-30))
    chosen = np.zeros(len(share), bool)
    chosen[np.argsort(-share, kind="stable")[:n]] = True
    return np.flatnonzero(chosen[probe.owner])


class _KeptTerms:
    """Products of other rows in the terms that a lobe keeps of its own."""

    def __init__(self, packed: PackedRows, exact: SparseRows, b: F32) -> None:
        self._packed, self._exact = packed, exact
        self._coefficients = haar_forward(packed.tree, b)
        self._products = packed.matmul(b)

    def products(self, record: I64, versions: list[SparseRows]) -> list[F32]:
        """Of versions of the rows of some records, each (len(record), k), with what rounding adds to the lobe's own."""
        n = self._coefficients.shape[1]
        out = [np.zeros((len(record), n), np.float32) for _ in versions]
        tile = record // LANES
        for number in np.unique(tile).tolist():
            begin, end = self._packed.tile_begin[number : number + 2]
            which = np.flatnonzero(tile == number)
            seen = np.zeros_like(self._coefficients)
            index = self._packed.index[begin:end]
            seen[index] = self._coefficients[index]
            b = haar_inverse(self._packed.tree, seen).astype(np.float32)
            rounding = self._products[record[which]] - take_rows(self._exact, record[which]).matmul(b)
            for rows, products in zip(versions, out, strict=True):
                products[which] = take_rows(rows, which).matmul(b) + rounding
        return out
