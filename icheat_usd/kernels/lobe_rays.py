"""Rays of specular lobes, made from their points."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import parallel_kernel
from icheat_usd.kernels.bsdf import sample_lobe
from icheat_usd.kernels.random import hash_combine, sobol_pair
from icheat_usd.kernels.tracing import offset_origin
from icheat_usd.kernels.vector import normalized, row3, store3


@parallel_kernel
def fill_lobe_rays(points, magnitude, to_eye, draws, n_rays, seed, origins, directions, reflectance):  # type: ignore[no-untyped-def]
    """`n_rays` rays of the lobe of each of n points, one point after another.

    Parameters
    ----------
    points : SurfacePoints of n points
    magnitude : (n,) float32, metres
        As of `offset_origin`.
    to_eye : (n, 3) float32
    draws : (n, 2) int64
        Sequence of each point, and its number among those that share it.
    seed : int, unsigned, 32 bits
    origins, directions, reflectance : (n n_rays, 3) float32
        Written: starts off the surface, unit directions, and what the lobe reflects from there over the density of
        asking; 0 below the horizon.
    """
    for i in prange(len(draws)):
        sequence = hash_combine(hash_combine(seed, 0x12), draws[i, 0])
        eye = normalized(row3(to_eye, i))
        position, normal, size = row3(points.position, i), row3(points.normal, i), np.float64(magnitude[i])
        for k in range(n_rays):
            u, v = sobol_pair(draws[i, 1] * n_rays + k, sequence)
            world, base, edge = sample_lobe(points, i, eye, u, v)
            row = i * n_rays + k
            store3(directions, row, world)
            store3(origins, row, offset_origin(position, normal, row3(directions, row), size))
            for c in range(3):
                reflectance[row, c] = (
                    np.float32(base) * points.specular[i, c] + np.float32(edge) * points.specular_edge[i, c]
                )
