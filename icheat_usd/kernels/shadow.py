"""Direct light of one light at many places, at interactive rates: sampled, shadowed and summed in one pass.

The light is a table of points spread evenly over its surface. Every place looks at some of them, sends a shadow
ray to one, chosen in proportion to what each would bring, and counts the mean of all for it (resampled
importance sampling [1]_ over strata): unbiased over the choice of points, and without most of the noise that
distance and cosines of a single point would have.

While a light moves little by little, most places see what they saw. Every place keeps what its last ray met. A
frame sends the rays of a part of each run of places, another part each time; where these meet what they met
before, the others keep what they know, and where one does not, all of the run are sent.

.. [1] Talbot, Cline, Egbert 2005, Importance Resampling for Global Illumination.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.embree import call_packet
from icheat_usd.kernels.lanes import minus, ratio, root, store_whole, where_above
from icheat_usd.kernels.random import hash_combine, hash_u32, to_unit
from icheat_usd.kernels.simd import address_of, load, multiply_add, plus, product, spread, store, zeros

RUN = 64  #: successive places that share shadow rays if that is allowed
STRIDE = 29  #: groups of points from a place to the next: neighbours look at different parts of the light
PLACE, TINT, GLOSS = 9, 3, 12  #: columns of the tables of places
POINT = 7  #: columns of the table of points that are looked at for every place
_RUNS = 16  # of a task
PART = 4  #: one of so many places of a run sends a ray where that is enough
_INVALID = np.uint32(0xFFFFFFFF)
_STOP_SHORT = np.float32(1.0 - 1e-4)  # as for other shadow rays: lights may lie in the plane of a ceiling
_BLOCKED, _CLEAR, _THROUGH = 0, 1, 2
STATES = 4  #: a place knows STATES * point + state
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)

# Rows of a task's scratch memory, RUN floats each: direction to the chosen point (for distant lights) or way to it,
# light, number of the chosen candidate, factors of the specular lobe, random numbers; then what is known of each
# candidate of 16 places, a packet of rays and its flags.
_TO_X, _TO_Y, _TO_Z, _LEVEL, _CHOICE, _BASE, _EDGE, _NUMBERS = 0, 1, 2, 3, 4, 5, 6, 7
_CANDIDATES, _RAYS, _ROWS = 8, 12, 16


@kernel
def _look(
    points: int, width: int, candidates: int, distant: bool, place: int, lane: int, numbers: int, scratch: int
) -> None:
    """What 16 places of a run, from number `lane`, get from their candidates, and which they would send a ray to.

    Addresses: `points` of the columns of the first place's candidates, each `width` floats long; `place` of the run's
    columns; `numbers` of a random number of each place; `scratch`.
    """
    step, at, out = width * 4, place + lane * 4, scratch + lane * 4
    x, y, z = load(at), load(at + RUN * 4), load(at + RUN * 8)
    gx, gy, gz = load(at + RUN * 12), load(at + RUN * 16), load(at + RUN * 20)
    nx, ny, nz = load(at + RUN * 24), load(at + RUN * 28), load(at + RUN * 32)
    none, total = zeros(), zeros()
    for c in range(candidates):
        point, kept = points + (c * POINT * width + lane) * 4, scratch + _CANDIDATES * RUN * 4 + c * 256
        dx, dy, dz, power = load(point), load(point + step), load(point + 2 * step), load(point + 6 * step)
        if distant:
            here = multiply_add(dx, nx, multiply_add(dy, ny, product(dz, nz)))
            weight = product(here, power)
        else:
            dx, dy, dz = minus(dx, x), minus(dy, y), minus(dz, z)
            here = multiply_add(dx, nx, multiply_add(dy, ny, product(dz, nz)))
            away = multiply_add(
                dx,
                load(point + 3 * step),
                multiply_add(dy, load(point + 4 * step), product(dz, load(point + 5 * step))),
            )
            square = multiply_add(dx, dx, multiply_add(dy, dy, product(dz, dz)))
            weight = product(ratio(product(here, minus(none, away)), product(square, square)), power)
            weight = where_above(none, away, weight, none)
        above = multiply_add(dx, gx, multiply_add(dy, gy, product(dz, gz)))
        weight = where_above(here, none, where_above(above, none, weight, none), none)
        store(kept, dx)
        store(kept + 64, dy)
        store(kept + 128, dz)
        store(kept + 192, weight)
        total = plus(total, weight)
    # the last one whose share of the total begins at or below the random number
    wanted, begin = product(load(numbers + lane * 4), total), zeros()
    dx, dy, dz, choice = zeros(), zeros(), zeros(), spread(np.float32(-1.0))
    for c in range(candidates):
        kept = scratch + _CANDIDATES * RUN * 4 + c * 256
        weight = load(kept + 192)
        dx = _if_reached(weight, begin, wanted, load(kept), dx)
        dy = _if_reached(weight, begin, wanted, load(kept + 64), dy)
        dz = _if_reached(weight, begin, wanted, load(kept + 128), dz)
        choice = _if_reached(weight, begin, wanted, spread(np.float32(c)), choice)
        begin = plus(begin, weight)
    store(out + _TO_X * RUN * 4, dx)
    store(out + _TO_Y * RUN * 4, dy)
    store(out + _TO_Z * RUN * 4, dz)
    store(out + _LEVEL * RUN * 4, product(total, spread(_ONE / np.float32(candidates))))
    store_whole(out + _CHOICE * RUN * 4, choice)


@kernel
def _if_reached(weight: Any, begin: Any, wanted: Any, new: Any, old: Any) -> Any:
    """Where a candidate brings something and its share begins at or below what is wanted the new, else the old."""
    return where_above(weight, zeros(), where_above(begin, wanted, old, new), old)


@kernel
def _shine(gloss: int, place: int, lane: int, scratch: int) -> None:
    """Factors of `specular` and `specular_edge` of 16 places of a run: the GGX lobe of `kernels.bsdf.specular_terms`.

    Addresses as those of `_look`; `gloss` of the run's columns.
    """
    lobe, at, out = gloss + lane * 4, place + lane * 4, scratch + lane * 4
    nx, ny, nz = load(at + RUN * 24), load(at + RUN * 28), load(at + RUN * 32)
    lx, ly, lz = load(out + _TO_X * RUN * 4), load(out + _TO_Y * RUN * 4), load(out + _TO_Z * RUN * 4)
    none, one = zeros(), spread(_ONE)
    inverse = ratio(one, root(multiply_add(lx, lx, multiply_add(ly, ly, product(lz, lz)))))
    lx, ly, lz = product(lx, inverse), product(ly, inverse), product(lz, inverse)
    light = multiply_add(nx, lx, multiply_add(ny, ly, product(nz, lz)))
    hx, hy, hz = plus(lx, load(lobe + RUN * 36)), plus(ly, load(lobe + RUN * 40)), plus(lz, load(lobe + RUN * 44))
    inverse = ratio(one, root(multiply_add(hx, hx, multiply_add(hy, hy, product(hz, hz)))))
    hx, hy, hz = product(hx, inverse), product(hy, inverse), product(hz, inverse)
    cosine = multiply_add(nx, hx, multiply_add(ny, hy, product(nz, hz)))
    # the sine from the cross product, as of a narrow lobe 1 - cos^2 has no digits
    sx, sy = minus(product(ny, hz), product(nz, hy)), minus(product(nz, hx), product(nx, hz))
    sz = minus(product(nx, hy), product(ny, hx))
    alpha = load(lobe + RUN * 24)
    alpha2 = product(alpha, alpha)
    sine2 = multiply_add(sx, sx, multiply_add(sy, sy, product(sz, sz)))
    width = multiply_add(alpha2, product(cosine, cosine), sine2)
    c2 = product(light, light)
    c2 = where_above(c2, one, one, c2)
    smith = root(multiply_add(alpha2, ratio(minus(one, c2), c2), one))
    smith = product(spread(np.float32(0.5)), minus(smith, one))
    below = product(plus(plus(one, load(lobe + RUN * 32)), smith), product(load(lobe + RUN * 28), light))
    below = product(below, product(product(width, width), spread(np.float32(4.0 * math.pi))))
    value = ratio(alpha2, below)
    value = where_above(light, none, where_above(cosine, none, where_above(alpha, none, value, none), none), none)
    met = multiply_add(lx, hx, multiply_add(ly, hy, product(lz, hz)))
    grazing = minus(one, where_above(met, none, where_above(met, one, one, met), none))
    square = product(grazing, grazing)
    edge = product(value, product(product(square, square), grazing))
    store(out + _BASE * RUN * 4, minus(value, edge))
    store(out + _EDGE * RUN * 4, edge)


@kernel
def _prepare_packet(rays: np.ndarray) -> None:
    """What all packets of shadow rays (12, 16) have in common, which tracing leaves as it is."""
    words = rays.view(np.uint32)
    for lane in range(16):
        rays[3, lane] = _ZERO
        rays[7, lane] = _ZERO
        words[9, lane] = _INVALID
        words[10, lane] = 0
        words[11, lane] = 0


@kernel
def _trace(
    function: int, arguments: int, opaque: int, passing: int, distant: bool, place: np.ndarray, run: int,
    scratch: np.ndarray, rows: np.ndarray, n: int, state: np.ndarray,
) -> None:  # fmt: skip
    """Shadow rays of `n` places of a run, in packets of 16; their `state` is set."""
    rays = scratch[_RAYS : _RAYS + 3].reshape(12, 16)
    valid = scratch[_RAYS + 3, :16].view(np.int32)
    limit = np.float32(np.inf) if distant else _STOP_SHORT
    for begin in range(0, n, 16):
        count = min(16, n - begin)
        for lane in range(16):
            valid[lane] = -1 if lane < count else 0
            j = rows[begin + min(lane, count - 1)]
            for c in range(3):
                rays[c, lane] = place[run, c, j]
                rays[4 + c, lane] = scratch[_TO_X + c, j]
            rays[8, lane] = limit
        call_packet(function, address_of(valid), opaque, address_of(rays), arguments)
        for lane in range(count):
            state[rows[begin + lane]] = _CLEAR if rays[8, lane] >= _ZERO else _BLOCKED
        if passing == 0:
            continue
        for lane in range(count):
            valid[lane] = -1 if rays[8, lane] >= _ZERO else 0
        call_packet(function, address_of(valid), passing, address_of(rays), arguments)
        for lane in range(count):
            if valid[lane] != 0 and rays[8, lane] < _ZERO:
                state[rows[begin + lane]] = _THROUGH


@kernel
def _meet(
    function: int, arguments: int, opaque: int, passing: int, distant: bool, place: np.ndarray, run: int,
    scratch: np.ndarray, points: np.ndarray, share_rays: bool, phase: int, known: np.ndarray, rows: np.ndarray,
    state: np.ndarray, asks: np.ndarray,
) -> None:  # fmt: skip
    """Find what is between the places of a run and their points; `points` (RUN,), -1 where there is none."""
    follows = phase >= 0
    # Loops without branches, which the compiler turns into vectors, and one that only counts.
    if follows:
        for j in range(len(known)):
            same = known[j] >> 2 == points[j]
            state[j] = known[j] & 3 if same and points[j] >= 0 else _BLOCKED
            asks[j] = 1 if points[j] >= 0 and (not same or (j & (PART - 1)) == phase) else 0
        for j in range(len(known), RUN):
            state[j], asks[j] = _BLOCKED, 0
    else:
        for j in range(RUN):
            state[j] = _BLOCKED
            asks[j] = 1 if points[j] >= 0 and (not share_rays or (j & (PART - 1)) == 0) else 0
    count = _rows_that_ask(asks, rows)
    _trace(function, arguments, opaque, passing, distant, place, run, scratch, rows, count, state)
    alike = True
    if follows:
        for q in range(count):
            j = rows[q]
            alike &= known[j] >> 2 != points[j] or known[j] & 3 == state[j]
    elif share_rays:
        common = state[rows[0]] if count >= RUN // 8 else _THROUGH
        for q in range(count):
            common = common if state[rows[q]] == common else _THROUGH
        alike = common != _THROUGH
        for j in range(RUN):
            if points[j] >= 0 and (j & (PART - 1)) != 0:
                state[j] = common
    if alike:
        return
    for j in range(RUN):
        asks[j] = 1 if points[j] >= 0 and asks[j] == 0 else 0
    count = _rows_that_ask(asks, rows)
    _trace(function, arguments, opaque, passing, distant, place, run, scratch, rows, count, state)


@kernel
def _rows_that_ask(asks: np.ndarray, rows: np.ndarray) -> int:
    """Numbers of the places with a 1, into `rows`; how many there are."""
    count = np.int64(0)
    for j in range(RUN):
        rows[count] = j
        count += asks[j]
    return count


@kernel
def _light_run(
    function: int, arguments: int, opaque: int, passing: int, points: np.ndarray, first_point: np.ndarray,
    colors: np.ndarray, distant: bool, offset: int, shift: float, place: np.ndarray, tint: np.ndarray,
    gloss: np.ndarray, lobe: int, share_rays: bool, phase: int, known: np.ndarray, row: np.ndarray, out: np.ndarray,
    through: np.ndarray, run: int, scratch: np.ndarray, whole: np.ndarray,
    rows: np.ndarray,
) -> None:  # fmt: skip
    """`light_places` for one run; `whole` (3, RUN) int32 and `rows` (RUN,) int64 are scratch memory as well."""
    candidates, width = points.shape[0], points.shape[2]
    start, here, size = address_of(scratch), address_of(place) + run * (PLACE * RUN * 4), min(RUN, len(row) - run * RUN)
    for lane in range(0, RUN, 16):
        numbers = load(start + _NUMBERS * RUN * 4 + lane * 4)
        numbers = plus(numbers, spread(np.float32(shift)))
        below_one = spread(np.float32(1.0 - 2.0**-24))
        numbers = where_above(numbers, below_one, minus(numbers, spread(_ONE)), numbers)
        store(start + _LEVEL * RUN * 4 + lane * 4, numbers)
        _look(address_of(points) + offset * 4, width, candidates, distant, here, lane, start + _LEVEL * RUN * 4, start)
    chosen, state, asks = whole[0], whole[1], whole[2]
    choice, first = scratch[_CHOICE].view(np.int32), first_point[offset : offset + RUN]
    for j in range(RUN):
        chosen[j] = first[j] + choice[j] if choice[j] >= 0 else -1
    chosen[size:] = -1
    _meet(
        function, arguments, opaque, passing, distant, place, run, scratch, chosen, share_rays, phase,
        known[run * RUN : run * RUN + size], rows, state, asks,
    )  # fmt: skip
    levels, n_lit = scratch[_LEVEL], np.int32(0)
    for j in range(RUN):
        levels[j] = levels[j] if state[j] != _BLOCKED else _ZERO
        n_lit += state[j]
    lit = n_lit > 0
    if not lit:
        scratch[_TO_X : _TO_Z + 1] = _ZERO
    elif lobe >= 0:
        for lane in range(0, RUN, 16):
            _shine(address_of(gloss) + lobe * (GLOSS * RUN * 4), here, lane, start)
    for lane in range(0, RUN if lit else 0, 16):
        at = start + lane * 4
        level = load(at + _LEVEL * RUN * 4)
        for c in range(3):
            reflects = load(address_of(tint) + ((run * TINT + c) * RUN + lane) * 4)
            if lobe >= 0:
                of_lobe = address_of(gloss) + ((lobe * GLOSS + c) * RUN + lane) * 4
                reflects = multiply_add(load(of_lobe), load(at + _BASE * RUN * 4), reflects)
                reflects = multiply_add(load(of_lobe + RUN * 12), load(at + _EDGE * RUN * 4), reflects)
            store(at + (_TO_X + c) * RUN * 4, product(reflects, level))
    if len(colors) > 0:
        for j in range(size):
            if chosen[j] >= 0:
                for c in range(3):
                    scratch[_TO_X + c, j] *= colors[chosen[j], c]
    red, green, blue, first_row = scratch[_TO_X], scratch[_TO_Y], scratch[_TO_Z], run * RUN
    for j in range(size):
        target = np.uint64(row[first_row + j])
        out[target, 0], out[target, 1], out[target, 2] = red[j], green[j], blue[j]
    if len(through) > 0:
        for j in range(size):
            through[first_row + j] = 1 + chosen[j] if state[j] == _THROUGH else 0
    if len(known) > 0:
        found = known[first_row : first_row + size]
        for j in range(size):
            found[j] = STATES * chosen[j] + state[j] if chosen[j] >= 0 else -1


@kernel
def _light_runs(
    function: int, arguments: int, opaque: int, passing: int, points: np.ndarray, first_point: np.ndarray,
    colors: np.ndarray, distant: bool, seed: int, turn: int, place: np.ndarray, tint: np.ndarray, gloss: np.ndarray,
    lobes: np.ndarray, share_rays: bool, phase: int, known: np.ndarray, row: np.ndarray, out: np.ndarray,
    through: np.ndarray, first: int, last: int,
) -> None:  # fmt: skip
    """`light_places` for the runs from `first` up to `last`."""
    storage = np.empty((_ROWS + 1) * RUN, np.float32)
    skip = np.int64((-storage.ctypes.data % 64) // 4)
    scratch = storage[skip : skip + _ROWS * RUN].reshape(_ROWS, RUN)
    whole, rows = np.empty((3, RUN), np.int32), np.empty(RUN, np.int64)
    _prepare_packet(scratch[_RAYS : _RAYS + 3].reshape(12, 16))
    for j in range(RUN):
        # multiples of the golden ratio are spread evenly, modulo 1, however many of them there are
        scratch[_NUMBERS, j] = np.float32((j * 0.6180339887498949) % 1.0)
    of_turn = hash_combine(seed, turn)
    groups = points.shape[2] - RUN
    for run in range(first, last):
        offset = np.int64(hash_u32(np.uint32(run) ^ np.uint32(seed))) & (groups - 1)
        shift = to_unit(hash_u32(np.uint32(of_turn) ^ np.uint32(run)))
        _light_run(
            function, arguments, opaque, passing, points, first_point, colors, distant, offset, shift, place, tint,
            gloss, np.int64(lobes[run]), share_rays, phase, known, row, out, through, run, scratch, whole, rows,
        )  # fmt: skip


@parallel_kernel
def light_places(
    function: int,
    arguments: int,
    opaque: int,
    passing: int,
    points: np.ndarray,
    first_point: np.ndarray,
    colors: np.ndarray,
    distant: bool,
    seed: int,
    turn: int,
    place: np.ndarray,
    tint: np.ndarray,
    gloss: np.ndarray,
    lobes: np.ndarray,
    share_rays: bool,
    phase: int,
    known: np.ndarray,
    row: np.ndarray,
    out: np.ndarray,
    through: np.ndarray,
) -> None:
    """What n places reflect of one light.

    Places come in runs of `RUN`, each a table with a row per property; the last run is filled up.

    Parameters
    ----------
    function, opaque, passing : addresses of rtcOccluded16 and of the scenes of opaque and of see-through triangles
        (0: there are none)
    arguments : address of RTCOccludedArguments, or 0
    points : (candidates, `POINT`, n_groups + `RUN`) float32
        Groups of so many points of the light as each place looks at: place, normal, and radiance times the whole
        light's area. Distant lights: directions, and radiance times solid angle; those without an angle: irradiance
        on a plane that faces them. The first `RUN` groups stand again behind the last; n_groups is a power of two.
        Places of a run look at groups that follow one another.
    first_point : (n_groups + `RUN`,) int32, number of the first point of each group
    colors : (m, 3) float32, colour of each point; none: all are white
    turn : int
        Number of the ray of each place.
    place : (n_runs, `PLACE`, `RUN`) float32
        Origin off the surface, geometric normal, shading normal.
    tint : (n_runs, `TINT`, `RUN`) float32, albedo over pi
    gloss : (n_lobed, `GLOSS`, `RUN`) float32
        specular, specular_edge, alpha (0: no lobe), cosine to the eye, Smith's Lambda of the eye, direction to the
        eye; for runs with a place that has a lobe.
    lobes : (n_runs,) int32, number of the run in `gloss`; -1: no place has a lobe
    share_rays : bool
        Rays of a part of the places stand for a whole run where all agree: for places in the order of tiles.
        Shadows that fall between those rays are missed.
    phase : int
        Which part of the places sends rays where the others may keep what is `known`; -1: nothing is known.
    known : (n,) int16, changed
        What each place has found between it and its point; none: nobody wants to know.
    row : (n,) int32
        Row of `out` that each place has, all different.
    out : (n, 3) float32, set
    through : (n,) int32, set
        1 + point of the light where only see-through surfaces are in the way, and `out` is what the place would get
        without them; else 0. None: there are no such surfaces.
    """
    n_runs = len(place)
    for task in prange((n_runs + _RUNS - 1) // _RUNS):
        _light_runs(
            function, arguments, opaque, passing, points, first_point, colors, distant, seed, turn, place, tint, gloss,
            lobes, share_rays, phase, known, row, out, through, task * _RUNS, min(n_runs, (task + 1) * _RUNS),
        )  # fmt: skip
