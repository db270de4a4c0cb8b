"""Rays from surface points to one light that is no mesh, found 16 at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.dome_rays import guided_dome_rays, make_dome_rays
from icheat_usd.kernels.guide import COSINE_SHARE, find_row, plain_dome_pdf, sphere_direction, warp
from icheat_usd.kernels.lights import sample_shape
from icheat_usd.kernels.random import hash_combine, sobol_pair
from icheat_usd.kernels.vector import row3

_DOME = 5


class Asked(NamedTuple):
    """Room for 16 rays that are asked for."""

    point: NDArray[np.int64]  #: (16,) where they start
    sample: NDArray[np.int64]  #: (16,) which of a point's rays they are
    guided: NDArray[np.int64]  #: (16,) row of the guide, -1 for none
    number: NDArray[np.float64]  #: (16, 2) random numbers
    ray: NDArray[np.float64]  #: (16, ...) of `dome_rays`: direction, `DISTANCE`, `PDF` and `RADIANCE`
    texel: NDArray[np.int64]  #: of `dome_rays`


@kernel
def make_asked():  # type: ignore[no-untyped-def]
    ray, texel = make_dome_rays()
    return Asked(
        np.empty(16, np.int64), np.empty(16, np.int64), np.empty(16, np.int64), np.empty((16, 2), np.float64), ray,
        texel,
    )  # fmt: skip


@kernel
def ask_rays(  # type: ignore[no-untyped-def]
    asked, point, sample, end, instance, draws, n_samples, seed, light, kind, axis, split, child, rows, position,
    shading_normal,
):  # fmt: skip
    """Fill `asked` with the next rays, from ray `sample` of `point` on; how many, and where to go on.

    Parameters
    ----------
    end : int
        The point before which to stop.
    instance : (n,) int32
        -1 for points that want none.
    draws : (n, 2) int64
        Sequence of random numbers of each point, and the number in it of its first ray.
    axis, split, child, rows
        Columns of the guide.
    """
    n, known, sequence, row = 0, -1, np.uint32(0), -1
    while point < end and n < 16:
        if instance[point] < 0:
            point += 1
            continue
        if known != point:
            known, sequence = point, _sequence_of(draws, point, light, seed)
            if kind == _DOME:
                p, about = row3(position, point), row3(shading_normal, point)
                row = find_row(axis, split, child, rows, light, p[0], p[1], p[2], about[0], about[1], about[2])
        asked.point[n], asked.sample[n], asked.guided[n] = point, sample, row
        asked.number[n, 0], asked.number[n, 1] = sobol_pair(draws[point, 1] + sample, sequence)
        n += 1
        sample += 1
        if sample == n_samples:
            point, sample = point + 1, 0
    return n, point, sample


@kernel
def find_rays(  # type: ignore[no-untyped-def]
    n, asked, shape, texels, rows_cdf, columns_cdf, bands, columns, position, normal, shading_normal
):
    """The n rays that were asked for; density 0 where one misses the light or leaves below a horizon.

    Parameters
    ----------
    shape
        Of `lights.light_shape`.
    """
    kind, m, inverse, size, image = shape
    ray = asked.ray
    if kind == _DOME and image[0] >= 0:
        guided_dome_rays(
            n, asked.point, asked.guided, asked.number, normal, shading_normal, m, size[0], image, texels, rows_cdf,
            columns_cdf, bands, columns, ray, asked.texel,
        )  # fmt: skip
        return
    for k in range(n):
        at = asked.point[k]
        ray[k, 0], ray[k, 1], ray[k, 2], ray[k, 3], ray[k, 4], ray[k, 5], ray[k, 6], ray[k, 7] = _analytic_ray(
            kind, m, inverse, size, image, texels, rows_cdf, columns_cdf, bands, columns, asked.guided[k],
            row3(position, at), row3(normal, at), row3(shading_normal, at), asked.number[k, 0], asked.number[k, 1],
        )  # fmt: skip


@kernel
def _sequence_of(draws, i, light, seed):  # type: ignore[no-untyped-def]
    """Sequence of random numbers of point i's rays to a light."""
    return hash_combine(hash_combine(hash_combine(seed, 0x11), draws[i, 0]), light)


@kernel
def _analytic_ray(  # type: ignore[no-untyped-def]
    kind, m, inverse, size, image, texels, rows_cdf, columns_cdf, bands, columns, guided, place, normal,
    shading_normal, u1, u2,
):  # fmt: skip
    """One of them to a light of any kind but domes with images."""
    px, py, pz = place
    gx, gy, gz = normal
    nx, ny, nz = shading_normal
    v1, v2 = u1, u2
    if guided >= 0:
        v1 /= COSINE_SHARE
    wx, wy, wz, t, p, r, g, b = sample_shape(
        kind, m, inverse, size, image, texels, rows_cdf, columns_cdf, px, py, pz, nx, ny, nz, min(v1, 1.0), v2
    )
    if guided >= 0:
        if v1 >= 1.0:
            v1, v2, _ = warp(bands, columns, guided, (u1 - COSINE_SHARE) / (1.0 - COSINE_SHARE), u2)
            wx, wy, wz = sphere_direction(v1, v2)
        p = plain_dome_pdf(bands, columns, guided, nx, ny, nz, wx, wy, wz)
    if p > 0.0 and (wx * nx + wy * ny + wz * nz <= 0.0 or wx * gx + wy * gy + wz * gz <= 0.0):
        p = 0.0
    return wx, wy, wz, t, p, r, g, b
