"""What 16 places at once get from the points of a light that they look at, and reflect of one of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.clear_light import BALL, clear_light
from icheat_usd.kernels.lanes import minus, ratio, root, store_whole, where_above
from icheat_usd.kernels.place_columns import ALPHA, COSINE, EYE, LAMBDA, NORMAL, ORIGIN, RUN, SHADING
from icheat_usd.kernels.simd import address_of, load, load_spread, multiply_add, plus, product, spread, store, zeros

POINT = 7  #: columns of the table of points that are looked at for every place
#: Floats that `look` needs for each candidate of 16 places.
CANDIDATE = 64
_ONE, _TINY, _LATER = np.float32(1.0), np.float32(1e-30), np.float32(1.0 + 1e-5)
# Weight of a point on the far side of a ball beside that of one at this side.
_RIM = np.float32(-1e-3)


@kernel
def look(
    points: int, width: int, candidates: int, distant: bool, form: np.ndarray, at: np.ndarray, lane: int, number: Any,
    room: int, found: int, choice_of: int,
) -> None:  # fmt: skip
    """What 16 places of a run, from number `lane`, get from their candidates, and which they would send a ray to.

    Parameters
    ----------
    points, room, found, choice_of : addresses
        Of the columns of the first place's candidates, each `width` floats long; of `CANDIDATE` floats for each
        candidate; of the run's rows of what is found: direction to the chosen point (for distant lights) or way to it,
        and light; and of the number of each place's chosen candidate, int32.
    form : (n,) float32, of the light, as `clear_light` has it
        What the whole of a ball brings is what is found, where that is known, else the mean of the candidates.
    at : (`COLUMNS`,) int64, addresses of the run's columns
    number : 16 random numbers
    """
    step, skip, out = width * 4, lane * 4, found + lane * 4
    x, y, z = load(at[ORIGIN] + skip), load(at[ORIGIN + 1] + skip), load(at[ORIGIN + 2] + skip)
    gx, gy, gz = load(at[NORMAL] + skip), load(at[NORMAL + 1] + skip), load(at[NORMAL + 2] + skip)
    nx, ny, nz = load(at[SHADING] + skip), load(at[SHADING + 1] + skip), load(at[SHADING + 2] + skip)
    none, total = zeros(), zeros()
    is_ball = len(form) > 0 and form[0] == BALL
    clear = clear_light(form, at, lane) if is_ball else zeros()
    inverse = ratio(spread(_ONE), clear) if is_ball else zeros()
    for c in range(candidates):
        point, kept = points + (c * POINT * width + lane) * 4, room + c * CANDIDATE * 4
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
            # Where it is known what all of a ball brings, some point is looked at in any case.
            rim = where_above(clear, none, product(weight, spread(_RIM)), none) if is_ball else none
            weight = where_above(none, away, weight, rim)
        above = multiply_add(dx, gx, multiply_add(dy, gy, product(dz, gz)))
        weight = where_above(here, none, where_above(above, none, weight, none), none)
        if is_ball:
            weight = where_above(clear, none, _sharp(product(weight, inverse)), weight)
        store(kept, dx)
        store(kept + 64, dy)
        store(kept + 128, dz)
        store(kept + 192, weight)
        total = plus(total, weight)
    # the last one whose share of the total begins at or below the random number
    wanted, begin = product(number, total), zeros()
    dx, dy, dz, choice = zeros(), zeros(), zeros(), spread(np.float32(-1.0))
    for c in range(candidates):
        kept = room + c * CANDIDATE * 4
        weight = load(kept + 192)
        dx = _if_reached(weight, begin, wanted, load(kept), dx)
        dy = _if_reached(weight, begin, wanted, load(kept + 64), dy)
        dz = _if_reached(weight, begin, wanted, load(kept + 128), dz)
        choice = _if_reached(weight, begin, wanted, spread(np.float32(c)), choice)
        begin = plus(begin, weight)
    store(out, dx)
    store(out + RUN * 4, dy)
    store(out + RUN * 8, dz)
    total = product(total, spread(_ONE / np.float32(candidates)))
    store(out + RUN * 12, where_above(clear, none, clear, total))
    store_whole(choice_of + lane * 4, choice)


@kernel
def keep_near_boxes(boxes: np.ndarray, rays: np.ndarray, valid: np.ndarray) -> bool:
    """Take those of a packet's rays from the `valid` ones that touch none of some boxes; whether any is left.

    Boxes (n, 6) have their least and largest corners; rays are those of `kernels.embree`, up to their own limit.
    """
    start, none, one = address_of(rays), zeros(), spread(_ONE)
    x, y, z = load(start), load(start + 64), load(start + 128)
    # Where the way is next to none, it still has a side, and there is no 0 / 0.
    ix = ratio(one, _not_none(load(start + 256)))
    iy = ratio(one, _not_none(load(start + 320)))
    iz = ratio(one, _not_none(load(start + 384)))
    limit, later, touched = load(start + 512), spread(_LATER), zeros()
    for b in range(len(boxes)):
        box = address_of(boxes) + 24 * b
        x0, x1 = _crossings(box, x, ix), _crossings(box + 12, x, ix)
        y0, y1 = _crossings(box + 4, y, iy), _crossings(box + 16, y, iy)
        z0, z1 = _crossings(box + 8, z, iz), _crossings(box + 20, z, iz)
        near = _larger(_larger(none, _smaller(x0, x1)), _larger(_smaller(y0, y1), _smaller(z0, z1)))
        far = _smaller(_smaller(limit, _larger(x0, x1)), _smaller(_larger(y0, y1), _larger(z0, z1)))
        # Rounding moves what lies far away.
        touched = where_above(near, product(far, later), touched, one)
    touches, left = np.empty(16, np.int32), 0
    store_whole(address_of(touches), touched)
    for lane in range(16):
        valid[lane] = valid[lane] if touches[lane] != 0 else 0
        left |= valid[lane]
    return left != 0


@kernel
def _not_none(way: Any) -> Any:
    return where_above(product(way, way), spread(_TINY), way, spread(_TINY))


@kernel
def _crossings(side: int, origin: Any, inverse: Any) -> Any:
    """Where rays cross the plane of a box's side, whose place is at an address."""
    return product(minus(load_spread(side), origin), inverse)


