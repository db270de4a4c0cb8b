"""From USD's row-vector matrices in stage units to columns in metres about the scene's centre."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Gf

from icheat_usd.scene import F64


def from_gf(matrix: Gf.Matrix4d) -> F64:
    """A USD matrix (row vectors, translation in the last row) as ``(3, 4) float64`` [R | t] for column vectors."""
    return np.ascontiguousarray(np.array(matrix, dtype=np.float64).T[:3])


def inverse(transforms: F64) -> F64:
    """Inverses of affine ``(n, 3, 4)`` transforms; the pseudo-inverse where one squashes space flat."""
    linear = transforms[:, :, :3]
    scale = np.maximum(np.abs(linear).max(axis=(1, 2)), np.finfo(np.float64).tiny)
    flat = np.abs(np.linalg.det(linear / scale[:, None, None])) < 1e-14
    inverted = np.empty_like(linear)
    inverted[~flat] = np.linalg.inv(linear[~flat])
    inverted[flat] = np.linalg.pinv(linear[flat])
    translation = -np.einsum("nij,nj->ni", inverted, transforms[:, :, 3])
    return np.concatenate([inverted, translation[:, :, None]], axis=2)


@dataclass(frozen=True)
class Placement:
    """How prims of one stage are placed in the snapshot: metres, about a centre, stage axes kept.

    Everything stays float64 until the centre is subtracted, so that a room
    ten kilometres from the origin keeps its precision.

    Parameters
    ----------
    meters_per_unit
        Metres per scene unit of the stage.
    centre : (3,) float64, metres
        Subtracted from every position.
    """

    meters_per_unit: float
    centre: F64

    def matrix(self, local_to_world: Gf.Matrix4d) -> F64:
        """A local-to-world matrix in stage units as ``(3, 4) float64`` from local units to metres about the centre."""
        return self.place(from_gf(local_to_world))

    def place(self, transforms: F64) -> F64:
        """``(..., 3, 4)`` column transforms in stage units, taken to metres about the centre."""
        placed = transforms * self.meters_per_unit
        placed[..., 3] -= self.centre
        return placed
