"""Products of transport rows with differences of the casters' radiance, tile by tile, exact or packed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from icheat_usd.kernels import versions as kernels
from icheat_usd.kernels.large_terms import multiply_large_terms
from icheat_usd.kernels.packed import PairedTiles, multiply_paired_tiles, pair_coefficients
from icheat_usd.kernels.residuals import largest_channels
from icheat_usd.samples import ClusterTree
from icheat_usd.samples.wavelets import haar_of_versions, plan_haar
from icheat_usd.scene import F32, F64, I32, I64, U8, Bool
from icheat_usd.transport import SparseRows, Transport
from icheat_usd.transport.packed import LANES, LargeTerms, PackedRows, PackedTransport

#: Versions with more cells than this are transformed as a whole, by all cores.
_MANY_CELLS = 4096
#: Quanta that are read of a large transport for light not seen before: a quarter of them loses little beside packing.
MOVING_BYTES = 80_000_000
#: Entries of uncompressed rows that are multiplied in one step of a refinement: some hundredths of a second.
_ENTRIES_AT_ONCE = 5_000_000
#: Versions that are transformed at once.
_TOGETHER = 8

_NONE: F32 = np.zeros((1, 0), np.float32)


class VersionTables(NamedTuple):
    """All versions, one after the other."""

    cell_begin: I64
    cells: I32
    node_begin: I64
    nodes: I32
    child: I32  #: (n_nodes, 2) see `kernels.versions.haar_of_cells`
    set_begin: I64
    sets: U8
    sign: F64
    restrict: I64  #: (n_versions, 4) see `kernels.versions.version_deltas`


class _Rows:
    """Rows of one lobe, and as kernels read them if they are quantised."""

    def __init__(self, rows: Any) -> None:
        self.rows = rows
        self.paired: PairedTiles | None = None
        if isinstance(rows, PackedRows) and rows.value.dtype == np.int8:
            quanta = cast(NDArray[np.int8], rows.value)
            self.paired = pair_coefficients(rows.tile_begin, rows.index, rows.scale, quanta)


class Products:
    """One transport, and what each version of the light is in the basis of its rows."""

    def __init__(
        self, transport: Transport | PackedTransport, tree: ClusterTree, names: tuple[str, ...] | None = None
    ) -> None:
        # A lobe that no view sample has holds no rows and costs nothing.
        lobes: list[Any] = [
            lobe for lobe in transport.lobes if (_n_entries(lobe.rows) if names is None else lobe.name in names)
        ]
        self.names = tuple(lobe.name for lobe in lobes)
        self._haar = isinstance(transport, PackedTransport)
        self._packed = replace(transport, lobes=tuple(lobes)) if isinstance(transport, PackedTransport) else None
        self._rows: list[_Rows] = [_Rows(lobe.rows) for lobe in lobes]
        self._narrow: list[_Rows] | None = None
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
        self._is_small: Bool = np.zeros(0, np.bool_)  # versions that are 0 nearly everywhere
        if self._haar:
            self._parent_of_leaf, self._parent = _parents(tree)
            self._share, self._root = _shares(tree)
            self._plan = plan_haar(tree)
            self._large_terms = (
                None if self._packed is None or self._packed.n_bytes < 2 * MOVING_BYTES else LargeTerms(self._packed)
            )
            self._leaves: F32 = np.zeros((_TOGETHER, self._n_leaves, 3), np.float32)
            self._unedited: F32 = np.zeros((1, self._n_leaves, 4), np.float32)

    def room(self, n_pairs: int) -> F32:
        """Place for products, (n_lobes, n_pairs, 64, 4)."""
        return np.zeros((len(self._rows), n_pairs, LANES, 4), np.float32)

    @property
    def is_narrow(self) -> bool:
        """Whether there are narrowed rows beside the others."""
        return self._narrow is not None

    def narrow(self, lights: F32, n_versions: int, max_bytes: int) -> None:
        """Keep, beside the rows, what of them matters to lights (n_lights, n_leaves, 3) and the first versions."""
        assert self._packed is not None
        sizes = np.abs(self._versions[:n_versions]).max(axis=(0, 2), initial=0.0)
        for light in lights:
            np.maximum(sizes, np.abs(haar_of_versions(self._plan, light[None])).max(axis=(0, 2)), out=sizes)
        self._narrow = [_Rows(lobe.rows) for lobe in self._packed.narrowed(sizes, max_bytes).lobes]

    def widen(self) -> None:
        """Forget the narrowed rows."""
        self._narrow = None

    def clear(self, version: int | None = None) -> None:
        """Forget one version, or all."""
        self._versions[slice(None) if version is None else version] = 0

    def keep(self, versions: I64) -> None:
        """Forget all but some versions (ascending), and number these anew, in their order."""
        n = len(versions)
        for values in (self._versions, self._sizes, self._is_small):
            for new, old in enumerate(versions):
                values[new] = values[old]
        self._versions[n:] = 0

    def reserve(self, n_versions: int) -> None:
        """Have place for so many versions."""
        if n_versions > len(self._versions):
            grown = np.zeros((max(n_versions, len(self._versions) * 3 // 2), self._n_leaves, 4), np.float32)
            grown[: len(self._versions)] = self._versions
            self._versions = grown
            sizes = np.zeros(grown.shape[:2], np.float32)
            sizes[: len(self._sizes)] = self._sizes
            self._sizes = sizes
            self._is_small = np.append(self._is_small, np.zeros(len(grown) - len(self._is_small), np.bool_))

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
            )
        # A few at a time: what lies between the two steps stays in the cache.
        for first in range(0, len(versions[large]), _TOGETHER):
            some = versions[large][first : first + _TOGETHER]
            values = self._leaves[: len(some)]
            kernels.fill_versions(some, tables.cell_begin, tables.cells, deltas, values)
            haar_of_versions(self._plan, values, self._versions, some)
        self._is_small[versions] = ~large
        largest_channels(versions[~large], self._versions, self._sizes)

    def multiply(self, pairs: I64, pair_tile: I32, pair_version: I32, out: F32, narrow: bool = False) -> None:
        """Products of some pairs of tile and version into ``out[:, pairs]``; `narrow`: with the narrowed rows."""
        small = self._is_small[pair_version[pairs]]
        for some, is_small in ((pairs[small], True), (pairs[~small], False)):
            if len(some):
                self._multiply_some(some, pair_tile, pair_version, out, narrow, is_small)

    def _multiply_some(
        self, pairs: I64, pair_tile: I32, pair_version: I32, out: F32, narrow: bool, small: bool
    ) -> None:
        tile, version = pair_tile[pairs], pair_version[pairs]
        least = np.full(len(self._versions) if small else 0, np.finfo(np.float32).tiny, np.float32)
        direct = len(pairs) == pairs[-1] - pairs[0] + 1 and bool((np.diff(pairs) == 1).all())
        part = slice(pairs[0], pairs[-1] + 1)
        for lobe in range(len(self._rows)):
            into = out[lobe, part] if direct else np.empty((len(pairs), LANES, 4), np.float32)
            self._multiply(lobe, self._versions, tile, version, into, narrow, self._sizes, least)
            if not direct:
                out[lobe, pairs] = into

    def multiply_cells(self, cells: I32, values: F32, tile: I32, out: F32) -> None:
        """Products of some tiles of uncompressed rows with values (n, 3) that are 0 but at some cells."""
        assert not self._haar
        leaves = np.zeros((1, self._n_leaves, 4), np.float32)
        leaves[0, cells, :3] = values
        for lobe in range(len(self._rows)):
            self._multiply(lobe, leaves, tile, np.zeros_like(tile), out[lobe], False, _NONE, _NONE[0])

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
        entries = sum((rows.rows.indptr[np.minimum(begin, rows.rows.n_rows)] for rows in self._rows), 0 * begin)
        end = int(np.searchsorted(entries, entries[first] + _ENTRIES_AT_ONCE, side="right")) - 1
        end = min(max(end, first + 1), self.n_tiles)
        values = np.zeros((1, self._n_leaves, 4), np.float32)
        values[0, :, :3] = b
        tile = np.arange(first, end, dtype=np.int32)
        for lobe in range(len(self._rows)):
            self._multiply(lobe, values, tile, np.zeros_like(tile), out[lobe, first:end], False, _NONE, _NONE[0])
        return end

    def multiply_all(self, b: F32, out: F32, narrow: bool = False) -> None:
        """Products of all tiles with leaf values (n_leaves, 3) into ``out[:, : n_tiles]``; `narrow`: as `multiply`.

        Of a large transport, only the terms that are large in this light are read; see `MOVING_BYTES`.
        """
        size, least = _NONE, np.zeros((len(self._rows), 0), np.float32)
        if self._haar:
            values = haar_of_versions(self._plan, b[None], self._unedited)
            if self._large_terms is not None and not narrow:
                size = np.empty((1, self._n_leaves), np.float32)
                largest_channels(np.zeros(1, np.int64), values, size)
                least = np.full((len(self._rows), 1), self._large_terms.least(size[0], MOVING_BYTES), np.float32)
                size[0, 0] = np.inf  # means stay, however dark it is
        else:
            values = np.zeros((1, self._n_leaves, 4), np.float32)
            values[0, :, :3] = b
        tile = np.arange(self.n_tiles, dtype=np.int32)
        for lobe in range(len(self._rows)):
            self._multiply(
                lobe, values, tile, np.zeros_like(tile), out[lobe, : self.n_tiles], narrow, size, least[lobe]
            )

    def _multiply(
        self,
        lobe: int,
        versions: F32,
        tile: I32,
        version: I32,
        out: F32,
        narrow: bool,
        size: F32,
        least: F32,
    ) -> None:
        """`least` (n_versions,) leaves out terms; empty: none."""
        chosen = self._narrow if narrow else self._rows
        assert chosen is not None
        rows, paired = chosen[lobe].rows, chosen[lobe].paired
        if not self._haar:
            kernels.multiply_sparse_pairs(rows.indptr, rows.indices, rows.weights, versions, tile, version, out)
            return
        if paired is None:
            kernels.multiply_pairs(rows.tile_begin, rows.index, rows.scale, rows.value, versions, tile, version, out)
            return
        if len(least):
            multiply_large_terms(
                rows.tile_begin,
                rows.index,
                rows.scale,
                rows.worth,
                rows.value,
                versions,
                size,
                least,
                tile,
                version,
                out,
            )
            return
        multiply_paired_tiles(paired.tile_begin, paired.index, paired.scale, paired.value, versions, tile, version, out)


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
