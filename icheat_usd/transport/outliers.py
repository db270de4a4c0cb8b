"""View samples whose light follows from no records beside them, such as bars a pixel wide, get records of their own."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import outliers as kernels
from icheat_usd.scene import F32, F64, I32, I64, Bool
from icheat_usd.transport.records import Records, RecordSettings
from icheat_usd.transport.sparse import SparseRows, select_rows, take_rows

_ROUNDS = 8  # of records, each of which may spare their neighbours one
_LEAST = 0.0005  # of the samples: outliers for which a round is worth its time
_CHUNK = 1 << 14  # samples
_NOISE = 0.02  # squared relative error below which a light's noise does not count against it
#: Of a set's variance: what the lesser of two sets that agree in sign by chance leaves, and some more
#: where geometry gives no reason for an outlier.
_CHANCE, _CHANCE_ON_SHEETS = 0.1, 0.5
_ON_SHEET = 0.99  # of a sample comes from the corners of its block, which all lie on one surface with it
_CREASE = 0.5  # pixels to a surface that rises from a sample's own
#: Squared error in creases, as a share of the squared light there, beyond what the survey saw: a lamp so near that no
#: light known resembles it shines on each of their pixels in another way.
_IN_CREASES = 0.02
_BLOCK = 16  # pixels over which noise is averaged


@dataclass(frozen=True, eq=False)
class Survey:
    """What few rays say about the light at every view sample, the same rays at all of them."""

    diffuse: F32  #: (n_view, 2, n_lights) before the tint, from two independent sets of rays
    glossy: I64  #: (n,) view samples with a reflection that matters, ascending
    specular: F32  #: (n, 2, 2, n_lights) the same for the two specular lobes, by set and lobe
    #: (m,) view samples that were looked at with more rays, ascending
    close: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    #: (m, 2, n_lights) what these say of `diffuse`
    closer: F32 = field(default_factory=lambda: np.empty((0, 2, 0), np.float32))

    @cached_property
    def closer_of(self) -> I32:
        """Row of `closer` of each view sample, or -1: (n_view,)."""
        return _places(self.close, len(self.diffuse))

    @cached_property
    def gloss_of(self) -> I32:
        """Row of `specular` of each view sample, or -1: (n_view,)."""
        return _places(self.glossy, len(self.diffuse))


def _places(samples: I64, n: int) -> I32:
    out = np.full(n, -1, np.int32)
    out[samples] = np.arange(len(samples), dtype=np.int32)
    return out


class Scores(NamedTuple):
    """Squared error of samples, as multiples of the image's mean square."""

    sure: F64  #: what both sets of rays say, never negative
    mean: F64  #: without noise on average
    noise: F64  #: variance of one set


def doubtful_samples(records: Records, survey: Survey, tint: F32, share: float) -> I64:
    """View samples of whose interpolation the survey can say least, and the records that they are made from.

    Parameters
    ----------
    tint : (3, n_view)
        Of the lobes, scalar.
    share
        Of the samples, how many are doubted.

    Returns
    -------
    (n,) int64, ascending
    """
    view = records.mesh.view
    judge = Judge(survey, tint, records, view.height, view.width, view.pixel)
    scores = judge.scores(np.arange(view.n), records.interpolation, records.view.astype(np.int64))
    n = int(share * view.n)
    doubted = np.sort(np.argpartition(-scores.noise, n)[:n]) if n < view.n else np.arange(view.n)
    used = take_rows(records.interpolation, doubted).indices
    return np.union1d(doubted, records.view[used].astype(np.int64))


def add_outliers(records: Records, survey: Survey, tint: F32, settings: RecordSettings) -> Records:
    """Give records to the samples that add most to the error of the image under the training lights.

    Greedy, the greatest first, until the rest are expected to be below the
    tolerance or there are ``settings.max_share`` records. More is expected in
    creases than the survey saw there. Neighbours take part in the new records
    where that at least halves their own error.

    Parameters
    ----------
    tint : (3, n_view)
        Of the lobes, scalar.

    Returns
    -------
    Records
        Those given come first; `error` is what the survey leaves, a lower bound: its rays have chosen the records.
    """
    mesh = records.mesh
    view = mesh.view
    judge = Judge(survey, tint, records, view.height, view.width, view.pixel)
    table = records.interpolation
    everything = np.arange(view.n)
    scores = judge.scores(everything, table, mesh.record_view)
    close = judge.is_close(everything, table, mesh.record_view)
    most = int(settings.max_share * view.n)
    noise = judge.smoothed(scores.noise) * np.where(records.fit > _ON_SHEET, _CHANCE_ON_SHEETS, _CHANCE)
    light = judge.scores(everything, SparseRows.empty(view.n, 1), np.zeros(1, np.int64)).sure
    unseen = np.where(mesh.corners < _CREASE, _IN_CREASES * light, 0)
    for round_ in range(_ROUNDS):
        excess = np.where(mesh.record < 0, np.maximum(scores.sure - noise, 0) + unseen, 0)
        order = np.lexsort((everything, -excess))
        rest = np.cumsum(excess[order][::-1])[::-1] / view.n
        worst = order[: int(np.searchsorted(-rest, -(settings.tolerance**2)))]
        worst = worst[: max(0, most - len(mesh.record_view))]
        if len(worst) < max(1, _LEAST * view.n):
            break
        # Others only after those that are worse than all beside them: these may serve them too.
        new = worst if round_ == _ROUNDS - 1 else worst[judge.is_peak(worst, excess)]
        mesh.add(np.sort(new))
        touched = everything[(mesh.record >= 0) | (excess > settings.tolerance**2)]
        found = mesh.interpolate(touched)
        again = judge.scores(touched, found, mesh.record_view)
        # With few rays much passes for right that more of them knew to be wrong.
        known_as_well = judge.is_close(touched, found, mesh.record_view) | ~close[touched]
        better = (mesh.record[touched] >= 0) | (known_as_well & (again.sure < 0.5 * scores.sure[touched]))
        table = select_rows(table, found, touched[better], np.flatnonzero(better))
        for all_of_it, part in zip(scores, again, strict=True):
            all_of_it[touched[better]] = part[better]
    error = float(np.sqrt(np.maximum(np.mean(scores.mean), 0)))
    return replace(records, view=mesh.record_view.astype(np.int32), interpolation=table, error=error)


