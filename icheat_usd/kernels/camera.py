"""Rays of the camera."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.random import hash_combine, sobol_pair


@kernel
def _place(filter_inverse: np.ndarray, share: float) -> float:
    """Where the filter has this share of its weight on the left; an empty table is the box of one pixel."""
    steps = len(filter_inverse) - 1
    if steps < 1:
        return share
    at = min(int(share * steps), steps - 1)
    return filter_inverse[at] + (share * steps - at) * (filter_inverse[at + 1] - filter_inverse[at])


@parallel_kernel
def camera_rays(  # type: ignore[no-untyped-def]
    to_world,
    window,
    width,
    height,
    orthographic,
    lens_radius,
    focus_distance,
    pixels,
    n_samples,
    first_sample,
    centred,
    filter_inverse,
    seed,
    origins,
    directions,
    axial,
    stream,
):
    """Rays of `pixels`, `n_samples` of each: unit directions, and the cosine to the camera's axis.

    They are the samples from number `first_sample` on of a sequence that
    stratifies the pixel filter and the lens's disk; where `centred`, all go
    through the centre of both. `filter_inverse` is `PixelFilter.inverse`. `stream` gets a number of its own for each
    sample of each pixel.
    """
    left, right, bottom, top = window
    for ray in prange(len(axial)):
        pixel = pixels[ray // n_samples]
        k = first_sample + ray % n_samples
        stream[ray] = np.int32(hash_combine(hash_combine(0x63616D, pixel), k))
        px, py = pixel % width, pixel // width
        u, v, lens_x, lens_y = 0.5, 0.5, 0.0, 0.0
        if not centred:
            scramble = hash_combine(seed, pixel)
            u, v = sobol_pair(k, hash_combine(scramble, 0))
            u, v = _place(filter_inverse, np.float64(u)), _place(filter_inverse, np.float64(v))
            if lens_radius > 0.0:
                a, b = sobol_pair(k, hash_combine(scramble, 1))
                radius = lens_radius * math.sqrt(a)
                lens_x = radius * math.cos(2.0 * math.pi * b)
                lens_y = radius * math.sin(2.0 * math.pi * b)
        x = left + (px + u) / width * (right - left)
        y = top - (py + v) / height * (top - bottom)
        if orthographic:
            ox, oy = x, y
            dx, dy, dz = 0.0, 0.0, -1.0
        else:
            ox, oy = lens_x, lens_y
            dx, dy, dz = x, y, -1.0
            if lens_radius > 0.0:
                dx -= lens_x / focus_distance
                dy -= lens_y / focus_distance
        scale = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        dx, dy, dz = dx * scale, dy * scale, dz * scale
        for c in range(3):
            origins[ray, c] = to_world[c, 0] * ox + to_world[c, 1] * oy + to_world[c, 3]
            directions[ray, c] = to_world[c, 0] * dx + to_world[c, 1] * dy + to_world[c, 2] * dz
        axial[ray] = -dz
