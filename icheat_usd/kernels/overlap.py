"""Triangles made larger by some steps of rounding, so that no ray passes between neighbours."""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.vector import Vector, cross, dot, plus_scaled, row3, scaled, store3

_CHUNK = 1024
#: By how much edges move outwards, in units of the largest coordinates of a triangle and of where rays start: of rays
#: aimed at the edges of closed meshes some pass between triangles with 2^-24, none of 12 million with 2^-23. Twice that
#: is a sixteenth of the way from a surface to the origin of a ray that leaves it.
_OUTWARDS = 2.0**-22
#: Corners move at most so many times as far as edges do: those of slivers would go anywhere.
_FARTHEST = 16.0


@kernel
def _length(a: Vector) -> float:
    return math.sqrt(dot(a, a))


@kernel
def _distance(a: Vector, b: Vector) -> float:
    return _length(plus_scaled(a, b, -1.0))


@parallel_kernel
def overlap_triangles(corners: np.ndarray, reach: float, farthest: float, out: np.ndarray) -> None:
    """Triangles ``corners (n, 3, 3)`` whose edges lie further outwards in their planes, to `out` of the same shape.

    Parameters
    ----------
    reach : float
        Largest coordinate that most rays start from. What a triangle needs depends on that and on its own.
    farthest : float
        Rays from more than so many times a triangle's own coordinates away do not count, as what is small beside
        them would grow more than by rounding.

    Notes
    -----
    Where two triangles share an edge, rounding may tell each that a ray is on the other's side. Embree's robust mode
    rules that out with tests that cost a third of its speed; triangles that overlap by more than is rounded need no
    such tests. What has no area stays as it is.
    """
    n = corners.shape[0]
    for chunk in prange((n + _CHUNK - 1) // _CHUNK):
        for i in range(chunk * _CHUNK, min(n, (chunk + 1) * _CHUNK)):
            a, b, c = row3(corners[i], 0), row3(corners[i], 1), row3(corners[i], 2)
            bc, ca, ab = _distance(b, c), _distance(c, a), _distance(a, b)
            around = bc + ca + ab
            centre, radius, outwards = a, 0.0, 0.0  # the circle that touches the edges
            if around > 0.0:
                centre = scaled(plus_scaled(plus_scaled(scaled(a, bc), b, ca), c, ab), 1.0 / around)
                own = 0.0
                for corner in (a, b, c):
                    own = max(own, abs(corner[0]), abs(corner[1]), abs(corner[2]))
                outwards = _OUTWARDS * (own + min(reach, farthest * own))
                radius = _length(cross(plus_scaled(b, a, -1.0), plus_scaled(c, a, -1.0))) / around
            for j in range(3):
                corner = row3(corners[i], j)
                if radius > 0.0:
                    way = plus_scaled(corner, centre, -1.0)
                    corner = plus_scaled(corner, way, outwards * min(1.0 / radius, _FARTHEST / _length(way)))
                store3(out[i], j, corner)