class Judge:
    """Errors of interpolation, relative to the images that the lights make."""

    def __init__(self, survey: Survey, tint: F32, records: Records, height: int, width: int, pixel: I32) -> None:
        self._survey, self._tint = survey, np.ascontiguousarray(tint, np.float32)
        self._shape, self._pixel = (height, width), pixel
        n_view = len(survey.diffuse)
        # The error of no interpolation at all is the image.
        some = np.arange(0, n_view, max(1, n_view // _CHUNK))
        one, two = self._errors(some, SparseRows.empty(len(some), 1), np.zeros(1, np.int64)).transpose(1, 0, 2)
        square = np.maximum(np.mean(one * two, axis=0, dtype=np.float64), 0)
        part = take_rows(records.interpolation, some)
        one, two = self._errors(some, part, records.view.astype(np.int64)).transpose(1, 0, 2)
        per_square = np.where(square > 0, 1 / np.where(square > 0, square, 1), 0)
        noise = 0.5 * np.mean((one - two) ** 2, axis=0, dtype=np.float64) * per_square
        weight = np.where(square > 0, 1 / (_NOISE + noise), 0)
        self.weight = (weight / max(weight.sum(), 1e-30) * per_square).astype(np.float32)  #: (n_lights,)

    def scores(self, samples: I64, table: SparseRows, record_view: I64) -> Scores:
        """Of some samples, whose rows the table holds: (n,) each."""
        out = Scores(np.empty(len(samples)), np.empty(len(samples)), np.empty(len(samples)))
        for first in range(0, len(samples), _CHUNK):
            part = slice(first, min(first + _CHUNK, len(samples)))
            wrong = self._errors(samples[part], table.rows(part.start, part.stop), record_view)
            kernels.score_errors(wrong, self.weight, out.sure[part], out.mean[part], out.noise[part])
        return out

    def _errors(self, samples: I64, table: SparseRows, record_view: I64) -> F32:
        survey = self._survey
        out = np.empty((len(samples), *survey.diffuse.shape[1:]), np.float32)
        kernels.interpolation_errors(
            samples,
            table.indptr,
            table.indices,
            table.weights,
            record_view,
            survey.diffuse,
            self.is_close(samples, table, record_view),
            survey.closer_of,
            survey.closer,
            survey.gloss_of,
            survey.specular,
            self._tint,
            out,
        )
        return out

    def is_close(self, samples: I64, table: SparseRows, record_view: I64) -> Bool:
        """Whether some samples, and all records that they are made from, were looked at with more rays: (n,)."""
        found = self._survey.closer_of[samples] >= 0
        far = self._survey.closer_of[record_view[table.indices]] < 0
        row = np.repeat(np.arange(table.n_rows), np.diff(table.indptr))
        found[row[far]] = False
        return found

    def smoothed(self, values: F64) -> F64:
        """Mean over blocks of the image, for each sample."""
        _, width = self._shape
        n_x = -(-width // _BLOCK)
        block = self._pixel // width // _BLOCK * n_x + self._pixel % width // _BLOCK
        total, count = np.bincount(block, values), np.bincount(block)
        out: F64 = (total / np.maximum(count, 1))[block]
        return out

    def is_peak(self, samples: I64, values: F64) -> Bool:
        """Whether no sample of the pixels around has a greater value: (n,)."""
        height, width = self._shape
        image = np.zeros((height + 2, width + 2))
        np.maximum.at(image, (self._pixel // width + 1, self._pixel % width + 1), values)
        around = np.zeros((height, width))
        for dy in range(3):
            for dx in range(3):
                around = np.maximum(around, image[dy : dy + height, dx : dx + width])
        return values[samples] >= around.reshape(-1)[self._pixel[samples]]
