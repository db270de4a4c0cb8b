"""The slow, obvious evaluator: what an edit stack means, pair by pair, in double precision.

    B'_i = sum_j [ t_ij (S_ij b_j + E_ij) + A_j O_ij b_j ]

This loop is the definition; every renderer is tested against it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from icheat_usd.edits.field import BoundEdit, EditField
from icheat_usd.edits.model import Blend
from icheat_usd.scene import F32

F64Array = NDArray[np.float64]


def pair_functions(
    field: EditField, b: F64Array, u: F64Array, w: F64Array
) -> tuple[F64Array, F64Array, F64Array, F64Array]:
    """S, E and the two kinds of O for one pair.

    Parameters
    ----------
    b : (3,) radiance that leaves the gather sample
    u, w : (n_rows,) receiver and caster masks of the pair

    Returns
    -------
    scale, emission, offset_diffuse, offset_paint : (3,) each
    """
    scale, emission = np.ones(3), np.zeros(3)
    offset = {False: np.zeros(3), True: np.zeros(3)}
    row = 0
    for bound in field.edits:
        paints = bound.operation is not None and not bound.operation.offset_times_albedo
        keys = range(row, row + len(bound.receivers))
        row += len(bound.receivers)
        weights = [bound.edit.amount * kw * u[k] * w[k] for k, kw in zip(keys, bound.key_weights, strict=True)]
        if not any(weights):
            continue
        seen = scale * b + emission if bound.edit.blend is Blend.COMPOSE else b
        s, e, o = np.ones(3), np.zeros(3), np.zeros(3)
        for key, weight in enumerate(weights):
            s_key, e_key, o_key = _coefficients(bound, key, seen)
            s, e, o = s + weight * (s_key - 1), e + weight * e_key, o + weight * o_key
        if bound.edit.blend is Blend.COMPOSE:
            scale, emission = s * scale, s * emission + e
            offset = {kind: s * value for kind, value in offset.items()}
        elif bound.edit.blend is Blend.OVER:
            kept = 1 - sum(weights)
            scale, emission = kept * scale + (s - kept), kept * emission + e
            offset = {kind: kept * value for kind, value in offset.items()}
        else:
            scale, emission = scale + (s - 1), emission + e
        offset[paints] = offset[paints] + o
    return scale, emission, offset[False], offset[True]


def _coefficients(bound: BoundEdit, key: int, seen: F64Array) -> tuple[F64Array, F64Array, F64Array]:
    coefficients = bound.evaluate(key, seen.astype(np.float32)[None, :])
    zero = np.zeros(3)
    return (
        np.asarray(coefficients.scale[0], np.float64),
        zero if coefficients.emission is None else np.asarray(coefficients.emission[0], np.float64),
        zero if coefficients.offset is None else np.asarray(coefficients.offset[0], np.float64),
    )


def edited_radiance(
    field: EditField, transport: F64Array, radiance: F64Array, area: F64Array, albedo: F64Array, u: F32, w: F32
) -> F64Array:
    """Edited indirect radiance of every view sample.

    Parameters
    ----------
    transport : (n_view, n_gather, 3) dimensionless, everything but the light and the edits
    radiance : (n_gather, 3) b
    area : (n_gather,) square metres
    albedo : (n_view, 3) diffuse albedo of the receivers, for offsets that it reflects
    u : (n_rows, n_view) ; w : (n_rows, n_gather)

    Returns
    -------
    (n_view, 3) float64
    """
    result = np.zeros((transport.shape[0], 3))
    for i in range(transport.shape[0]):
        for j in range(transport.shape[1]):
            b = radiance[j].astype(np.float64)
            s, e, o_diffuse, o_paint = pair_functions(field, b, u[:, i].astype(float), w[:, j].astype(float))
            result[i] += transport[i, j] * (s * b + e) + area[j] * (albedo[i] * o_diffuse + o_paint) * b
    return np.maximum(result, 0)
