"""Weights of interpolation that fit the lights at rest, at view samples whose records these lights differ much at."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from icheat_usd.materials import take_points
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, F64, I64, Bool, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport import Transport
from icheat_usd.transport.build import rows_of_points
from icheat_usd.transport.rays import RowBuilder
from icheat_usd.transport.sparse import SparseRows, take_rows

#: Samples are fitted whose records differ by more than this of the image's root mean square, in any light; of these
#: those that differ most, so many of all and no more than can be looked at in some seconds.
LEAST_DIFFERENCE, MOST_SHARE, MOST = 0.1, 0.01, 4096
#: Rays of each of them and lobe, in each of two estimates. Half as many made grazing lights worse.
RAYS = 2048
#: How strongly weights stay near the given ones, in units of the mean curvature.
PRIOR = 0.05
#: How much plausible lights count, all of them together, beside each of the lights at rest.
TRAINING_SHARE = 1.0
#: View samples that tell how bright an image they make.
_LEVEL_SAMPLES = 4096
#: Of coordinate descent: within a thousandth of the least squares.
_SWEEPS = 60
#: Samples that are looked at in one step: some tens of milliseconds.
_TOGETHER = 24
#: Records whose light of plausible lights is found in one step.
_RECORDS_TOGETHER = 2048
#: Of the seed of the rows: rays are others.
_OTHER_RAYS = 0x5EE4


class FitSource(NamedTuple):
    """What weights are fitted with."""

    tracer: Tracer
    training: F32  #: (n, n_gather), `transport.training.training_radiance`


class RestWeights:
    """Fits weights in steps; when lights move, these stay until they come to rest again.

    Interpolation is chosen for lights of any kind. Where geometry is a pixel wide it can be off by half of what one
    light brings to a sample, of which the light itself tells: its records differ much in it. Such samples are looked
    at with rays of their own under the lights at hand, and their weights are moved by least squares to what is seen,
    as far as that is no noise. Edits, groups and images of lights then come of these weights as they do of others.
    A light that is dragged is mostly like it was, but not always, and one or two lights tell little of more records:
    what plausible lights bring to these samples counts too.

    Parameters
    ----------
    transport : Transport
        Exact rows. The weights of its interpolation are changed in place.
    names
        Of the lobes that have rows.
    """

    def __init__(
        self,
        source: FitSource,
        snapshot: SceneSnapshot,
        view: ViewSamples,
        gather: GatherSamples,
        transport: Transport,
        names: tuple[str, ...],
    ) -> None:
        assert transport.interpolation is not None
        self._training = source.training
        self._view, self._spread = view, transport.interpolation
        self._before = replace(self._spread, weights=self._spread.weights.copy())
        self._lobes = [lobe for lobe in transport.lobes if lobe.name in names]
        self._builders = [
            RowBuilder(snapshot, source.tracer, gather, transport.seed + _OTHER_RAYS + half) for half in (0, 1)
        ]
        self._work: Iterator[None] | None = None
        self._is_done = False

    def forget(self) -> None:
        """Fit weights anew, to other lights."""
        self._work, self._is_done = None, False

    @property
    def is_done(self) -> bool:
        """Whether weights fit the lights: nothing is left to do until `forget`."""
        return self._is_done

    def step(self, products_of: Callable[[int], F32], radiance: F32) -> bool:
        """Do a part of the work; true after the last, which may have changed weights.

        Parameters
        ----------
        products_of
            Exact products of a light with all rows: (n_lobes, n_tiles, 64, 4).
        radiance : (n_lights, n_gather, 3)
            The same in every step.
        """
        if self._work is None:
            self._work = self._fit(products_of, radiance)
        self._is_done = next(self._work, self) is self
        if self._is_done:
            self._work = None
        return self._is_done

    def _fit(self, products_of: Callable[[int], F32], radiance: F32) -> Iterator[None]:
        products, shining = [], []
        differs = np.zeros(self._view.n, np.float32)
        for light, of_light in enumerate(radiance):
            at_rows = products_of(light)
            at_rows = np.ascontiguousarray(at_rows.reshape(len(at_rows), -1, 4)[:, : self._spread.n_columns, :3])
            image, differs_here = np.zeros((self._view.n, 3), np.float32), np.zeros(self._view.n, np.float32)
            for lobe, values in zip(self._lobes, at_rows, strict=True):
                self._add_differences(lobe.tint, values, image, differs_here)
                yield
            square = np.mean(np.square(image, dtype=np.float64))
            if square > 0:
                # All in units of the light's image, so that each light counts alike.
                level = np.float32(np.sqrt(square))
                products.append(at_rows / level)
                shining.append(of_light / level)
                np.maximum(differs, differs_here / np.float32(square), out=differs)
        samples = _most_different(differs)
        if not len(samples):
            self._spread.weights[:] = self._before.weights
            return
        some = np.arange(0, self._view.n, max(1, self._view.n // _LEVEL_SAMPLES))
        records = self._records_of(np.union1d(samples, some))
        # Three at a time are the channels of one light.
        training = np.ascontiguousarray(self._training[: len(self._training) // 3 * 3].T)
        of_training = np.empty((len(self._lobes), len(records), training.shape[1]), np.float32)
        for first in range(0, len(records), _RECORDS_TOGETHER):
            part = slice(first, first + _RECORDS_TOGETHER)
            for lobe, values in zip(self._lobes, of_training, strict=True):
                values[part] = take_rows(lobe.rows, records[part]).matmul(training)
            yield
        given, shown = self._shown(some, records, of_training)
        square = np.mean(np.square(np.einsum("nm,nmk->nk", given, shown)), axis=0)
        share = 3 * TRAINING_SHARE / max(1, len(square)) / np.where(square > 0, square, np.inf)
        factor = np.sqrt(share).astype(np.float32)
        yield
        at_records = np.concatenate([*(values[:, records] for values in products), factor * of_training], axis=2)
        columns = np.concatenate([*shining, factor * training], axis=1)
        seen = np.empty((2, len(samples), columns.shape[1]), np.float32)
        for first in range(0, len(samples), _TOGETHER):
            for half, builder in enumerate(self._builders):
                part = slice(first, first + _TOGETHER)
                seen[half, part] = self._look(builder, samples[part], columns)
                yield
        self._put(samples, records, at_records, seen)

    def _add_differences(self, tint: F32, at_rows: F32, image: F32, differs: F32) -> None:
        """Add what a lobe shows of a light, and the variance of its records at each sample, mean of the channels."""
        mean, square = self._before.matmul(at_rows), self._before.matmul(np.square(at_rows))
        image += tint * mean
        differs += np.mean(np.square(tint) * np.maximum(square - np.square(mean), 0), axis=1)

    def _look(self, builder: RowBuilder, samples: I64, light: F32) -> F32:
        """What rays of their own say of some samples, (n, k), of light (n_gather, k) of several lights and channels."""
        points = take_points(self._view.points, samples)
        rows = rows_of_points(builder, points, self._view.to_eye[samples], samples, RAYS)
        out = np.zeros((len(samples), light.shape[1]), np.float32)
        for lobe in self._lobes:
            if lobe.name in rows:
                out += _in_columns(lobe.tint[samples], light.shape[1]) * rows[lobe.name].matmul(light)
        return out

    def _records_of(self, samples: I64) -> I64:
        """Numbers of the records that some samples are made of, ascending."""
        entries = _entries_of(self._before, samples)
        return np.unique(self._before.indices[entries.place[entries.is_there]]).astype(np.int64)

    def _shown(self, samples: I64, records: I64, at_records: F32) -> tuple[F64, F64]:
        """Weights of the records of some samples (n, m), and what these would show with each alone: (n, m, k).

        Parameters
        ----------
        records
            Ascending; theirs are among them.
        at_records : (n_lobes, n_records, k)
            What shines on these.
        """
        entries = _entries_of(self._before, samples)
        record = np.searchsorted(records, self._before.indices[entries.place])
        shown = np.zeros((*record.shape, at_records.shape[2]))
        for lobe, values in zip(self._lobes, at_records, strict=True):
            shown += _in_columns(lobe.tint[samples], at_records.shape[2])[:, None] * values[record]
        given = np.where(entries.is_there, self._before.weights[entries.place], 0).astype(np.float64)
        return given, shown * entries.is_there[:, :, None]

    def _put(self, samples: I64, records: I64, at_records: F32, seen: F32) -> None:
        """Take the weights that there were before, some samples' (ascending) towards what two estimates (2, n, k) say.

        `records` and `at_records` are those of `_shown`.
        """
        fitted = fitted_weights(*self._shown(samples, records, at_records), seen[0], seen[1])
        entries = _entries_of(self._before, samples)
        self._spread.weights[:] = self._before.weights
        self._spread.weights[entries.place[entries.is_there]] = fitted[entries.is_there]


class _Entries(NamedTuple):
    """Where in a table the entries of some of its rows are."""

    place: I64  #: (n, most)
    is_there: Bool  #: (n, most) False where a row has fewer


def _entries_of(table: SparseRows, rows: I64) -> _Entries:
    """All entries of some rows."""
    begin = table.indptr[rows]
    count = table.indptr[rows + 1] - begin
    place = begin[:, None] + np.arange(count.max())
    is_there = place < (begin + count)[:, None]
    return _Entries(np.where(is_there, place, begin[:, None]), is_there)


def _in_columns(tint: F32, n: int) -> F32:
    """Tint (m, 3) of light in `n` columns, three of each light."""
    return np.tile(tint, n // 3)


def fitted_weights(given: F64, shown: F64, one: F32, other: F32) -> F64:
    """Weights with which what records show comes close to what was seen.

    Least squares with the given weights as a prior, and none below 0: light would be, under edits or another light. Of
    the step to these weights as much is taken as is sure not to be noise, by the two estimates (James and Stein 1961).

    Parameters
    ----------
    given : (n, m)
        Of m records of each of n samples, not below 0.
    shown : (n, m, k)
        What a sample would show with the light of each of them, 0 where it has fewer.
    one, other : (n, k)
        Independent estimates of what it shows.
    """
    one, other = one.astype(np.float64), other.astype(np.float64)
    missing = (one + other) / 2 - np.einsum("nm,nmk->nk", given, shown)
    noise = np.square((one - other) / 2).sum(axis=1)
    sure = np.maximum(1 - noise / np.maximum(np.square(missing).sum(axis=1), np.finfo(np.float64).tiny), 0)
    curvature = shown @ shown.transpose(0, 2, 1)
    size = np.einsum("nmm->n", curvature) / np.maximum((shown != 0).any(axis=2).sum(axis=1), 1)
    # Where no record shows anything, there is nothing to mix.
    curvature += np.where(size > 0, PRIOR * size, 1)[:, None, None] * np.eye(given.shape[1])
    pull = np.einsum("nmk,nk->nm", shown, missing)
    step = np.zeros_like(given)
    for _ in range(_SWEEPS):  # of coordinate descent
        for record, here in enumerate(curvature.transpose(1, 0, 2)):
            slope = pull[:, record] - np.einsum("nm,nm->n", here, step)
            step[:, record] = np.maximum(step[:, record] + slope / here[:, record], -given[:, record])
    return np.asarray(given + sure[:, None] * step)


def _most_different(differs: F32) -> I64:
    """Samples to be fitted, ascending, of those that differ by squares of the image's root mean square."""
    samples = np.flatnonzero(differs > LEAST_DIFFERENCE**2)
    most = min(int(MOST_SHARE * len(differs)), MOST)
    return np.sort(samples[np.argsort(-differs[samples], kind="stable")[:most]])
