"""Directions of gather rays."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.random import hash_combine, sobol_pair


@kernel
def _frame(nx, ny, nz):  # type: ignore[no-untyped-def]
    """Two tangents that complete a unit normal (Duff et al. 2017, JCGT 6(1))."""
    sign = np.float32(math.copysign(1.0, nz))
    a = np.float32(-1.0) / (sign + nz)
    b = nx * ny * a
    return (
        np.float32(1.0) + sign * nx * nx * a,
        sign * b,
        -sign * nx,
        b,
        sign + ny * ny * a,
        -ny,
    )


@parallel_kernel
def cosine_directions(normal, stream, n_rays, seed, out):  # type: ignore[no-untyped-def]
    """Cosine-weighted directions about (n, 3) normals: rows ``i * n_rays + k`` of `out`.

    Each point's rays are one scrambled Sobol set, named by `stream` (n,) and `seed`.
    """
    for i in prange(len(normal)):
        tx, ty, tz, bx, by, bz = _frame(normal[i, 0], normal[i, 1], normal[i, 2])
        point_seed = hash_combine(seed, stream[i])
        for k in range(n_rays):
            u, v = sobol_pair(k, point_seed)
            radius = math.sqrt(u)
            phi = np.float32(2.0 * math.pi) * v
            x = radius * math.cos(phi)
            y = radius * math.sin(phi)
            z = math.sqrt(max(np.float32(0.0), np.float32(1.0) - u))
            row = i * n_rays + k
            out[row, 0] = tx * x + bx * y + normal[i, 0] * z
            out[row, 1] = ty * x + by * y + normal[i, 1] * z
            out[row, 2] = tz * x + bz * y + normal[i, 2] * z


@parallel_kernel
def point_sets(stream, n_rays, seed, out):  # type: ignore[no-untyped-def]
    """Scrambled Sobol points in the unit square, one set of `n_rays` for each of `stream` (n,)."""
    for i in prange(len(stream)):
        point_seed = hash_combine(seed, stream[i])
        for k in range(n_rays):
            u, v = sobol_pair(k, point_seed)
            out[i * n_rays + k, 0] = u
            out[i * n_rays + k, 1] = v
