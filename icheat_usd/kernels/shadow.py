"""Direct light of one light at many places, at interactive rates: sampled, shadowed and summed in one pass.

The light is a table of points spread evenly over its surface. Every place looks at some of them, sends a shadow
ray to one, chosen in proportion to what each would bring, and counts the mean of all for it (resampled
importance sampling [1]_ over strata): unbiased over the choice of points, and without most of the noise that
distance and cosines of a single point would have. Where it is known what the whole light would bring, that can be
counted instead (a ratio estimator with one sample [2]_): all noise that is left is then that of shadows. Next to a long
rectangle few points tell too little of how much of it is hidden: there it is done where nothing is.

While a light moves little by little, most places see what they saw. Every place keeps what its last ray met. A
frame sends the rays of a part of each run of places, another part each time; where these meet what they met
before, the others keep what they know, and where one does not, all next to it are sent. Where points of the light
itself came behind a surface or out of it, as on a light that is pushed into a wall, that is so for places everywhere,
and few places tell. One that came behind is taken to be hidden from all others, too, and one that came out to be seen
as the other points are where these all look alike; the part of rays that is sent finds where that is wrong. Between
points that look different, rays to such ones are sent always, and say nothing of the rest of a run.

.. [1] Talbot, Cline, Egbert 2005, Importance Resampling for Global Illumination.
.. [2] Heitz, Hill, McGuire 2018, Combining Analytic Direct Illumination and Stochastic Shadows.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.clear_light import RECTANGLE, clear_light
from icheat_usd.kernels.embree import PACKET
from icheat_usd.kernels.lanes import minus, where_above
from icheat_usd.kernels.place_columns import COLUMNS, EDGE, ORIGIN, RUN, SPECULAR, TINT
from icheat_usd.kernels.place_rays import BLOCKED, CLEAR, THROUGH, find_columns, prepare_packet, trace_rows
from icheat_usd.kernels.random import hash_combine, hash_u32, to_unit
from icheat_usd.kernels.shadow_lanes import CANDIDATE, look, shine
from icheat_usd.kernels.simd import address_of, fetch, load, multiply_add, plus, product, spread, store, zeros

STRIDE = 29  #: groups of points from a place to the next: neighbours look at different parts of the light
PART = 8  #: one of so many places of a run sends a ray where all have met the same so far, and that is enough
SHARED_PART = 16  #: the same of runs whose places share rays, of which nothing is told to others
_MIXED_PART = 4  # the same of other runs, of those behind glass and leaves, and of those that nothing is known of
_BESIDE = 16  # successive places of a run, such as 4 x 4 pixels, that are all sent where one meets something else
STATES = 4  #: a place knows STATES * point + state
#: What is told of a point of the light: of places that see it, now or before, some met something else, or nearly all
#: see it now and did not before; hardly any place sees it.
TURNED, APPEARED, BURIED = 1, 2, 4
_LEAST_ALIKE = RUN // 8  # places of a run that tell how a point that came out looks to the others
_RUNS = 16  # of a task, whose rays fill packets together
_STILL_THROUGH = 3  # in a look alone: as it was known, and no ray was sent
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_FOUND = 4  # rows of what a run finds: direction to the chosen point (for distant lights) or way to it, and light
# How far sums of products of float32 numbers may be from what they are: what is called turned away by more is so.
_ROUNDED = np.float32(1e-5)


@kernel
def is_turned_away(bounds: np.ndarray, light: np.ndarray, distant: bool) -> bool:
    """Whether no place of a run can get anything from a light, as one of the two is behind the other.

    `bounds` (4, 3) of the places and of their geometric normals, least and largest; `light` (4, 3) the same of its
    points (of directions to it) and of their normals. The scalar product of a way and a normal lies between the sums
    of the least and of the largest products of their bounds.
    """
    most, least, size = _ZERO, _ZERO, _ZERO
    for c in range(3):
        low, high = light[0, c], light[1, c]
        if not distant:
            low, high = low - bounds[1, c], high - bounds[0, c]
            a, b = low * light[2, c], low * light[3, c]
            p, q = high * light[2, c], high * light[3, c]
            least += min(min(a, b), min(p, q))
        a, b = low * bounds[2, c], low * bounds[3, c]
        p, q = high * bounds[2, c], high * bounds[3, c]
        most += max(max(a, b), max(p, q))
        size += max(abs(low), abs(high))
    return most < -_ROUNDED * size or least > _ROUNDED * size


@kernel
def _alike(known: np.ndarray, told: np.ndarray) -> int:
    """How a run saw the points of which nothing is told: a state, if there was one alone, else -1; -2: too few tell."""
    met, n = 0, 0
    # Loops without branches, which the compiler turns into vectors.
    if len(told) > 0:
        for j in range(len(known)):
            counts = 1 if known[j] >= 0 and told[max(known[j] >> 2, 0)] == 0 else 0
            met |= counts << (known[j] & 3)
            n += counts
    else:
        for j in range(len(known)):
            met |= 1 << (known[j] & 3) if known[j] >= 0 else 0
        n = len(known)
    if met & (met - 1) != 0:
        return -1
    if n < _LEAST_ALIKE or met == 0:
        return -2
    return BLOCKED if met == 1 << BLOCKED else CLEAR if met == 1 << CLEAR else THROUGH


@kernel
def _foretold(point: int, told: np.ndarray, alike: int) -> int:
    """State of a point that has turned, as far as others tell; -1: they do not."""
    if told[point] & BURIED != 0:
        return BLOCKED
    return max(alike, -1) if told[point] & APPEARED != 0 else -1


@kernel
def _ask(
    chosen: np.ndarray, share_rays: bool, phase: int, known: np.ndarray, told: np.ndarray, alike: int,
    state: np.ndarray, asks: np.ndarray,
) -> None:  # fmt: skip
    """Which places of a run send a ray at first, and what the others know; `chosen` is -1 where there is no point."""
    if phase >= 0:
        part = (_MIXED_PART if alike == -1 or alike == THROUGH else SHARED_PART if share_rays else PART) - 1
        for j in range(len(known)):
            same = known[j] >> 2 == chosen[j]
            was = _STILL_THROUGH if known[j] & 3 == THROUGH else known[j] & 3
            state[j] = was if same and chosen[j] >= 0 else BLOCKED
            asks[j] = 1 if chosen[j] >= 0 and (not same or (j ^ phase) & part == 0) else 0
        if len(told) > 0:
            for j in range(len(known)):
                if chosen[j] >= 0 and told[chosen[j]] & TURNED != 0:
                    foretold = _foretold(chosen[j], told, alike)
                    state[j] = max(foretold, BLOCKED)
                    asks[j] |= foretold < 0
                elif chosen[j] >= 0 and told[chosen[j]] & BURIED != 0:
                    asks[j] |= state[j] != BLOCKED
        for j in range(len(known), RUN):
            state[j], asks[j] = BLOCKED, 0
    else:
        for j in range(RUN):
            state[j] = BLOCKED
            asks[j] = 1 if chosen[j] >= 0 and (not share_rays or (j & (_MIXED_PART - 1)) == 0) else 0


@kernel
def _doubt(
    rows: np.ndarray, offset: int, chosen: np.ndarray, share_rays: bool, phase: int, known: np.ndarray,
    told: np.ndarray, alike: int, state: np.ndarray,
) -> int:  # fmt: skip
    """Where other places of a run are to send rays, by those of `rows` less `offset`: a bit for `_BESIDE` places."""
    doubted, every = 0, (1 << RUN // _BESIDE) - 1
    if phase >= 0:
        for q in range(len(rows)):
            j = rows[q] - offset
            if len(told) > 0 and told[chosen[j]] & TURNED != 0:
                foretold = _foretold(chosen[j], told, alike)
                doubted |= every if foretold >= 0 and foretold != state[j] else 0
            elif len(told) == 0 or told[chosen[j]] & BURIED == 0:
                differs = known[j] >> 2 == chosen[j] and known[j] & 3 != state[j]
                doubted |= 1 << j // _BESIDE if differs else 0
        return doubted
    if not share_rays:
        return 0
    common = state[rows[0] - offset] if len(rows) >= RUN // 8 else THROUGH
    for q in range(len(rows)):
        common = common if state[rows[q] - offset] == common else THROUGH
    for j in range(RUN):
        if chosen[j] >= 0 and (j & (_MIXED_PART - 1)) != 0:
            state[j] = common
    return every if common == THROUGH else 0


@kernel
def _append_rows(asks: np.ndarray, offset: int, count: int, rows: np.ndarray) -> int:
    """Numbers of a run's places with a 1, counted from `offset`, behind the first `count` rows; how many there are."""
    for j in range(RUN):
        rows[count] = offset + j
        count += asks[j]
    return count