@kernel
def _larger(a: Any, b: Any) -> Any:
    return where_above(a, b, a, b)


@kernel
def _smaller(a: Any, b: Any) -> Any:
    return where_above(b, a, a, b)


@kernel
def _sharp(weight: Any) -> Any:
    """Weight of a point of a ball, half of whose points are in view.

    The brighter of two points that are spread evenly over a hemisphere is spread as its light is, ``2 c`` by the cosine
    ``c``: a high power picks it. Picked in proportion to their light, points of the rim come too often.
    """
    square = product(weight, weight)
    fourth = product(square, square)
    return product(fourth, fourth)


@kernel
def _if_reached(weight: Any, begin: Any, wanted: Any, new: Any, old: Any) -> Any:
    """Where a candidate brings something and its share begins at or below what is wanted the new, else the old."""
    return where_above(weight, zeros(), where_above(begin, wanted, old, new), old)


@kernel
def shine(at: np.ndarray, lane: int, found: int, room: int) -> None:
    """Factors of `specular` and `specular_edge` of 16 places of a run: the GGX lobe of `kernels.bsdf.specular_terms`.

    `at`, `lane` and `found` as for `look`; the factors go to the address `room`, 16 floats each.
    """
    skip, way = lane * 4, found + lane * 4
    nx, ny, nz = load(at[SHADING] + skip), load(at[SHADING + 1] + skip), load(at[SHADING + 2] + skip)
    lx, ly, lz = load(way), load(way + RUN * 4), load(way + RUN * 8)
    none, one = zeros(), spread(_ONE)
    inverse = ratio(one, root(multiply_add(lx, lx, multiply_add(ly, ly, product(lz, lz)))))
    lx, ly, lz = product(lx, inverse), product(ly, inverse), product(lz, inverse)
    light = multiply_add(nx, lx, multiply_add(ny, ly, product(nz, lz)))
    hx, hy, hz = plus(lx, load(at[EYE] + skip)), plus(ly, load(at[EYE + 1] + skip)), plus(lz, load(at[EYE + 2] + skip))
    inverse = ratio(one, root(multiply_add(hx, hx, multiply_add(hy, hy, product(hz, hz)))))
    hx, hy, hz = product(hx, inverse), product(hy, inverse), product(hz, inverse)
    cosine = multiply_add(nx, hx, multiply_add(ny, hy, product(nz, hz)))
    # the sine from the cross product, as of a narrow lobe 1 - cos^2 has no digits
    sx, sy = minus(product(ny, hz), product(nz, hy)), minus(product(nz, hx), product(nx, hz))
    sz = minus(product(nx, hy), product(ny, hx))
    alpha = load(at[ALPHA] + skip)
    alpha2 = product(alpha, alpha)
    sine2 = multiply_add(sx, sx, multiply_add(sy, sy, product(sz, sz)))
    width = multiply_add(alpha2, product(cosine, cosine), sine2)
    c2 = product(light, light)
    c2 = where_above(c2, one, one, c2)
    smith = root(multiply_add(alpha2, ratio(minus(one, c2), c2), one))
    smith = product(spread(np.float32(0.5)), minus(smith, one))
    below = product(plus(plus(one, load(at[LAMBDA] + skip)), smith), product(load(at[COSINE] + skip), light))
    below = product(below, product(product(width, width), spread(np.float32(4.0 * math.pi))))
    value = ratio(alpha2, below)
    value = where_above(light, none, where_above(cosine, none, where_above(alpha, none, value, none), none), none)
    met = multiply_add(lx, hx, multiply_add(ly, hy, product(lz, hz)))
    grazing = minus(one, where_above(met, none, where_above(met, one, one, met), none))
    square = product(grazing, grazing)
    edge = product(value, product(product(square, square), grazing))
    store(room, minus(value, edge))
    store(room + 64, edge)
