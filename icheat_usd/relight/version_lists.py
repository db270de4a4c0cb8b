"""What versions are made of, one after the other as kernels read them, while versions come and go."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from itertools import combinations
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels.versions import version_deltas
from icheat_usd.relight.compiled import CompiledStack, Way
from icheat_usd.relight.growing import Growing
from icheat_usd.relight.products import Products, VersionTables
from icheat_usd.scene import F32, F64, I32, I64, U8


class VersionKey(NamedTuple):
    """What a version is: the difference that `differ` make together, one by one taken away, where `whole` act too."""

    whole: tuple[int, ...]  #: rows of the stack, ascending
    differ: tuple[int, ...] = ()  #: members of the stack, ascending; empty: the difference to unedited light
    restrict: int = -1  #: count the casters and lights of this aggregate's row alone
    reach: bool = False  #: the casters' weights, not their light
    cells: bytes = b""  #: of an atom, which is the light of some cells: what tells them from others


class Version(NamedTuple):
    """One version."""

    key: VersionKey
    cells: I32
    nodes: I32
    child: I32  #: (n_nodes, 2) see `kernels.versions.haar_of_cells`
    sets: U8  #: (n_sets, n_members)
    sign: F64
    restrict: tuple[int, ...]  #: see `kernels.versions.version_deltas`
    rows: frozenset[int]  #: of the stack, on which it depends
    by_pairs: bool  #: multiplied pair by pair


def made_version(key: VersionKey, compiled: CompiledStack, products: Products) -> Version:
    """The version of a key."""
    support, inner = compiled.support, _inner(key, compiled)
    together = support[inner].all(axis=0) if inner else support[list(key.whole)].any(axis=0)
    cells = np.flatnonzero(together).astype(np.int32)
    rows = frozenset((*key.whole, *inner))
    by_pairs = bool((compiled.way[list(rows)] == Way.PAIRS).any())
    nodes, child = products.nodes(cells[:0] if by_pairs else cells)
    n = len(key.differ)
    subsets = [some for k in range(n + 1) for some in combinations(key.differ, k)]
    sets = np.zeros((len(subsets), len(compiled.edit_of)), np.uint8)
    for row, some in enumerate(subsets):
        sets[row, list(key.whole + some)] = 1
    sign = np.array([(-1.0) ** (n - len(some)) for some in subsets])
    unedited = not key.differ and key.restrict < 0
    restrict = (key.restrict, unedited, key.reach, bool(compiled.gives_offset[list(rows)].any()))
    return Version(key, cells, nodes, child, sets, sign, restrict, rows, by_pairs)


def evaluate(
    pieces: I64,
    changed_rows: U8,
    tables: VersionTables,
    compiled: CompiledStack,
    light: F32,
    area: F32,
    cells: I32,
    deltas: F32,
    offsets: F64,
) -> None:
    """Differences that versions make to the light of some cells; see `kernels.versions.version_deltas`."""
    version_deltas(
        pieces,
        changed_rows,
        tables.set_begin,
        tables.sign,
        tables.sets,
        tables.restrict,
        compiled.run_of,
        compiled.looks_at,
        compiled.cell_begin,
        compiled.entry_row,
        compiled.entry_weight,
        compiled.entry_slot,
        compiled.slots,
        compiled.row_table,
        compiled.row_amount,
        compiled.groups,
        light,
        area,
        cells,
        deltas,
        offsets,
    )


def key_of_atom(cells: I32) -> VersionKey:
    """Key of the light of some cells."""
    return VersionKey((), cells=hashlib.blake2b(cells.tobytes(), digest_size=16).digest())


def made_atom(key: VersionKey, cells: I32, n_members: int, products: Products) -> Version:
    """The light of some cells as a version."""
    sets = np.zeros((1, n_members), np.uint8)
    return Version(key, cells, *products.nodes(cells), sets, np.ones(1), (-1, False, False, False), frozenset(), False)


def moved_version(version: Version, compiled: CompiledStack, now: I64) -> Version | None:
    """A version whose rows have other numbers, `now` by row; None if one is gone, or they are in another order."""
    old = sorted(version.rows)
    rows = now[old]
    if len(rows) and (rows.min() < 0 or bool((rows[1:] <= rows[:-1]).any())):
        return None
    number = dict(zip(old, rows.tolist(), strict=True))
    whole, differ = (tuple(number[row] for row in some) for some in (version.key.whole, version.key.differ))
    sets = np.zeros((len(version.sets), len(compiled.edit_of)), np.uint8)
    sets[:, rows] = version.sets[:, old]
    return version._replace(
        key=VersionKey(whole, differ, cells=version.key.cells), sets=sets, rows=frozenset(number.values())
    )


def _inner(key: VersionKey, compiled: CompiledStack) -> list[int]:
    """Rows that all have to act on a caster for it to count."""
    return [compiled.row_of(member) for member in key.differ] + ([key.restrict] if key.restrict >= 0 else [])


class VersionLists:
    """The lists of all versions; a number keeps its place when its version is given up."""

    def __init__(self, versions: Iterable[Version], n_members: int) -> None:
        self._cells, self._cell_begin = Growing(np.zeros(0, np.int32)), Growing(np.zeros(1, np.int64))
        self._nodes, self._node_begin = Growing(np.zeros(0, np.int32)), Growing(np.zeros(1, np.int64))
        self._child = Growing(np.zeros((0, 2), np.int32))
        self._set_begin, self._sets = Growing(np.zeros(1, np.int64)), Growing(np.zeros((0, n_members), np.uint8))
        self._sign, self._restrict = Growing(np.zeros(0)), Growing(np.zeros((0, 4), np.int64))
        for version in versions:
            self.append(version)

    @property
    def tables(self) -> VersionTables:
        """As kernels read them, until something is appended."""
        return VersionTables(
            self._cell_begin.values,
            self._cells.values,
            self._node_begin.values,
            self._nodes.values,
            self._child.values,
            self._set_begin.values,
            self._sets.values,
            self._sign.values,
            self._restrict.values,
        )

    def append(self, version: Version) -> None:
        """Put a version at the end."""
        self._cells.append(version.cells)
        self._nodes.append(version.nodes)
        self._child.append(version.child)
        self._cell_begin.append(np.array([self._cells.n]))
        self._node_begin.append(np.array([self._nodes.n]))
        self._append_sets(version)

    def rewrite_sets(self, versions: Iterable[Version | None], n_members: int) -> None:
        """Write anew what names rows of the stack; None has none."""
        self._set_begin, self._sets = Growing(np.zeros(1, np.int64)), Growing(np.zeros((0, n_members), np.uint8))
        self._sign, self._restrict = Growing(np.zeros(0)), Growing(np.zeros((0, 4), np.int64))
        for version in versions:
            self._append_sets(version)

    def part(self, number: int) -> slice:
        """Where the cells of a version are."""
        begin = self._cell_begin.values
        return slice(int(begin[number]), int(begin[number + 1]))

    def _append_sets(self, version: Version | None) -> None:
        if version is not None:
            self._sets.append(version.sets)
            self._sign.append(version.sign)
        self._set_begin.append(np.array([self._sign.n]))
        self._restrict.append(np.array([(-1, 0, 0, 0) if version is None else version.restrict], np.int64))


class PairLists:
    """Pairs of versions and tiles, and their products."""

    def __init__(self, products: Products) -> None:
        self._products = products
        self._of = Growing(np.zeros((0, products.n_tiles), np.int32))
        self._tile, self._version = Growing(np.zeros(0, np.int32)), Growing(np.zeros(0, np.int32))
        self.of_version: list[I64] = []
        self.values: F32 = products.room(0)  #: (n_lobes, at least n, 64, 4)

    @property
    def n(self) -> int:
        return self._tile.n

    @property
    def of(self) -> I32:
        """(n_versions, n_tiles) pair of each version and tile, -1 where there is none."""
        found: I32 = self._of.values
        return found

    @property
    def tile(self) -> I32:
        """(n,)"""
        found: I32 = self._tile.values
        return found

    @property
    def version(self) -> I32:
        """(n,)"""
        found: I32 = self._version.values
        return found

    def add_version(self) -> None:
        """One more version, without pairs."""
        self._of.extend(1, -1)
        self.of_version.append(np.empty(0, np.int64))

    def add(self, version: I64, tile: I64) -> I64:
        """Make pairs; their numbers."""
        fresh = self.n + np.arange(len(version), dtype=np.int64)
        self.of[version, tile] = fresh
        self._tile.append(tile.astype(np.int32))
        self._version.append(version.astype(np.int32))
        self.values = self.grown(self.values)
        order = np.argsort(version, kind="stable")
        some, first = np.unique(version[order], return_index=True)
        for v, part in zip(some.tolist(), np.split(fresh[order], first[1:]), strict=True):
            self.of_version[v] = np.append(self.of_version[v], part)
        return fresh

    def grown(self, values: F32) -> F32:
        """The same products with room for all pairs, and for some more."""
        if values.shape[1] >= self.n:
            return values
        room = self._products.room(max(self.n, values.shape[1] * 3 // 2))
        room[:, : values.shape[1]] = values
        return room

    def drop(self, version: int) -> None:
        """Give up the pairs of a version; their room is found again by `keep`."""
        self._of.values[version] = -1
        self.of_version[version] = np.empty(0, np.int64)

    def keep(self, versions: I64) -> I64:
        """Have the pairs of some versions alone, and number both anew, in order; the pairs that stay (n,) ascending."""
        number = np.full(len(self.of_version), -1, np.int64)
        number[versions] = np.arange(len(versions))
        pairs = np.sort(np.concatenate([np.empty(0, np.int64), *(self.of_version[v] for v in versions)]))
        place = np.full(self.n + 1, -1, np.int32)
        place[pairs] = np.arange(len(pairs), dtype=np.int32)
        tile, version = self.tile[pairs], number[self.version[pairs]].astype(np.int32)
        of, values = place[self.of[versions]], np.ascontiguousarray(self.values[:, pairs])
        self.of_version = [place[self.of_version[v]].astype(np.int64) for v in versions]
        self._of, self._tile, self._version = Growing(of), Growing(tile), Growing(version)
        self.values = values
        return pairs
