"""Light of cache records by caster, rays that end where its painted masks weigh alike taken together.

This is all that edits which know nothing but masks need to know of rays: for any amounts and colours, and any masks of
the receivers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.mask_patches import mask_patches
from icheat_usd.edits.mask_sheets import EntrySheets, mask_sheets
from icheat_usd.final_gather.gatherer import GatherSolution
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.kernels import merged_rays as kernels
from icheat_usd.kernels.caster_sums import RayTable, Senders
from icheat_usd.kernels.mask_patches import MaskPatches
from icheat_usd.kernels.mask_table import MaskTable
from icheat_usd.kernels.record_lanes import LANES
from icheat_usd.scene import F32, I32, I64, Bool, Geometry, SceneSnapshot

#: Difference in the change of light, by all masks of a caster together, from which on rays are kept apart.
LEAST_APART = 0.4
#: Stacks whose light is kept for others, and memory for all of it: of rough masks no two rays are taken together.
_MOST_KEPT, MOST_BYTES = 32, 1 << 29
_MOST_OF_TABLE, _MOST_OF_SCRATCH = 1 << 27, 1 << 24  #: bytes
_PILOT = 1 << 16  #: rays of the first table, which tells how many are left of others


class PaintedWeights(NamedTuple):
    """Painted weights of a table of casters, and where they are alike."""

    of_entries: EntrySheets
    patches: MaskPatches  #: on which they change light alike
    plateaus: MaskPatches  #: on which they are the same

    def met_by(
        self, some: Iterable[Groups], sent: F32, selected: Bool, geometry: Geometry
    ) -> Iterator[kernels.PaintedRays]:
        """Rays with what they meet, where cells send `sent` and `selected` (n_instances,) casters count."""
        senders = Senders(geometry.face, geometry.face_uv, sent, selected.view(np.uint8))
        for groups in some:
            yield kernels.PaintedRays(*groups, senders, self.of_entries.sheets, self.patches, self.plateaus)


def painted_weights(casters: MaskTable, on_instances: Bool, steepness: tuple[F32, F32]) -> PaintedWeights:
    """Masks on some instances (n_instances,), with rows' changes of light of some size: `mask_stack.steepness`."""
    n = len(casters.row)
    found = mask_sheets(casters, on_instances, np.ones(n, np.float32), np.zeros((n, 0), np.float32))
    changes = mask_sheets(casters, on_instances, *(np.take(of_row, casters.row, axis=0) for of_row in steepness))
    patches, plateaus = (mask_patches(changes.sheets, apart) for apart in (LEAST_APART, 0.0))
    return PaintedWeights(found, patches, plateaus)


def sent_by_group(solution: GatherSolution, *, with_transport: bool) -> F32:
    """What gather cells send, (n_cells, n_blocks, 4): a block for each group of lights, each with its brightness.

    That of transport is below 0: what travels on it is not the light of cells, and near hits do not change it.

    Parameters
    ----------
    with_transport : bool
        Whether a last block is of cells that send 1, as what is added travels on transport alone.
    """
    b = solution.b if solution.sent is None else solution.sent
    n_groups, n_cells = b.shape[:2]
    sent = np.zeros((n_cells, n_groups + int(with_transport), 4), np.float32)
    sent[:, :n_groups, :3] = b.transpose(1, 0, 2)
    if with_transport:
        sent[:, n_groups, :3] = 1
    sent[:, :, 3] = sent[:, :, :3].sum(axis=2)
    sent[:, n_groups:, 3] *= -1
    return sent


def merged_light(of: Hemispheres, sent: F32, selected: Bool, weights: PaintedWeights) -> MergedLight:
    """What is known of hemispheres when cells send `sent`, from the `selected` (n_instances,) casters at least."""
    for one in of.merged:
        if one.is_of(sent, selected, weights):
            return one
    found = MergedLight(sent, selected, weights, of.n)
    of.merged[:] = [*of.merged[1 - _MOST_KEPT :], found]
    return found