@kernel
def _meet(
    function: int, arguments: int, opaque: int, passing: int, boxes: np.ndarray, distant: bool, columns: np.ndarray,
    column: np.ndarray, runs: np.ndarray, found: np.ndarray, rays: np.ndarray, valid: np.ndarray, chosen: np.ndarray,
    share_rays: bool, phase: int, known: np.ndarray, told: np.ndarray, state: np.ndarray,
) -> None:  # fmt: skip
    """Find what is between the places of some runs and their points, `chosen` (n_runs, RUN)."""
    n = len(runs)
    asks, begin = np.empty((n, RUN), np.int32), np.zeros(n + 1, np.int64)
    rows, others = np.empty(n * RUN + 1, np.int32), np.empty(n * RUN + 1, np.int32)
    every_state, alike = state.reshape(-1), np.empty(n, np.int64)
    way = function, arguments, opaque, passing, boxes, distant, columns, column, runs, found, rays, valid
    for k in range(n):
        knows = known[runs[k] * RUN : (runs[k] + 1) * RUN]
        alike[k] = _alike(knows, told)
        _ask(chosen[k], share_rays, phase, knows, told, alike[k], state[k], asks[k])
        begin[k + 1] = _append_rows(asks[k], k * RUN, begin[k], rows)
    trace_rows(*way, rows, begin[n], every_state)
    count = 0
    for k in range(n):
        offset = k * RUN
        some = rows[begin[k] : begin[k + 1]]
        knows = known[runs[k] * RUN : (runs[k] + 1) * RUN]
        doubted = _doubt(some, offset, chosen[k], share_rays, phase, knows, told, alike[k], state[k])
        if doubted != 0:
            for j in range(RUN):
                asks[k, j] = 1 if doubted >> j // _BESIDE & 1 != 0 and chosen[k, j] >= 0 and asks[k, j] == 0 else 0
            count = _append_rows(asks[k], offset, count, others)
    trace_rows(*way, others, count, every_state)


