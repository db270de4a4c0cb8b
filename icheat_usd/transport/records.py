"""Where rows of transport are kept: an adaptive choice of view samples, and how the others follow from them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import records as kernels
from icheat_usd.kernels.rows import pack_rows
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, F64, I32, I64, Bool, Camera
from icheat_usd.transport.sparse import SparseRows, take_rows

BUCKET = 8  # pixels
_LEAST_GAIN = 0.005  # of the number of records: blocks to divide for which another round of rays is worth its time
_FAINT = 0.02  # of the light that arrives: what shows less, as reflections in glass do, gets no records of its own
_FOR_BLOCKS = 0.57  # of the records: some are left for sheets that were found by no corner, and for outliers
_MISFIT = 0.5  # of a sample comes from the corners of its block: with less, records beside them must be near
_PRIOR = 0.02  # squared relative error where a sheet has no record of its own to tell, before any has
#: What halving a block leaves of its squared error: a bend of the light 1/16, an edge 1/2.
_DECAY = 0.125

#: Responses of view samples to the training lights, from two independent sets of rays: (n,) samples to
#: (2, n_lobes, n, n_lights). Products of the two have no noise in the mean. Neighbours' rays should be the same
#: in either set, so that their differences are not noise.
Probe = Callable[[I64], F32]


@dataclass(frozen=True)
class RecordSettings:
    """How densely rows are kept.

    Raises
    ------
    ValueError
        A value makes no sense.
    """

    tolerance: float = 0.01  #: relative RMS error of the image that interpolation may add
    max_share: float = 0.2  #: of the view samples: there are no more records, where there is a choice
    coarsest: int = 32  #: pixels, a power of two: side of the largest blocks

    def __post_init__(self) -> None:
        if not self.tolerance > 0 or not 0 < self.max_share <= 1:
            raise ValueError(f"tolerance {self.tolerance} must be positive, and max_share {self.max_share} in (0, 1]")
        if self.coarsest < 2 or self.coarsest & (self.coarsest - 1) or self.coarsest > 128:
            raise ValueError(f"coarsest is a power of two from 2 to 128, not {self.coarsest}")


@dataclass(frozen=True, eq=False)
class Records:
    """View samples with rows of their own, and the weights that give all others."""

    view: I32  #: (n,) view samples
    interpolation: SparseRows  #: (n_view x n) rows sum to 1
    #: Relative RMS error expected of the training lights; inf before the first test. Less than the true one after
    #: records or weights were chosen by what it is judged by: see `add_outliers` and `fit_weights`.
    error: float
    fit: F32  #: (n_view,) share of each sample that comes from the corners of its block
    mesh: Mesh  #: what they were made from, which changes with the next


class _Weights(NamedTuple):
    number: I64  #: (n,) of records
    record: I32  #: (n, 8) padded
    weight: F32  #: (n, 8) padded
    fit: F32  #: (n,) share from the corners of the block
    reach: F32  #: (n,) pixels to the nearest record, where `fit` is not 1


class Mesh:
    """The quadtree, its corners, and the records on and beside them."""

    def __init__(self, view: ViewSamples, camera: Camera, coarsest: int) -> None:
        self.view = view
        left, right, bottom, top = camera.window
        shape = view.height, view.width
        size = (right - left) / view.width
        self.extent = np.full(view.n, size, np.float32)
        self._nearness = np.ones(view.n, np.float32)
        if not camera.orthographic:
            x = left + (view.pixel % view.width + 0.5) * size
            y = top - (view.pixel // view.width + 0.5) / view.height * (top - bottom)
            depth = np.maximum(view.depth, np.float32(1e-20))
            self.extent *= depth
            self._nearness = (np.sqrt(x * x + y * y + 1) / depth).astype(np.float32)
        self.first = np.full(shape, -1, np.int64)
        self.first.reshape(-1)[view.pixel[::-1]] = np.arange(view.n)[::-1]
        self.corners = np.empty(view.n, np.float32)  #: pixels to the surface that rises nearest, at most 4
        kernels.corner_distance(
            self.first, view.points.position, view.points.shading_normal, self.extent, view.pixel, self.corners
        )
        self.level = np.full(shape, coarsest.bit_length() - 1, np.int32)
        self.parent = self.level.copy()  #: before the last division
        self.corner = np.zeros(shape, np.uint8)
        kernels.mark_corners(self.level, self.corner)
        self.record = np.full(view.n, -1, np.int32)
        self.record_view = np.empty(0, np.int64)

    def missing_corners(self) -> I64:
        """First view samples of the pixels at corners that have no record yet."""
        samples = self.first[self.corner != 0]
        samples = samples[samples >= 0]
        return np.sort(samples[self.record[samples] < 0])

    def add(self, samples: I64) -> None:
        self.record[samples] = np.arange(len(samples), dtype=np.int32) + len(self.record_view)
        self.record_view = np.concatenate([self.record_view, samples])

    def buckets(self) -> tuple[I64, I64]:
        """Records by blocks of `BUCKET` pixels, row by row: first of each, (n_blocks + 1,), and records."""
        view, pixel = self.view, self.view.pixel[self.record_view]
        n_x = (view.width + BUCKET - 1) // BUCKET
        n_y = (view.height + BUCKET - 1) // BUCKET
        bucket = pixel // view.width // BUCKET * n_x + pixel % view.width // BUCKET
        record = np.argsort(bucket, kind="stable")
        return np.searchsorted(bucket[record], np.arange(n_x * n_y + 1)), record

    def weights(self, samples: I64, strict: bool = True) -> _Weights:
        """Of some samples; without `strict` records of other sheets will do."""
        view = self.view
        record_at = np.where(self.first >= 0, self.record[np.maximum(self.first, 0)], -1).astype(np.int32)
        bucket_begin, bucket_record = self.buckets()
        n = len(samples)
        count = np.empty(n, np.int64)
        record = np.empty((n, kernels.MAX_ENTRIES), np.int32)
        weight = np.empty((n, kernels.MAX_ENTRIES), np.float32)
        fit, reach = np.empty(n, np.float32), np.empty(n, np.float32)
        kernels.record_weights(
            samples,
            view.pixel,
            view.points.position,
            view.points.shading_normal,
            view.points.instance,
            self.extent,
            self.corners,
            self._nearness,
            self.level,
            self.corner,
            record_at,
            self.record,
            self.record_view,
            BUCKET,
            bucket_begin,
            bucket_record,
            int(strict),
            count,
            record,
            weight,
            fit,
            reach,
        )
        return _Weights(count, record, weight, fit, reach)

    def interpolate(self, samples: I64) -> SparseRows:
        """Records and weights of some samples; a sample with a record takes that alone."""
        return _packed(self.weights(samples), len(self.record_view))

    def split(self, blocks: Bool) -> None:
        """Divide the marked blocks (a mask of pixels, whole blocks), and what balance asks for."""
        self.parent[:] = self.level
        self.level[blocks] -= 1
        kernels.balance(self.level)
        kernels.mark_corners(self.level, self.corner)


def place_records(
    view: ViewSamples, camera: Camera, probe: Probe, tint: F32, settings: RecordSettings
) -> Iterator[Records]:
    """Choose view samples to keep rows at, coarse ones first; every choice is usable.

    Records are the corners of a quadtree over the image, and samples on
    sheets of surface that no corner near lies on. Blocks are divided, and
    more of the others added, as long as the light at new records is not what
    was interpolated there before, until the error expected of the image is
    below the tolerance.

    Parameters
    ----------
    probe
        Rows of some samples times the training lights.
    tint : (n_lobes, n_view)
        What the lobes' responses are multiplied with; scalar.

    Yields
    ------
    Records
        Ever finer; those of one are the first of the next.
    """
    mesh = Mesh(view, camera, settings.coarsest)
    most = int(settings.max_share * view.n)
    shown = tint.max(axis=0) > _FAINT
    table: Records | None = None
    response = np.empty((2, len(tint), 0, 0), np.float32)
    tests = _Tests()
    while True:
        fresh = mesh.missing_corners()
        mesh.add(fresh)
        new = np.concatenate([fresh, _add_orphans(mesh, most, shown, 8)])
        answer = probe(new)
        if table is None:
            response = answer
            exposure = _exposure(answer, tint[:, new])
        else:
            missed = _missed(answer, _apply(table.interpolation, new, response), tint[:, new], exposure)
            tests = tests.extended(view.pixel[new], mesh.parent.reshape(-1)[view.pixel[new]], table.fit[new], missed)
            response = np.concatenate([response, answer], axis=2)
        table = _records(mesh)
        share = _expected(mesh, tests, table.fit, shown)
        yield replace(table, error=float(np.sqrt(share.sum())))
        divisible = np.flatnonzero((share > 0) & (mesh.level.reshape(-1) > 0))
        ranked = divisible[np.lexsort((divisible, share[divisible]))]
        ranked = ranked[np.cumsum(share[ranked]) > settings.tolerance**2][::-1]
        ranked = ranked[: max(0, (int(_FOR_BLOCKS * most) - len(mesh.record_view)) // 3)]
        if len(ranked) < _LEAST_GAIN * len(mesh.record_view):
            break
        chosen = np.zeros(mesh.level.size, bool)
        chosen[ranked] = True
        mesh.split(chosen[_block_of(mesh.level)])
    new = _add_orphans(mesh, most, shown, mesh.level.size)
    if len(new):
        probe(new)
        yield replace(_records(mesh), error=float(np.sqrt(share.sum())))


class _Exposure(NamedTuple):
    """What makes the lights comparable."""

    square: F64  #: (n_lights,) mean square of the image
    trust: F64  #: (n_lights,) share of it that is not noise


def _exposure(answer: F32, tint: F32) -> _Exposure:
    one, two = (answer * tint[..., None]).sum(axis=1).astype(np.float64)
    square = np.maximum(np.mean(one * two, axis=0), 0)
    noisy = 0.5 * np.mean(one * one + two * two, axis=0)
    trust = np.where(noisy > 0, square / np.where(noisy > 0, noisy, 1), 0)
    return _Exposure(np.where(square > 0, square, 1), trust * trust)


def _missed(answer: F32, predicted: F32, tint: F32, exposure: _Exposure) -> F64:
    """Mean over lights of the squared error, relative to the light there or in the image, whichever is more: (n,)."""
    true = (answer * tint[..., None]).sum(axis=1).astype(np.float64)
    wrong = ((answer - predicted) * tint[..., None]).sum(axis=1).astype(np.float64)
    relative = wrong[0] * wrong[1] / (np.mean(true, axis=0) ** 2 + exposure.square)
    return relative @ exposure.trust / max(exposure.trust.sum(), 1e-30)


@dataclass(frozen=True)
class _Tests:
    """What interpolation said where records were then added, and how wrong it was."""

    pixel: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    level: I64 = field(default_factory=lambda: np.empty(0, np.int64))  #: of the block then
    fit: F64 = field(default_factory=lambda: np.empty(0))
    missed: F64 = field(default_factory=lambda: np.empty(0))

    def extended(self, pixel: I32, level: I32, fit: F32, missed: F64) -> _Tests:
        return _Tests(
            np.concatenate([self.pixel, pixel]),
            np.concatenate([self.level, level]),
            np.concatenate([self.fit, fit]),
            np.concatenate([self.missed, missed]),
        )


def _expected(mesh: Mesh, tests: _Tests, fit: F32, shown: Bool) -> F64:
    """Squared relative error expected of each block, as a share of the image: (n_pixels,), at the block's first pixel.

    Samples that their block's corners give and those beside them are judged
    apart, each by the tests of its kind in the parent of the block.
    """
    height, width = mesh.level.shape
    view = mesh.view
    block = _block_of(mesh.level).reshape(-1)
    own = block[view.pixel]
    out = np.zeros(height * width)
    origin = np.unique(block)
    level = mesh.level.reshape(-1)[origin]
    y, x = origin // width, origin % width
    side = 1 << (level + 1)
    py, px = y & ~(side - 1), x & ~(side - 1)
    for inside in (True, False):
        share = np.bincount(own, np.where(shown, fit if inside else 1 - fit, 0), len(out))[origin] / view.n
        of_kind = np.flatnonzero((tests.fit >= _MISFIT) == inside)
        prior = float(np.mean(tests.missed[of_kind])) if len(of_kind) else _PRIOR
        total, count = np.zeros(len(origin)), np.zeros(len(origin))
        for here in np.unique(level):
            blocks = np.flatnonzero(level == here)
            chosen = of_kind[tests.level[of_kind] == here + 1]
            ty, tx = tests.pixel[chosen] // width, tests.pixel[chosen] % width
            shift, stride = int(here) + 1, (width >> (int(here) + 1)) + 2
            n_places = stride * ((height >> shift) + 2)
            sums, counts = np.zeros(n_places), np.zeros(n_places)
            edge = (1 << shift) - 1
            # A test on the border of parents counts for each of them.
            for dy in (0, 1):
                for dx in (0, 1):
                    also = ((dy == 0) | (ty & edge == 0)) & ((dx == 0) | (tx & edge == 0))
                    also &= (ty >= dy) & (tx >= dx)
                    place = ((ty[also] - dy) >> shift) * stride + ((tx[also] - dx) >> shift)
                    sums += np.bincount(place, tests.missed[chosen[also]], n_places)
                    counts += np.bincount(place, minlength=n_places)
            place = (py[blocks] >> shift) * stride + (px[blocks] >> shift)
            total[blocks] += sums[place]
            count[blocks] += counts[place]
        missed = np.where(count > 0, total / np.maximum(count, 1), prior)
        if inside:
            missed *= _DECAY
        else:  # most folds do no harm and some do much: a few harmless tests say little
            missed = np.maximum(missed, prior)
        out[origin] += share * np.maximum(missed, 0)
    return out


def _block_of(level: I32) -> I64:
    """First pixel of each pixel's block: (height, width)."""
    height, width = level.shape
    y, x = np.mgrid[:height, :width]
    mask = ~((1 << level) - 1)
    return (y & mask) * width + (x & mask)


