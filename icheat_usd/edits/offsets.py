"""Offset light: what edits add per area of their casters, whether the receivers see them or not.

    sum_j A_j O_ij b_j

Gather rays only find what is visible, so this sum is taken over the gather
samples, without a visibility test and without noise.
"""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.field import EditField
from icheat_usd.scene import F32


def offset_radiance(field: EditField, b: F32, area: F32, receiver: F32, caster: F32, albedo: F32) -> F32:
    """Radiance that offsets add at n receivers.

    Parameters
    ----------
    b : (n_gather, 3) float32, radiance that leaves the gather samples
    area : (n_gather,) float32, square metres
    receiver : (n_rows, n) float32, masks u
    caster : (n_rows, n_gather) float32, masks w
    albedo : (n, 3) float32, diffuse albedo of the receivers

    Returns
    -------
    (n, 3) float32, radiance, scene-linear
    """
    result = np.zeros((receiver.shape[1], 3), np.float32)
    signatures, inverse = np.unique(receiver, axis=1, return_inverse=True)
    for k, masks in enumerate(signatures.T):
        coefficients = field.evaluate(b, masks[:, None], caster)
        which = np.flatnonzero(inverse.reshape(-1) == k)
        for offset, tint in ((coefficients.offset_diffuse, albedo[which]), (coefficients.offset_paint, np.float32(1))):
            if offset is not None:
                total = (area[:, None] * offset * b).sum(axis=0, dtype=np.float64)
                result[which] += tint * total.astype(np.float32)
    return result
