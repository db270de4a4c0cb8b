"""Light of hits that are nearer than a gather cell is wide, gathered where they are: a cell is too coarse there.

At contacts, in corners and in narrow gaps light changes within a cell, and most rays of a record end in a few of them.
Where neighbouring cells send about the same light it does not, and the hits of such cells keep their light.
A path goes on from any other, with direct light at each of its vertices, until it ends further away from the vertex
before than a cell is wide (the secondary final gather for nearby surfaces of Jensen 1996, Global Illumination
using Photon Maps, section 4). Paths are shared: a cell is divided into patches about as wide as the rays that end in
them are long, and all rays that end in one get the mean of its first few paths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icheat_usd.final_gather.hits import INVERSE_PI, trace_hemisphere_to_cells
from icheat_usd.kernels.patch_table import PatchTable, add_light, ask, mean_light, move_patches
from icheat_usd.kernels.random import hash_combine
from icheat_usd.lighting import LightSampler, irradiance
from icheat_usd.materials import effective_albedo
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, F64, I32, I64, U64, Bool, SceneSnapshot, SurfacePoints
from icheat_usd.tracing import Tracer

#: A hit is near if its distance is less than this many widths of the cell that it lies in.
WIDTHS = 1.0

#: Cells whose neighbours differ by less than this are taken as lit evenly.
EVEN = 0.15
_NEIGHBOURS = 8

_VERTICES = 2  # of a path between near surfaces, at most
_FIRST_ROOM = 1 << 16  # rows of the table of patches, which doubles when it is half full


@dataclass(eq=False)
class NearLight:
    """Radiance of near hits; what is known of a patch serves all later ones.

    Parameters
    ----------
    cells : (n_cells, 3) float32
        Radiance that gather cells send, of all lights.
    n_paths : int
        Of each patch.
    """

    snapshot: SceneSnapshot
    tracer: Tracer
    sampler: LightSampler
    gather: GatherSamples
    cells: F32
    n_paths: int
    seed: int

    def __post_init__(self) -> None:
        widths = np.float32(WIDTHS) * np.sqrt(self.gather.area.astype(np.float32))
        widths[_unevenness(self.cells) < EVEN] = 0
        self._reach = np.append(widths, np.float32(0))
        self._patches, self._n_patches = _table(_FIRST_ROOM), 0

    def is_near(self, distance: F32, cell: I32) -> Bool:
        """Whether hits in some cells, -1 for none, are near."""
        return np.asarray(distance < np.take(self._reach, cell), np.bool_)

    def wanted(self, key: U64) -> Bool:
        """Which hits in some patches need a path, the first of each patch; `learn` has to follow."""
        is_wanted, first = np.empty(len(key), np.bool_), 0
        while True:
            keys, number, _ = self._patches
            first, self._n_patches = ask(keys, number, self._n_patches, key, first, self.n_paths, is_wanted)
            if first == len(key):
                return is_wanted
            larger = _table(2 * len(keys))
            move_patches(*self._patches, *larger)
            self._patches = larger

    def learn(self, key: U64, points: SurfacePoints, stream: I64) -> None:
        """Paths from the hits that are wanted; `stream` (n,) numbers their random sequences."""
        add_light(*self._patches, key, self._paths(points, stream))

    def radiance(self, key: U64) -> F32:
        """Radiance of hits in patches that are known, (n, 3)."""
        out = np.empty((len(key), 3), np.float32)
        mean_light(*self._patches, key, out)
        return out

    def _paths(self, points: SurfacePoints, stream: I64) -> F32:
        """Radiance that points reflect, (n, 3), by one path from each."""
        out = np.zeros((len(stream), 3), np.float32)
        alive = np.arange(len(stream), dtype=np.int64)
        carried = np.ones((len(stream), 3), np.float32)
        for vertex in range(_VERTICES):
            step = int(hash_combine(self.seed, vertex))
            carried = carried * effective_albedo(points)
            direct = irradiance(self.snapshot, self.tracer, self.sampler, points, step, 1).sum(axis=0)
            out[alive] += carried * direct * INVERSE_PI
            rays = trace_hemisphere_to_cells(
                self.snapshot, self.tracer, self.gather, points, stream[alive], 1, int(hash_combine(step, 2))
            )
            carried = carried * rays.throughput
            cell = rays.cells(self.gather)
            goes_on = self.is_near(rays.distances(), cell) if vertex + 1 < _VERTICES else np.zeros(len(cell), np.bool_)
            done = np.flatnonzero((cell >= 0) & ~goes_on)
            out[alive[done]] += carried[done] * np.take(self.cells, cell[done], axis=0)
            some = np.flatnonzero(goes_on & carried.any(axis=1))
            alive, carried, points = alive[some], carried[some], rays.ends_of(self.snapshot, some)
            if len(alive) == 0:
                break
        return out


def _table(room: int) -> PatchTable:
    return PatchTable(np.empty(room, np.uint64), np.full(room, -1, np.int32), np.zeros((room, 3)))


def _unevenness(cells: F32) -> F64:
    """Relative standard deviation of the light of cells that follow one another in the tree, (n_cells,)."""
    light = cells.mean(axis=1, dtype=np.float64)
    floor = 0.05 * light.mean()
    last = np.clip(np.arange(len(light)) + _NEIGHBOURS // 2, min(_NEIGHBOURS, len(light)), len(light))
    first = np.maximum(last - _NEIGHBOURS, 0)
    one, two = (np.concatenate([[0.0], np.cumsum(light**power)]) for power in (1, 2))
    mean = (one[last] - one[first]) / (last - first)
    square = (two[last] - two[first]) / (last - first)
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0)) / np.maximum(mean, max(floor, 1e-30)))
