"""A bound stack as tables for kernels: what acts on each gather cell, in order, with which numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from icheat_usd.edits.bound import BoundEdit
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level, PairCoefficients, PairEnd, Pairs
from icheat_usd.edits.operations.base import number
from icheat_usd.edits.operations.hsv import Hsv
from icheat_usd.kernels import versions as kernels
from icheat_usd.kernels.entries import entries_by_cell
from icheat_usd.samples import GatherSamples
from icheat_usd.scene import F32, F64, I32, I64, U8, Bool

_BLENDS = {Blend.COMPOSE: kernels.COMPOSE, Blend.OVER: kernels.OVER, Blend.ADD: kernels.ADD}
_IDENTITY = np.array([[1.0] * 3 + [0.0] * 6])
_NOWHERE = PairEnd(*(np.zeros((1, 3), np.float32),) * 3)


class Way(IntEnum):
    """How the light of receivers under a row of the stack is found."""

    VERSION = 0  #: receivers share edited copies of the casters' radiance
    AGGREGATE = 1  #: they do, and each makes something of its own of the sum
    VIEW = 2  #: at the end
    ALONE = 3  #: sample by sample and pair by pair
    PAIRS = 4  #: versions, multiplied pair by pair at the records


@dataclass(frozen=True, eq=False)
class CompiledStack:
    """Rows are those of the field's masks, one for each edit and key; members are rows, then emission of aggregates."""

    field: EditField
    way: I64  #: (n_rows,) `Way`
    edit_of: I64  #: (n_members,)
    looks: Bool  #: (n_rows,) the coefficients depend on the light that weaker edits left
    gives_offset: Bool  #: (n_rows,) whether it may add light that does not come by the transport
    row_table: I64  #: (n_rows, 5) see `kernels.versions.compose`
    row_amount: F64  #: (n_rows,) amount times key weight
    groups: U8  #: (n_edits, G) groups of lights
    cell_begin: I64  #: (n_gather + 1,) entries of each cell
    entry_row: I32
    entry_weight: F32
    entry_slot: I32
    slots: F64  #: (n_slots, 9) scale, emission and offset, or the numbers of an operation
    slot_begin: I64  #: (n_rows + 1,) those of each row: one, or one for each cell of its support
    support: Bool  #: (n_rows, n_gather) cells on surfaces that the casters may lie on, painted or not
    together: Bool  #: (n_signatures, n_rows) rows that occur together at some cell
    run_of: I32  #: (n_gather,) see `kernels.versions.version_deltas`
    looks_at: U8  #: (n_gather,)
    _entries: dict[int, I64] = dataclasses.field(default_factory=dict)

    @property
    def n_rows(self) -> int:
        return len(self.way)

    def meet(self, rows: Iterable[int]) -> Bool:
        """Which of the signatures have all these rows (members stand for their row)."""
        found = np.ones(len(self.together), np.bool_)
        for row in rows:
            found &= self.together[:, self.row_of(row)]
        return found

    def row_of(self, member: int) -> int:
        """Row of the stack of a member."""
        if member < self.n_rows:
            return member
        return int(np.flatnonzero(self.row_table[:, 4] == member)[0])

    def rows_of(self, edit: int) -> range:
        """Rows of an edit of the field."""
        first, end = np.searchsorted(self.row_table[:, 0], (edit, edit + 1))
        return range(int(first), int(end))

    def slots_of(self, row: int) -> F64:
        """Numbers of a row, to be read or written."""
        return self.slots[self.slot_begin[row] : self.slot_begin[row + 1]]

    def set_weights(self, row: int, cells: I64, weights: F32) -> None:
        """Paint some cells of the row's support anew."""
        if row not in self._entries:
            self._entries[row] = np.flatnonzero(self.entry_row == row)
        there = self.support[row]
        rank = np.cumsum(there) - 1
        inside = there[cells]
        self.entry_weight[self._entries[row][rank[cells[inside]]]] = weights[inside]
        self.find_runs()

    def find_runs(self) -> None:
        """Find which neighbouring cells are acted on alike."""
        kernels.find_runs(
            self.cell_begin,
            self.entry_row,
            self.entry_weight,
            self.entry_slot,
            self.row_table,
            self.run_of,
            self.looks_at,
        )


