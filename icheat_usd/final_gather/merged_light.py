"""Light of cache records by caster, rays that end where its painted masks weigh alike taken together.

This is all that edits which know nothing but masks need to know of rays: for any amounts and colours, and any masks of
the receivers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.mask_patches import mask_patches
from icheat_usd.edits.mask_sheets import EntrySheets, mask_sheets
from icheat_usd.final_gather.gatherer import GatherSolution
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.record_rays import RecordRays
from icheat_usd.kernels import merged_rays as kernels
from icheat_usd.kernels.caster_sums import N_VALUES, RayTable
from icheat_usd.kernels.mask_patches import MaskPatches
from icheat_usd.kernels.mask_table import MaskTable
from icheat_usd.scene import F32, I32, I64, Bool, SceneSnapshot

#: Difference in the change of light, by all masks of a caster together, from which on rays are kept apart.
LEAST_APART = 0.4
#: Tables of light that are kept for other stacks.
_MOST_KEPT = 32
_MOST_BYTES = 1 << 25  #: of rays taken together at once


class PaintedWeights(NamedTuple):
    """Painted weights of a table of casters, and where they are alike."""

    of_entries: EntrySheets
    patches: MaskPatches  #: on which they change light alike
    plateaus: MaskPatches  #: on which they are the same


def painted_weights(casters: MaskTable, on_instances: Bool, steepness: tuple[F32, F32]) -> PaintedWeights:
    """Masks on some instances (n_instances,), with rows' changes of light of some size: `mask_stack.steepness`."""
    n = len(casters.row)
    found = mask_sheets(casters, on_instances, np.ones(n, np.float32), np.zeros((n, 0), np.float32))
    changes = mask_sheets(casters, on_instances, *(np.take(of_row, casters.row, axis=0) for of_row in steepness))
    patches, plateaus = (mask_patches(changes.sheets, apart) for apart in (LEAST_APART, 0.0))
    return PaintedWeights(found, patches, plateaus)


def sent_by_group(solution: GatherSolution, *, with_transport: bool) -> F32:
    """What gather cells send, (n_cells, n_blocks, 4): a block for each group of lights, each with its brightness.

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
    return sent


def merged_light(of: Hemispheres, sent: F32, selected: Bool, weights: PaintedWeights) -> MergedLight:
    """What is known of hemispheres when cells send `sent`, from the `selected` (n_instances,) casters at least."""
    for one in of.merged:
        if one.is_of(sent, selected, weights):
            return one
    found = MergedLight(sent, selected, weights, of.n)
    of.merged[:] = [*of.merged[1 - _MOST_KEPT :], found]
    return found


class _Kept(NamedTuple):
    """Light of rays taken together."""

    caster: I32  #: (m,)
    weights: F32  #: (m, width) of the caster's masks
    light: F32  #: (m, n_blocks, N_VALUES, 4)


class MergedLight:
    """Light of n records, found when it is first asked for."""

    def __init__(self, sent: F32, selected: Bool, weights: PaintedWeights, n: int) -> None:
        self._sent, self._selected, self._painted = sent, selected, weights
        self._width = weights.of_entries.width
        self._is_known = np.zeros(n, np.bool_)
        self._record, self._n_kept = np.empty(0, np.int64), 0
        shape = (sent.shape[1], N_VALUES, 4)
        self._kept = _Kept(
            np.empty(0, np.int32), np.empty((0, self._width), np.float32), np.empty((0, *shape), np.float32)
        )
        self.begin = np.zeros(n + 1, np.int64)  #: entries of each record
        self.entry = np.empty(0, np.int64)  #: (m,) where they are among what is kept

    @property
    def kept(self) -> _Kept:
        """Entries, and room for more."""
        return self._kept

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

    def find(self, of: Hemispheres, snapshot: SceneSnapshot, needed: Bool) -> None:
        """See to it that some records are known."""
        new = needed & ~self._is_known
        if not new.any():
            return
        self._is_known |= new
        records, left = [self._record], int(new[np.concatenate([part.owner for part in of.parts])].sum())
        for rays, owner, table in of.tables():
            order = np.flatnonzero(new[owner])
            if len(order) == 0:
                continue
            order = order[np.argsort(owner[order], kind="stable")]
            mine = owner[order]
            first = np.append(np.flatnonzero(np.append(True, mine[1:] != mine[:-1])), len(mine))
            records += self._of_rays(rays, table, order, first, mine[first[:-1]], of.shares(), snapshot, left)
            left -= len(order)
        self._record = np.concatenate(records)
        self.entry = np.argsort(self._record, kind="stable")
        self.begin = np.searchsorted(self._record[self.entry], np.arange(of.n + 1))

    def _of_rays(
        self,
        rays: RecordRays,
        table: RayTable,
        order: I64,
        first: I64,
        record: I64,
        share: F32,
        snapshot: SceneSnapshot,
        left: int,
    ) -> list[I64]:
        """Keep what hemispheres ``order[first[k]:first[k + 1]]`` of each record bring; the records of what is kept.

        `left` is how many hemispheres will follow, these among them.
        """
        geometry = snapshot.geometry
        room = rays.n_rays * int(np.diff(first).max())
        if self._width == 0:
            room = min(room, int(self._selected.sum()))
        shape = (self._sent.shape[1], N_VALUES, 4)
        at_once = max(1, _MOST_BYTES // (4 * room * (1 + self._width + int(np.prod(shape)))))
        found = []
        for begin in range(0, len(record), at_once):
            some = record[begin : begin + at_once]
            n = len(some)
            number, caster = np.empty(n, np.int64), np.empty((n, room), np.int32)
            weights, light = np.empty((n, room, self._width), np.float32), np.empty((n, room, *shape), np.float32)
            kernels.merge_rays(
                table,
                geometry.face,
                geometry.face_uv,
                self._sent,
                order,
                first[begin : begin + n + 1],
                some,
                share,
                self._selected.view(np.uint8),
                self._painted.of_entries.sheets,
                self._painted.patches,
                self._painted.plateaus,
                rays.seed,
                rays.n_theta,
                rays.n_phi,
                number,
                caster,
                weights,
                light,
            )
            ends = self._n_kept + np.cumsum(number)
            share_left = (left - first[begin]) / (first[begin + n] - first[begin])
            self._make_room(int(ends[-1]), int(share_left * number.sum()))
            kernels.keep(ends, number, caster, weights, light, *self._kept)
            self._n_kept = int(ends[-1])
            found.append(np.repeat(some, number))
        return found

    def _make_room(self, n: int, more: int) -> None:
        """See to it that there is room for `n` entries; if there is not, for `more` than there are."""
        if n <= len(self._kept.caster):
            return
        room = max(n, self._n_kept + more + more // 8)
        grown = _Kept(*(np.empty((room, *column.shape[1:]), column.dtype) for column in self._kept))
        for column, before in zip(grown, self._kept, strict=True):
            column[: self._n_kept] = before[: self._n_kept]
        self._kept = grown
