"""Where the picture changes from one camera sample to the next."""

from __future__ import annotations

import numpy as np
from numba import prange

from icheat_usd.kernels._jit import kernel, parallel_kernel
from icheat_usd.kernels.vector import dot, plus_scaled

EMPTY, EVEN, MIXED = 0, 1, 2


# Columns of what a camera sample sees: position, geometric and shading normal, what would be seen of it under white
# light from everywhere, emission, and the width of a pixel there. One table: each array that is handed on costs time.
POSITION, NORMAL, SHADING_NORMAL, TINT, EMISSION, REACH = 0, 3, 6, 9, 12, 15
N_COLUMNS = 16


@kernel
def _triple(seen: np.ndarray, i: int, column: int) -> tuple[float, float, float]:
    return np.float64(seen[i, column]), np.float64(seen[i, column + 1]), np.float64(seen[i, column + 2])


@kernel
def _colours_differ(a: tuple, b: tuple, tolerance: float) -> bool:
    largest = max(a[0], a[1], a[2], b[0], b[1], b[2])
    return max(abs(a[0] - b[0]), abs(a[1] - b[1]), abs(a[2] - b[2])) > tolerance * largest


@kernel
def _differ(instance: np.ndarray, seen: np.ndarray, i: int, j: int, limits: tuple) -> bool:
    """Whether two camera samples are of different things; `limits` as of `samples.adaptive.Tolerances`."""
    cosine, widths, colour = limits
    if instance[i] != instance[j]:
        return True
    if dot(_triple(seen, i, SHADING_NORMAL), _triple(seen, j, SHADING_NORMAL)) < cosine:
        return True
    between = plus_scaled(_triple(seen, j, POSITION), _triple(seen, i, POSITION), -1.0)
    off = max(abs(dot(_triple(seen, i, NORMAL), between)), abs(dot(_triple(seen, j, NORMAL), between)))
    if off > widths * min(seen[i, REACH], seen[j, REACH]):
        return True
    return _colours_differ(_triple(seen, i, TINT), _triple(seen, j, TINT), colour) or _colours_differ(
        _triple(seen, i, EMISSION), _triple(seen, j, EMISSION), colour
    )


@parallel_kernel
def kinds_of_pixels(instance: np.ndarray, seen: np.ndarray, begin: np.ndarray, escaped: np.ndarray, limits: tuple,
                    out: np.ndarray) -> None:  # fmt: skip
    """Whether the samples ``begin[p] : begin[p + 1]`` of a pixel are of one thing (EVEN), of several (MIXED), or none.

    `escaped` are the paths of each pixel that saw no surface.
    """
    for p in prange(len(out)):
        kind = EMPTY
        if begin[p + 1] > begin[p]:
            kind = EVEN if escaped[p] == 0 else MIXED
        for i in range(begin[p] + 1, begin[p + 1]):
            if kind == EVEN and _differ(instance, seen, begin[p], i, limits):
                kind = MIXED
        out[p] = kind


@kernel
def _edges_of_row(instance: np.ndarray, seen: np.ndarray, kind: np.ndarray, width: int, y: int, limits: tuple,
                  out: np.ndarray) -> None:  # fmt: skip
    height = len(kind) // width
    for x in range(width):
        p = y * width + x
        edge = kind[p] == MIXED
        for other_y in range(max(y - 1, 0), min(y + 2, height)):
            for other_x in range(max(x - 1, 0), min(x + 2, width)):
                q = other_y * width + other_x
                if edge or q == p:
                    continue
                edge = kind[q] != kind[p] or (kind[p] == EVEN and _differ(instance, seen, p, q, limits))
        out[p] = edge


@parallel_kernel
def edges(instance: np.ndarray, seen: np.ndarray, kind: np.ndarray, width: int, limits: tuple,
          out: np.ndarray) -> None:  # fmt: skip
    """Which pixels of an image hold several things, or differ from one of their eight neighbours.

    `instance` and `seen` are of one sample of each pixel.
    """
    for y in prange(len(out) // width):
        _edges_of_row(instance, seen, kind, width, np.int64(y), limits, out)