class Groups(NamedTuple):
    """Hemispheres of some records that were traced together."""

    rays: RayTable
    groups: kernels.RayGroups


def groups_of(of: Hemispheres, wanted: Bool) -> Iterator[Groups]:
    """Hemispheres of the `wanted` (n,) records, some after others: those that were traced together."""
    share = of.shares()
    for rays, owner, table in of.tables():
        order = np.flatnonzero(wanted[owner])
        if len(order) == 0:
            continue
        order = order[np.argsort(owner[order], kind="stable")]
        mine = owner[order]
        first = np.append(np.flatnonzero(np.append(True, mine[1:] != mine[:-1])), len(mine))
        record = mine[first[:-1]]
        yield Groups(table, kernels.RayGroups(rays.n_theta, rays.n_phi, rays.seed, order, first, record, share))


class LightTable(NamedTuple):
    """Light of some of n records: rays of theirs taken together."""

    has: Bool  #: (n,) those records
    begin: I64  #: (n + 1,)
    entry: I64  #: (m,) rows of record r are ``entry[begin[r]:begin[r + 1]]``
    rows: _Rows

    @property
    def n_bytes(self) -> int:
        return sum(column.nbytes for column in (self.entry, *self.rows))


class _Rows(NamedTuple):
    caster: I32  #: (m,)
    weights: F32  #: (m, width) of the caster's masks
    light: F32  #: (m, n_blocks, LANES)