def compile_stack(
    field: EditField, gather: GatherSamples, casters: Sequence[tuple[I64, F32]], at_records: bool = True
) -> CompiledStack:
    """Write a bound stack as tables.

    Parameters
    ----------
    casters : for each row
        Cells, ascending, on surfaces that its casters may lie on, and their weights.
    at_records
        Edits that look at receivers may look at records instead.
    """
    rows = [(edit, bound, key) for edit, bound in enumerate(field.edits) for key in range(bound.n_keys)]
    way = np.array([_way(bound) for _, bound, _ in rows], np.int64)
    if not at_records:
        way[way == Way.PAIRS] = Way.ALONE
    aggregates = np.flatnonzero(way == Way.AGGREGATE)
    table = np.full((len(rows), 5), -1, np.int64)
    for row, (edit, bound, _) in enumerate(rows):
        kind = kernels.AGGREGATE if way[row] == Way.AGGREGATE else kernels.CONSTANT
        kind = kernels.HSV if isinstance(bound.operation, Hsv) else kind
        table[row, :4] = edit, kind, _BLENDS[bound.edit.blend], bound.offset_is_paint
    table[aggregates, 4] = len(rows) + np.arange(len(aggregates))
    instance = gather.points.instance
    on_instances = np.zeros((len(rows), max(int(instance.max(initial=0)) + 1, 1)), np.bool_)
    for row, (_, bound, key) in enumerate(rows):
        if way[row] in (Way.VERSION, Way.AGGREGATE, Way.PAIRS):
            on_instances[row] = bound.casters[key].on_instances[: on_instances.shape[1]] > 0
    acting = np.isin(way, (Way.VERSION, Way.AGGREGATE, Way.PAIRS))
    cells = [found if acts else found[:0] for (found, _), acts in zip(casters, acting, strict=True)]
    support = np.zeros((len(rows), gather.n), np.bool_)
    for row, there in enumerate(cells):
        support[row, there] = True
    slots, slot_begin = _slots(rows, way, cells, gather)
    row_begin = np.concatenate([[0], np.cumsum([len(there) for there in cells])]).astype(np.int64)
    n, begin = int(row_begin[-1]), np.empty(gather.n + 1, np.int64)
    entry_row, entry_weight, entry_slot = np.empty(n, np.int32), np.empty(n, np.float32), np.empty(n, np.int32)
    entries_by_cell(
        np.concatenate([np.empty(0, np.int64), *cells]),
        row_begin,
        np.concatenate(
            [np.empty(0, np.float32), *(weights[: len(c)] for (_, weights), c in zip(casters, cells, strict=True))]
        ),
        slot_begin[:-1],
        (np.diff(slot_begin) > 1).astype(np.uint8),
        begin,
        entry_row,
        entry_weight,
        entry_slot,
    )
    edit_of = np.concatenate([table[:, 0], table[aggregates, 0]]).astype(np.int64)
    compiled = CompiledStack(
        field,
        way,
        edit_of,
        np.array([bound.operation is not None and bound.operation.uses_incident for _, bound, _ in rows], np.bool_),
        np.array([_gives_offset(bound, key) for _, bound, key in rows], np.bool_),
        table,
        np.array([np.float64(bound.edit.amount * bound.key_weights[key]) for _, bound, key in rows], np.float64),
        np.array([bound.groups for bound in field.edits], np.uint8).reshape(len(field.edits), field.n_groups),
        begin,
        entry_row,
        entry_weight,
        entry_slot,
        slots,
        slot_begin,
        support,
        np.unique(on_instances[:, np.unique(instance[instance >= 0])].T, axis=0),
        np.zeros(gather.n, np.int32),
        np.zeros(gather.n, np.uint8),
    )
    compiled.find_runs()
    return compiled


def _way(bound: BoundEdit) -> Way:
    operation = bound.operation
    if bound.level is Level.VIEW:
        return Way.VIEW
    if bound.level is Level.AGGREGATE:
        return Way.AGGREGATE if bound.edit.blend is Blend.COMPOSE else Way.ALONE
    if operation is None:
        if any(rows is not None and rows.has_offset for rows in bound.rows):
            return Way.ALONE
        return Way.PAIRS if any(rows is not None for rows in bound.rows) else Way.VERSION
    other_incident = operation.uses_incident and type(operation) is not Hsv
    if operation.has_through or (operation.has_offset and (operation.uses_receiver or other_incident)):
        return Way.ALONE
    return Way.PAIRS if operation.uses_receiver or other_incident else Way.VERSION


def _gives_offset(bound: BoundEdit, key: int) -> bool:
    baked = bound.baked[key]
    return bound.operation.has_offset if bound.operation is not None else baked is not None and baked.offset is not None


def _slots(
    rows: list[tuple[int, BoundEdit, int]], way: I64, cells: list[I64], gather: GatherSamples
) -> tuple[F64, I64]:
    """Numbers of all rows, and where those of each begin: one for all of its cells, or one for each."""
    parts: list[F64] = []
    for row, (_, bound, key) in enumerate(rows):
        parts.append(numbers_of(bound, key, gather, cells[row]) if way[row] == Way.VERSION else _IDENTITY)
    begin = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
    return np.concatenate([np.zeros((0, 9)), *parts]), begin


def numbers_of(bound: BoundEdit, key: int, gather: GatherSamples, cells: I64) -> F64:
    """What a row of `Way.VERSION` does: (1, 9), or (len(cells), 9) where it differs between casters."""
    operation = bound.operation
    if isinstance(operation, Hsv):
        names = ("hue", "saturation", "value")
        return np.array([[number(bound.parameters[key], name) for name in names] + [0.0] * 6])
    place = _NOWHERE
    if operation is not None and operation.uses_caster:
        points = gather.points
        place = PairEnd(points.position[cells], points.shading_normal[cells], points.albedo[cells])
    pairs = Pairs(np.zeros((len(place.position), 3), np.float32), _NOWHERE, place)
    found: PairCoefficients = bound.evaluate(key, pairs, None, None)
    values = (found.scale, found.emission, found.offset)
    n = max((len(value) for value in values if value is not None), default=1)
    out = np.zeros((max(n, 1), 9))
    for column, value in enumerate(values):
        if value is not None:
            out[:, 3 * column : 3 * column + 3] = value
    return out
