"""Direct light of one light at many places, at interactive rates: sampled, shadowed and summed in one pass.

The light is a table of points spread evenly over its surface. Every place looks at some of them, sends a shadow
ray to one, chosen in proportion to what each would bring, and counts the mean of all for it (resampled
importance sampling [1]_ over strata): unbiased over the choice of points, and without most of the noise that
distance and cosines of a single point would have.

.. [1] Talbot, Cline, Egbert 2005, Importance Resampling for Global Illumination.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.embree import call_packet
from icheat_usd.kernels.random import hash_combine, hash_u32, to_unit

RUN = 64  #: successive places that share shadow rays if that is allowed
CANDIDATES = 4  #: points of the light that a place looks at
_QUICK_CANDIDATES = 2  # where places share rays
_RUNS = 16  # of a task
_INVALID = np.uint32(0xFFFFFFFF)
_STOP_SHORT = np.float32(1.0 - 1e-4)  # as for other shadow rays: lights may lie in the plane of a ceiling
_BLOCKED, _CLEAR, _THROUGH = 0, 1, 2
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@kernel
def _brings(
    table: np.ndarray, k: int, distant: bool, x: float, y: float, z: float, nx: float, ny: float, nz: float,
    gx: float, gy: float, gz: float,
) -> float:  # fmt: skip
    """Irradiance at a place if all of the light were at point `k`; its colour apart."""
    if distant:
        dx, dy, dz = table[k, 0], table[k, 1], table[k, 2]
        if dx * gx + dy * gy + dz * gz <= _ZERO:
            return _ZERO
        return max(_ZERO, dx * nx + dy * ny + dz * nz) * table[k, 9]
    dx, dy, dz = table[k, 0] - x, table[k, 1] - y, table[k, 2] - z
    here = dx * nx + dy * ny + dz * nz
    there = -(dx * table[k, 3] + dy * table[k, 4] + dz * table[k, 5])
    if here <= _ZERO or there <= _ZERO or dx * gx + dy * gy + dz * gz <= _ZERO:
        return _ZERO
    square = dx * dx + dy * dy + dz * dz
    return here * there / (square * square) * table[k, 9]


@kernel
def _choose(
    table: np.ndarray, distant: bool, place: np.ndarray, i: int, candidates: int, weight: np.ndarray,
    of_run: int, of_turn: int, turn: int,
) -> tuple[int, float]:  # fmt: skip
    """Point of the light that place `i` sends its ray to (-1: none), and the mean of what its candidates bring."""
    x, y, z = place[i, 0], place[i, 1], place[i, 2]
    gx, gy, gz = place[i, 3], place[i, 4], place[i, 5]
    nx, ny, nz = place[i, 6], place[i, 7], place[i, 8]
    # neighbours look at different points, those of a run at all of them, and so does one place in as many turns
    groups = len(table) // candidates
    first = ((((i & (RUN - 1)) * 29 + of_run) ^ turn) & (groups - 1)) * candidates
    total = _ZERO
    for c in range(candidates):
        weight[c] = _brings(table, first + c, distant, x, y, z, nx, ny, nz, gx, gy, gz)
        total += weight[c]
    if not total > _ZERO:
        return -1, _ZERO
    left = to_unit(hash_u32(np.uint32(of_turn) ^ np.uint32(i))) * total
    last = -1
    for c in range(candidates):
        if weight[c] > _ZERO:
            last = c
            if left < weight[c]:
                break
            left -= weight[c]
    return first + last, total / np.float32(candidates)


@kernel
def _trace(
    function: int, arguments: int, opaque: int, passing: int, table: np.ndarray, distant: bool, place: np.ndarray,
    first: int, rows: np.ndarray, n: int, chosen: np.ndarray, valid: np.ndarray, rays: np.ndarray, state: np.ndarray,
) -> None:  # fmt: skip
    """Shadow rays of `n` places of a run, in packets of 16."""
    words = rays.view(np.uint32)
    for begin in range(0, n, 16):
        count = min(16, n - begin)
        for lane in range(16):
            valid[lane] = -1 if lane < count else 0
            j = rows[begin + min(lane, count - 1)]
            i, k = first + j, chosen[j]
            for c in range(3):
                rays[c, lane] = place[i, c]
                rays[4 + c, lane] = table[k, c] if distant else table[k, c] - place[i, c]
            rays[3, lane] = _ZERO
            rays[7, lane] = _ZERO
            rays[8, lane] = np.inf if distant else _STOP_SHORT
            words[9, lane] = _INVALID
            words[10, lane] = 0
            words[11, lane] = 0
        call_packet(function, valid.ctypes.data, opaque, rays.ctypes.data, arguments)
        for lane in range(count):
            state[rows[begin + lane]] = _CLEAR if rays[8, lane] >= _ZERO else _BLOCKED
        if passing == 0:
            continue
        for lane in range(count):
            valid[lane] = -1 if rays[8, lane] >= _ZERO else 0
        call_packet(function, valid.ctypes.data, passing, rays.ctypes.data, arguments)
        for lane in range(count):
            if valid[lane] != 0 and rays[8, lane] < _ZERO:
                state[rows[begin + lane]] = _THROUGH


@kernel
def _gloss(
    table: np.ndarray, k: int, distant: bool, place: np.ndarray, gloss: np.ndarray, i: int
) -> tuple[float, float]:
    """Factors of `specular` and `specular_edge`: the GGX lobe of `kernels.bsdf.specular_terms`."""
    lx, ly, lz = table[k, 0], table[k, 1], table[k, 2]
    if not distant:
        lx, ly, lz = lx - place[i, 0], ly - place[i, 1], lz - place[i, 2]
        inverse = _ONE / np.float32(math.sqrt(lx * lx + ly * ly + lz * lz))
        lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
    nx, ny, nz = place[i, 6], place[i, 7], place[i, 8]
    light = nx * lx + ny * ly + nz * lz
    hx, hy, hz = lx + gloss[i, 9], ly + gloss[i, 10], lz + gloss[i, 11]
    length = np.float32(math.sqrt(hx * hx + hy * hy + hz * hz))
    cosine = (nx * hx + ny * hy + nz * hz) / length
    if light <= _ZERO or cosine <= _ZERO:
        return _ZERO, _ZERO
    # the sine from the cross product, as of a narrow lobe 1 - cos^2 has no digits
    sx, sy, sz = (ny * hz - nz * hy) / length, (nz * hx - nx * hz) / length, (nx * hy - ny * hx) / length
    alpha2 = gloss[i, 6] * gloss[i, 6]
    spread = alpha2 * cosine * cosine + sx * sx + sy * sy + sz * sz
    c2 = min(light * light, _ONE)
    light_lambda = np.float32(0.5) * (np.float32(math.sqrt(_ONE + alpha2 * (_ONE - c2) / c2)) - _ONE)
    shadowing = _ONE / (_ONE + gloss[i, 8] + light_lambda)
    value = alpha2 / (np.float32(math.pi) * spread * spread) * shadowing / (np.float32(4.0) * gloss[i, 7] * light)
    grazing = _ONE - min(max((lx * hx + ly * hy + lz * hz) / length, _ZERO), _ONE)
    edge = grazing * grazing * grazing * grazing * grazing
    return value * (_ONE - edge), value * edge


@parallel_kernel
def light_places(
    function: int,
    arguments: int,
    opaque: int,
    passing: int,
    table: np.ndarray,
    distant: bool,
    seed: int,
    turn: int,
    place: np.ndarray,
    tint: np.ndarray,
    gloss: np.ndarray,
    share_rays: bool,
    row: np.ndarray,
    out: np.ndarray,
    through: np.ndarray,
) -> None:
    """What n places reflect of one light.

    Parameters
    ----------
    function, opaque, passing : addresses of rtcOccluded16 and of the scenes of opaque and of see-through triangles
        (0: there are none)
    arguments : address of RTCOccludedArguments, or 0
    table : (m, 12) float32
        Points of the light: place, normal, colour, radiance times the whole light's area. Distant lights:
        directions, and radiance times solid angle; those without an angle: irradiance on a plane that faces
        them. m is a power of two and a multiple of `CANDIDATES`.
    turn : int
        Number of the ray of each place: in m / `CANDIDATES` turns a place looks at every point once.
    place : (n, 9) float32
        Origin off the surface, geometric normal, shading normal.
    tint : (n, 3) float32, albedo over pi
    gloss : (n, 12) float32
        specular, specular_edge, alpha (0: no lobe), cosine to the eye, Smith's Lambda of the eye, direction to the
        eye; or no rows: no place has a lobe.
    share_rays : bool
        Rays of a quarter of the places stand for a whole run where all agree: for places in the order of tiles.
        Shadows that fall between those rays are missed. Such places look at two points only.
    row : (n,) int32
        Row of `out` that each place has, all different.
    out : (n, 3) float32, set
    through : (n,) int32, set
        1 + point of the table where only see-through surfaces are in the way, and `out` is what the place would get
        without them; else 0.
    """
    n = len(place)
    glossy = len(gloss) > 0
    task_size = RUN * _RUNS
    for task in prange((n + task_size - 1) // task_size):
        storage = np.empty(14 * 16 + 16, np.float32)
        shift = np.int64((-storage.ctypes.data % 64) // 4)
        valid = storage[shift : shift + 16].view(np.int32)
        rays = storage[shift + 16 : shift + 16 + 12 * 16].reshape(12, 16)
        weight = np.empty(CANDIDATES, np.float32)
        of_turn = np.int64(hash_combine(seed, turn))
        candidates = _QUICK_CANDIDATES if share_rays else CANDIDATES
        rows = np.empty(RUN, np.int64)
        chosen = np.empty(RUN, np.int64)
        state = np.empty(RUN, np.int64)
        level = np.empty(RUN, np.float32)
        for first in range(task * task_size, min(n, (task + 1) * task_size), RUN):
            size = min(RUN, n - first)
            of_run = np.int64(hash_u32(np.uint32(first // RUN) ^ np.uint32(seed)))
            for j in range(size):
                chosen[j], level[j] = _choose(
                    table, distant, place, first + j, candidates, weight, of_run, of_turn, turn
                )
                state[j] = _BLOCKED
            count = 0
            for j in range(size):
                if chosen[j] >= 0 and (not share_rays or j % 4 == 0):
                    rows[count] = j
                    count += 1
            _trace(
                function, arguments, opaque, passing, table, distant, place, first, rows, count, chosen, valid, rays,
                state,
            )  # fmt: skip
            if share_rays:
                common = state[rows[0]] if count >= RUN // 8 else _THROUGH
                for q in range(count):
                    common = common if state[rows[q]] == common else _THROUGH
                count = 0
                for j in range(size):
                    if chosen[j] >= 0 and j % 4 != 0:
                        state[j] = common
                        rows[count] = j
                        count += 1
                if common == _THROUGH:
                    _trace(
                        function, arguments, opaque, passing, table, distant, place, first, rows, count, chosen, valid,
                        rays, state,
                    )  # fmt: skip
            for j in range(size):
                i, k = first + j, chosen[j]
                target = np.int64(row[i])
                through[i] = 0
                if state[j] == _BLOCKED:
                    for c in range(3):
                        out[target, c] = _ZERO
                    continue
                if state[j] == _THROUGH:
                    through[i] = 1 + k
                base, edge = _ZERO, _ZERO
                if glossy and gloss[i, 6] > _ZERO:
                    base, edge = _gloss(table, k, distant, place, gloss, i)
                for c in range(3):
                    reflects = tint[i, c]
                    if glossy:
                        reflects += gloss[i, c] * base + gloss[i, 3 + c] * edge
                    out[target, c] = reflects * level[j] * table[k, 6 + c]
