"""Light of a rectangle at places next to it that something hides a part of: rays spread evenly over what is in sight.

What all of it brings is known [1]_, and rays tell how much of that is hidden: a ratio estimator [2]_ over directions
of equal solid angle [3]_, by the cosine of each. Points spread evenly over the rectangle tell little there, as the few
that are near bring nearly all.

.. [1] `clear_light`.
.. [2] Heitz, Hill, McGuire 2018, Combining Analytic Direct Illumination and Stochastic Shadows.
.. [3] Urena, Fajardo, King 2013, An area-preserving parametrization for spherical rectangles.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.clear_light import clear_light
from icheat_usd.kernels.embree import PACKET
from icheat_usd.kernels.light_geometry import Floats, plane_axes, rect_frame, world_frame
from icheat_usd.kernels.lights import place_in_rect
from icheat_usd.kernels.place_columns import COLUMNS, NORMAL, ORIGIN, RUN, SHADING, TINT
from icheat_usd.kernels.place_rays import CLEAR, THROUGH, find_columns, prepare_packet, trace_rows
from icheat_usd.kernels.random import hash_combine, sobol_pair
from icheat_usd.kernels.simd import address_of, load, multiply_add, product, spread, store


@parallel_kernel
def look_evenly(
    function: int,
    opaque: int,
    passing: int,
    boxes: np.ndarray,
    lights: Any,
    form: np.ndarray,
    color: np.ndarray,
    n_rays: int,
    seed: int,
    columns: np.ndarray,
    column: np.ndarray,
    sequence: np.ndarray,
    diffuse: float,
    out: np.ndarray,
) -> None:
    """What places reflect of a rectangle, diffusely.

    Those of whose rays one meets what lets light through keep what they have. Where there is no closed form, rays alone
    tell.

    Parameters
    ----------
    function, opaque, passing, boxes, columns, column
        As `shadow.light_places` has them.
    lights : Lights
        The rectangle alone.
    form : (14,) float32
        Of the rectangle, as `clear_light` has it.
    color : (3,) float32, of mean 1
    n_rays : int
        Of each place; powers of two are spread best.
    sequence : (n, 2) int64
        Of each place, a number that its rays go by, and which of the rays of that number are its first.
    diffuse : float, factor of what places reflect
    out : (n, 3) float32, changed
        In the places' order.
    """
    for run in prange(len(column)):
        _look_at_run(
            function, opaque, passing, boxes, lights, form, color, n_rays, seed, columns, column, sequence,
            np.int64(run), diffuse, out,
        )  # fmt: skip


@parallel_kernel
def light_of_clear_places(
    form: np.ndarray, color: np.ndarray, columns: np.ndarray, column: np.ndarray, wanted: np.ndarray, diffuse: float,
    out: np.ndarray,
) -> None:  # fmt: skip
    """What places of some runs reflect of a light that nothing hides, diffusely, the sum of the channels.

    Parameters
    ----------
    form, columns, column, wanted
        As `shadow.light_places` has them.
    color, diffuse
        As `look_evenly` has them.
    out : (n_runs * RUN,) float32, changed
        In the places' order, where they are of the runs; 0 where the light has no closed form.
    """
    for i in prange(len(wanted)):
        at, run = np.empty(COLUMNS, np.int64), np.int64(wanted[i])
        find_columns(address_of(columns), column, run, at)
        for lane in range(0, RUN, 16):
            tint = product(spread(np.float32(diffuse * color[0])), load(at[TINT] + lane * 4))
            for c in range(1, 3):
                channel = load(at[TINT + c] + lane * 4)
                tint = multiply_add(spread(np.float32(diffuse * color[c])), channel, tint)
            store(address_of(out) + (run * RUN + lane) * 4, product(tint, clear_light(form, at, lane)))


@kernel
def _look_at_run(  # type: ignore[no-untyped-def]
    function, opaque, passing, boxes, lights, form, color, n_rays, seed, columns, column, sequence, run, diffuse, out
):
    storage = np.empty(PACKET + 16 + RUN + 16, np.float32)
    begin = (-address_of(storage) % 64) // 4
    rays = storage[begin : begin + PACKET].reshape(22, 16)
    begin += PACKET
    valid = storage[begin : begin + 16].view(np.int32)
    begin += 16
    whole = storage[begin : begin + RUN]
    at, runs, count = np.empty(COLUMNS, np.int64), np.full(n_rays, run), min(RUN, len(sequence) - run * RUN)
    ways, weight = np.empty((n_rays, 3, RUN), np.float32), np.zeros((n_rays, RUN), np.float64)
    rows, state = np.empty(n_rays * RUN, np.int32), np.zeros((n_rays, RUN), np.int32)
    measure = np.empty(RUN, np.float64)
    prepare_packet(rays)
    find_columns(address_of(columns), column, run, at)
    for lane in range(0, RUN, 16):
        store(address_of(whole) + lane * 4, clear_light(form, at, lane))
    m, width, height = world_frame(lights, 0), float(lights.size[0, 0]), float(lights.size[0, 1])
    n = 0
    for j in range(count):
        of_place, first = hash_combine(seed, sequence[run * RUN + j, 0]), sequence[run * RUN + j, 1]
        n, measure[j] = _aim(m, width, height, n_rays, of_place, first, columns, column[run], j, ways, weight, rows, n)
    trace_rows(
        function, 0, opaque, passing, boxes, False, columns, column, runs, ways, rays, valid, rows, n,
        state.reshape(-1),
    )  # fmt: skip
    for j in range(count):
        total, seen, is_through = 0.0, 0.0, False
        for r in range(n_rays):
            total += weight[r, j]
            seen += weight[r, j] if state[r, j] == CLEAR else 0.0
            is_through |= weight[r, j] > 0.0 and state[r, j] == THROUGH
        if (total > 0.0 or whole[j] <= 0.0) and not is_through:
            light = whole[j] * seen / total if whole[j] > 0.0 else abs(form[1]) / math.pi * measure[j] * seen / n_rays
            for c in range(3):
                out[run * RUN + j, c] = np.float32(diffuse * light * columns[column[run, TINT + c], j] * color[c])
    whole[0] = rays[0, 0]  # Numba may free an array after its last mention, and addresses do not count.


@kernel
def _aim(  # type: ignore[no-untyped-def]
    m: Floats, width, height, n_rays, seed, first, columns, of_run, j, ways, weight, rows, n
):
    """Ways of the rays of place `j` and what they count, and their rows behind the first `n`.

    Returns
    -------
    n : int
        How many rows there are.
    measure : float
        Solid angle or area that the rays are spread over; the light of the place is radiance times that, times the mean
        over rays of what they count, of those that nothing blocks.
    """
    px, py, pz = _vector(columns, of_run, ORIGIN, j)
    nx, ny, nz = _vector(columns, of_run, NORMAL, j)
    sx, sy, sz = _vector(columns, of_run, SHADING, j)
    frame = rect_frame(m, width, height, px, py, pz)
    depth, solid_angle = frame[4], frame[8]
    if depth <= 0.0:
        return n, 0.0
    for r in range(n_rays):
        u1, u2 = sobol_pair(first + r, seed)
        x, y = place_in_rect(frame, u1, u2)
        x, y = (x - 0.5) * width, (y - 0.5) * height
        dx = m[3] - px + m[0] * x + m[1] * y
        dy = m[7] - py + m[4] * x + m[5] * y
        dz = m[11] - pz + m[8] * x + m[9] * y
        cosine = dx * sx + dy * sy + dz * sz
        if cosine <= 0.0 or dx * nx + dy * ny + dz * nz <= 0.0:
            continue
        square = dx * dx + dy * dy + dz * dz
        weight[r, j] = cosine / math.sqrt(square)
        if solid_angle <= 0.0:  # by area
            weight[r, j] *= depth / (square * math.sqrt(square))
        ways[r, 0, j], ways[r, 1, j], ways[r, 2, j] = dx, dy, dz
        rows[n] = r * RUN + j
        n += 1
    return n, solid_angle if solid_angle > 0.0 else plane_axes(m)[9] * width * height


@kernel
def _vector(columns: np.ndarray, of_run: np.ndarray, first: int, j: int) -> Floats:
    return float(columns[of_run[first], j]), float(columns[of_run[first + 1], j]), float(columns[of_run[first + 2], j])
