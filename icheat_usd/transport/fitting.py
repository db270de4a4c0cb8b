"""Weights of interpolation that are fitted to what few rays saw, where geometry alone finds no good ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icheat_usd.kernels import fitting as kernels
from icheat_usd.kernels.rows import pack_rows
from icheat_usd.scene import F32
from icheat_usd.transport.outliers import Judge, Survey
from icheat_usd.transport.records import BUCKET, Records
from icheat_usd.transport.sparse import SparseRows, select_rows, take_rows

_WORTH_IT = 1e-3  # squared relative error from which a sample's weights are fitted
_PRIOR = 0.1  # how strongly they stay near the given ones
_MOST, _LEAST = 4, 0.05  # entries of a sample, and the smallest weight among them


def fit_weights(records: Records, survey: Survey, tint: F32) -> Records:
    """Interpolate samples whose light is not what interpolation says from records that match it better.

    Each takes the mixture of records near, on any surface of the same object
    that faces alike and of those that it had, that is closest to its own light
    under the training lights, by least squares with the given weights as a prior. The rays of the survey are the
    same everywhere, so what is noise in one place is noise in the other.
    Both halves of the survey take part in fits and judge them: more light to
    fit with is worth more than a judge who has not seen it.

    Parameters
    ----------
    tint : (3, n_view)
        Of the lobes, scalar.

    Returns
    -------
    Records
        `error` is what the fits leave of the survey that they were made from, a lower bound: no estimate for others.
    """
    mesh, view = records.mesh, records.mesh.view
    judge = Judge(survey, tint, records, view.height, view.width, view.pixel)
    table = records.interpolation
    scores = judge.scores(np.arange(view.n), table, mesh.record_view)
    some = np.flatnonzero((mesh.record < 0) & (scores.sure > _WORTH_IT))
    if not len(some):
        return records
    count = np.empty(len(some), np.int64)
    record, weight = np.empty((len(some), _MOST), np.int32), np.empty((len(some), _MOST), np.float32)
    bucket_begin, bucket_record = mesh.buckets()
    kernels.fit_weights(
        some,
        table.indptr,
        table.indices,
        table.weights,
        view.pixel,
        (view.height, view.width),
        view.points.position,
        view.points.shading_normal,
        view.points.instance,
        mesh.extent,
        BUCKET,
        bucket_begin,
        bucket_record,
        mesh.record_view,
        survey.diffuse,
        judge.is_close(some, take_rows(table, some), mesh.record_view),
        survey.closer_of,
        survey.closer,
        survey.gloss_of,
        survey.specular,
        np.ascontiguousarray(tint, np.float32),
        np.sqrt(judge.weight),
        _PRIOR,
        _MOST,
        _LEAST,
        count,
        record,
        weight,
    )
    indptr = np.concatenate([[0], np.cumsum(count)])
    rows = SparseRows(indptr, np.empty(indptr[-1], np.int32), np.empty(indptr[-1], np.float32), table.n_columns)
    pack_rows(count, indptr, record, weight, rows.indices, rows.weights)
    again = judge.scores(some, rows, mesh.record_view)
    better = np.flatnonzero((count > 0) & (again.sure < scores.sure[some]))
    fitted = select_rows(table, rows, some[better], better)
    scores.mean[some[better]] = again.mean[better]
    error = float(np.sqrt(np.maximum(np.mean(scores.mean), 0)))
    return replace(records, interpolation=fitted, error=error)