@kernel
def tell_points(
    before: np.ndarray, known: np.ndarray, sent: np.ndarray, some: float, all_but: float, least: int, told: np.ndarray
) -> None:
    """Find points of a light whose rays meet something else than in the look before, and those that are hardly seen.

    Parameters
    ----------
    before, known : (n,) int16
        What each place has found in the look before and in this one, as for `light_places`.
    sent : (n_sent,) int64
        Places that sent a ray, whatever others saw.
    some, all_but, least
        Of the places that see a point now or did before so large a share, and so many of them, met something else; a
        point has appeared if all do but so many. Buried is one that no ray sees now.
    told : (n_points,) int32, set
        Sums of `TURNED`, `APPEARED` and `BURIED`.
    """
    both, others, looks, sees = np.zeros((4, len(told)), np.int32)
    for q in range(len(sent)):
        old, new = np.int32(before[sent[q]]), np.int32(known[sent[q]])
        if new < 0:
            continue
        point = new >> 2
        looks[point] += 1
        sees[point] += 1 if new & 3 != BLOCKED else 0
        if old >= 0 and old >> 2 == point and (old | new) & 3 != BLOCKED:
            both[point] += 1
            others[point] += 1 if old != new else 0
    for point in range(len(told)):
        turned = others[point] >= least and others[point] > some * both[point]
        buried = looks[point] >= least and sees[point] == 0
        appeared = turned and not buried and min(others[point], sees[point]) >= (1.0 - all_but) * both[point]
        told[point] = (TURNED if turned else 0) + (APPEARED if appeared else 0) + (BURIED if buried else 0)


