"""Bins of the sky: directions in which gather rays leave the scene, each a column of light from domes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels import sky as kernels
from icheat_usd.scene import F32, I32


@dataclass(frozen=True)
class SkyBins:
    """The octahedral map of all directions (world space, y in the middle), divided into `resolution` squared bins."""

    resolution: int = 64

    def __post_init__(self) -> None:
        if self.resolution < 1:
            raise ValueError(f"the sky needs at least one bin, not {self.resolution} squared")

    @property
    def n(self) -> int:
        return self.resolution**2

    def of_directions(self, directions: F32) -> I32:
        """Bin of each direction (n, 3) of any length: (n,) int32."""
        out = np.empty(len(directions), np.int32)
        kernels.bins_of_directions(np.require(directions, np.float32, ["C", "W"]), self.resolution, out)
        return out
