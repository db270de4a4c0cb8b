"""What hemispheres of rays bring to records: irradiance and its gradients.

Ward and Heckbert 1992, Irradiance Gradients.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.record_rays import turn_of
from icheat_usd.kernels.samples import basis

#: Rays lower than this above the tangent plane, as a share of the cosine distribution, do not tell how near
#: the nearest surface is: a bevelled floor would be one.
_HIGH = 0.97
_TOUCHING = np.float32(1e-6)  # metres: a ray may end where it starts, in a crease


@parallel_kernel
def record_sums(  # type: ignore[no-untyped-def]
    radiance, distance, shading_normal, stream, seed, n_theta, n_phi, irradiance, by_turn, by_move, spread
):
    """Irradiance and its gradients from stratified hemispheres (`record_rays.trace_hemispheres`).

    Ward and Heckbert 1992, equations 3 and 4, with the signs and weights that finite differences confirm.

    Parameters
    ----------
    radiance : (n, n_rays, C) float32
    distance : (n, n_rays) float32
    irradiance : (n, C) float32, out
    by_turn, by_move : (n, C, 3) float32, out
        Change with ``normal x other normal``, and with place, metres, both in world space.
    spread : (n, 3) float32, out
        Harmonic mean of the distances, and the least of them but for grazing rays; metres, inf if there is nothing.
        Relative standard error of the irradiance, as neighbouring rays differ: too large where light varies smoothly.
    """
    for r in prange(len(stream)):
        _sums_of_record(
            np.int64(r),
            radiance,
            distance,
            shading_normal,
            turn_of(seed, stream[r]),
            n_theta,
            n_phi,
            irradiance,
            by_turn,
            by_move,
            spread,
        )


@kernel
def _sums_of_record(  # type: ignore[no-untyped-def]
    r, radiance, distance, shading_normal, first_turn, n_theta, n_phi, irradiance, by_turn, by_move, spread
):
    n_channels = radiance.shape[2]
    nx, ny, nz = shading_normal[r, 0], shading_normal[r, 1], shading_normal[r, 2]
    tx, ty, tz, bx, by, bz = basis(nx, ny, nz)
    m, n = n_theta, n_phi
    closeness, nearest = 0.0, np.inf
    for j in range(m):
        for k in range(n):
            d = distance[r, j * n + k]
            closeness += 1.0 / max(d, np.float32(1e-30))
            if (j + 0.5) / m < _HIGH:
                nearest = min(nearest, d)
    spread[r, 0] = m * n / closeness if closeness > 0.0 else np.inf
    spread[r, 1] = nearest
    slope, low, width = np.empty(m), np.empty(m), np.empty(m)
    for j in range(m):
        u = (j + 0.5) / m
        slope[j] = np.sqrt(u / (1.0 - u))
        low[j] = (1.0 - j / m) * np.sqrt(j / m) * (2.0 * np.pi / n)
        width[j] = np.sqrt((j + 1) / m) - np.sqrt(j / m)
    unlike = 0.0
    total, turn, move = np.zeros(n_channels), np.zeros((n_channels, 2)), np.zeros((n_channels, 2))
    for k in range(n):
        phi = 2.0 * np.pi * ((k + 0.5) / n + first_turn)
        edge = 2.0 * np.pi * (k / n + first_turn)
        across, along = np.cos(phi), np.sin(phi)
        edge_across, edge_along = np.cos(edge), np.sin(edge)
        before = k - 1 if k > 0 else n - 1
        for j in range(m):
            ray, beside, inside = j * n + k, j * n + before, max(j - 1, 0) * n + k
            d = distance[r, ray]
            outwards = low[j] / max(min(d, distance[r, inside]), _TOUCHING)
            around = width[j] / max(min(d, distance[r, beside]), _TOUCHING)
            step = 0.0
            for c in range(n_channels):
                value = np.float64(radiance[r, ray, c])
                step += value - radiance[r, beside, c]
                total[c] += value
                turn[c, 0] -= along * slope[j] * value
                turn[c, 1] += across * slope[j] * value
                out = outwards * (value - radiance[r, inside, c])
                turned = around * (value - radiance[r, beside, c])
                move[c, 0] += across * out - edge_along * turned
                move[c, 1] += along * out + edge_across * turned
            unlike += step * step
    light = 0.0
    for c in range(n_channels):
        light += total[c]
    spread[r, 2] = np.sqrt(0.5 * unlike) / light if light > 0.0 else 0.0
    share = np.pi / (m * n)
    for c in range(n_channels):
        irradiance[r, c] = share * total[c]
        a, b = share * turn[c, 0], share * turn[c, 1]
        by_turn[r, c, 0] = a * tx + b * bx
        by_turn[r, c, 1] = a * ty + b * by
        by_turn[r, c, 2] = a * tz + b * bz
        by_move[r, c, 0] = move[c, 0] * tx + move[c, 1] * bx
        by_move[r, c, 1] = move[c, 0] * ty + move[c, 1] * by
        by_move[r, c, 2] = move[c, 0] * tz + move[c, 1] * bz
