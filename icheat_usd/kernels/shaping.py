"""Emission of lights by direction: cones, focus and measured profiles.

Directions lead from a place to the light, so that they are along the light's +Z on its axis, and rows of what a light
brings are multiplied by what is emitted against them. The formulas are those of UsdLux's ShapingAPI [1]_; its profile
is looked up linearly, in the polar angles of that direction about +Z in the light's own space.

.. [1] https://openusd.org/release/user_guides/schemas/usdLux/ShapingAPI.html
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.environment import F32, F64, Floats, Table, search_cdf
from icheat_usd.kernels.place_columns import ORIGIN, RUN
from icheat_usd.kernels.shadow import STATES

I32 = NDArray[np.int32]
I16 = NDArray[np.int16]


@kernel
def _smooth_step(x: float, low: float, high: float) -> float:
    """0 up to `low`, 1 beyond `high`; where they are equal, 0 up to there."""
    if x <= low:
        return 0.0
    if x >= high:
        return 1.0
    t = (x - low) / (high - low)
    return t * t * (3.0 - 2.0 * t)


@kernel
def _place_between(angles: F64, x: float) -> tuple[int, float]:
    """Lower neighbour of an angle and its distance from there in parts of the gap."""
    low = search_cdf(angles, 1, len(angles), x) - 1
    gap = angles[low + 1] - angles[low]
    return low, (x - angles[low]) / gap if gap > 0.0 else 0.0


@kernel
def _profile(shaping: Table, x: float, y: float, z: float) -> float:
    """Factor of a measured profile for a direction in the light's own space (any length)."""
    theta = math.atan2(math.sqrt(x * x + y * y), z)
    if shaping.profile_scale > 0.0:
        theta = theta / shaping.profile_scale
    elif shaping.profile_scale < 0.0:
        theta = (theta - math.pi) / -shaping.profile_scale + math.pi
    theta = min(max(theta, 0.0), math.pi)
    vertical, horizontal, intensity = shaping.vertical, shaping.horizontal, shaping.intensity
    if theta < vertical[0] or theta > vertical[len(vertical) - 1]:
        return 0.0
    phi = math.atan2(y, x)
    while phi < horizontal[0]:
        phi += 2.0 * math.pi
    v, dv = _place_between(vertical, theta)
    h, dh = _place_between(horizontal, phi)
    near = (1.0 - dv) * intensity[h, v] + dv * intensity[h, v + 1]
    far = (1.0 - dv) * intensity[h + 1, v] + dv * intensity[h + 1, v + 1]
    return (1.0 - dh) * near + dh * far


@kernel
def shaping_factor(shaping: Table, axis: F64, to_local: F64, wx: float, wy: float, wz: float) -> Floats:
    """Factor of what a light emits against a unit direction: colour (3)."""
    cosine = min(max(axis[0] * wx + axis[1] * wy + axis[2] * wz, -1.0), 1.0)
    level = 1.0 - _smooth_step(math.acos(cosine), shaping.cone[0], shaping.cone[1])
    if level <= 0.0:
        return 0.0, 0.0, 0.0
    if len(shaping.horizontal) > 0:
        x = to_local[0, 0] * wx + to_local[0, 1] * wy + to_local[0, 2] * wz
        y = to_local[1, 0] * wx + to_local[1, 1] * wy + to_local[1, 2] * wz
        z = to_local[2, 0] * wx + to_local[2, 1] * wy + to_local[2, 2] * wz
        level *= _profile(shaping, x, y, z)
    if shaping.focus <= 0.0:
        return level, level, level
    towards = abs(cosine) ** shaping.focus
    away, tint = 1.0 - towards, shaping.focus_tint
    return level * (towards + away * tint[0]), level * (towards + away * tint[1]), level * (towards + away * tint[2])


@parallel_kernel
def shape_rays(shaping: Table, axis: F64, to_local: F64, direction: F32, values: F32) -> None:
    """Multiply rows of `values` (m, 3) by what is emitted against the unit rows of `direction` (m, 3).

    `axis` is the light's +Z, unit, in the world; `to_local` (3, 3) takes directions to its own space.
    """
    for i in prange(len(direction)):
        r, g, b = shaping_factor(
            shaping, axis, to_local, float(direction[i, 0]), float(direction[i, 1]), float(direction[i, 2])
        )
        values[i, 0] *= r
        values[i, 1] *= g
        values[i, 2] *= b


@parallel_kernel
def shape_places(
    shaping: Table,
    axis: F64,
    to_local: F64,
    points: F32,
    distant: bool,
    columns: F32,
    column: I32,
    known: I16,
    row: I32,
    out: F32,
) -> None:
    """The same for what `light_places` found, each place by the point of the light that it chose.

    `points` (n_points, 12) as `lighting.points.light_points` makes them; the others are those of `light_places`.
    """
    for i in prange(len(row)):
        if known[i] < 0:
            continue
        target = row[i]
        if out[target, 0] == 0.0 and out[target, 1] == 0.0 and out[target, 2] == 0.0:
            continue
        k, run, lane = known[i] // STATES, i // RUN, i % RUN
        wx, wy, wz = float(points[k, 0]), float(points[k, 1]), float(points[k, 2])
        if not distant:
            wx -= columns[column[run, ORIGIN], lane]
            wy -= columns[column[run, ORIGIN + 1], lane]
            wz -= columns[column[run, ORIGIN + 2], lane]
        length = math.sqrt(wx * wx + wy * wy + wz * wz)
        if length == 0.0:
            continue
        r, g, b = shaping_factor(shaping, axis, to_local, wx / length, wy / length, wz / length)
        out[target, 0] *= r
        out[target, 1] *= g
        out[target, 2] *= b
