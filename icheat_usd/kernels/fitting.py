"""Weights of interpolation that reproduce what few rays saw of many lights."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel

MOST = 12  # records that one sample is fitted with
_STEPS = 40  # of coordinate descent
_SAME_WEIGHT = 10.0  # strictness of the weights' sum being 1, in units of the mean curvature
_LEAST_COSINE = np.float32(0.3)  # between the normals of a sample and a record
_LANES, _BLOCK = 32, 128  # that samples are shared out to, and at a time
_TURN = np.float32(16.0)  # square of the pixels that a turn by a radian is as far as


@kernel
def _see(is_close, response, closer_of, closer, gloss_of, gloss, tint, light, v, at, out):  # type: ignore[no-untyped-def]
    """What sample `v` would show with the light at sample `at`, by set and light: (n_sets n_lights,)."""
    n_sets, n_lights = response.shape[1], response.shape[2]
    seen = closer if is_close else response
    row = np.int64(closer_of[at]) if is_close else np.int64(at)
    for s in range(n_sets):
        for k in range(n_lights):
            out[s * n_lights + k] = tint[0, v] * seen[row, s, k] * light[k]
    g = gloss_of[at]
    if g >= 0:
        for s in range(n_sets):
            for k in range(n_lights):
                out[s * n_lights + k] += (tint[1, v] * gloss[g, s, 0, k] + tint[2, v] * gloss[g, s, 1, k]) * light[k]


@kernel
def _find(  # type: ignore[no-untyped-def]
    v,
    pixel,
    shape,
    position,
    normal,
    instance,
    extent,
    bucket_side,
    bucket_begin,
    bucket_record,
    record_view,
    is_close,
    closer_of,
    n,
    record,
):
    """Append the nearest records on the same object to the `n` that a sample has, up to `MOST`; their number then.

    `is_close`: those alone that were looked at more closely.

    Others may lie behind a wall: that many lights show them alike is no proof that the next one does.
    """
    near, best = np.full(MOST, np.float32(np.inf)), np.full(MOST, np.int64(-1))
    height, width = shape
    n_x, n_y = (width + bucket_side - 1) // bucket_side, (height + bucket_side - 1) // bucket_side
    bx, by = pixel[v] % width // bucket_side, pixel[v] // width // bucket_side
    for cy in range(max(0, by - 1), min(n_y, by + 2)):
        for cx in range(max(0, bx - 1), min(n_x, bx + 2)):
            place = cy * n_x + cx
            for e in range(bucket_begin[place], bucket_begin[place + 1]):
                r = bucket_record[e]
                w = record_view[r]
                if instance[w] != instance[v] or (is_close and closer_of[w] < 0):
                    continue
                cosine = normal[v, 0] * normal[w, 0] + normal[v, 1] * normal[w, 1] + normal[v, 2] * normal[w, 2]
                if cosine < _LEAST_COSINE:
                    continue
                known = False
                for k in range(n):
                    known |= record[k] == r
                if known:
                    continue
                dx, dy, dz = (
                    position[v, 0] - position[w, 0],
                    position[v, 1] - position[w, 1],
                    position[v, 2] - position[w, 2],
                )
                d = (dx * dx + dy * dy + dz * dz) / (extent[v] * extent[v]) + _TURN * (np.float32(1.0) - cosine)
                k = MOST - 1
                if d < near[k]:
                    while k > 0 and near[k - 1] > d:
                        near[k], best[k] = near[k - 1], best[k - 1]
                        k -= 1
                    near[k], best[k] = d, r
    for k in range(MOST):
        if n < MOST and best[k] >= 0:
            record[n] = best[k]
            n += 1
    return n


@kernel
def _descend(seen, want, n, start, prior, weight):  # type: ignore[no-untyped-def]
    """Least squares with weights not below 0, that sum to 1 and stay near `start`; `weight` (n,) out."""
    a, b = np.zeros((MOST, MOST)), np.zeros(MOST)
    for i in range(n):
        for e in range(len(want)):
            b[i] += seen[i, e] * want[e]
        for j in range(i + 1):
            total = 0.0
            for e in range(len(want)):
                total += seen[i, e] * seen[j, e]
            a[i, j] = total
            a[j, i] = total
    curve = 0.0
    for i in range(n):
        curve += a[i, i] / n
    for i in range(n):
        for j in range(n):
            a[i, j] += _SAME_WEIGHT * curve
        a[i, i] += prior * curve
        b[i] += _SAME_WEIGHT * curve + prior * curve * start[i]
        weight[i] = start[i]
    if not curve > 0.0:
        return
    for _ in range(_STEPS):
        for i in range(n):
            gradient = b[i]
            for j in range(n):
                gradient -= a[i, j] * weight[j]
            weight[i] = max(0.0, weight[i] + gradient / a[i, i])


@kernel
def _thin(record, weight, n, most, least, out_record, out_weight):  # type: ignore[no-untyped-def]
    """The `most` largest weights of at least `least`, made to sum to 1, by ascending record; their number."""
    count = 0
    while count < most:
        best = -1
        for k in range(n):
            if weight[k] >= least and (best < 0 or weight[k] > weight[best]):
                best = k
        if best < 0:
            break
        place = count
        while place > 0 and out_record[place - 1] > record[best]:
            out_record[place], out_weight[place] = out_record[place - 1], out_weight[place - 1]
            place -= 1
        out_record[place], out_weight[place] = record[best], np.float32(weight[best])
        weight[best] = -1.0
        count += 1
    total = np.float32(0.0)
    for k in range(count):
        total += out_weight[k]
    for k in range(count):
        out_weight[k] /= total
    return count


@kernel
def _fit_one(  # type: ignore[no-untyped-def]
    v,
    indptr,
    indices,
    weights,
    pixel,
    shape,
    position,
    normal,
    instance,
    extent,
    bucket_side,
    bucket_begin,
    bucket_record,
    record_view,
    response,
    is_close,
    closer_of,
    closer,
    gloss_of,
    gloss,
    tint,
    light,
    prior,
    most,
    least,
    out_record,
    out_weight,
):
    """See `fit_weights`; how many entries there are."""
    record, start = np.empty(MOST, np.int64), np.zeros(MOST)
    n = 0
    for e in range(indptr[v], indptr[v + 1]):
        record[n], start[n] = indices[e], weights[e]
        n += 1
    n = _find(
        v,
        pixel,
        shape,
        position,
        normal,
        instance,
        extent,
        bucket_side,
        bucket_begin,
        bucket_record,
        record_view,
        is_close,
        closer_of,
        n,
        record,
    )
    size = response.shape[1] * response.shape[2]
    want, seen = np.empty(size, np.float32), np.empty((MOST, size), np.float32)
    _see(is_close, response, closer_of, closer, gloss_of, gloss, tint, light, v, v, want)
    for k in range(n):
        at = record_view[record[k]]
        _see(is_close, response, closer_of, closer, gloss_of, gloss, tint, light, v, at, seen[k])
    weight = np.empty(MOST)
    _descend(seen, want, n, start, prior, weight)
    return _thin(record, weight, n, most, least, out_record, out_weight)


@parallel_kernel
def fit_weights(  # type: ignore[no-untyped-def]
    samples,
    indptr,
    indices,
    weights,
    pixel,
    shape,
    position,
    normal,
    instance,
    extent,
    bucket_side,
    bucket_begin,
    bucket_record,
    record_view,
    response,
    is_close,
    closer_of,
    closer,
    gloss_of,
    gloss,
    tint,
    light,
    prior,
    most,
    least,
    count,
    out_record,
    out_weight,
):
    """Records and weights of some view samples, from those that they have and others near on the same object.

    Parameters
    ----------
    samples : (n,)
    indptr, indices, weights
        Interpolation of all view samples.
    pixel, position, normal, instance, extent, record_view, bucket_side, bucket_begin, bucket_record
        As for `record_weights`.
    shape
        Height and width of the image, pixels.
    response, is_close, closer_of, closer, gloss_of, gloss, tint
        As for `interpolation_errors`.
    light : (n_lights,)
        Factor of each light.
    prior
        Weight of staying near the interpolation given, in units of the mean curvature.
    most, least
        Entries of a sample, and the smallest weight among them.
    count : (n,) int64, out_record : (n, most) int32, out_weight : (n, most) float32
        Out.
    """
    n = len(samples)
    for lane in prange(_LANES):
        # Blocks here and there: hard samples lie close together.
        for first in range(lane * _BLOCK, n, _LANES * _BLOCK):
            for q in range(first, min(n, first + _BLOCK)):
                count[q] = _fit_one(
                    samples[q],
                    indptr,
                    indices,
                    weights,
                    pixel,
                    shape,
                    position,
                    normal,
                    instance,
                    extent,
                    bucket_side,
                    bucket_begin,
                    bucket_record,
                    record_view,
                    response,
                    is_close[q],
                    closer_of,
                    closer,
                    gloss_of,
                    gloss,
                    tint,
                    light,
                    prior,
                    most,
                    least,
                    out_record[q],
                    out_weight[q],
                )
