"""How far interpolation between records is from what was measured at the samples themselves."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def _add(seen, at_seen, gloss_of, gloss, tint, v, at, share, out):  # type: ignore[no-untyped-def]
    """Add what sample `v` would show with `share` of the light at sample `at`, which is `seen` in a row of its own."""
    n_sets, n_lights = out.shape
    for s in range(n_sets):
        for light in range(n_lights):
            out[s, light] += share * tint[0, v] * seen[at_seen, s, light]
    g = gloss_of[at]
    if g >= 0:
        for s in range(n_sets):
            for lobe in range(2):
                for light in range(n_lights):
                    out[s, light] += share * tint[1 + lobe, v] * gloss[g, s, lobe, light]


@parallel_kernel
def interpolation_errors(  # type: ignore[no-untyped-def]
    samples, indptr, indices, weights, record_view, response, is_close, closer_of, closer, gloss_of, gloss, tint, out
):
    """Interpolated less measured light of some samples.

    Parameters
    ----------
    samples : (n,)
    indptr, indices, weights
        Row q holds the records that interpolate ``samples[q]``.
    record_view : (n_records,)
        View sample of each record.
    response : (n_view, n_sets, n_lights)
        Diffuse, before the tint, from independent sets of rays.
    is_close : (n,) bool
        Samples that are judged by `closer`; they and their records must be there.
    closer_of : (n_view,)
        Row of `closer` (n_closer, n_sets, n_lights), the same by more rays, or -1.
    gloss_of : (n_view,)
        Row of `gloss` (n_glossy, n_sets, 2 lobes, n_lights), or -1.
    tint : (3, n_view)
    out : (n, n_sets, n_lights)
    """
    for q in prange(len(samples)):
        v = samples[q]
        out[q] = np.float32(0.0)
        seen = closer if is_close[q] else response
        for e in range(indptr[q], indptr[q + 1]):
            at = record_view[indices[e]]
            at_seen = np.int64(closer_of[at]) if is_close[q] else np.int64(at)
            _add(seen, at_seen, gloss_of, gloss, tint, v, at, weights[e], out[q])
        at_seen = np.int64(closer_of[v]) if is_close[q] else np.int64(v)
        _add(seen, at_seen, gloss_of, gloss, tint, v, v, np.float32(-1.0), out[q])


@parallel_kernel
def score_errors(wrong, weight, sure, mean, noise):  # type: ignore[no-untyped-def]
    """Squared errors of n samples by two sets of rays, summed over lights with a weight each.

    Parameters
    ----------
    wrong : (n, 2, n_lights) float32
        Of `interpolation_errors`.
    weight : (n_lights,) float32
    sure, mean, noise : (n,) float64
        Out: the square of the lesser where both sets agree in sign; their product; half the square of their difference.
    """
    for q in prange(len(wrong)):
        least, product, spread = 0.0, 0.0, 0.0
        for light in range(len(weight)):
            one, two, share = np.float64(wrong[q, 0, light]), np.float64(wrong[q, 1, light]), np.float64(weight[light])
            product += share * one * two
            spread += share * (one - two) * (one - two)
            if one * two > 0.0:
                least += share * min(one * one, two * two)
        sure[q], mean[q], noise[q] = least, product, 0.5 * spread