@kernel
def _reflect(
    colors: np.ndarray, at: np.ndarray, has_lobe: bool, diffuse: np.float32, specular: np.float32, found: np.ndarray,
    chosen: np.ndarray, state: np.ndarray, room: int,
) -> None:  # fmt: skip
    """What the places of a run reflect, into the first three rows of `found`.

    `at` as for `look`; `room` is an address with place for 32 floats.
    """
    levels, n_lit = found[3], np.int32(0)
    for j in range(RUN):
        levels[j] = levels[j] if state[j] != BLOCKED else _ZERO
        n_lit += state[j]
    if n_lit == 0:
        found[:3] = _ZERO
        return
    start, of_diffuse, of_specular = address_of(found), spread(diffuse), spread(specular)
    for lane in range(0, RUN, 16):
        skip = lane * 4
        base = edge = of_specular
        if has_lobe:
            shine(at, lane, start, room)
            base, edge = product(load(room), of_specular), product(load(room + 64), of_specular)
        level = load(start + skip + RUN * 12)
        for c in range(3):
            reflects = product(load(at[TINT + c] + skip), of_diffuse)
            if has_lobe:
                reflects = multiply_add(load(at[SPECULAR + c] + skip), base, reflects)
                reflects = multiply_add(load(at[EDGE + c] + skip), edge, reflects)
            store(start + skip + c * RUN * 4, product(reflects, level))
    if len(colors) > 0:
        for j in range(RUN):
            # Without a point, a place has no light, or that of all of a rectangle, which is of one colour.
            for c in range(3):
                found[c, j] *= colors[max(chosen[j], 0), c]


@kernel
def _take_whole(form: np.ndarray, at: np.ndarray, chosen: np.ndarray, state: np.ndarray, found: np.ndarray) -> None:
    """What all of a light brings for what is found of it by points, if none of a run's places is in its shadow."""
    sees = False
    for j in range(RUN):
        if chosen[j] >= 0:
            if state[j] != CLEAR:
                return
            sees = True
    if not sees:
        return
    light = address_of(found) + 3 * RUN * 4
    for lane in range(0, RUN, 16):
        whole = clear_light(form, at, lane)
        store(light + lane * 4, where_above(whole, zeros(), whole, load(light + lane * 4)))
    # All points that a place looked at may be below its horizon, though not all of the light is.
    for j in range(RUN):
        state[j] = CLEAR if chosen[j] < 0 and found[3, j] > _ZERO else state[j]


@kernel
def _get_nothing(run: int, row: np.ndarray, out: np.ndarray, through: np.ndarray, known: np.ndarray) -> None:
    """What `light_places` says of a run that is turned away from the light."""
    begin, end = run * RUN, min((run + 1) * RUN, len(row))
    for i in range(begin, end):
        target = np.uint64(row[i])
        out[target, 0], out[target, 1], out[target, 2] = _ZERO, _ZERO, _ZERO
    if len(through) > 0:
        for i in range(begin, end):
            through[i] = 0
    if len(known) > 0:
        for i in range(begin, end):
            known[i] = -1


