"""Products of transport rows with differences of the casters' radiance, tile by tile, exact or packed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.kernels import version_products as kernels
from icheat_usd.kernels.found_terms import TermColumns, find_of_jobs, multiply_found, order_terms
from icheat_usd.kernels.large_terms import multiply_terms
from icheat_usd.kernels.marked_terms import WORD, mark_terms, multiply_marked
from icheat_usd.kernels.paired_tiles import PairedTiles, QuantisedTiles, pair_tiles
from icheat_usd.kernels.residuals import largest_channels, squares_of_tiles
from icheat_usd.kernels.term_energy import least_of_versions
from icheat_usd.kernels.workers import take_back
from icheat_usd.samples import ClusterTree
from icheat_usd.samples.wavelets import haar_of_versions, plan_haar
from icheat_usd.scene import F32, F64, I32, I64, U8, Bool
from icheat_usd.transport import SparseRows, Transport
from icheat_usd.transport.packed import LANES, LargeTerms, PackedRows, PackedTransport

#: Versions with more cells than this are transformed as a whole, by all cores.
_MANY_CELLS = 4096
#: Of a transport of more bytes than this, terms that are small in the light at hand are left out of its products.
SMALL_BYTES = 8_000_000
#: What is left out is expected to be off by as much of the image if its terms have random signs. They do not quite:
#: measured with training lights, it adds up to one to four times as much.
LEFT_OUT = 0.0015
#: The same for each version alone, however many there are: most of them act on pixels of their own.
LEFT_OUT_OF_VERSION = 0.0015
#: No more is left out of a version than this of itself, however dark it is: a stroke changes few pixels.
LEFT_OUT_OF_ITSELF = 0.005
#: More than this is not read for light not seen before, whatever is left out.
MOVING_BYTES = 80_000_000
#: Terms that are looked at to find which are large: in unedited light, and in a version.
_LOOKED_AT = 8_192, 4_096
#: Of light not seen before, the products of so many tiles tell how bright the image will be.
_TILES_LOOKED_AT = 16
#: Entries of uncompressed rows that are multiplied in one step of a refinement: some hundredths of a second.
_ENTRIES_AT_ONCE = 5_000_000
#: Versions that are transformed, or whose terms are marked, at once.
_TOGETHER = 8
#: Products that are made in one go; in between, workers that have become free help.
_JOBS = 512

_NONE: F32 = np.zeros((1, 0), np.float32)


class VersionTables(NamedTuple):
    """All versions, one after the other."""

    cell_begin: I64
    cells: I32
    node_begin: I64
    nodes: I32
    child: I32  #: (n_nodes, 2) see `kernels.version_products.haar_of_cells`
    set_begin: I64
    sets: U8
    sign: F64
    restrict: I64  #: (n_versions, 4) see `kernels.versions.version_deltas`


class _Jobs(NamedTuple):
    """Products of a tile and a version each, and where they go."""

    tile: I32
    version: I32
    place: I32

    def some(self, which: Bool) -> _Jobs:
        return _Jobs(self.tile[which], self.version[which], self.place[which])


class _Tiles:
    """Packed rows of all lobes as kernels read them."""

    def __init__(self, rows: list[PackedRows], narrow_of: _Tiles | None = None) -> None:
        self.n_tiles = rows[0].n_tiles
        self.n_lobes = len(rows)
        self._tiles: PairedTiles = pair_tiles([_quantised(of_lobe) for of_lobe in rows])
        # Also of what is narrower, so that nothing that was there before stays.
        self._is_empty: Bool = np.diff(self._tiles.tile_begin) == 0 if narrow_of is None else narrow_of._is_empty
        self._columns: TermColumns | None = None
        self._every: dict[tuple[int, int], _Jobs] = {}  # of `multiply_one`

    def order(self, n_leaves: int) -> None:
        """Have terms found by their coefficients from now on, in `multiply` with `has_few`."""
        self._columns = order_terms(self._tiles, n_leaves)

    def multiply(
        self,
        versions: F32,
        size: F32,
        least: F32,
        tile: I32,
        version: I32,
        place: I64,
        out: F32,
        has_few: Bool | None = None,
    ) -> None:
        """Products of pairs of tile and version, to ``out[:, place]`` (n_lobes, n, 64, 4); `least` may be empty.

        No pair is there twice. Where a lobe has no coefficients, `out` stays as it is: 0. Which versions have few
        large terms (n_versions,) matters to time alone; it needs `order`. Without it, all terms are looked at.
        """
        self._multiply(versions, size, least, self._jobs(tile, version, place, out.shape[1]), out, has_few)

    def multiply_one(
        self, versions: F32, size: F32, least: F32, out: F32, step: int = 1, has_few: Bool | None = None
    ) -> None:
        """Products of every `step`-th tile and version 0, to `out` from its start on; else as `multiply`."""
        width = out.shape[1]
        if (step, width) not in self._every:
            tile = np.arange(0, self.n_tiles, step, dtype=np.int32)
            self._every[step, width] = self._jobs(tile, 0 * tile, np.arange(len(tile)), width)
        self._multiply(versions, size, least, self._every[step, width], out, has_few)

    def _jobs(self, tile: I32, version: I32, place: I64, width: int) -> _Jobs:
        """Of all lobes; `width` is how many places each of them has."""
        lobe = np.arange(self.n_lobes, dtype=np.int32)[:, None]
        tiles, places = tile + self.n_tiles * lobe, place.astype(np.int32) + width * lobe
        is_there = ~self._is_empty[tiles]
        return _Jobs(tiles[is_there], np.broadcast_to(version, tiles.shape)[is_there], places[is_there])

    def _multiply(self, versions: F32, size: F32, least: F32, jobs: _Jobs, out: F32, has_few: Bool | None) -> None:
        assert out.flags.c_contiguous  # a copy would be written to, and lost
        flat = out.reshape(-1, LANES, 4)
        if has_few is None:
            multiply_terms(*self._tiles, versions, size, least, *jobs, flat)
            return
        few = has_few[jobs.version]
        if few.any():
            self._multiply_found(versions, size, least, jobs.some(few), flat)
            jobs = jobs.some(~few)
        # A few versions at a time, since each has marks of its own.
        many = np.unique(jobs.version)
        for first in range(0, len(many), _TOGETHER):
            take_back()
            marked = many[first : first + _TOGETHER]
            of_these = jobs if len(marked) == len(many) else jobs.some(np.isin(jobs.version, marked))
            self._multiply_marked(versions, size, least, marked, of_these, flat)

    def _multiply_found(self, versions: F32, size: F32, least: F32, jobs: _Jobs, out: F32) -> None:
        assert self._columns is not None
        begin, found = find_of_jobs(self._columns, len(self._is_empty), size, least, jobs.tile, jobs.version)
        _, index, scale, _, value = self._tiles
        multiply_found(index, scale, value, versions, begin, found, jobs.version, jobs.place, out)

    def _multiply_marked(self, versions: F32, size: F32, least: F32, marked: I32, jobs: _Jobs, out: F32) -> None:
        """`marked` are the versions of the jobs, ascending."""
        columns, (begin, index, scale, _, value) = self._columns, self._tiles
        assert columns is not None
        marks = np.zeros((len(marked), (begin[-1] >> 1) + WORD), np.uint8)
        for v, of_version in zip(marked, marks, strict=True):
            mark_terms(columns.begin, columns.most, columns.worth, columns.pair, size[v], least[v], of_version)
        row = np.searchsorted(marked, jobs.version).astype(np.int32)
        for first in range(0, len(row), _JOBS):
            take_back()
            some = slice(first, first + _JOBS)
            columns_of_jobs = jobs.tile[some], jobs.version[some], row[some], jobs.place[some]
            multiply_marked(begin, index, scale, value, versions, marks, *columns_of_jobs, out)


class Products:
    """One transport, and what each version of the light is in the basis of its rows."""

    def __init__(
        self,
        transport: Transport | PackedTransport,
        tree: ClusterTree,
        names: tuple[str, ...] | None = None,
        detail: float = 1.0,
    ) -> None:
        # By which `LEFT_OUT` and its like are divided; and as errors fall with more bytes, so are these more.
        self._detail = detail
        self._most_bytes = int(MOVING_BYTES * detail**2)
        # A lobe that no view sample has holds no rows and costs nothing.
        lobes: list[Any] = [
            lobe for lobe in transport.lobes if (_n_entries(lobe.rows) if names is None else lobe.name in names)
        ]
        self.names = tuple(lobe.name for lobe in lobes)
        self._haar = isinstance(transport, PackedTransport)
        self._packed = replace(transport, lobes=tuple(lobes)) if isinstance(transport, PackedTransport) else None
        self._rows: list[Any] = [lobe.rows for lobe in lobes]
        is_quantised = bool(lobes) and all(
            isinstance(rows, PackedRows) and rows.value.dtype == np.int8 for rows in self._rows
        )
        self._tiles = _Tiles(self._rows) if is_quantised else None
        self._is_narrow = False
        self._narrow: _Tiles | None = None  # of quantised rows alone; others are not large
        self._n_leaves = tree.n_leaves
        self._tree = tree
        n_view = len(transport.lobes[0].tint)
        self.tints: F32 = np.ascontiguousarray(
            np.stack([lobe.tint for lobe in lobes]) if lobes else np.zeros((0, n_view, 3)), np.float32
        )
        spread = transport.interpolation
        self.interpolation: SparseRows = SparseRows.empty(0, 0) if spread is None else spread
        self.is_sparse = int(spread is not None)
        self.n_tiles = -(-(n_view if spread is None else spread.n_columns) // LANES)
        self._versions: F32 = np.zeros((0, self._n_leaves, 4), np.float32)
        self._sizes: F32 = np.zeros((0, self._n_leaves), np.float32)  # largest channels of the versions
        self._is_large: Bool = np.zeros(0, np.bool_)  # versions that have many cells
        if self._haar:
            self._parent_of_leaf, self._parent = _parents(tree)
            self._share, self._root = _shares(tree)
            self._plan = plan_haar(tree)
            is_large = self._packed is not None and self._tiles is not None and self._packed.n_bytes > SMALL_BYTES
            # There can be many versions in a frame, which are looked at more coarsely.
            self._large_terms, self._few_terms = (
                LargeTerms(self._packed, n) if is_large and self._packed is not None else None for n in _LOOKED_AT
            )
            if is_large and self._tiles is not None:
                self._tiles.order(self._n_leaves)
            self._energy = self._packed.term_energies() if is_large and self._packed is not None else None
            self._counts = self._weights_of_rows() if is_large else np.zeros((0, 0, LANES), np.float32)
            self._shown = 0.0  # sum over pixels of the squared unedited light that was multiplied last
            self._leaves: F32 = np.zeros((_TOGETHER, self._n_leaves, 3), np.float32)
            self._unedited: F32 = np.zeros((1, self._n_leaves, 4), np.float32)

    def room(self, n_pairs: int) -> F32:
        """Place for products, (n_lobes, n_pairs, 64, 4)."""
        return np.zeros((len(self._rows), n_pairs, LANES, 4), np.float32)

    @property
    def is_narrow(self) -> bool:
        """Whether it was narrowed."""
        return self._is_narrow

    def narrow(self, lights: F32, n_versions: int, max_bytes: int) -> None:
        """Keep, beside the rows, what of them matters to lights (n_lights, n_leaves, 3) and the first versions."""
        assert self._packed is not None
        self._is_narrow = True
        if self._tiles is None:
            return
        sizes = np.abs(self._versions[:n_versions]).max(axis=(0, 2), initial=0.0)
        for light in lights:
            np.maximum(sizes, np.abs(haar_of_versions(self._plan, light[None])).max(axis=(0, 2)), out=sizes)
        self._narrow = _Tiles([lobe.rows for lobe in self._packed.narrowed(sizes, max_bytes).lobes], self._tiles)

    def widen(self) -> None:
        """Forget the narrowed rows."""
        self._narrow, self._is_narrow = None, False

    def clear(self, version: int | None = None) -> None:
        """Forget one version, or all."""
        some = slice(None) if version is None else version
        self._versions[some] = 0
        self._sizes[some] = 0

    def keep(self, versions: I64) -> None:
        """Forget all but some versions (ascending), and number these anew, in their order."""
        n = len(versions)
        for values in (self._versions, self._sizes, self._is_large):
            for new, old in enumerate(versions):
                values[new] = values[old]
        self._versions[n:] = 0
        self._sizes[n:] = 0

    def reserve(self, n_versions: int) -> None:
        """Have place for so many versions."""
        if n_versions > len(self._versions):
            grown = np.zeros((max(n_versions, len(self._versions) * 3 // 2), self._n_leaves, 4), np.float32)
            grown[: len(self._versions)] = self._versions
            self._versions = grown
            sizes = np.zeros(grown.shape[:2], np.float32)
            sizes[: len(self._sizes)] = self._sizes
            self._sizes = sizes
            self._is_large = np.append(self._is_large, np.zeros(len(grown) - len(self._is_large), np.bool_))

    def nodes(self, cells: I32) -> tuple[I32, I32]:
        """Nodes of the tree above some cells and their children; nothing where no wavelets are needed."""
        if not self._haar or not len(cells):
            return np.empty(0, np.int32), np.empty((0, 2), np.int32)
        tree, count = self._tree, np.zeros(1, np.int64)
        nodes, child = np.empty(0, np.int32), np.empty((0, 2), np.int32)
        for _ in range(2):
            kernels.nodes_above(cells, self._parent_of_leaf, self._parent, tree.left, tree.right, count, nodes, child)
            if not len(nodes):
                nodes, child = np.empty(count[0], np.int32), np.empty((count[0], 2), np.int32)
        return nodes, child

    def prepare(self, versions: I64, tables: VersionTables, deltas: F32) -> None:
        """Bring the differences of some versions into the basis of the rows."""
        if not self._haar:
            kernels.spread_cells(versions, tables.cell_begin, tables.cells, deltas, self._versions)
            return
        large = np.diff(tables.cell_begin)[versions] > _MANY_CELLS
        self._is_large[versions] = large
        if not large.all():
            kernels.haar_of_cells(
                versions[~large],
                tables.cell_begin,
                deltas,
                tables.node_begin,
                tables.nodes,
                tables.child,
                self._share,
                self._root,
                self._versions,
                self._sizes,
            )
        # A few at a time: what lies between the two steps stays in the cache.
        for first in range(0, len(versions[large]), _TOGETHER):
            some = versions[large][first : first + _TOGETHER]
            values = self._leaves[: len(some)]
            kernels.fill_versions(some, tables.cell_begin, tables.cells, deltas, values)
            haar_of_versions(self._plan, values, self._versions, some)
        largest_channels(versions[large], self._versions, self._sizes)
        self._sizes[versions, 0] = np.inf  # means stay, however dark they are

    def multiply(
        self,
        pairs: I64,
        pair_tile: I32,
        pair_version: I32,
        out: F32,
        narrow: bool = False,
        part: F64 | None = None,
    ) -> None:
        """Products of some pairs of tile and version into ``out[:, pairs]``.

        Of a large transport, only the terms are read that are large in a version, seen beside the unedited light; see
        `LEFT_OUT_OF_VERSION`. Each version is seen alone, so that it does not matter which change together.

        Parameters
        ----------
        narrow
            With the narrowed rows.
        part : (n_versions,)
            Of squares of light at the cells, the share that versions have beside what is known of them; by default
            nothing is known.
        """
        if not len(pairs):
            return
        tile, version = pair_tile[pairs], pair_version[pairs]
        tiles = self._narrow if narrow else self._tiles
        if tiles is None:
            for lobe, rows in enumerate(self._rows):
                into = np.empty((len(pairs), LANES, 4), np.float32)
                self._multiply_floats(rows, self._versions, tile, version, into)
                out[lobe, pairs] = into
            return
        least = np.full(len(self._versions), np.finfo(np.float32).tiny, np.float32)
        has_few = None
        if self._large_terms is not None and not narrow:
            self._find_least(np.unique(version), np.ones(len(least)) if part is None else part, least)
            has_few = ~self._is_large
        tiles.multiply(self._versions, self._sizes, least, tile, version, pairs, out, has_few)

    def _find_least(self, versions: I64, part: F64, least: F32) -> None:
        """Least terms of some versions that count; of those with many cells a sample of all terms tells."""
        assert self._few_terms is not None and self._energy is not None
        error = (LEFT_OUT_OF_VERSION / self._detail) ** 2 * self._shown
        # Of a small part, a larger share is as much of the whole version.
        of_itself = (LEFT_OUT_OF_ITSELF / self._detail) ** 2
        share = np.minimum(of_itself / np.maximum(part, np.finfo(np.float64).tiny), 1.0)
        is_large = self._is_large[versions]
        for v in versions[is_large]:
            least_of_v = self._few_terms.least_of_error(self._sizes[v], error, self._most_bytes, float(share[v]))
            least[v] = max(least_of_v, least[v])
        least_of_versions(versions[~is_large].astype(np.int64), self._sizes, *self._energy, error, share, least)

    def multiply_cells(self, cells: I32, values: F32, tile: I32, out: F32) -> None:
        """Products of some tiles of uncompressed rows with values (n, 3) that are 0 but at some cells."""
        assert not self._haar
        leaves = np.zeros((1, self._n_leaves, 4), np.float32)
        leaves[0, cells, :3] = values
        for lobe, rows in enumerate(self._rows):
            self._multiply_floats(rows, leaves, tile, np.zeros_like(tile), out[lobe])

    def multiply_more(self, b: F32, first: int, out: F32) -> int:
        """Products of some tiles of uncompressed rows, from `first` on, with leaf values (n_leaves, 3).

        Parameters
        ----------
        out : (n_lobes, at least n_tiles, 64, 4) float32
            Receives those of these tiles.

        Returns
        -------
        int
            The first tile that is left; `n_tiles` after the last.
        """
        assert not self._haar
        begin = np.arange(self.n_tiles + 1) * LANES
        entries = sum((rows.indptr[np.minimum(begin, rows.n_rows)] for rows in self._rows), 0 * begin)
        end = int(np.searchsorted(entries, entries[first] + _ENTRIES_AT_ONCE, side="right")) - 1
        end = min(max(end, first + 1), self.n_tiles)
        values = np.zeros((1, self._n_leaves, 4), np.float32)
        values[0, :, :3] = b
        tile = np.arange(first, end, dtype=np.int32)
        for lobe, rows in enumerate(self._rows):
            self._multiply_floats(rows, values, tile, np.zeros_like(tile), out[lobe, first:end])
        return end

    def light_of(self, b: F32) -> F32:
        """Leaf values (n_leaves, 3) as `multiply_all` takes them, which stay until the next call: (1, n_leaves, 4)."""
        if self._haar:
            return haar_of_versions(self._plan, b[None], self._unedited)
        values = np.zeros((1, self._n_leaves, 4), np.float32)
        values[0, :, :3] = b
        return values

    def multiply_all(
        self,
        light: F32,
        out: F32,
        known: Callable[[F32, I32], None] | None = None,
        seen: Callable[[], None] | None = None,
    ) -> None:
        """Products of all tiles with what `light_of` makes of some light, into ``out[:, : n_tiles]``.

        Of a large transport, only the terms that are large in this light are read; see `LEFT_OUT`.

        Parameters
        ----------
        known
            Adds to the products of some tiles what is known of others, so that together they are the unedited light.
        seen
            Called, by a large transport alone, once `multiply` may be called for other light than before.
        """
        tile = np.arange(self.n_tiles, dtype=np.int32)
        tiles = self._tiles
        if tiles is None or self._large_terms is None:
            if tiles is None:
                for lobe, rows in enumerate(self._rows):
                    self._multiply_floats(rows, light, tile, 0 * tile, out[lobe, : self.n_tiles])
            else:
                tiles.multiply_one(light, _NONE, _NONE[0], out)
            if known is not None:
                known(out, tile)
            return
        size = np.empty((1, self._n_leaves), np.float32)
        largest_channels(np.zeros(1, np.int64), light, size)
        size[0, 0] = np.inf  # means stay, however dark it is
        # How bright the image is follows from this light, not from the last frame: the same light, the same bits.
        step = max(1, len(tile) // _TILES_LOOKED_AT)
        some = tile[::step]
        looked_at = self.room(len(some))
        tiles.multiply_one(light, _NONE, _NONE[0], looked_at, step)
        if known is not None:
            known(looked_at, some)
        self.see(looked_at, some)
        if seen is not None:
            seen()
        error = (LEFT_OUT / self._detail) ** 2 * self._shown
        least = self._large_terms.least_of_error(size[0], error, self._most_bytes)
        leasts = np.full(1, max(least, np.finfo(np.float32).tiny), np.float32)
        take_back()
        tiles.multiply_one(light, size, leasts, out, has_few=np.zeros(1, np.bool_))
        if known is not None:
            known(out, tile)

    def see(self, products: F32, tile: I32) -> None:
        """Take products of some tiles for those of the unedited light, beside which others are large or small."""
        if self._haar and self._large_terms is not None:
            counts = np.take(self._counts, tile, axis=1)  # as an index would order it, it would depend on the lobes
            found = np.empty(counts.shape[0] * counts.shape[1])
            squares_of_tiles(products.reshape(*products.shape[:2], 4 * LANES), counts, found)
            self._shown = float(found.sum()) * self.n_tiles / max(len(tile), 1)

    def _weights_of_rows(self) -> F32:
        """What the square of each product counts in all pixels, mean of the channels: (n_lobes, n_tiles, 64)."""
        square = np.mean(self.tints.astype(np.float64) ** 2, axis=2) / 3
        out = np.zeros((len(square), self.n_tiles * LANES), np.float32)
        spread = self.interpolation
        for lobe, of_view in enumerate(square):
            if self.is_sparse:
                pixel = np.repeat(np.arange(spread.n_rows), np.diff(spread.indptr))
                of_view = np.bincount(spread.indices, spread.weights * of_view[pixel], spread.n_columns)
            out[lobe, : len(of_view)] = of_view
        return out.reshape(len(square), self.n_tiles, LANES)

    def _multiply_floats(self, rows: Any, versions: F32, tile: I32, version: I32, out: F32) -> None:
        """Products with rows of one lobe that are not quantised."""
        if self._haar:
            kernels.multiply_pairs(rows.tile_begin, rows.index, rows.scale, rows.value, versions, tile, version, out)
        else:
            kernels.multiply_sparse_pairs(rows.indptr, rows.indices, rows.weights, versions, tile, version, out)


def _quantised(rows: PackedRows) -> QuantisedTiles:
    assert rows.value.dtype == np.int8
    return QuantisedTiles(rows.tile_begin, rows.index, rows.scale, rows.worth, rows.value)  # type: ignore[arg-type]


def _n_entries(rows: Any) -> int:
    return rows.n_entries if isinstance(rows, SparseRows) else len(rows.index)


def _parents(tree: ClusterTree) -> tuple[I32, I32]:
    """Node above each leaf and above each node, -1 above the root."""
    of_leaf = np.full(tree.n_leaves, -1, np.int32)
    of_node = np.full(len(tree.left), -1, np.int32)
    number = np.arange(len(tree.left), dtype=np.int32)
    for side in (tree.left, tree.right):
        leaf = side < 0
        of_leaf[-1 - side[leaf]] = number[leaf]
        of_node[side[~leaf]] = number[~leaf]
    return of_leaf, of_node


def _shares(tree: ClusterTree) -> tuple[F64, float]:
    """Weights of the children's means in each node's, and the factor on their difference; see `haar_forward`."""
    left, right = (
        np.where(side < 0, tree.weight[np.maximum(-1 - side, 0)], tree.node_weight[np.maximum(side, 0)])
        if len(tree.left)
        else np.zeros(0)
        for side in (tree.left, tree.right)
    )
    total = left + right
    root = np.sqrt(tree.node_weight[0] if len(tree.left) else tree.weight[0])
    return np.stack([left / total, right / total, np.sqrt(left * right / total)], axis=1), float(root)
