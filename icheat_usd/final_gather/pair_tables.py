"""What the operations of a stack make of the rays of some cache records, found once for all sets of edits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import BoundEdit, Ends
from icheat_usd.edits.composing import key_shares
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend
from icheat_usd.edits.operations import Level, PairCoefficients, PairEnd, Pairs
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.hemispheres import Hemispheres, Part
from icheat_usd.final_gather.irradiance_cache import RecordValues
from icheat_usd.final_gather.record_pairs import Beside, is_located, may_send, places_beside
from icheat_usd.final_gather.record_rays import RecordRays, concatenate_rays, take_rays
from icheat_usd.kernels.hemisphere_light import HemisphereTable
from icheat_usd.kernels.pair_sums import PairEdits, PairTable, pair_sums
from icheat_usd.kernels.row_edits import ADD, COMPOSE, OVER
from icheat_usd.materials import concatenate_points, take_points
from icheat_usd.scene import F32, I64, U8, Bool

_BLENDS = {Blend.COMPOSE: COMPOSE, Blend.OVER: OVER, Blend.ADD: ADD}
_RAYS_AT_ONCE = 1 << 19
_NOWHERE = np.zeros((1, 3), np.float32)


class _Key(NamedTuple):
    """A key of an edit that acts on pairs."""

    bound: BoundEdit
    number: int  #: among the edit's keys
    row: int  #: of the field's masks
    located: int  #: among the rows that receivers and casters are located in, -1 where it is no rows


class PairStack:
    """The edits of a field that act on pairs, none by the colour of light."""

    def __init__(self, field: EditField) -> None:
        self._keys: list[_Key] = []
        self.edits = [bound for bound in field.edits if bound.level is not Level.VIEW]
        row = located = 0
        for bound in field.edits:
            for number, rows in enumerate(bound.rows):
                if bound.level is not Level.VIEW:
                    self._keys.append(_Key(bound, number, row, -1 if rows is None else located))
                located += rows is not None
                row += 1
        self.operations = [bound.operation for bound in self.edits if bound.operation is not None]
        self.rows = np.array([key.row for key in self._keys], np.int64)
        first = np.cumsum([0, *(bound.n_keys for bound in self.edits)])
        groups = np.zeros((len(self.edits), field.n_groups), np.uint8)
        for one, bound in enumerate(self.edits):
            groups[one] = bound.groups
        self.table = PairEdits(first, np.array([_BLENDS[bound.edit.blend] for bound in self.edits], np.int64), groups)

        self.amounts = np.array([bound.edit.amount for bound in self.edits], np.float32)
        self._edit_of_row = np.full(field.n_rows, -1, np.int64)
        self._edit_of_row[self.rows] = np.repeat(np.arange(len(self.edits)), np.diff(first))

    def alone(self, is_in: Bool) -> int:
        """The edit that acts on pairs with no other beside it, -1 for none; `is_in` (n_rows,)."""
        found = np.unique(self._edit_of_row[is_in])
        found = found[found >= 0]
        return int(found[0]) if len(found) == 1 else -1

    def coefficients(self, receivers: Ends, casters: Ends, row: I64, wanted: F32, beside: list[Beside]) -> _Tables:
        """Of n pairs of receivers `row` and casters; `wanted` (n_rows, n_receivers) is 0 for keys of no matter."""
        n, n_places = len(row), 1 + len(beside)
        weight = np.zeros((len(self._keys), n), np.float32)
        parts: list[tuple[int, int, I64, PairCoefficients]] = []
        for q, key in enumerate(self._keys):
            own = [k.located for k in self._keys if k.bound is key.bound and k.located >= 0]
            share = key_shares(key.bound.at_full_amount, [receivers.located[one] for one in own])[key.number]
            at_receivers = np.asarray(share, np.float32) * wanted[key.row]
            weight[q] = np.take(at_receivers, row) * casters.masks[key.row]
            touched = np.flatnonzero(weight[q])
            if len(touched) == 0:
                continue
            found = _evaluated(key, receivers.place, receivers, casters, row, touched)
            parts.append((0, q, touched, found))
            depends = key.bound.operation is not None and key.bound.operation.uses_receiver
            for place, other in enumerate(beside):
                if depends:
                    found = _evaluated(key, other.where, receivers, casters, row, touched)
                parts.append((1 + place, q, touched, found))
        is_grey = all(_is_grey(found.scale) for *_, found in parts)
        emits = any(found.emission is not None for *_, found in parts)
        change = np.zeros((n_places, len(self._keys), n, 1 if is_grey else 3), np.float32)
        emission = np.zeros((n_places, len(self._keys) if emits else 0, n if emits else 0, 3), np.float32)
        for place, q, touched, found in parts:
            w = weight[q, touched, None]
            change[place, q, touched] = w * (found.scale[:, : change.shape[3]] - np.float32(1))
            if found.emission is not None:
                emission[place, q, touched] = w * found.emission
        return _Tables(weight, change, emission)


class _Tables(NamedTuple):
    """Columns of `PairTable`."""

    weight: F32
    change: F32
    emission: F32


def _evaluated(
    key: _Key, place: PairEnd | None, receivers: Ends, casters: Ends, row: I64, touched: I64
) -> PairCoefficients:
    """Coefficients of some pairs, for receivers that are taken to be somewhere."""
    at = row[touched]
    operation = key.bound.operation
    if place is not None and operation is not None and not operation.uses_normals:
        place = PairEnd(place.position, _NOWHERE, _NOWHERE)
    pairs = Pairs(np.broadcast_to(np.float32(0), (len(touched), 3)), _taken(place, at), _taken(casters.place, touched))
    if key.located < 0:
        return key.bound.evaluate(key.number, pairs, None, None)
    mixture = type(receivers.located[key.located])(*(column[at] for column in receivers.located[key.located]))
    return key.bound.evaluate(key.number, pairs, mixture, casters.located[key.located][touched])


def _taken(place: PairEnd | None, which: I64) -> PairEnd:
    if place is None:
        return PairEnd(_NOWHERE, _NOWHERE, _NOWHERE)
    return PairEnd(*(column if len(column) == 1 else np.take(column, which, axis=0) for column in place))


def _is_grey(scale: F32) -> bool:
    return scale.strides[1] == 0


class PairSums:
    """Rays of some records, and what the stack makes of each; light of records is summed from these.

    Parameters
    ----------
    part : Part
        Of n hemispheres.
    reach, share, shrink : (n,) float32
        Of their records; see `HemisphereTable`.
    wanted : (n_rows, n)
        Masks of the field that will be asked for, of each.
    """

    def __init__(
        self,
        gatherer: Gatherer,
        stack: PairStack,
        part: Part,
        reach: F32,
        share: F32,
        shrink: F32,
        wanted: Bool,
    ) -> None:
        solution = gatherer.solution
        assert solution is not None
        rays, points, self.owner = part
        self._rays, self._stack = rays, stack
        self._sent, self._emits = (solution.b, True) if solution.sent is None else (solution.sent, False)
        field = gatherer.field
        sender = rays.sender.reshape(-1)
        flat = np.flatnonzero(may_send(field, sender))
        casters = _casters(gatherer, stack, rays, flat, np.take(sender, flat))
        receivers = field.receivers(points)
        looks_at_normals = any(one.uses_receiver and one.uses_normals for one in stack.operations)
        self.beside: list[Beside] = []
        if receivers.place is not None:
            self.beside = places_beside(receivers.place, reach, with_turns=looks_at_normals)
        row = flat // rays.n_rays
        found = stack.coefficients(receivers, casters, row, wanted * is_located(receivers, field), self.beside)
        n = len(rays.stream)
        self._table = PairTable(
            np.searchsorted(row, np.arange(n + 1)), (flat - row * rays.n_rays).astype(np.int32), *found
        )
        self._hemispheres = HemisphereTable(
            rays.cell,
            rays.cell,
            rays.distance,
            rays.shading_normal,
            rays.stream,
            np.searchsorted(rays.adjusted, rays.n_rays * np.arange(n + 1)),
            rays.adjusted,
            np.ascontiguousarray(rays.throughput, np.float32),
            rays.way(),
            share,
            shrink,
        )

    def values(self, rows: I64, which: I64, is_in: U8, amounts: F32) -> RecordValues:
        """Change of the irradiance by hemispheres `rows`, for receivers in the set of edits `which` of each.

        Parameters
        ----------
        is_in : (n_sets, n_keys) uint8
        amounts : (n_sets, n_edits) float32
        """
        rays, table = self._rays, self._table
        out = np.empty((len(rows), 3, 7), np.float32)
        beside = np.empty((len(rows), len(self.beside), 3), np.float32)
        pair_sums(
            self._hemispheres, table, self._stack.table, amounts, self._sent, self._emits,
            rays.seed, rays.n_theta, rays.n_phi, rows, which, is_in, out, beside,
        )  # fmt: skip
        values = RecordValues(
            *(np.ascontiguousarray(column) for column in (out[:, :, 0], out[:, :, 1:4], out[:, :, 4:]))
        )
        for number, one in enumerate(self.beside):
            slope = beside[:, number] / one.step[rows]
            gradient = values.by_move if one.is_moved else values.by_turn
            gradient += slope[:, :, None] * one.direction[rows][:, None, :]
        return values


def _casters(gatherer: Gatherer, stack: PairStack, rays: RecordRays, flat: I64, sender: I64) -> Ends:
    """The ends of rays `flat` as casters; of what they are no more than the edits look at."""
    field = gatherer.field
    selections = [casters for bound in field.edits for casters in bound.casters]
    looks_closer = len(stack.operations) < len(stack.edits) or any(
        (one.uses_receiver or one.uses_caster) and one.uses_normals for one in stack.operations
    )
    if looks_closer or not all(casters.constant_on_instances for casters in selections):
        return field.casters(rays.ends(gatherer.snapshot, flat))
    masks = np.stack([np.take(casters.on_instances, sender) for casters in selections]).astype(np.float32)
    return Ends(masks, PairEnd(rays.end_positions(flat), _NOWHERE, _NOWHERE), ())


def batches(hemispheres: Hemispheres, wanted: Bool) -> Iterator[Part]:
    """Hemispheres of some records, (n_records,) flags, many at once but not too many."""
    parts: list[Part] = []
    n = 0
    for rays, points, owner in hemispheres.chunks():
        some = np.flatnonzero(wanted[owner])
        if len(some) == 0:
            continue
        if parts and n + len(some) * rays.n_rays > _RAYS_AT_ONCE:
            yield _joined(parts)
            parts, n = [], 0
        parts.append(Part(take_rays(rays, some), take_points(points, some), owner[some]))
        n += len(some) * rays.n_rays
    if parts:
        yield _joined(parts)


def _joined(parts: list[Part]) -> Part:
    if len(parts) == 1:
        return parts[0]
    rays, points, owner = zip(*parts, strict=True)
    return Part(concatenate_rays(list(rays)), concatenate_points(*points), np.concatenate(owner))
