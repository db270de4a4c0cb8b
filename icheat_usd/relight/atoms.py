"""Casters that the edits of a stack act on alike: of edits that multiply, every version is a sum over few of these."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from icheat_usd.kernels.residuals import in_lanes
from icheat_usd.kernels.version_products import sum_atoms
from icheat_usd.kernels.versions import CONSTANT
from icheat_usd.relight.compiled import CompiledStack, Way
from icheat_usd.relight.products import VersionTables
from icheat_usd.relight.version_lists import PairLists, Version, evaluate
from icheat_usd.scene import F32, I32, I64, Bool

#: A version of more atoms than this is multiplied by itself.
MOST_ATOMS = 24
#: Casters' masks of more weights than this are soft: their casters are not divided by weight.
_MOST_WEIGHTS = 4


@dataclass(frozen=True, eq=False)
class Atoms:
    """Cells by which rows of the stack multiply their light, and by how much."""

    of_cell: I32  #: (n_gather,) atom, numbered by its first cell; -1 where no such row acts
    first: I32  #: (n_atoms,) first cell of each
    multiplies: Bool  #: (n_rows,) rows that multiply the light of casters, with few weights
    emits: Bool  #: (n_rows,) rows that would, but add light

    def cells(self, atom: int) -> I32:
        """Cells of one, ascending."""
        return np.flatnonzero(self.of_cell == atom).astype(np.int32)

    def of_version(self, version: Version) -> I32 | None:
        """What a version is a sum over, ascending; None if it is none, or over too many."""
        rows = list(version.rows)
        if version.by_pairs or version.restrict[0] >= 0 or version.restrict[2] or not self.multiplies[rows].all():
            return None
        found = np.unique(self.of_cell[version.cells])
        found = found[found >= 0].astype(np.int32)
        return found if len(found) <= MOST_ATOMS else None

    def still_hold(self, compiled: CompiledStack, rows: Iterable[int]) -> bool:
        """Whether other numbers of some rows leave the atoms as they are; the casters' weights must be the same."""
        return all(self.emits[row] == _emits(compiled, row) for row in rows)


def find_atoms(compiled: CompiledStack) -> Atoms:
    """The atoms of a stack; there are none where lights are edited one by one."""
    n_rows, n_cells = compiled.n_rows, len(compiled.run_of)
    emits = np.array([_emits(compiled, row) for row in range(n_rows)], np.bool_)
    multiplies = (
        (compiled.way == Way.VERSION) & (compiled.row_table[:, 1] == CONSTANT) & ~compiled.gives_offset & ~emits
    )
    multiplies &= np.diff(compiled.slot_begin) == 1
    if compiled.field.n_groups != 1:
        multiplies[:] = False
    weight = compiled.entry_weight.view(np.uint32)
    # Most masks have one weight.
    last = np.zeros(n_rows, np.uint32)
    last[compiled.entry_row] = weight
    varies = np.bincount(compiled.entry_row, weight != last[compiled.entry_row], n_rows) > 0
    for row in np.flatnonzero(multiplies & varies):
        multiplies[row] = len(np.unique(weight[compiled.entry_row == row])) <= _MOST_WEIGHTS
    acts = multiplies[compiled.entry_row] & (compiled.entry_weight != 0)
    # Sums of hashes of what acts: equal where the same does.
    key = (compiled.entry_row.astype(np.uint64) + np.uint64(1)) << np.uint64(32) | weight
    ends = np.concatenate([np.zeros(1, np.uint64), np.cumsum(np.where(acts, _mixed(key), np.uint64(0)))])
    sums = ends[compiled.cell_begin[1:]] - ends[compiled.cell_begin[:-1]]
    n_acting = np.concatenate([[0], np.cumsum(acts)])
    there = np.flatnonzero(n_acting[compiled.cell_begin[1:]] > n_acting[compiled.cell_begin[:-1]])
    _, first, number = np.unique(sums[there], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    of_cell = np.full(n_cells, -1, np.int32)
    of_cell[there] = rank[number.ravel()]
    return Atoms(of_cell, there[np.sort(first)].astype(np.int32), multiplies, emits)


class AtomSums:
    """What versions are as sums over atoms: which, and the factors of their light."""

    def __init__(self, area: F32) -> None:
        self.atoms: dict[int, I64] = {}  #: by number of a version: the numbers that its atoms have as versions
        self.cells: dict[int, I32] = {}  #: a cell of each of these
        self._area, self._white = area, np.ones((1, len(area), 3), np.float32)

    def put(self, version: int, atoms: I64, cells: I32) -> None:
        """Let a version be a sum."""
        self.atoms[version], self.cells[version] = atoms, cells

    def drop(self, version: int) -> None:
        """Forget a version."""
        self.atoms.pop(version, None)
        self.cells.pop(version, None)

    def renumber(self, number: dict[int, int]) -> None:
        """Keep the versions that have a new number."""
        kept = {
            number[v]: np.array([number[a] for a in some.tolist()], np.int64)
            for v, some in self.atoms.items()
            if v in number
        }
        self.cells = {number[v]: some for v, some in self.cells.items() if v in number}
        self.atoms = kept

    def add_up(
        self, versions: list[int], tables: VersionTables, compiled: CompiledStack, pairs: PairLists, values: F32
    ) -> None:
        """Make the products of some versions from those of their atoms, all among `values` of the pairs."""
        cells = [self.cells[v] for v in versions]
        begin = np.concatenate([[0], np.cumsum([len(some) for some in cells])]).astype(np.int64)
        factors, no_offsets = np.zeros((int(begin[-1]), 3), np.float32), np.zeros((len(versions), 6))
        # What a version makes of white light at one cell of each atom.
        pieces = np.stack([np.array(versions, np.int64), begin[:-1], begin[1:]], axis=1)
        every, joined = np.ones(1, np.uint8), np.concatenate(cells)
        evaluate(pieces, every, tables, compiled, self._white, self._area, joined, factors, no_offsets)
        of_version = [pairs.of_version[v] for v in versions]
        sum_atoms(
            np.concatenate(of_version),
            np.repeat(np.arange(len(versions)), [len(some) for some in of_version]),
            pairs.tile,
            begin,
            np.concatenate([self.atoms[v] for v in versions]),
            in_lanes(factors),
            pairs.of,
            values,
        )

    def with_some(self, atom: int) -> set[int]:
        """Versions that an atom is a part of."""
        return {v for v, some in self.atoms.items() if atom in some}


def _emits(compiled: CompiledStack, row: int) -> bool:
    slots = compiled.slots_of(row)
    # Numbers of other rows mean other things, and of many nothing hangs on it.
    return compiled.row_table[row, 1] == CONSTANT and len(slots) == 1 and bool(slots[:, 3:6].any())


def _mixed(key: np.ndarray) -> np.ndarray:
    """Hashes of 64 bits (splitmix64)."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        key = (key ^ (key >> np.uint64(shift))) * np.uint64(factor)
    found: np.ndarray = key ^ (key >> np.uint64(31))
    return found