@kernel
def _fetch_columns(columns: int, column: np.ndarray, run: int, other: int, first: int, end: int) -> None:
    """Ask for some columns of a run before they are needed, but for those that another run shares."""
    for c in range(first, end):
        if column[run, c] != column[other, c]:
            begin = columns + np.int64(column[run, c]) * (RUN * 4)
            for line in range(RUN // 16):
                fetch(begin + line * 64)


@kernel
def _light_runs(
    function: int, arguments: int, opaque: int, passing: int, boxes: np.ndarray, points: np.ndarray,
    first_point: np.ndarray, colors: np.ndarray, form: np.ndarray, light: np.ndarray, distant: bool, seed: int,
    turn: int, bounds: np.ndarray, columns: np.ndarray, column: np.ndarray, lobes: np.ndarray, diffuse: np.float32,
    specular: np.float32, share_rays: bool, phase: int, known: np.ndarray, told: np.ndarray, row: np.ndarray,
    wanted: np.ndarray, out: np.ndarray, through: np.ndarray, first: int, last: int,
) -> None:  # fmt: skip
    """`light_places` for those runs that are `wanted` from number `first` up to `last`."""
    n, candidates, width = last - first, points.shape[0], points.shape[2]
    n_found, n_room = n * _FOUND * RUN, max(candidates * CANDIDATE, 32)
    storage = np.empty(n_found + PACKET + 16 + n_room + 16, np.float32)
    begin = (-address_of(storage) % 64) // 4
    found = storage[begin : begin + n_found].reshape(n, _FOUND, RUN)
    begin += n_found
    rays = storage[begin : begin + PACKET].reshape(22, 16)
    begin += PACKET
    valid = storage[begin : begin + 16].view(np.int32)
    room = address_of(storage) + (begin + 16) * 4
    chosen, state = np.empty((n, RUN), np.int32), np.empty((n, RUN), np.int32)
    runs, at = np.empty(n, np.int64), np.empty(COLUMNS, np.int64)
    every_column, before = address_of(columns), np.int64(wanted[first])
    numbers = np.empty(RUN, np.float32)
    for j in range(RUN):
        # multiples of the golden ratio are spread evenly, modulo 1, however many of them there are
        numbers[j] = np.float32((j * 0.6180339887498949) % 1.0)
    prepare_packet(rays)
    of_turn, groups = hash_combine(seed, turn), width - RUN
    below_one, one = spread(np.float32(1.0 - 2.0**-24)), spread(_ONE)
    n = 0
    for i in range(first, last):
        run = np.int64(wanted[i])
        # Columns stream by once a frame, and those of the next run are asked for while this one is looked at.
        _fetch_columns(every_column, column, np.int64(wanted[min(i + 1, last - 1)]), run, ORIGIN, TINT)
        if is_turned_away(bounds[run], light, distant):
            _get_nothing(run, row, out, through, known)
            continue
        _fetch_columns(every_column, column, run, before, TINT, COLUMNS)
        find_columns(every_column, column, run, at)
        before = run
        k, runs[n] = n, run
        n += 1
        offset = np.int64(hash_u32(np.uint32(run) ^ np.uint32(seed))) & (groups - 1)
        shift = spread(to_unit(hash_u32(np.uint32(of_turn) ^ np.uint32(run))))
        size = min(RUN, len(row) - run * RUN)
        for lane in range(0, RUN, 16):
            number = plus(load(address_of(numbers) + lane * 4), shift)
            number = where_above(number, below_one, minus(number, one), number)
            look(
                address_of(points) + offset * 4, width, candidates, distant, form, at, lane, number, room,
                address_of(found[k]), address_of(chosen[k]),
            )  # fmt: skip
        for j in range(RUN):
            chosen[k, j] = first_point[offset + j] + chosen[k, j] if chosen[k, j] >= 0 else -1
        chosen[k, size:] = -1
    _meet(
        function, arguments, opaque, passing, boxes, distant, columns, column, runs[:n], found, rays, valid, chosen,
        share_rays, phase, known, told, state,
    )  # fmt: skip
    for k in range(n):
        run = runs[k]
        find_columns(every_column, column, run, at)
        if len(form) > 0 and form[0] == RECTANGLE:
            _take_whole(form, at, chosen[k], state[k], found[k])
        _reflect(colors, at, lobes[run] != 0, diffuse, specular, found[k], chosen[k], state[k], room)
        red, green, blue, of_run = found[k, 0], found[k, 1], found[k, 2], run * RUN
        size = min(RUN, len(row) - of_run)
        for j in range(size):
            target = np.uint64(row[of_run + j])
            out[target, 0], out[target, 1], out[target, 2] = red[j], green[j], blue[j]
        if len(through) > 0:
            for j in range(size):
                sign = 1 if state[k, j] == THROUGH else -1 if state[k, j] == _STILL_THROUGH else 0
                through[of_run + j] = sign * (1 + chosen[k, j])
        if len(known) > 0:
            knows = known[of_run : of_run + size]
            for j in range(size):
                knows[j] = STATES * chosen[k, j] + min(state[k, j], THROUGH) if chosen[k, j] >= 0 else -1
    storage[0] = _ZERO  # Numba may free an array after its last mention, and addresses do not count.
    numbers[0] = _ZERO


@parallel_kernel
def light_places(
    function: int,
    arguments: int,
    opaque: int,
    passing: int,
    boxes: np.ndarray,
    points: np.ndarray,
    first_point: np.ndarray,
    colors: np.ndarray,
    form: np.ndarray,
    light: np.ndarray,
    distant: bool,
    seed: int,
    turn: int,
    bounds: np.ndarray,
    columns: np.ndarray,
    column: np.ndarray,
    lobes: np.ndarray,
    diffuse: np.float32,
    specular: np.float32,
    share_rays: bool,
    phase: int,
    known: np.ndarray,
    told: np.ndarray,
    row: np.ndarray,
    wanted: np.ndarray,
    out: np.ndarray,
    through: np.ndarray,
) -> None:
    """What n places reflect of one light.

    Places come in runs of `RUN`, with a column for each property; the last run is filled up.

    Parameters
    ----------
    function, opaque, passing : addresses of rtcOccluded16 and of the scenes of opaque and of see-through triangles
        (0: there are none)
    arguments : address of RTCOccludedArguments, or 0
    boxes : (n, 6) float32
        Least and largest corners of boxes around all see-through triangles: rays past these are not traced to them.
    points : (candidates, `POINT`, n_groups + `RUN`) float32
        Groups of so many points of the light as each place looks at: place, normal, and radiance times the whole
        light's area. Distant lights: directions, and radiance times solid angle; those without an angle: irradiance
        on a plane that faces them. The first `RUN` groups stand again behind the last; n_groups is a power of two.
        Places of a run look at groups that follow one another.
    first_point : (n_groups + `RUN`,) int32, number of the first point of each group
    colors : (m, 3) float32, colour of each point; none: all are white
    form : (n,) float32
        Of the light, as `clear_light` has it: places count what all of it brings that is above their horizon, of a ball
        where they see the point they chose and it is whole, of a rectangle where all of their run see theirs. None:
        the mean of the points.
    light : (4, 3) float32, least and largest place of the points, and least and largest normal
    turn : int
        Number of the ray of each place.
    bounds : (n_runs, 4, 3) float32, least and largest origin of a run, and least and largest geometric normal
    columns : (n_columns, `RUN`) float32
    column : (n_runs, `COLUMNS`) int32
        Number of each of a run's columns, as `place_columns` names them; runs may share some.
    lobes : (n_runs,) bool, whether a place of the run has a lobe
    diffuse, specular : float32, factors of what places reflect
    share_rays : bool
        Rays of a part of the places stand for a whole run where all agree: for places in the order of tiles.
        Shadows that fall between those rays are missed.
    phase : int
        Which part of the places sends rays where the others may keep what is `known`; -1: nothing is known.
    known : (n,) int16, changed
        What each place has found between it and its point; none: nobody wants to know.
    told : (n_points,) int32
        What other places tell of each point, as `tell_points` has it; none: nothing is known.
    row : (n,) int32
        Row of `out` that each place has, all different.
    wanted : (n_wanted,) int32
        Runs that are meant; what the places of others have stays.
    out : (n, 3) float32, set
    through : (n,) int32, set
        1 + point of the light where only see-through surfaces are in the way, and `out` is what the place would get
        without them; less than 0 where no ray was sent, as that is known; else 0. None: there are no such surfaces.
    """
    n_runs = len(wanted)
    n_tasks = (n_runs + _RUNS - 1) // _RUNS
    half = (n_tasks + 1) // 2
    for i in prange(n_tasks):
        # Threads take turns from first to last: what is lit may be all at one side.
        turn_of = np.int64(i)
        task = 2 * turn_of if turn_of < half else 2 * (turn_of - half) + 1
        _light_runs(
            function, arguments, opaque, passing, boxes, points, first_point, colors, form, light, distant, seed, turn,
            bounds, columns, column, lobes, diffuse, specular, share_rays, phase, known, told, row, wanted, out,
            through, task * _RUNS, min(n_runs, (task + 1) * _RUNS),
        )  # fmt: skip
