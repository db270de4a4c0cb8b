"""What 16 places at once get from the whole of a light that nothing hides: closed forms for balls and rectangles.

From a ball of radiance ``L`` and radius ``r``, all of it above the horizon, a place gets ``pi L r^2 cos(theta) / d^2``;
from a polygon ``L / 2`` times the sum over its edges of the angle that each fills times the cosine between the place's
normal and that of the plane through the edge and the place (Lambert 1760; Baum, Rushmeier, Winget 1989, eq. 9). Where
the horizon cuts a rectangle, its outline is closed along it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from icheat_usd.kernels._jit import kernel
from icheat_usd.kernels.lanes import minus, ratio, root, where_above
from icheat_usd.kernels.place_columns import NORMAL, ORIGIN, SHADING
from icheat_usd.kernels.simd import load, multiply_add, plus, product, spread, total, zeros

#: Kinds of a light's form, its first number; then what the closed form is multiplied by; then a ball's centre and
#: radius, or the corners of a rectangle in turn, from the left to what it shines at.
BALL, RECTANGLE = 1, 2
# From this cosine between two opposite corners on, at 32 diagonals, the sum over edges has too few digits.
_TOO_FAR = np.float32(1.0 - 5e-4)
# An edge that fills a larger angle than that of this cosine is too near: the place may lie on it.
_TOO_NEAR = np.float32(-0.999)
# Normals of a larger cosine are one.
_FLAT = np.float32(1.0 - 1e-5)
# An angle over 2 pi times its sine by its cosine, from 1 down to `_WIDE`: a Chebyshev fit, off by at most 3e-5.
_WIDE = np.float32(-0.5)
_ANGLE = (
    0.02654680237174034, -0.08486497402191162, 0.11054859310388565, -0.09323710948228836, 0.0883350521326065,
    -0.10421322286128998, 0.1252824068069458, -0.159234881401062, 0.24999725818634033,
)  # fmt: skip


@kernel
def clear_light(form: np.ndarray, at: np.ndarray, lane: int) -> Any:
    """Light on 16 places of a run, from number `lane`; 0 where it has no closed form.

    A ball has one where all of it is above the horizon, a rectangle is cut there.

    Parameters
    ----------
    form : (n,) float32
        See `BALL`; empty for a light that has none.
    at : (`COLUMNS`,) int64, addresses of the run's columns
    """
    if len(form) == 0:
        return zeros()
    return _of_ball(form, at, lane * 4) if form[0] == BALL else _of_rectangle(form, at, lane * 4)


@kernel
def _to(form: np.ndarray, first: int, at: np.ndarray, skip: int) -> Any:
    """Ways from the places to a point, three numbers of the form."""
    x = minus(spread(form[first]), load(at[ORIGIN] + skip))
    y = minus(spread(form[first + 1]), load(at[ORIGIN + 1] + skip))
    return x, y, minus(spread(form[first + 2]), load(at[ORIGIN + 2] + skip))


@kernel
def _dot(a: Any, b: Any) -> Any:
    return multiply_add(a[0], b[0], multiply_add(a[1], b[1], product(a[2], b[2])))


@kernel
def _along(a: Any, column: int, at: np.ndarray, skip: int) -> Any:
    """Scalar products with a vector of the places."""
    return _dot(a, (load(at[column] + skip), load(at[column + 1] + skip), load(at[column + 2] + skip)))


@kernel
def _of_ball(form: np.ndarray, at: np.ndarray, skip: int) -> Any:
    way, radius = _to(form, 2, at, skip), spread(form[5])
    here, above, square = _along(way, SHADING, at, skip), _along(way, NORMAL, at, skip), _dot(way, way)
    light = ratio(product(spread(form[1]), here), product(square, root(square)))
    return where_above(here, radius, where_above(above, radius, light, zeros()), zeros())


@kernel
def _of_rectangle(form: np.ndarray, at: np.ndarray, skip: int) -> Any:
    a, b = _direction(_to(form, 2, at, skip)), _direction(_to(form, 5, at, skip))
    c, d = _direction(_to(form, 8, at, skip)), _direction(_to(form, 11, at, skip))
    ab, bc, cd, da = _dot(a, b), _dot(b, c), _dot(c, d), _dot(d, a)
    widest, one = _least(ab, bc, cd, da), spread(np.float32(1.0))
    is_wide = total(where_above(spread(_WIDE), widest, one, zeros())) > 0.0
    edges = plus(
        plus(_edge(a, b, ab, is_wide, at, skip), _edge(b, c, bc, is_wide, at, skip)),
        plus(_edge(c, d, cd, is_wide, at, skip), _edge(d, a, da, is_wide, at, skip)),
    )
    ha, hb, hc, hd = _above(a, at, skip), _above(b, at, skip), _above(c, at, skip), _above(d, at, skip)
    lowest, highest = _least(ha, hb, hc, hd), _highest(ha, hb, hc, hd)
    rest, closest = zeros(), widest
    if total(where_above(lowest, zeros(), zeros(), where_above(highest, zeros(), one, zeros()))) > 0.0:
        rest, closest = _of_cut_rectangle(a, b, c, d, at, skip)
    edges, widest = where_above(lowest, zeros(), edges, rest), where_above(lowest, zeros(), widest, closest)
    light = where_above(widest, spread(_TOO_NEAR), product(spread(form[1]), edges), zeros())
    light = where_above(spread(_TOO_FAR), _dot(a, c), light, zeros())
    return where_above(light, zeros(), light, zeros())


@kernel
def _of_cut_rectangle(a: Any, b: Any, c: Any, d: Any, at: np.ndarray, skip: int) -> Any:
    """Sum over the edges of what of a rectangle is above the horizon, and the cosine of the widest of them.

    By the directions of its corners; 0 where the two normals differ, which have horizons of their own.
    """
    ha, hb = _along(a, NORMAL, at, skip), _along(b, NORMAL, at, skip)
    hc, hd = _along(c, NORMAL, at, skip), _along(d, NORMAL, at, skip)
    nothing = zeros(), zeros(), zeros()
    sinks, rises = _crossing(a, ha, b, hb, nothing, nothing)
    sinks, rises = _crossing(b, hb, c, hc, sinks, rises)
    sinks, rises = _crossing(c, hc, d, hd, sinks, rises)
    sinks, rises = _crossing(d, hd, a, ha, sinks, rises)
    one, ab = _cut_edge(a, ha, b, hb, sinks, rises, at, skip)
    two, bc = _cut_edge(b, hb, c, hc, sinks, rises, at, skip)
    three, cd = _cut_edge(c, hc, d, hd, sinks, rises, at, skip)
    four, da = _cut_edge(d, hd, a, ha, sinks, rises, at, skip)
    along = _dot(sinks, rises)
    edges = plus(plus(plus(one, two), plus(three, four)), _edge(sinks, rises, along, True, at, skip))
    normal = load(at[NORMAL] + skip), load(at[NORMAL + 1] + skip), load(at[NORMAL + 2] + skip)
    widest = _least(ab, bc, cd, da)
    widest = where_above(along, widest, widest, along)
    return where_above(_along(normal, SHADING, at, skip), spread(_FLAT), edges, zeros()), widest


@kernel
def _crossing(a: Any, ha: Any, b: Any, hb: Any, sinks: Any, rises: Any) -> Any:
    """Where the outline sinks below the horizon and where it rises, as known by now, after an edge from `a` to `b`."""
    share = ratio(ha, minus(ha, hb))
    x = multiply_add(share, minus(b[0], a[0]), a[0])
    y = multiply_add(share, minus(b[1], a[1]), a[1])
    way = _direction((x, y, multiply_add(share, minus(b[2], a[2]), a[2])))
    return _if_crosses(ha, hb, way, sinks), _if_crosses(hb, ha, way, rises)


@kernel
def _if_crosses(above: Any, below: Any, new: Any, old: Any) -> Any:
    """Where the first height is above 0 and the second is not, the one, else the other."""
    x = where_above(above, zeros(), where_above(below, zeros(), old[0], new[0]), old[0])
    y = where_above(above, zeros(), where_above(below, zeros(), old[1], new[1]), old[1])
    return x, y, where_above(above, zeros(), where_above(below, zeros(), old[2], new[2]), old[2])


@kernel
def _cut_edge(a: Any, ha: Any, b: Any, hb: Any, sinks: Any, rises: Any, at: np.ndarray, skip: int) -> Any:
    """Share of what of an edge is above the horizon, and the cosine of its angle; 0 and 1 where nothing is."""
    begin, end = _if_above(ha, a, rises), _if_above(hb, b, sinks)
    cosine = _dot(begin, end)
    edge = _edge(begin, end, cosine, True, at, skip)
    highest, one = where_above(ha, hb, ha, hb), spread(np.float32(1.0))
    return where_above(highest, zeros(), edge, zeros()), where_above(highest, zeros(), cosine, one)


@kernel
def _if_above(height: Any, a: Any, b: Any) -> Any:
    """Where a height is above 0, a direction, else another."""
    x, y = where_above(height, zeros(), a[0], b[0]), where_above(height, zeros(), a[1], b[1])
    return x, y, where_above(height, zeros(), a[2], b[2])


@kernel
def _direction(way: Any) -> Any:
    inverse = ratio(spread(np.float32(1.0)), root(_dot(way, way)))
    return product(way[0], inverse), product(way[1], inverse), product(way[2], inverse)


@kernel
def _edge(a: Any, b: Any, cosine: Any, is_wide: bool, at: np.ndarray, skip: int) -> Any:
    """Share of one edge in the form factor, by the directions of its ends."""
    angle = _angle(cosine)
    if is_wide:
        sine = root(minus(spread(np.float32(1.0)), product(cosine, cosine)))
        angle = where_above(
            cosine, zeros(), angle, minus(ratio(spread(np.float32(0.5)), sine), _angle(minus(zeros(), cosine)))
        )
    x = minus(product(a[1], b[2]), product(a[2], b[1]))
    y = minus(product(a[2], b[0]), product(a[0], b[2]))
    z = minus(product(a[0], b[1]), product(a[1], b[0]))
    return product(angle, _along((x, y, z), SHADING, at, skip))


@kernel
def _angle(cosine: Any) -> Any:
    angle = spread(np.float32(_ANGLE[0]))
    for k in range(1, len(_ANGLE)):
        angle = multiply_add(angle, cosine, spread(np.float32(_ANGLE[k])))
    return angle


@kernel
def _above(a: Any, at: np.ndarray, skip: int) -> Any:
    """How far a direction is above the horizon."""
    here, above = _along(a, SHADING, at, skip), _along(a, NORMAL, at, skip)
    return where_above(here, above, above, here)


@kernel
def _least(a: Any, b: Any, c: Any, d: Any) -> Any:
    low, other = where_above(a, b, b, a), where_above(c, d, d, c)
    return where_above(low, other, other, low)


@kernel
def _highest(a: Any, b: Any, c: Any, d: Any) -> Any:
    high, other = where_above(a, b, a, b), where_above(c, d, c, d)
    return where_above(high, other, high, other)
