"""Three-vectors as scalars: Numba keeps tuples in registers, small arrays on the heap."""

from __future__ import annotations

import math

import numpy as np

from icheat_usd.kernels._jit import kernel

Vector = tuple[float, float, float]


@kernel
def dot(a: Vector, b: Vector) -> float:
    """Inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """Right-handed cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def scaled(a: Vector, s: float) -> Vector:
    """``a * s``."""
    return a[0] * s, a[1] * s, a[2] * s


@kernel
def plus_scaled(a: Vector, b: Vector, s: float) -> Vector:
    """``a + b * s``."""
    return a[0] + b[0] * s, a[1] + b[1] * s, a[2] + b[2] * s


@kernel
def normalized(a: Vector) -> Vector:
    """Unit vector along `a`; zero stays zero. The largest component goes first, so tiny vectors do not underflow."""
    largest = max(abs(a[0]), abs(a[1]), abs(a[2]))
    if not (largest > 0.0 and largest < np.inf):
        return a[0] * 0.0, a[1] * 0.0, a[2] * 0.0
    x, y, z = a[0] / largest, a[1] / largest, a[2] / largest
    s = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * s, y * s, z * s


@kernel
def row3(array: np.ndarray, i: int) -> Vector:
    """Row `i` of an (n, 3) array in double precision."""
    return np.float64(array[i, 0]), np.float64(array[i, 1]), np.float64(array[i, 2])


@kernel
def store3(array: np.ndarray, i: int, a: Vector) -> None:
    """Write `a` to row `i` of an (n, 3) array."""
    array[i, 0] = a[0]
    array[i, 1] = a[1]
    array[i, 2] = a[2]


@kernel
def transform_point(m: np.ndarray, i: int, p: Vector) -> Vector:
    """``m[i] @ (p, 1)`` for (n, 3, 4) matrices, in double precision."""
    return (
        np.float64(m[i, 0, 0]) * p[0] + np.float64(m[i, 0, 1]) * p[1] + np.float64(m[i, 0, 2]) * p[2] + m[i, 0, 3],
        np.float64(m[i, 1, 0]) * p[0] + np.float64(m[i, 1, 1]) * p[1] + np.float64(m[i, 1, 2]) * p[2] + m[i, 1, 3],
        np.float64(m[i, 2, 0]) * p[0] + np.float64(m[i, 2, 1]) * p[1] + np.float64(m[i, 2, 2]) * p[2] + m[i, 2, 3],
    )


@kernel
def transform_normal(to_object: np.ndarray, i: int, n: Vector) -> Vector:
    """A plane's normal to world space, ``to_object[i].T @ n``; keeps its side under mirroring. Not normalised."""
    return (
        np.float64(to_object[i, 0, 0]) * n[0] + np.float64(to_object[i, 1, 0]) * n[1] + to_object[i, 2, 0] * n[2],
        np.float64(to_object[i, 0, 1]) * n[0] + np.float64(to_object[i, 1, 1]) * n[1] + to_object[i, 2, 1] * n[2],
        np.float64(to_object[i, 0, 2]) * n[0] + np.float64(to_object[i, 1, 2]) * n[1] + to_object[i, 2, 2] * n[2],
    )


@kernel
def frame(n: Vector) -> tuple[Vector, Vector]:
    """Two unit vectors that make a right-handed basis with unit `n` (Duff et al. 2017, JCGT 6(1))."""
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])
