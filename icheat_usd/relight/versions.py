"""Versions: edited copies of the casters' radiance that many receivers share, and their products with the transport."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import versions as kernels
from icheat_usd.kernels.residuals import add_version_residuals, proportions
from icheat_usd.relight.compiled import CompiledStack, Way
from icheat_usd.relight.pair_products import PairProducts, PairSum
from icheat_usd.relight.products import Products, VersionTables
from icheat_usd.scene import F32, F64, I32, I64, U8
from icheat_usd.transport.packed import LANES

#: Pairs of tile and version that are refined at once.
_PAIRS_AT_ONCE = 256
#: Casters of a version that are evaluated in one piece.
_PIECE = 2048


class VersionKey(NamedTuple):
    """What a version is: the difference that `differ` make together, one by one taken away, where `whole` act too."""

    whole: tuple[int, ...]  #: rows of the stack, ascending
    differ: tuple[int, ...] = ()  #: members of the stack, ascending; empty: the difference to unedited light
    restrict: int = -1  #: count the casters and lights of this aggregate's row alone
    reach: bool = False  #: the casters' weights, not their light


class _Version(NamedTuple):
    key: VersionKey
    cells: I32
    nodes: I32
    child: I32  #: (n_nodes, 2) see `kernels.versions.haar_of_cells`
    sets: U8  #: (n_sets, n_members)
    sign: F64
    rows: frozenset[int]  #: of the stack, on which it depends
    by_pairs: bool  #: multiplied pair by pair


class Versions:
    """The versions that groups of receivers ask for, and for each the tiles of rows that some receiver needs.

    Numbers of versions and pairs depend on the order in which they were asked
    for; values do not.
    """

    def __init__(self, compiled: CompiledStack, products: Products, pairs: PairProducts | None, area: F32) -> None:
        self._compiled, self._products, self._pair_products, self._area = compiled, products, pairs, area
        self._number: dict[VersionKey, int] = {}
        self._versions: list[_Version] = []
        self._tables: VersionTables | None = None
        self._deltas: F32 = np.zeros((0, 3), np.float32)
        self._stale: set[int] = set()
        self._refined: set[int] = set()
        self._exact_of = -1  # version that is being refined
        self._exact: F32 = products.room(0)  # its first exact products
        self._n_exact = 0  # how many of them there are
        self._known: set[int] = set()  # whose residual is known
        self._reference: F32 = np.zeros((0, 3), np.float32)  # what the differences of these were then
        self._lost: F32 = products.room(0)  # (n_lobes, n_pairs, 64, 4) what narrowed rows lost of that
        self._pairs_of: list[I64] = []
        self._light: F32 | None = None
        self.offsets: F64 = np.zeros((0, 6))  #: (n_versions, 6) light without transport: to be reflected, and not
        self.pair_of: I32 = np.full((0, products.n_tiles), -1, np.int32)  #: (n_versions, n_tiles)
        self._pair_tile: I32 = np.zeros(0, np.int32)
        self._pair_version: I32 = np.zeros(0, np.int32)
        self._changed_rows: U8 = np.zeros(1 + compiled.n_rows, np.uint8)
        products.clear()
        self.values: F32 = products.room(0)  #: (n_lobes, n_pairs, 64, 4)

    @property
    def n(self) -> int:
        return len(self._versions)

    def number(self, key: VersionKey) -> int:
        """Number of a version, which is made if it is new."""
        if key not in self._number:
            self._number[key] = len(self._versions)
            self._versions.append(self._made(key))
            self._tables = None
        return self._number[key]

    def stack_changed(self, compiled: CompiledStack, rows: Iterable[int], painted: Iterable[int]) -> None:
        """Go on with another stack of the same structure, of which some rows act differently, some on other casters."""
        self._compiled = compiled
        # What is lost of a difference follows from what was lost before only while it stays similar.
        self._known -= {v for v in self._known if not self._versions[v].rows.isdisjoint(painted)}
        changed = set(rows)
        if changed:
            self._changed_rows[1 + np.array(sorted(changed))] = 1
            stale = {v for v, version in enumerate(self._versions) if version.rows & changed}
            self._stale |= stale
            if self._pair_products is not None:
                self._pair_products.stack_changed(stale)

    def forget_residuals(self) -> None:
        """Multiply with all of the rows until the next refinement."""
        self._known = set()

    def light_changed(self, b: F32) -> None:
        """Take other light, (G, n_gather, 3)."""
        self._light = b
        self._stale = set(range(len(self._versions)))
        self._changed_rows[0] = 1

    def need(self, needed: U8) -> None:
        """Have products for pairs of versions and tiles, (n_versions, n_tiles) flags, from the next update on."""
        self._arrange()
        version, tile = np.nonzero((needed != 0) & (self.pair_of < 0))
        first = len(self._pair_tile)
        if not len(version):
            return
        self.pair_of[version, tile] = first + np.arange(len(version), dtype=np.int32)
        self._pair_tile = np.concatenate([self._pair_tile, tile.astype(np.int32)])
        self._pair_version = np.concatenate([self._pair_version, version.astype(np.int32)])
        grown = self._products.room(len(self._pair_tile))
        grown[:, :first] = self.values
        self.values = grown
        lost = self._products.room(len(self._pair_tile) if self._known else 0)
        lost[:, : self._lost.shape[1]] = self._lost[:, : lost.shape[1]]
        self._lost = lost
        order = np.argsort(self._pair_version, kind="stable")
        ends = np.searchsorted(self._pair_version[order], np.arange(self.n + 1))
        self._pairs_of = [order[ends[v] : ends[v + 1]].astype(np.int64) for v in range(self.n)]
        self._stale |= {v for v in set(version.tolist()) if self._versions[v].by_pairs}
        self._refined -= set(version.tolist())
        self._exact_of = -1
        self._known -= set(version.tolist())
        # Those whose version is evaluated anyway are multiplied then.
        fresh = np.arange(first, len(self._pair_tile))
        done = ~np.isin(self._pair_version[fresh], list(self._stale))
        self._products.multiply(fresh[done], self._pair_tile, self._pair_version, self.values)

    def update(self) -> None:
        """Evaluate what has changed since the last time."""
        if not self._stale:
            return
        assert self._light is not None
        self._arrange()
        tables = self._tables
        assert tables is not None
        stale = np.array(sorted(self._stale), np.int64)
        pieces = _pieces(stale, tables.cell_begin)
        compiled = self._compiled
        sums = np.zeros((len(pieces), 6))
        kernels.version_deltas(
            pieces,
            self._changed_rows,
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
            self._light,
            self._area,
            tables.cells,
            self._deltas,
            sums,
        )
        if compiled.field.has_offset:
            self.offsets[stale] = 0
            np.add.at(self.offsets, pieces[:, 0], sums)
        plain = np.array([v for v in stale if not self._versions[v].by_pairs], np.int64)
        self._products.prepare(plain, tables, self._deltas)
        known = np.array([v in self._known for v in plain], np.bool_)
        pairs = self._pairs_of_some(plain[~known])
        self._products.multiply(pairs, self._pair_tile, self._pair_version, self.values)
        self._multiply_narrow(plain[known])
        for v in stale:
            if self._versions[v].by_pairs:
                self._multiply_by_pairs(int(v))
        self._refined -= self._stale
        self._exact_of = -1
        self._stale = set()
        self._changed_rows[:] = 0

    def _pairs_of_some(self, versions: I64) -> I64:
        return np.concatenate([np.empty(0, np.int64), *(self._pairs_of[v] for v in versions)])

    def _multiply_narrow(self, versions: I64) -> None:
        """With narrowed rows, and with what these lost the last time of a difference of about the same shape."""
        if not len(versions):
            return
        assert self._tables is not None
        pairs = self._pairs_of_some(versions)
        self._products.multiply(pairs, self._pair_tile, self._pair_version, self.values, narrow=True)
        factors = np.zeros((self.n, LANES), np.float32)
        proportions(versions, self._tables.cell_begin, self._deltas, self._reference, factors)
        lost, values = (array.reshape(*array.shape[:2], 4 * LANES) for array in (self._lost, self.values))
        add_version_residuals(pairs, self._pair_version, lost, factors, values)

    def refine(self, exact: Products) -> bool:
        """Multiply some pairs with exact rows that were multiplied with packed ones; False when none is left."""
        self.update()
        self._arrange()
        tables = self._tables
        assert tables is not None
        narrow = self._products.is_narrow
        n_done = 0
        for v, version in enumerate(self._versions):
            pairs = self._pairs_of[v]
            known = v in self._refined and (v in self._known or not narrow)
            if version.by_pairs or known or not len(pairs):
                continue
            if n_done == _PAIRS_AT_ONCE:
                return True
            if self._exact_of != v:
                self._exact_of, self._exact, self._n_exact = v, exact.room(len(pairs)), 0
            some = slice(tables.cell_begin[v], tables.cell_begin[v + 1])
            part = slice(self._n_exact, min(self._n_exact + _PAIRS_AT_ONCE - n_done, len(pairs)))
            n_done += part.stop - part.start
            tile = self._pair_tile[pairs[part]]
            exact.multiply_cells(tables.cells[some], self._deltas[some], tile, self._exact[:, part])
            self._n_exact = part.stop
            if part.stop < len(pairs):
                return True
            if narrow:
                self._learn_residual(v, self._exact)
            self.values[:, pairs] = self._exact
            self._refined.add(v)
        return False

    def _learn_residual(self, v: int, exact: F32) -> None:
        """Keep what narrowed rows lose of a version of which the exact products are known."""
        assert self._tables is not None
        if self._lost.shape[1] != len(self._pair_tile):
            self._lost = self._products.room(len(self._pair_tile))
        if len(self._reference) != len(self._deltas):
            reference = np.zeros_like(self._deltas)
            reference[: len(self._reference)] = self._reference
            self._reference = reference
        pairs, some = self._pairs_of[v], slice(self._tables.cell_begin[v], self._tables.cell_begin[v + 1])
        self._products.multiply(pairs, self._pair_tile, self._pair_version, self.values, narrow=True)
        self._lost[:, pairs] = exact - self.values[:, pairs]
        self._reference[some] = self._deltas[some]
        self._known.add(v)

    def _multiply_by_pairs(self, v: int) -> None:
        assert self._pair_products is not None and self._light is not None
        version, pairs = self._versions[v], self._pairs_of[v]
        key = version.key
        unedited = not key.differ and key.restrict < 0
        out = np.zeros((len(self.values), len(pairs), LANES, 4), np.float32)
        self._pair_products.products(
            v,
            PairSum(version.sets, version.sign, key.restrict, unedited, version.cells),
            self._compiled,
            self._pair_tile[pairs].astype(np.int64),
            self._light,
            out,
        )
        self.values[:, pairs] = out

    def _made(self, key: VersionKey) -> _Version:
        compiled = self._compiled
        support = compiled.support
        inner = [compiled.row_of(member) for member in key.differ] + ([key.restrict] if key.restrict >= 0 else [])
        if inner:
            cells = np.flatnonzero(support[inner].all(axis=0)).astype(np.int32)
        else:
            cells = np.flatnonzero(support[list(key.whole)].any(axis=0)).astype(np.int32)
        n = len(key.differ)
        subsets = [some for k in range(n + 1) for some in combinations(key.differ, k)]
        sets = np.zeros((len(subsets), len(compiled.edit_of)), np.uint8)
        for row, some in enumerate(subsets):
            sets[row, list(key.whole + some)] = 1
        sign = np.array([(-1.0) ** (n - len(some)) for some in subsets])
        # A new version knows nothing yet: it has to be evaluated at all of its cells.
        self._changed_rows[0] = 1
        self._stale.add(len(self._versions))
        rows = frozenset((*key.whole, *inner))
        by_pairs = any(compiled.way[row] == Way.PAIRS for row in rows)
        nodes, child = self._products.nodes(cells if not by_pairs else cells[:0])
        return _Version(key, cells, nodes, child, sets, sign, rows, by_pairs)

    def _restrict(self, version: _Version) -> tuple[int, bool, bool, bool]:
        key = version.key
        unedited = not key.differ and key.restrict < 0
        return key.restrict, unedited, key.reach, bool(self._compiled.gives_offset[list(version.rows)].any())

    def _arrange(self) -> None:
        if self._tables is not None:
            return
        versions = self._versions
        n_known = len(self.offsets)
        known_cells = len(self._deltas)
        self._tables = VersionTables(
            _begins([len(v.cells) for v in versions]),
            np.concatenate([np.empty(0, np.int32), *(v.cells for v in versions)]),
            _begins([len(v.nodes) for v in versions]),
            np.concatenate([np.empty(0, np.int32), *(v.nodes for v in versions)]),
            np.concatenate([np.empty((0, 2), np.int32), *(v.child for v in versions)]),
            _begins([len(v.sign) for v in versions]),
            np.concatenate([np.empty((0, len(self._compiled.edit_of)), np.uint8), *(v.sets for v in versions)]),
            np.concatenate([np.empty(0), *(v.sign for v in versions)]),
            np.array([self._restrict(version) for version in versions], np.int64).reshape(-1, 4),
        )
        deltas = np.zeros((len(self._tables.cells), 3), np.float32)
        deltas[:known_cells] = self._deltas
        self._deltas = deltas
        self.offsets = np.concatenate([self.offsets, np.zeros((len(versions) - n_known, 6))])
        more = np.full((len(versions) - n_known, self._products.n_tiles), -1, np.int32)
        self.pair_of = np.concatenate([self.pair_of, more])
        self._pairs_of += [np.empty(0, np.int64)] * (len(versions) - n_known)
        self._products.reserve(len(versions))


def _begins(counts: Sequence[int]) -> I64:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


def _pieces(versions: I64, cell_begin: I64) -> I64:
    """Parts of at most `_PIECE` cells of some versions: (n, 3) version and range."""
    parts = [np.empty((0, 3), np.int64)]
    for version in versions:
        begin = np.arange(cell_begin[version], cell_begin[version + 1], _PIECE)
        end = np.minimum(begin + _PIECE, cell_begin[version + 1])
        parts.append(np.stack([np.full(len(begin), version), begin, end], axis=1))
    return np.concatenate(parts)