def _apply(interpolation: SparseRows, samples: I64, response: F32) -> F32:
    """Interpolated responses of some samples: (2, n_lobes, n, n_lights)."""
    rows = take_rows(interpolation, samples)
    return np.stack([np.stack([rows.matmul(lobe) for lobe in one]) for one in response])


def _add_orphans(mesh: Mesh, most: int, shown: Bool, divisions: int) -> I64:
    """Give records to samples on sheets that have none near: (n,) the new ones.

    Near is half a block; on a grid of that spacing, and where the grid does
    not meet the sheet on finer ones, down to the block's side over `divisions`.
    """
    view = mesh.view
    x, y = view.pixel % view.width, view.pixel // view.width
    side = 1 << mesh.level.reshape(-1)[view.pixel]
    finest = np.maximum(side // divisions, 1)
    near = np.maximum(side // 2, 1)
    spacing = near.copy()
    missing = np.arange(view.n)
    added = [np.empty(0, np.int64)]
    while len(missing) and len(mesh.record_view) < most:
        weights = mesh.weights(missing)
        far = (weights.fit < _MISFIT) & (weights.reach > near[missing]) & shown[missing]
        missing = missing[far | (weights.number == 0)]
        step = spacing[missing]
        on_grid = (x[missing] % step == step // 2) & (y[missing] % step == step // 2)
        chosen = missing[on_grid][: most - len(mesh.record_view)]
        mesh.add(chosen)
        added.append(chosen)
        missing = missing[step > finest[missing]]
        spacing[missing] //= 2
    return np.concatenate(added)


def _records(mesh: Mesh) -> Records:
    found = mesh.weights(np.arange(mesh.view.n))
    left = np.flatnonzero(found.number == 0)
    if len(left):
        loose = mesh.weights(left, strict=False)
        found.number[left], found.record[left], found.weight[left] = loose.number, loose.record, loose.weight
    rows = _packed(found, len(mesh.record_view))
    return Records(mesh.record_view.astype(np.int32), rows, np.inf, found.fit, mesh)


def _packed(found: _Weights, n_records: int) -> SparseRows:
    indptr = np.concatenate([[0], np.cumsum(found.number)]).astype(np.int64)
    indices, weights = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32)
    pack_rows(found.number, indptr, found.record, found.weight, indices, weights)
    return SparseRows(indptr, indices, weights, n_records)


def tile_order(position: F32, normal: F32, lanes: int = 64) -> I64:
    """Order in which `lanes` records after one another lie close together and face alike.

    Halves at multiples of `lanes`, along the longest axis of place and normal; a turn by
    about a radian is as far as 0.7 of all the records' extent.
    """
    extent = float(np.ptp(position, axis=0).max()) if len(position) else 0.0
    axes = np.concatenate([position, normal * np.float32(0.7 * extent)], axis=1)
    order = np.arange(len(axes))
    tasks = [(0, len(axes))]
    while tasks:
        begin, end = tasks.pop()
        tiles = -(-(end - begin) // lanes)
        if tiles < 2:
            order[begin:end].sort()
            continue
        rows = order[begin:end]
        axis = int(np.argmax(np.ptp(axes[rows], axis=0)))
        order[begin:end] = rows[np.argsort(axes[rows, axis], kind="stable")]
        middle = begin + tiles // 2 * lanes
        tasks += [(begin, middle), (middle, end)]
    return order
