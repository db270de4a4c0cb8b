"""How far interpolation between records is from what was measured at the samples themselves."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel


@kernel
def _add(response, gloss_of, gloss, tint, v, at, share, out):  # type: ignore[no-untyped-def]
    """Add what sample `v` would show with `share` of the light at sample `at`."""
    n_sets, n_lights = out.shape
    for s in range(n_sets):
        for light in range(n_lights):
            out[s, light] += share * tint[0, v] * response[at, s, light]
    g = gloss_of[at]
    if g >= 0:
        for lobe in range(2):
            for light in range(n_lights):
                add = share * tint[1 + lobe, v] * gloss[g, lobe, light]
                for s in range(n_sets):
                    out[s, light] += add


@parallel_kernel
def interpolation_errors(  # type: ignore[no-untyped-def]
    samples, indptr, indices, weights, record_view, response, gloss_of, gloss, tint, out
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
    gloss_of : (n_view,)
        Row of `gloss` (n_glossy, 2 lobes, n_lights), or -1.
    tint : (3, n_view)
    out : (n, n_sets, n_lights)
    """
    for q in prange(len(samples)):
        v = samples[q]
        out[q] = np.float32(0.0)
        for e in range(indptr[q], indptr[q + 1]):
            _add(response, gloss_of, gloss, tint, v, record_view[indices[e]], weights[e], out[q])
        _add(response, gloss_of, gloss, tint, v, v, np.float32(-1.0), out[q])
