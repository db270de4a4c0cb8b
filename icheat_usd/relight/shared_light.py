"""The image as one interpolation of products: unedited ones, and for groups touched wholly, their edited light."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels import version_products as kernels
from icheat_usd.kernels.assemble import assemble_film, assemble_view, runs_in_order
from icheat_usd.kernels.film_table import FilmTable
from icheat_usd.relight.direct_sum import SummedLight
from icheat_usd.relight.groups import SampleGroups, TermTable
from icheat_usd.relight.narrow import Narrow, Rest
from icheat_usd.relight.products import Products
from icheat_usd.relight.versions import Versions
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F32, I32, I64, Bool
from icheat_usd.transport.packed import LANES


class OwnLight(NamedTuple):
    """Indirect light that samples do not share with a group; see `assemble_film`."""

    samples: I32  #: ascending; all of theirs
    added: I32  #: ascending; besides what they share with a group
    light: F32  #: (n_view, 3)


class SeenSamples(NamedTuple):
    """How view samples make pixels; see `assemble_film`."""

    dimmed: I32  #: ascending
    throughput: F32  #: (n_dimmed, 3)
    sample_begin: I32
    in_order: Bool
    still_pixel: I32
    still: F32


def seen_samples(view: ViewSamples) -> SeenSamples:
    """Those of a view, with its background and what glows."""
    begin = np.searchsorted(view.pixel, np.arange(view.width * view.height + 1)).astype(np.int32)
    still = (view.background + develop(view, view.points.emission)).astype(np.float32)
    shown = np.flatnonzero(still.any(axis=1)).astype(np.int32)
    dimmed = np.flatnonzero((view.throughput != 1).any(axis=1)).astype(np.int32)
    throughput = np.ascontiguousarray(view.throughput[dimmed], np.float32)
    return SeenSamples(dimmed, throughput, begin, runs_in_order(begin), shown, np.ascontiguousarray(still[shown]))


class SharedLight:
    """Sums of products by group and tile, of the terms that all samples of a group receive alike.

    The table that the edited image is interpolated with names these sums
    instead of the unedited products, so that an edit costs a pixel nothing.
    """

    def __init__(self, products: Products, table: FilmTable) -> None:
        self._products = products
        self._base = base = table
        self._edited = base._replace(row=base.row.copy(), more_row=base.more_row.copy())
        self._of: I32 = np.zeros((0, products.n_tiles), np.int32)
        self._tile: I32 = np.zeros(0, np.int32)
        self._group: I32 = np.zeros(0, np.int32)
        #: (n_lobes, n_tiles + n_sums, 64, 4) unedited products, then the sums
        self._sums: F32 = products.room(products.n_tiles)

    def take_weights(self, table: FilmTable) -> None:
        """Go on with a table that differs from the present one in weights alone."""
        self._base = table
        self._edited = table._replace(row=self._edited.row, more_row=self._edited.more_row)

    def place(self, samples: I64, groups: SampleGroups, shared: Bool) -> None:
        """Let the table name what some samples share; `shared` (n_groups + 1,) says which groups do."""
        base, edited = self._base, self._edited
        of = groups.of_sample
        grown = np.full((len(shared) - 1 - len(self._of), self._of.shape[1]), -1, np.int32)
        self._of = np.concatenate([self._of, grown])
        more = _entries_of(base.more_view, samples)
        for view, row, out, which in (
            (samples, base.row, edited.row, samples),
            (base.more_view[more].astype(np.int64), base.more_row, edited.more_row, more),
        ):
            group = of[view]
            moved = shared[group]
            out[which[~moved]] = row[which[~moved]]
            there = row[which[moved]]
            group = np.repeat(group[moved, None], there.shape[1], axis=1)
            tile, lane = there // LANES, there % LANES
            self._ask(group, tile)
            out[which[moved]] = (self._products.n_tiles + self._of[group, tile]) * LANES + lane

    def _ask(self, group: I32, tile: I32) -> None:
        flags = np.zeros(self._of.shape, np.bool_)
        flags[group, tile] = True
        new_group, new_tile = np.nonzero(flags & (self._of < 0))
        if not len(new_group):
            return
        self._of[new_group, new_tile] = len(self._tile) + np.arange(len(new_group), dtype=np.int32)
        self._tile = np.concatenate([self._tile, new_tile.astype(np.int32)])
        self._group = np.concatenate([self._group, new_group.astype(np.int32)])
        sums = self._products.room(self._products.n_tiles + len(self._tile))
        sums[:, : self._sums.shape[1]] = self._sums
        self._sums = sums

    def take_unedited(self, other: SharedLight) -> None:
        """Go on with the unedited products of another one."""
        n_tiles = self._products.n_tiles
        self._sums[:, :n_tiles] = other._sums[:, :n_tiles]

    def set_unedited(self, light: F32, seen: Callable[[], None] | None = None) -> None:
        """Multiply the transport with the unedited light; both as for `Products.multiply_all`."""
        self._products.multiply_all(light, self._sums, seen=seen)

    def refine_unedited(self, b: F32, exact: Products, first: int) -> int:
        """Multiply some tiles of exact rows with the unedited light, from `first` on; the first tile that is left."""
        return exact.multiply_more(b, first, self._sums)

    def set_unedited_near_rest(self, narrow: Narrow, rest: Rest, seen: Callable[[], None] | None = None) -> None:
        """The same of lights of which some may be as they were at rest; see `Narrow.rest_of`."""
        narrow.unedited(rest, self._sums, seen)

    def unedited(self, out: F32) -> None:
        """Unedited indirect light of all view samples into `out`."""
        self._assemble(self._base, out)

    def add_up(self, terms: TermTable, versions: Versions) -> None:
        """Make the sums of groups from the products of their terms."""
        self._add_groups(terms, versions.pair_of, versions.values, self._sums)

    def sums_of(self, unedited: F32, terms: TermTable, pair_of: I32, values: F32) -> F32:
        """The same of other products: unedited ones (n_lobes, n_tiles, 64, 4), and `values` of the terms."""
        sums = np.empty_like(self._sums)
        sums[:, : self._products.n_tiles] = unedited
        self._add_groups(terms, pair_of, values, sums)
        return sums

    def _add_groups(self, terms: TermTable, pair_of: I32, values: F32, sums: F32) -> None:
        if len(self._tile):
            n_tiles, begin, version = self._products.n_tiles, terms.term_begin, terms.term_version
            kernels.sum_products(self._tile, self._group, begin, version, pair_of, values, n_tiles, sums)

    def edited(self, out: F32, sums: F32 | None = None) -> None:
        """Indirect light of all view samples into `out`: edited where a group shares it, else unedited.

        Parameters
        ----------
        sums
            Of `sums_of`, in place of the present ones.
        """
        self._assemble(self._edited, out, sums)

    def film(self, own: OwnLight, direct: SummedLight, seen: SeenSamples, out: F32, sums: F32 | None = None) -> None:
        """The image with direct light into `out` (n_pixels, 3); `sums` as for `edited`."""
        assemble_film(tuple(self._edited), self._flat(sums), tuple(own), tuple(direct), tuple(seen), out)

    def _flat(self, sums: F32 | None) -> F32:
        sums = self._sums if sums is None else sums
        n_lobes, n_sums = sums.shape[:2]
        return sums.reshape(n_lobes, n_sums * LANES, 4)

    def _assemble(self, table: FilmTable, out: F32, sums: F32 | None = None) -> None:
        assemble_view(tuple(table), self._flat(sums), out)


def _entries_of(view: I32, samples: I64) -> I64:
    """Places in `view`, ascending with repetitions, that belong to some samples, ascending."""
    begin, end = np.searchsorted(view, samples), np.searchsorted(view, samples, side="right")
    counts = end - begin
    return np.asarray(
        np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(begin, counts)
    )