class MergedLight:
    """Light of n records, found when it is first asked for, and kept as far as there is room."""

    def __init__(self, sent: F32, selected: Bool, weights: PaintedWeights, n: int) -> None:
        self._sent, self._selected, self._painted = sent, selected, weights
        self._width = weights.of_entries.width
        self._kept: list[LightTable] = []
        self._is_kept, self._is_full = np.zeros(n, np.bool_), False
        self._n_rays = self._n_rows = 0  # that have been looked at, and what was left of them

    @property
    def n_bytes(self) -> int:
        """Memory that is kept."""
        return sum(table.n_bytes for table in self._kept)

    def is_of(self, sent: F32, selected: Bool, weights: PaintedWeights) -> bool:
        """Whether it tells of these cells, casters and masks."""
        n_blocks = sent.shape[1]
        # Means of masks are weighted by all that is sent.
        is_enough = self._sent.shape[1] >= n_blocks if self._width == 0 else self._sent.shape[1] == n_blocks
        if not is_enough or (selected & ~self._selected).any() or not np.array_equal(self._sent[:, :n_blocks], sent):
            return False
        own, other = self._painted, weights
        pairs = ((own.of_entries.sheets, other.of_entries.sheets), (own.patches, other.patches))
        return all(np.array_equal(a, b) for one in pairs for a, b in zip(*one, strict=True))

    def tables(self, of: Hemispheres, snapshot: SceneSnapshot, wanted: Bool, likely: Bool) -> Iterator[LightTable]:
        """Tables that hold each of the `wanted` records once.

        What is not kept is looked at again whenever it is wanted.

        Parameters
        ----------
        wanted, likely : (n,)
            Records; those that are likely to be wanted are kept, too, if there is room.
        """
        for table in list(self._kept):
            if (table.has & wanted).any():
                yield table
        number = np.zeros(of.n, np.int64)
        for rays, owner, _ in of.tables():
            number += rays.n_rays * np.bincount(owner, minlength=of.n)
        left = np.flatnonzero((wanted | likely) & ~self._is_kept & (number > 0))
        scratch: dict[int, F32] = {}
        while len(left):
            if self._is_full:
                left = left[wanted[left]]
            n = int(np.searchsorted(np.cumsum(number[left]), self._rays_at_once(), side="right"))
            has = np.zeros(of.n, np.bool_)
            has[left[: max(n, 1)]] = True
            left = left[max(n, 1) :]
            table = self._table(of, snapshot, has, int(number[has].sum()), scratch)
            self._keep(table, of)
            if (has & wanted).any():
                yield table

    def _keep(self, table: LightTable, of: Hemispheres) -> None:
        """Keep a table if there is room; what stacks before have kept is given up first."""
        others = [one for one in of.merged if one is not self]
        while others and table.n_bytes + sum(one.n_bytes for one in (*others, self)) > MOST_BYTES:
            del others[0]
        if table.n_bytes + self.n_bytes > MOST_BYTES:
            self._is_full = True
            return
        of.merged[:] = [one for one in of.merged if one is self or one in others]
        self._kept.append(table)
        self._is_kept |= table.has

    def _row_bytes(self) -> int:
        return 4 * (1 + self._width + self._sent.shape[1] * LANES)

    def _rays_at_once(self) -> int:
        """Of a table, by what was left of those before."""
        if self._n_rays == 0:
            return _PILOT
        return int(_MOST_OF_TABLE * self._n_rays / (max(self._n_rows, 1) * self._row_bytes()))

    def _table(
        self, of: Hemispheres, snapshot: SceneSnapshot, has: Bool, n_rays: int, scratch: dict[int, F32]
    ) -> LightTable:
        """What hemispheres of some records bring; `n_rays` is how many these have."""
        seen, n_rows = 0, 0
        rows, records = self._no_rows(0), [np.zeros(0, np.int64)]
        for rays in self._painted.met_by(groups_of(of, has), self._sent, self._selected, snapshot.geometry):
            for record, number, found, n_seen in self._merged(rays, scratch):
                n, seen = int(number.sum()), seen + n_seen
                if n_rows + n > len(rows.caster):
                    grown = self._no_rows(max(n_rows + n, int(1.1 * (n_rows + n) * n_rays / seen)))
                    for column, before in zip(grown, rows, strict=True):
                        column[:n_rows] = before[:n_rows]
                    rows = grown
                kernels.keep(n_rows + np.cumsum(number), number, *found, *rows)
                records.append(np.repeat(record, number))
                n_rows += n
        self._n_rays, self._n_rows = self._n_rays + n_rays, self._n_rows + n_rows
        of_row = np.concatenate(records)
        entry = np.argsort(of_row, kind="stable")
        return LightTable(has, np.searchsorted(of_row[entry], np.arange(of.n + 1)), entry, rows)

    def _no_rows(self, n: int) -> _Rows:
        shape = (n, self._sent.shape[1], LANES)
        return _Rows(np.empty(n, np.int32), np.empty((n, self._width), np.float32), np.empty(shape, np.float32))

    def _merged(self, rays: kernels.PaintedRays, scratch: dict[int, F32]) -> Iterator[tuple[I64, I64, _Rows, int]]:
        """What hemispheres of each record bring, for some records after others.

        Records, how many rows each has, these rows, and how many rays there were.
        """
        groups, n_rays, first = rays.groups, rays.groups.n_theta * rays.groups.n_phi, rays.groups.first
        room = n_rays * int(np.diff(first).max())
        if self._width == 0:
            room = min(room, int(self._selected.sum()))
        at_once = max(1, _MOST_OF_SCRATCH // (room * self._row_bytes()))
        for begin in range(0, len(groups.record), at_once):
            record = groups.record[begin : begin + at_once]
            n = len(record)
            some = rays._replace(groups=groups._replace(first=first[begin : begin + n + 1], record=record))
            number, found = np.empty(n, np.int64), self._scratch(n, room, scratch)
            kernels.merge_rays(*some, number, *found)
            yield record, number, found, n_rays * int(first[begin + n] - first[begin])

    def _scratch(self, n: int, room: int, before: dict[int, F32]) -> _Rows:
        """Rows for n records: new memory would take as long as the rays."""
        shapes = ((n, room), (n, room, self._width), (n, room, self._sent.shape[1], LANES))
        for number, shape in enumerate(shapes):
            if number not in before or before[number].size < np.prod(shape):
                before[number] = np.empty(int(np.prod(shape)), np.float32)
        caster, weights, light = (
            before[number][: int(np.prod(shape))].reshape(shape) for number, shape in enumerate(shapes)
        )
        return _Rows(caster.view(np.int32), weights, light)
