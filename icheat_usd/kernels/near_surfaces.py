"""How near the next surface is to many places, by a few short rays of each."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.packets import trace_16
from icheat_usd.kernels.random import hash_combine, sobol_pair
from icheat_usd.kernels.samples import cosine_direction
from icheat_usd.kernels.simd import address_of

_CHUNK = 256  # places that share buffers
_INVALID = np.uint32(0xFFFFFFFF)


@parallel_kernel
def near_surfaces(trace, position, shading_normal, normal, stream, seed, n_rays, limit, out):  # type: ignore[no-untyped-def]
    """Distance of the nearest surface that cosine rays from n places meet.

    Parameters
    ----------
    trace : TraceTable
    position, shading_normal, normal : (n, 3) float32
        Starts in world space, off the surface; unit normals.
    stream : (n,) int64
        Number of each place's random sequence.
    n_rays : int
        Of each place; 1, 2, 4, 8 or 16.
    limit : (n,) float32
        Metres that rays are followed.
    out : (n,) float32
        Metres; inf where nothing is met.
    """
    for chunk in prange((len(out) + _CHUNK - 1) // _CHUNK):
        _near_of_chunk(chunk * _CHUNK, trace, position, shading_normal, normal, stream, seed, n_rays, limit, out)


@kernel
def _near_of_chunk(first, trace, position, shading_normal, normal, stream, seed, n_rays, limit, out):  # type: ignore[no-untyped-def]
    storage = np.zeros(24 * 16 + 16 + 64, np.float32)
    shift = (-address_of(storage) % 64) // 4
    valid = storage[shift : shift + 16].view(np.int32)
    rays = storage[shift + 16 : shift + 16 + 22 * 16].reshape(22, 16)
    words = rays.view(np.uint32)
    single = storage[shift + 23 * 16 : shift + 23 * 16 + 24]
    single_words = single.view(np.uint32)
    rays_at, valid_at, single_at = address_of(rays), address_of(valid), address_of(single)
    end = min(first + _CHUNK, len(out))
    places = 16 // n_rays
    for begin in range(first, end, places):
        for e in range(16):
            p, k = begin + e // n_rays, e % n_rays
            valid[e] = 0
            if p >= end:
                continue
            u, v = sobol_pair(k, hash_combine(seed, stream[p]))
            x, y, z = cosine_direction(shading_normal[p, 0], shading_normal[p, 1], shading_normal[p, 2], u, v)
            if x * normal[p, 0] + y * normal[p, 1] + z * normal[p, 2] > np.float32(0.0):
                valid[e] = -1
            rays[0, e], rays[1, e], rays[2, e] = position[p, 0], position[p, 1], position[p, 2]
            rays[4, e], rays[5, e], rays[6, e] = x, y, z
            rays[8, e] = limit[p]
        rays[3, :] = 0.0
        rays[7, :] = 0.0
        words[9, :] = _INVALID
        words[10:12, :] = 0
        words[17:21, :] = _INVALID
        trace_16(trace, rays, words, valid, rays_at, valid_at, single, single_words, single_at)
        for p in range(begin, min(begin + places, end)):
            out[p] = np.inf
        for e in range(16):
            if valid[e] != 0 and words[18, e] != _INVALID:
                p = begin + e // n_rays
                out[p] = min(out[p], rays[8, e])


@parallel_kernel
def least_of_pixels(begin, instance, near, out):  # type: ignore[no-untyped-def]
    """Least of `near` (n,) among the places ``begin[p]:begin[p + 1]`` of a pixel that lie on the same instance."""
    for p in prange(len(begin) - 1):
        for i in range(begin[p], begin[p + 1]):
            least = near[i]
            for j in range(begin[p], begin[p + 1]):
                if instance[j] == instance[i]:
                    least = min(least, near[j])
            out[i] = least
