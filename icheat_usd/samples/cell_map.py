"""A table over the triangles that finds the gather cell of a hit without a walk down the cluster tree."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels import cell_map as kernels
from icheat_usd.samples.locate import DETOUR, Locator
from icheat_usd.scene import I64, Geometry

#: Size of a square in mean spacings of the samples: smaller ones have fewer candidates, but are more.
FINENESS = 0.25
#: Placed triangles with entries; placements with the most triangles per sample go without beyond it.
MOST_PLACED = 3_000_000
_BLOCKS_AT_ONCE = 8192  # 6 MB of candidates
# Look-ups that cost as much more without a map as making one: measured in a room of 143,000 triangles, 8,192 and
# 65,536 samples.
_WORTH_PER_TRIANGLE, _WORTH_PER_SAMPLE = 4, 16


@dataclass(frozen=True, eq=False)
class CellMap:
    """Gather cells of hits, exactly as `Locator.locate` finds them."""

    table: kernels.CellTable

    @property
    def n_bytes(self) -> int:
        return sum(column.nbytes for column in self.table)


class HitCells:
    """The cell map of a gather set, made once look-ups are so many that it saves time; they find the same without."""

    def __init__(self, locator: Locator) -> None:
        self._locator = locator
        self._asked = 0
        self._map: CellMap | None = None
        self._lock = threading.Lock()

    def table(self, geometry: Geometry, n_hits: int) -> kernels.CellTable:
        """What to look up `n_hits` hits by; without entries while there is no map."""
        with self._lock:
            self._asked += n_hits
            if self._map is None:
                triangles = min(int(np.diff(geometry.mesh_begin)[geometry.instance_mesh].sum()), MOST_PLACED)
                samples = len(self._locator.table.sample)
                if self._asked < _WORTH_PER_TRIANGLE * triangles + _WORTH_PER_SAMPLE * samples:
                    place = np.full(len(geometry.instance_mesh), kernels.NO_FACES)
                    nothing = np.zeros(0, np.int32)
                    return kernels.CellTable(place, np.zeros((0, 4), np.int32), nothing, nothing)
                self._map = build_cell_map(geometry, self._locator)
            return self._map.table


def build_cell_map(geometry: Geometry, locator: Locator, *, fineness: float = FINENESS) -> CellMap:
    """Divide the triangles of all placements and find the samples that are nearest in each square.

    Parameters
    ----------
    fineness
        Size of a square in mean spacings of the samples of its side.

    Notes
    -----
    About 32 bytes per placed triangle and 450 per sample.
    """
    table = locator.table
    size = np.diff(geometry.mesh_begin)[geometry.instance_mesh].astype(np.int64)
    with_faces = _placed(size, table.slot, table.slot_begin)
    size[~with_faces] = 0
    begin = np.concatenate([[0], np.cumsum(size)])
    place = begin[:-1] - geometry.mesh_begin[geometry.instance_mesh]
    place[~with_faces] = kernels.NO_FACES
    placed_instance = np.repeat(np.arange(len(size), dtype=np.int32), size)
    n_sides = 2 * len(placed_instance)

    divided = np.empty((n_sides, 3), np.int32)
    spacing = np.sqrt(table.slot_detour.astype(np.float64)) / DETOUR
    kernels.divide_faces(
        geometry.points, geometry.instance_to_world, table, spacing, fineness, placed_instance, place, divided
    )
    along = divided[:, :2]
    blocks = np.maximum(1, (-(-along // kernels.BLOCK)).prod(axis=1, dtype=np.int64))
    squares = np.where(along.prod(axis=1, dtype=np.int64) > 1, kernels.BLOCK**2 * blocks, 0)
    square_begin = np.concatenate([[0], np.cumsum(squares)])
    face = np.zeros((n_sides, 4), np.int32)
    face[:, 0] = square_begin[:-1]
    face[squares > 0, 1:] = divided[squares > 0]
    square = np.full(square_begin[-1], kernels.WALK, np.int32)

    block_end = np.cumsum(blocks)
    lists = [np.zeros(0, np.int32)]
    stored = 0
    for first in range(0, int(block_end[-1]) if n_sides else 0, _BLOCKS_AT_ONCE):
        block = np.arange(first, min(first + _BLOCKS_AT_ONCE, int(block_end[-1])))
        side = np.searchsorted(block_end, block, side="right")
        number = (block - block_end[side] + blocks[side]).astype(np.int32)
        count = np.empty((len(block), kernels.BLOCK**2), np.int32)
        found = np.empty((len(block), kernels.BLOCK**2, kernels.MOST), np.int32)
        kernels.find_candidates(
            geometry.points,
            geometry.instance_to_world,
            geometry.instance_to_object,
            table,
            locator.depth,
            placed_instance,
            place,
            divided,
            side,
            number,
            count,
            found,
        )
        length = np.where(count > 1, count + 1, 0).astype(np.int64)
        list_end = np.cumsum(length.ravel()).reshape(length.shape)
        part = np.empty(int(list_end[-1, -1]), np.int32)
        list_begin = list_end - length
        kernels.store_entries(divided, square_begin, side, number, count, found, list_begin, stored, face, square, part)
        stored += len(part)
        lists.append(part)
    return CellMap(kernels.CellTable(place, face, square, np.concatenate(lists)))


def _placed(size: I64, slot: np.ndarray, slot_begin: np.ndarray) -> np.ndarray:
    """Which placements have entries: those with the fewest triangles per sample, up to `MOST_PLACED` triangles."""
    samples = np.diff(slot_begin)[slot].reshape(-1, 2).max(axis=1)
    order = np.lexsort((np.arange(len(size)), size / samples))
    chosen = np.zeros(len(size), bool)
    chosen[order] = np.cumsum(size[order]) <= MOST_PLACED
    return chosen
