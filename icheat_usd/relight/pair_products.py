"""Products of versions that look at receivers: pair by pair on the exact rows, kept as edited rows of RGB weights.

An edit of this kind is seen from the places of the records: exact where every
view sample is one, and as good as the interpolation of the transport elsewhere.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import Aggregate, Ends
from icheat_usd.edits.field import EditField
from icheat_usd.edits.offsets import PAIRS_AT_ONCE
from icheat_usd.edits.operations import Level, PairCoefficients
from icheat_usd.kernels import version_products as kernels
from icheat_usd.materials import take_points
from icheat_usd.relight.compiled import CompiledStack
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, F64, I32, I64, U8, Bool
from icheat_usd.transport import SparseRows, Transport
from icheat_usd.transport.packed import LANES


class _EditedRows(NamedTuple):
    """Rows of some tiles: what arrives is ``sum of weight (sum_g factor_g b_g + emission)``."""

    begin: I64  #: (n_tiles 64 + 1,)
    cell: I32
    weight: F32  #: (n,) transport
    factor: F32  #: (G, n, 3)
    emission: F32  #: (n, 3)


class PairSum(NamedTuple):
    """The sets of edits whose signed sum a version is."""

    sets: U8  #: (n_sets, n_members)
    sign: F64
    restrict: int  #: row of the aggregate whose casters and lights alone count, or -1
    unedited: bool  #: whether the unedited light is subtracted
    cells: I32  #: casters that count


class PairProducts:
    """The exact rows of one transport and the places of its records."""

    def __init__(self, transport: Transport, view: ViewSamples, gather: GatherSamples) -> None:
        self._lobes = [lobe.rows for lobe in transport.lobes if lobe.rows.n_entries]
        self._records = take_points(view.points, transport.row_view.astype(np.int64))
        self._gather = gather
        self._receivers: Ends | None = None
        self._casters: Ends | None = None
        self._kept: dict[int, list[_EditedRows]] = {}

    def forget(self) -> None:
        """Start anew, with versions of other numbers."""
        self._receivers = self._casters = None
        self._kept = {}

    def stack_changed(self, versions: set[int]) -> None:
        """Forget the edited rows of some versions."""
        self._receivers = self._casters = None
        for version in versions:
            self._kept.pop(version, None)

    def products(self, version: int, pair_sum: PairSum, compiled: CompiledStack, tiles: I64, b: F32, out: F32) -> None:
        """Products of one version with some tiles, (n_lobes, n_tiles, 64, 4), from light b (G, n_gather, 3)."""
        looks = bool((compiled.looks & (pair_sum.sets[:, : compiled.n_rows] != 0).any(axis=0)).any())
        rows = None if looks else self._kept.get(version)
        if rows is None or len(rows[0].begin) != len(tiles) * LANES + 1:
            rows = [self._edited_rows(lobe, pair_sum, compiled, tiles, b) for lobe in self._lobes]
            self._kept[version] = rows
        for lobe, edited in enumerate(rows):
            flat = np.empty((len(tiles) * LANES, 4), np.float32)
            kernels.multiply_edited_rows(
                edited.begin, edited.cell, edited.weight, edited.factor, edited.emission, b, flat
            )
            out[lobe] = flat.reshape(-1, LANES, 4)

    def _edited_rows(
        self, rows: SparseRows, pair_sum: PairSum, compiled: CompiledStack, tiles: I64, b: F32
    ) -> _EditedRows:
        counted: Bool = np.zeros(self._gather.n, np.bool_)
        counted[pair_sum.cells] = True
        record = (tiles[:, None] * LANES + np.arange(LANES)).reshape(-1)
        real = record < rows.n_rows
        begin = np.where(real, rows.indptr[np.minimum(record, rows.n_rows)], 0)
        counts = np.where(real, rows.indptr[np.minimum(record + 1, rows.n_rows)] - begin, 0)
        owner = np.repeat(np.arange(len(record)), counts)
        before = np.cumsum(counts) - counts
        place = np.arange(counts.sum()) + np.repeat(begin - before, counts)
        some = counted[rows.indices[place]]
        owner, place = owner[some], place[some]
        cell = rows.indices[place]
        factor = np.empty((len(b), len(cell), 3), np.float32)
        emission = np.empty((len(cell), 3), np.float32)
        for first in range(0, len(cell), PAIRS_AT_ONCE):
            part = slice(first, first + PAIRS_AT_ONCE)
            factor[:, part], emission[part] = self._summed(
                pair_sum, compiled, record[owner[part]], cell[part].astype(np.int64), b
            )
        ends = np.searchsorted(owner, np.arange(len(record) + 1)).astype(np.int64)
        return _EditedRows(ends, cell, rows.weights[place], factor, emission)

    def _summed(self, pair_sum: PairSum, compiled: CompiledStack, record: I64, cell: I64, b: F32) -> tuple[F32, F32]:
        """Signed sum of the composed functions at pairs of records and cells."""
        field, n_rows = compiled.field, compiled.n_rows
        if self._receivers is None or self._casters is None:
            self._receivers = field.receivers(self._records)
            self._casters = field.casters(self._gather.points)
        receivers, casters = self._receivers.take(record), self._casters.take(cell)
        seen = np.take(b, cell, axis=1)
        factor, emission = np.zeros(seen.shape, np.float32), np.zeros(seen.shape[1:], np.float32)
        for members, sign in zip(pair_sum.sets, pair_sum.sign.astype(np.float32), strict=True):
            masks = members[:n_rows].astype(np.float32)
            resolved = _resolved(field, compiled, members, masks)
            here = receivers._replace(masks=np.broadcast_to(masks[:, None], (n_rows, len(record))))
            found = field.evaluate(seen, here, casters, resolved)
            factor += sign * found.scale
            emission += sign * found.emission
        if pair_sum.unedited:
            factor -= np.float32(1)
        if pair_sum.restrict >= 0:
            aggregate = next(found for found in field.aggregates if found.row == pair_sum.restrict)
            return _restricted(field, aggregate, casters, factor, emission)
        return factor, emission


def _restricted(field: EditField, aggregate: Aggregate, casters: Ends, factor: F32, emission: F32) -> tuple[F32, F32]:
    whole = bool(field.edits[aggregate.edit].groups.all())
    mask = casters.masks[aggregate.row][:, None] if whole else np.float32(0)
    return field.aggregate_share(aggregate, casters) * factor, np.asarray(mask * emission)


def _resolved(field: EditField, compiled: CompiledStack, members: U8, masks: F32) -> list[PairCoefficients]:
    """Aggregates as edits that add 1 to the scale, or to the emission, whatever their amount: see `groups.Term`."""
    found = []
    for aggregate in field.aggregates:
        row = aggregate.row
        scaled, emitted = bool(members[row]), False
        if compiled.row_table[row, 4] >= 0:
            emitted = bool(members[compiled.row_table[row, 4]])
        amount = compiled.row_amount[row]
        each = np.float32(1 / amount if amount else 0)
        masks[row] = scaled or emitted
        assert field.edits[aggregate.edit].level is Level.AGGREGATE
        scale = np.full((1, 3), np.float32(1) + (each if scaled else np.float32(0)), np.float32)
        found.append(PairCoefficients(scale, np.full((1, 3), each if emitted else 0, np.float32)))
    return found
