"""What both tracers do to the rays they are given."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.scene import F32


def checked_rays(origins: ArrayLike, directions: ArrayLike, t_max: ArrayLike | None) -> tuple[F32, F32, F32]:
    """Contiguous, writable float32 rays; `t_max` has n entries, or one that holds for all.

    Raises
    ------
    ValueError
        Shapes do not match.
    """
    origin_rows = np.require(origins, np.float32, ["C", "W"])
    direction_rows = np.require(directions, np.float32, ["C", "W"])
    if origin_rows.ndim != 2 or origin_rows.shape[1] != 3 or direction_rows.shape != origin_rows.shape:
        raise ValueError(f"rays need origins and directions (n, 3); got {origin_rows.shape}, {direction_rows.shape}")
    limits = np.require(np.atleast_1d(np.inf if t_max is None else np.asarray(t_max)), np.float32, ["C", "W"])
    if limits.shape not in ((1,), (len(origin_rows),)):
        raise ValueError(f"t_max needs one value or one per ray ({len(origin_rows)}); got {limits.shape}")
    return origin_rows, direction_rows, limits


def unit_directions(directions: F32) -> F32:
    """Directions (n, 3) of length 1; those without length stay zero."""
    x, y, z = directions.T.astype(np.float64)
    length = np.sqrt(x * x + y * y + z * z)  # a quarter of the time of `np.linalg.norm`
    has_length = length > 0
    out: F32 = (directions / np.where(has_length, length, 1)[:, None]).astype(np.float32)
    out[~has_length] = 0
    return out
