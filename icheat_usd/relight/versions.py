"""Versions: edited copies of the casters' radiance that many receivers share, and their products with the transport."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from icheat_usd.kernels.residuals import add_version_residuals, proportions
from icheat_usd.kernels.versions import CONSTANT
from icheat_usd.kernels.workers import take_back
from icheat_usd.relight.atoms import Atoms, AtomSums, find_atoms
from icheat_usd.relight.compiled import CompiledStack, Way
from icheat_usd.relight.growing import Growing
from icheat_usd.relight.pair_products import PairProducts, PairSum
from icheat_usd.relight.products import Products
from icheat_usd.relight.version_lists import (
    PairLists,
    Version,
    VersionKey,
    VersionLists,
    evaluate,
    key_of_atom,
    made_atom,
    made_version,
    moved_version,
)
from icheat_usd.scene import F32, F64, I32, I64, U8
from icheat_usd.transport.packed import LANES

#: Pairs of tile and version that are refined at once.
_PAIRS_AT_ONCE = 256
#: Of a difference, what is taken for rounding: it has no products of its own.
_ROUNDED = 1e-6
#: Casters of a version that are evaluated in one piece.
_PIECE = 2048


class Versions:
    """The versions that groups of receivers ask for, and for each the tiles of rows that some receiver needs.

    Numbers of versions and pairs depend on the order in which they were asked
    for; values do not. Versions of edits that multiply are sums over atoms,
    which are versions themselves: their products follow from those, and
    another amount needs no product at all.
    """

    def __init__(self, compiled: CompiledStack, products: Products, pairs: PairProducts | None, area: F32) -> None:
        self._compiled, self._products, self._pair_products, self._area = compiled, products, pairs, area
        self._number: dict[VersionKey, int] = {}
        self._versions: list[Version | None] = []  # None: given up
        self._lists = VersionLists((), len(compiled.edit_of))
        self._delta, self._offset = Growing(np.zeros((0, 3), np.float32)), Growing(np.zeros((0, 6)))
        self._stale: set[int] = set()
        self._refined: set[int] = set()
        self._exact_of = -1  # version that is being refined
        self._exact: F32 = products.room(0)  # its first exact products
        self._n_exact = 0  # how many of them there are
        self._known: set[int] = set()  # whose residual is known
        self._reference: F32 = np.zeros((0, 3), np.float32)  # what the differences of these were then
        self._known_values: F32 = products.room(0)  # (n_lobes, n_pairs or more, 64, 4) exact products of that
        self._pairs = PairLists(products)
        self._light: F32 | None = None
        self._changed_rows: U8 = np.zeros(1 + compiled.n_rows, np.uint8)
        self._atoms: Atoms = find_atoms(compiled)
        self._sums = AtomSums(area)
        self._unsummed: set[int] = set()  # sums over atoms that have to be made anew
        products.clear()

    @property
    def n(self) -> int:
        """How many numbers there are, also of versions that were given up."""
        return len(self._versions)

    @property
    def offsets(self) -> F64:
        """(n, 6) light without transport: to be reflected, and not."""
        found: F64 = self._offset.values
        return found

    @property
    def pair_of(self) -> I32:
        """(n, n_tiles) row of `values`, -1 where there is none."""
        return self._pairs.of

    @property
    def values(self) -> F32:
        """(n_lobes, at least n_pairs, 64, 4)"""
        return self._pairs.values

    @property
    def _deltas(self) -> F32:
        found: F32 = self._delta.values
        return found

    def number(self, key: VersionKey) -> int:
        """Number of a version, which is made if it is new."""
        if key not in self._number:
            v = self._add(made_version(key, self._compiled, self._products))
            self._divide(v)
        return self._number[key]

    def _add(self, version: Version) -> int:
        self._number[version.key] = v = len(self._versions)
        self._versions.append(version)
        self._lists.append(version)
        self._delta.extend(len(version.cells))
        self._offset.extend(1)
        self._pairs.add_version()
        self._products.reserve(v + 1)
        # A new version knows nothing yet: it has to be evaluated at all of its cells.
        self._changed_rows[0] = 1
        self._stale.add(v)
        return v

    def _divide(self, v: int) -> None:
        """Let a version be a sum over the present atoms if it can be, else one of its own."""
        version = self._versions[v]
        if version is None or version.key.cells:
            return
        atoms = self._atoms.of_version(version)
        if atoms is None:
            if v in self._sums.atoms:
                self._sums.drop(v)
                self._unsummed.discard(v)
                self._stale.add(v)
                self._changed_rows[0] = 1
            return
        n_members = len(self._compiled.edit_of)
        numbers = []
        for atom in atoms:
            cells = self._atoms.cells(int(atom))
            key = key_of_atom(cells)
            if key not in self._number:
                self._add(made_atom(key, cells, n_members, self._products))
            numbers.append(self._number[key])
        self._sums.put(v, np.array(numbers, np.int64), self._atoms.first[atoms])
        for some in (self._stale, self._refined, self._known):
            some.discard(v)
        self._unsummed.add(v)

    def _find_atoms(self) -> None:
        """Divide the versions anew; atoms that none needs are given up."""
        self._atoms = find_atoms(self._compiled)
        for v in range(self.n):
            self._divide(v)
        used = {int(a) for some in self._sums.atoms.values() for a in some}
        for a, version in enumerate(self._versions):
            if version is not None and version.key.cells and a not in used:
                del self._number[version.key]
                self._give_up(a)
        self.need(np.zeros((self.n, self._products.n_tiles), np.uint8))

    def _give_up(self, v: int) -> None:
        self._versions[v] = None
        self._pairs.drop(v)
        self._products.clear(v)
        self._sums.drop(v)
        for some in (self._stale, self._refined, self._known, self._unsummed):
            some.discard(v)

    def restructured(self, compiled: CompiledStack, before: I64, n_before: int) -> None:
        """Go on with a stack of other rows and no aggregates; versions of rows that stay, in their order, stay.

        Parameters
        ----------
        before : (n_rows,) row that each row was, -1 for new ones
        n_before
            Rows that there were.
        """
        now = np.full(n_before, -1, np.int64)
        stays = np.flatnonzero(before >= 0)
        now[before[stays]] = stays
        self._compiled, self._number = compiled, {}
        for v, version in enumerate(self._versions):
            if version is None:
                continue
            moved = moved_version(version, compiled, now)
            if moved is None:
                self._give_up(v)
                continue
            self._versions[v] = moved
            self._number[moved.key] = v
        self._lists.rewrite_sets(self._versions, len(compiled.edit_of))
        self._exact_of = -1
        # What was to be evaluated at some cells alone is evaluated at all of them.
        was_changed = bool(self._changed_rows.any())
        self._changed_rows = np.zeros(1 + compiled.n_rows, np.uint8)
        self._changed_rows[0] = was_changed
        self._find_atoms()

    def keep(self, needed: set[int]) -> None:
        """Forget all but some versions, and number these anew, in their order."""
        needed = needed.union(*(self._sums.atoms[v].tolist() for v in needed & self._sums.atoms.keys()))
        kept = np.array(sorted(needed), np.int64)
        number = {int(v): k for k, v in enumerate(kept)}
        parts = [self._lists.part(int(v)) for v in kept]
        self._pad_reference()
        deltas, references = (
            np.concatenate([np.zeros((0, 3), np.float32), *(values[part] for part in parts)])
            for values in (self._deltas, self._reference)
        )
        versions = [version for v in kept if (version := self._versions[v]) is not None]
        assert len(versions) == len(kept)
        self._lists = VersionLists(versions, len(self._compiled.edit_of))
        self._versions = [*versions]
        self._number = {version.key: v for v, version in enumerate(versions)}
        self._delta, self._offset, self._reference = Growing(deltas), Growing(self.offsets[kept]), references
        pairs = self._pairs.keep(kept)
        if self._known_values.shape[1]:
            self._known_values = np.ascontiguousarray(self._known_values[:, pairs])
        self._stale, self._refined, self._known, self._unsummed = (
            {number[v] for v in some & needed} for some in (self._stale, self._refined, self._known, self._unsummed)
        )
        self._sums.renumber(number)
        self._exact_of = -1
        self._products.keep(kept)
        if self._pair_products is not None:
            self._pair_products.forget()

    def stack_changed(self, compiled: CompiledStack, rows: Iterable[int], painted: Iterable[int]) -> None:
        """Go on with another stack of the same structure, of which some rows act differently, some on other casters."""
        self._compiled = compiled
        # A difference on other casters has little in common with what it was.
        painted = set(painted)
        self._known -= {v for v in self._known if not self._rows_of(v).isdisjoint(painted)}
        changed = set(rows)
        if changed:
            self._changed_rows[1 + np.array(sorted(changed))] = 1
            stale = {v for v in range(self.n) if self._rows_of(v) & changed}
            self._unsummed |= stale & self._sums.atoms.keys()
            stale -= self._sums.atoms.keys()
            self._stale |= stale
            if self._pair_products is not None:
                self._pair_products.stack_changed(stale)
            if painted or not self._atoms.still_hold(compiled, changed):
                self._find_atoms()

    def forget_products(self) -> None:
        """Multiply all of the differences anew."""
        self._stale |= self._known
        self._known = set()

    def light_changed(self, b: F32) -> None:
        """Take other light, (G, n_gather, 3)."""
        self._light = b
        sums = self._sums.atoms.keys()
        self._stale = {v for v, version in enumerate(self._versions) if version is not None and v not in sums}
        self._unsummed = set(sums)
        self._changed_rows[0] = 1

    def need(self, needed: U8) -> None:
        """Have products for pairs of versions and tiles, (n_versions, n_tiles) flags, from the next update on."""
        there = needed != 0
        for v, atoms in self._sums.atoms.items():
            there[atoms] |= there[v] | (self.pair_of[v] >= 0)
        version, tile = np.nonzero(there & (self.pair_of < 0))
        if not len(version):
            return
        fresh = self._pairs.add(version, tile)
        if self._known:
            self._known_values = self._pairs.grown(self._known_values)
        else:
            self._known_values = self._products.room(0)
        some = set(version.tolist())
        # What was prepared of known ones is their rest alone.
        self._unsummed |= some & self._sums.atoms.keys()
        self._stale |= {v for v in some if self._is_by_pairs(v)} | (some & self._known)
        self._refined -= some
        self._exact_of = -1
        self._known -= some
        # Those whose version is evaluated anyway are multiplied then.
        done = ~np.isin(version, list(self._stale | self._unsummed))
        self._multiply(fresh[done])

    @property
    def has_work(self) -> bool:
        """Whether there is something to multiply in `update`."""
        return bool(self._stale)

    def update(self, look: Callable[[], object] | None = None) -> None:
        """Evaluate what has changed since the last time; `look` returns once products of new light may be made."""
        self._evaluate(look)
        self._add_up()

    def _evaluate(self, look: Callable[[], object] | None) -> None:
        if not self._stale:
            return
        assert self._light is not None
        tables = self._lists.tables
        stale = np.array(sorted(self._stale), np.int64)
        pieces = _pieces(stale, tables.cell_begin)
        compiled = self._compiled
        sums = np.zeros((len(pieces), 6))
        evaluate(
            pieces, self._changed_rows, tables, compiled, self._light, self._area, tables.cells, self._deltas, sums
        )
        if compiled.field.has_offset:
            self.offsets[stale] = 0
            np.add.at(self.offsets, pieces[:, 0], sums)
        plain = np.array([v for v in stale if not self._is_by_pairs(v)], np.int64)
        known = np.array([v in self._known for v in plain], np.bool_)
        factors = np.zeros((self.n if known.any() else 0, LANES), np.float32)
        rest, differs, part = self._deltas, ~known, np.ones(self.n)
        if known.any():
            rest, size = np.empty_like(rest), np.zeros((self.n, 4))
            if not known.all():
                rest[:] = self._deltas
            some = pieces[np.isin(pieces[:, 0], plain[known])]
            proportions(some, self._deltas, self._reference, factors, rest, size)
            differs |= size[plain, 0] > _ROUNDED * size[plain, 1]
            np.divide(size[:, 2], size[:, 3], out=part, where=size[:, 3] > 0)
        self._products.prepare(plain[differs], tables, rest)
        if look is not None:
            look()
        take_back()
        self._multiply(self._pairs_of_some(plain[~known]))
        self._multiply_rest(plain[known & differs], plain[known], factors, part)
        for v in stale:
            if self._is_by_pairs(v):
                self._multiply_by_pairs(int(v))
        self._refined -= self._stale
        self._exact_of = -1
        self._stale = set()
        self._changed_rows[:] = 0

    def _add_up(self) -> None:
        """Make the products of versions that are sums over atoms."""
        if self._unsummed:
            self._sums.add_up(sorted(self._unsummed), self._lists.tables, self._compiled, self._pairs, self.values)
        self._unsummed = set()

    def _pairs_of_some(self, versions: I64) -> I64:
        return np.concatenate([np.empty(0, np.int64), *(self._pairs.of_version[v] for v in versions)])

    def _multiply(self, pairs: I64, narrow: bool = False, part: F64 | None = None) -> None:
        self._products.multiply(pairs, self._pairs.tile, self._pairs.version, self.values, narrow, part)

    def _is_by_pairs(self, v: int) -> bool:
        version = self._versions[v]
        return version is not None and version.by_pairs

    def _rows_of(self, v: int) -> frozenset[int]:
        version = self._versions[v]
        return frozenset() if version is None else version.rows

    def _multiply_rest(self, differ: I64, versions: I64, factors: F32, part: F64) -> None:
        """What is not like an earlier difference, and to that the exact products of the earlier one times factors.

        Only those that `differ` by more than rounding have something to be multiplied; `part` as for
        `Products.multiply`.
        """
        if not len(versions):
            return
        pairs = self._pairs_of_some(versions)
        if len(differ) < len(versions):
            self.values[:, pairs] = 0
        self._multiply(self._pairs_of_some(differ), self._products.is_narrow, part)
        known, values = (array.reshape(*array.shape[:2], 4 * LANES) for array in (self._known_values, self.values))
        add_version_residuals(pairs, self._pairs.version, known, factors, values)

    def refine(self, exact: Products) -> bool:
        """Multiply some pairs with exact rows that were multiplied with packed ones; False when none is left."""
        self.update()
        more = self._refine(exact)
        self._add_up()
        return more

    def _refine(self, exact: Products) -> bool:
        tables = self._lists.tables
        narrow = self._products.is_narrow
        n_done = 0
        for v, version in enumerate(self._versions):
            pairs = self._pairs.of_version[v]
            known = v in self._refined and (v in self._known or not narrow)
            if version is None or version.by_pairs or known or not len(pairs) or v in self._sums.atoms:
                continue
            if n_done == _PAIRS_AT_ONCE:
                return True
            if self._exact_of != v:
                self._exact_of, self._exact, self._n_exact = v, exact.room(len(pairs)), 0
            some = self._lists.part(v)
            part = slice(self._n_exact, min(self._n_exact + _PAIRS_AT_ONCE - n_done, len(pairs)))
            n_done += part.stop - part.start
            tile = self._pairs.tile[pairs[part]]
            exact.multiply_cells(tables.cells[some], self._deltas[some], tile, self._exact[:, part])
            self._n_exact = part.stop
            if part.stop < len(pairs):
                return True
            if narrow:
                self._learn(v, self._exact)
            self.values[:, pairs] = self._exact
            self._refined.add(v)
            self._unsummed |= self._sums.with_some(v)
        return False

    @property
    def are_linear(self) -> bool:
        """Whether edited light is a sum over lights, each by itself, and all of it comes by products with versions."""
        compiled = self._compiled
        by_version = (compiled.way == Way.VERSION) & (compiled.row_table[:, 1] == CONSTANT) & ~compiled.gives_offset
        return bool(by_version.all()) and not compiled.slots[:, 3:6].any()

    @property
    def n_multiplied(self) -> int:
        """Products of pairs that do not follow from those of others."""
        return sum(len(pairs) for v, pairs in enumerate(self._pairs.of_version) if v not in self._sums.atoms)

    def room(self) -> F32:
        """Place for products of all pairs."""
        return self._products.room(self.values.shape[1])

    def multiply_alone(self, b: F32, exact: Products, values: F32) -> Iterator[None]:
        """Exact products of all pairs with other light (G, n_gather, 3), where versions are linear, step by step."""
        tables, pairs_of = self._lists.tables, self._pairs.of_version
        made = [v for v in range(self.n) if v not in self._sums.atoms and len(pairs_of[v])]
        pieces = _pieces(np.array(made, np.int64), tables.cell_begin)
        deltas, no_offsets = np.zeros_like(self._deltas), np.zeros((len(pieces), 6))
        every = np.ones(1, np.uint8)
        evaluate(pieces, every, tables, self._compiled, b, self._area, tables.cells, deltas, no_offsets)
        for v in made:
            some = self._lists.part(v)
            for first in range(0, len(pairs_of[v]), _PAIRS_AT_ONCE):
                pairs = pairs_of[v][first : first + _PAIRS_AT_ONCE]
                found = exact.room(len(pairs))
                exact.multiply_cells(tables.cells[some], deltas[some], self._pairs.tile[pairs], found)
                values[:, pairs] = found
                yield
        if self._sums.atoms:
            self._sums.add_up(sorted(self._sums.atoms), tables, self._compiled, self._pairs, values)

    def _learn(self, v: int, exact: F32) -> None:
        """Keep a version's exact products, and what they are the products of."""
        self._known_values = self._pairs.grown(self._known_values)
        self._pad_reference()
        pairs, some = self._pairs.of_version[v], self._lists.part(v)
        self._known_values[:, pairs] = exact
        self._reference[some] = self._deltas[some]
        self._known.add(v)

    def _pad_reference(self) -> None:
        """Versions that were added since are not known."""
        if len(self._reference) != len(self._deltas):
            reference = np.zeros_like(self._deltas)
            reference[: len(self._reference)] = self._reference
            self._reference = reference

    def _multiply_by_pairs(self, v: int) -> None:
        assert self._pair_products is not None and self._light is not None
        version, pairs = self._versions[v], self._pairs.of_version[v]
        assert version is not None
        key = version.key
        unedited = not key.differ and key.restrict < 0
        out = np.zeros((len(self.values), len(pairs), LANES, 4), np.float32)
        self._pair_products.products(
            v,
            PairSum(version.sets, version.sign, key.restrict, unedited, version.cells),
            self._compiled,
            self._pairs.tile[pairs].astype(np.int64),
            self._light,
            out,
        )
        self.values[:, pairs] = out


def _pieces(versions: I64, cell_begin: I64) -> I64:
    """Parts of at most `_PIECE` cells of some versions: (n, 3) version and range."""
    parts = [np.empty((0, 3), np.int64)]
    for version in versions:
        begin = np.arange(cell_begin[version], cell_begin[version + 1], _PIECE)
        end = np.minimum(begin + _PIECE, cell_begin[version + 1])
        parts.append(np.stack([np.full(len(begin), version), begin, end], axis=1))
    return np.concatenate(parts)
