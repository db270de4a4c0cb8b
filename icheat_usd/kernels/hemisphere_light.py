"""Light that the rays of cache records bring, and what a unit of it adds to irradiance and its gradients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.record_rays import turn_of

_TOUCHING = np.float32(1e-6)  # metres: a ray may end where it starts, in a crease


class HemisphereTable(NamedTuple):
    """Rays of n hemispheres; see `record_rays.trace_hemispheres`."""

    cell: NDArray[np.int32]  #: (n, n_rays)
    caster: NDArray[np.int32]  #: (n, n_rays) where masks and leaves are looked up
    distance: NDArray[np.float32]  #: (n, n_rays)
    shading_normal: NDArray[np.float32]  #: (n, 3)
    stream: NDArray[np.int64]  #: (n,)
    adjusted_begin: NDArray[np.int64]  #: (n + 1,)
    adjusted: NDArray[np.int64]  #: ascending numbers ``row * n_rays + ray``
    throughput: NDArray[np.float32]  #: (n_adjusted, 3)
    way: NDArray[np.float32]  #: (n_adjusted, 3) what the way leaves of any light
    share: NDArray[np.float32]  #: (n,) in its record
    shrink: NDArray[np.float32]  #: (n,) factor on what changes with place


@kernel
def linear_in_light(h, hemispheres, seed, n_theta, n_phi, out):  # type: ignore[no-untyped-def]
    """What one unit of radiance of each ray adds to irradiance and its gradients (`record_sums.record_sums`)."""
    distance, m, n = hemispheres.distance, n_theta, n_phi
    first_turn = turn_of(seed, hemispheres.stream[h])
    share = hemispheres.share[h]
    shrunk = share * hemispheres.shrink[h]
    value = np.float32(np.pi / (m * n)) * share
    slope, low, width = np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32)
    for j in range(m):
        u = (j + 0.5) / m
        slope[j] = value * np.sqrt(u / (1.0 - u))
        low[j] = shrunk * (1.0 - j / m) * np.sqrt(j / m) * (2.0 * np.pi / n)
        width[j] = shrunk * (np.sqrt((j + 1) / m) - np.sqrt(j / m))
    for ray in range(m * n):
        out[ray, 3], out[ray, 4] = np.float32(0.0), np.float32(0.0)
    for k in range(n):
        phi = 2.0 * np.pi * ((k + 0.5) / n + first_turn)
        edge = 2.0 * np.pi * (k / n + first_turn)
        across, along = np.float32(np.cos(phi)), np.float32(np.sin(phi))
        edge_across, edge_along = np.float32(np.cos(edge)), np.float32(np.sin(edge))
        before = k - 1 if k > 0 else n - 1
        for j in range(m):
            ray, beside, inside = j * n + k, j * n + before, max(j - 1, 0) * n + k
            d = distance[h, ray]
            outwards = low[j] / max(min(d, distance[h, inside]), _TOUCHING)
            around = width[j] / max(min(d, distance[h, beside]), _TOUCHING)
            out[ray, 0] = value
            out[ray, 1] = -along * slope[j]
            out[ray, 2] = across * slope[j]
            out[ray, 3] += across * outwards - edge_along * around
            out[ray, 4] += along * outwards + edge_across * around
            out[inside, 3] -= across * outwards
            out[inside, 4] -= along * outwards
            out[beside, 3] += edge_along * around
            out[beside, 4] -= edge_across * around


@kernel
def arriving(h, ray, a, hemispheres, sent, emits, light):  # type: ignore[no-untyped-def]
    """Light of a ray by group, and behind these what a unit of added emission comes to; returns the next `a`."""
    n_groups, n_rays, cell = len(sent), hemispheres.cell.shape[1], hemispheres.cell[h, ray]
    is_adjusted = a < hemispheres.adjusted_begin[h + 1] and hemispheres.adjusted[a] == h * n_rays + ray
    for c in range(3):
        tint = hemispheres.throughput[a, c] if is_adjusted else np.float32(1.0)
        way = hemispheres.way[a, c] if is_adjusted else np.float32(1.0)
        for g in range(n_groups):
            light[g, c] = tint * sent[g, cell, c] if cell >= 0 else np.float32(0.0)
        light[n_groups, c] = way if emits else np.float32(0.0)
    return a + 1 if is_adjusted else a


@kernel
def find_strangers(cell, instance, of_cell, is_varied, out):  # type: ignore[no-untyped-def]
    """Numbers of rays whose sender is not that of their cell, or is masked in part; returns how many."""
    n, n_rays = cell.shape
    total = 0
    for r in range(n):
        for ray in range(n_rays):
            j, i = cell[r, ray], instance[r, ray]
            if j >= 0 and i >= 0 and (of_cell[j] != i or is_varied[i] != 0):
                if total < len(out):
                    out[total] = r * n_rays + ray
                total += 1
    return total
