"""Bins of the sky: directions in which gather rays leave the scene, each a column of light from domes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from icheat_usd.kernels import sky as kernels
from icheat_usd.scene import F32, F64, I32, I64

_PATCHES_PER_BIN = 64  # each counts for the bin that its middle falls in, so the border of a bin is only as sharp
_PARTS = 4  # that threads work on; a fixed number, so that sums do not depend on the threads


@dataclass(frozen=True, eq=False)
class DomePatches:
    """A lat-long image as patches of constant radiance, each smaller than a bin."""

    direction: F64  #: (n, 3) unit, in the dome's own frame
    solid_angle: F64  #: (n,)
    radiance: F64  #: (n, 3)


@dataclass(frozen=True)
class SkyBins:
    """The octahedral map of all directions (world space, +y in the middle), divided into `resolution` squared bins.

    Rows of `RowBuilder.measure` times `average` of a dome are the mean radiance
    that a surface's cosine-distributed rays meet outside the scene: irradiance
    over pi.
    """

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

    @property
    def direction(self) -> F32:
        """Unit directions of the bins' middles: (n, 3)."""
        return self._described[0]

    @property
    def solid_angle(self) -> F32:
        """Of each bin, steradians: (n,); their sum is 4 pi."""
        return self._described[1]

    @cached_property
    def _described(self) -> tuple[F32, F32]:
        direction, solid_angle = np.empty((self.n, 3), np.float32), np.empty(self.n, np.float64)
        kernels.describe_bins(self.resolution, 16, direction, solid_angle)
        return direction, (solid_angle * (4 * np.pi / solid_angle.sum())).astype(np.float32)

    def patches(self, texels: F32) -> DomePatches:
        """Divide a lat-long image so that `average` is quick and misses nothing.

        Parameters
        ----------
        texels : (height, width, 3 or more) float32
            Row 0 at the top; oriented as in `icheat_usd.lighting.environment_radiance`. One texel is a plain dome.
        """
        rows = max(128, int(np.sqrt(_PATCHES_PER_BIN * self.n / 2)))
        image = np.nan_to_num(texels[..., :3].astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
        image = _enlarged(_enlarged(image, rows, 0), 2 * rows, 1)
        height, width = image.shape[:2]
        top = np.cos(np.pi * np.arange(height + 1) / height)
        band = top[:-1] - top[1:]
        row_begin, column_begin = np.arange(rows) * height // rows, np.arange(2 * rows) * width // (2 * rows)
        weighted = np.add.reduceat(image * band[:, None, None], row_begin, axis=0)
        bands = np.add.reduceat(band, row_begin)
        radiance = np.add.reduceat(weighted, column_begin, axis=1)
        columns = np.diff(np.append(column_begin, width))
        radiance /= bands[:, None, None] * columns[None, :, None]
        y = 1.0 - (np.cumsum(bands) - bands / 2)
        longitude = np.pi - 2 * np.pi * (column_begin + columns / 2) / width
        r = np.sqrt(np.maximum(0.0, 1.0 - y * y))
        direction = np.stack(
            [
                r[:, None] * np.sin(longitude),
                np.broadcast_to(y[:, None], (rows, 2 * rows)),
                r[:, None] * np.cos(longitude),
            ],
            axis=-1,
        )
        solid_angle = bands[:, None] * columns * (2 * np.pi / width)
        return DomePatches(direction.reshape(-1, 3), solid_angle.ravel(), radiance.reshape(-1, 3))

    def average(self, dome: DomePatches, to_world: F32 | F64) -> F32:
        """Mean radiance of a dome over each bin: (n, 3), black where its transform has no inverse.

        Parameters
        ----------
        to_world : (3, 3) or (3, 4)
            Transform of the dome; translation is ignored.
        """
        linear = np.ascontiguousarray(np.asarray(to_world, np.float64)[:3, :3])
        stretch = abs(float(np.linalg.det(linear)))
        energy, covered = np.zeros((self.n, 3), np.float64), np.zeros(self.n, np.float64)
        if stretch > 0.0:
            parts = np.zeros((_PARTS, self.n, 4), np.float64)
            kernels.add_patches(
                dome.direction, dome.solid_angle, dome.radiance, linear, stretch, self.resolution, parts
            )
            light = parts.sum(axis=0)
            energy, covered = light[:, :3], light[:, 3]
            missed = np.flatnonzero(covered == 0.0)  # by the middles of all patches: the dome is stretched
            local = self.direction[missed].astype(np.float64) @ np.linalg.inv(linear).T
            energy[missed], covered[missed] = dome.radiance[_nearest_patch(dome, local)], 1.0
        return (energy / np.maximum(covered, 1e-30)[:, None]).astype(np.float32)


def _nearest_patch(dome: DomePatches, directions: F64) -> I64:
    """Patch around each direction of any length; patches lie in rows of about equal width."""
    rows = int(np.sqrt(len(dome.direction) // 2))
    y = directions[:, 1] / np.linalg.norm(directions, axis=1)
    heights = dome.direction[:: 2 * rows, 1]
    row = np.searchsorted(-0.5 * (heights[1:] + heights[:-1]), -y)
    turn = 0.5 - np.arctan2(directions[:, 0], directions[:, 2]) / (2 * np.pi)
    column = np.minimum((turn * 2 * rows).astype(np.int64), 2 * rows - 1)
    return row * 2 * rows + column


def _enlarged(image: F64, least: int, axis: int) -> F64:
    """Bilinear image at `least` places or more along an axis; rows are clamped, columns repeat."""
    size = image.shape[axis]
    factor = -(-least // size)
    if factor == 1:
        return image
    place = (np.arange(size * factor) + 0.5) / factor - 0.5
    before = np.floor(place).astype(np.int64)
    fraction = (place - before).reshape([-1 if a == axis else 1 for a in range(3)])
    low, high = (np.clip(k, 0, size - 1) if axis == 0 else k % size for k in (before, before + 1))
    return np.take(image, low, axis) * (1.0 - fraction) + np.take(image, high, axis) * fraction
