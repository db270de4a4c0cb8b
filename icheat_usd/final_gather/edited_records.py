"""What edits make of the light of cache records, for each set of edits that a receiver may be in.

A receiver's masks are no part of a record: a hard edge within its reach would be smeared (50 % wrong around the
edge of a painted mask, measured). Pair functions are linear in each receiver mask, so that a record needs the
change of its light for masks of 0 and 1 alone; what lies between is mixed at the camera sample.
"""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.bound import Ends, weighted
from icheat_usd.edits.field import EditField
from icheat_usd.edits.mask_stack import is_of_masks
from icheat_usd.edits.operations import PairEnd
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.hemispheres import Hemispheres
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup, RecordValues
from icheat_usd.final_gather.masked_records import MaskedRecords
from icheat_usd.final_gather.receiver_sets import Mixtures, Touched, mixtures_of
from icheat_usd.final_gather.record_rays import RecordRays, take_rays
from icheat_usd.final_gather.row_records import RowRecords
from icheat_usd.final_gather.row_stack import is_of_rows
from icheat_usd.kernels import record_mixtures as kernels
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I32, I64, Bool, SurfacePoints

_STEP = 0.1  # of a record's reach, or radians: from how far beside a record a receiver's own part is looked at


def edited_records(
    gatherer: Gatherer, cache: IrradianceCache, hemispheres: Hemispheres
) -> MaskedRecords | RowRecords | EditedRecords:
    """Changes that a gatherer's stack makes of the light of a cache's records."""
    if is_of_masks(gatherer.field):
        return MaskedRecords(gatherer, cache, hemispheres)
    return (RowRecords if is_of_rows(gatherer.field) else EditedRecords)(gatherer, cache, hemispheres)


class EditedRecords:
    """Changes of records' irradiance, found when a camera sample first asks for them.

    Parameters
    ----------
    hemispheres : Hemispheres
        Rays of the cache's records.
    """

    #: Mixtures are of no more than `MOST_SOFT` masks.
    takes_soft_masks = False

    def __init__(self, gatherer: Gatherer, cache: IrradianceCache, hemispheres: Hemispheres) -> None:
        assert gatherer.solution is not None
        self._gatherer, self._cache, self._hemispheres = gatherer, cache, hemispheres
        self._slots: dict[bytes, I32] = {}
        self._values = _no_values(0)

    def change(self, found: Lookup, points: SurfacePoints, receivers: Touched) -> F32:
        """Change of irradiance at m receivers with records.

        Parameters
        ----------
        found : of all points
        receivers : Touched
            No more than `MOST_SOFT` masks of each lie between 0 and 1.

        Returns
        -------
        (m, 3) float32
        """
        cache, where, which = self._cache, receivers.where, receivers.which
        mixed = mixtures_of(receivers)
        needed = np.zeros((len(mixed.is_in), cache.n), np.uint8)
        kernels.mark_records(found.number, found.record, where, which, mixed.begin, mixed.entry, needed)
        self._prepare(mixed, needed.view(np.bool_))
        slots = [self._slots[is_in.tobytes()] for is_in in mixed.is_in]
        out = np.empty((len(where), 3), np.float32)
        kernels.mix_records(
            cache.table.position,
            cache.table.normal,
            *self._values,
            np.stack(slots) if slots else np.zeros((0, cache.n), np.int32),
            points.position,
            points.shading_normal,
            *found[:3],
            where,
            which,
            *mixed[1:],
            out,
        )
        return out

    def change_alone(self, points: SurfacePoints, rays: Hemispheres, row: I64, receivers: Touched) -> F32:
        """The same at m receivers without records, from hemispheres of their own; `row` (m,) is that of each."""
        own = rays.parts[0].rays
        pairs = RecordPairs(self._gatherer, take_rays(own, row), take_points(points, receivers.where))
        return np.asarray(np.pi * pairs.change(np.arange(len(row)), receivers.ends().masks).mean(axis=1))

    def _prepare(self, mixed: Mixtures, wanted: Bool) -> None:
        """Changes of records in some sets of edits; `wanted` is (n_sets, n_records)."""
        n = len(self._values.irradiance)
        parts, missing = [self._values], []
        for is_in, asked in zip(mixed.is_in, wanted, strict=True):
            slots = self._slots.setdefault(is_in.tobytes(), np.full(self._cache.n, -1, np.int32))
            needed = asked & (slots < 0)
            count = int(needed.sum())
            if count == 0:
                continue
            slots[needed] = n + np.arange(count, dtype=np.int32)
            n += count
            parts.append(_no_values(count))
            missing.append((is_in, needed, parts[-1]))
        if missing:
            self._by_pairs(missing)
        if len(parts) > 1:
            self._values = RecordValues(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    def _by_pairs(self, missing: list[tuple[Bool, Bool, RecordValues]]) -> None:
        """Changes of records ray by ray: sets of edits, the records (n_records,) wanted in each, and their values."""
        cache, hemispheres = self._cache, self._hemispheres
        every = np.zeros(cache.n, np.bool_)
        for _, needed, _ in missing:
            every |= needed
        share = hemispheres.shares()
        for rays, points, owner in hemispheres.chunks():
            some = np.flatnonzero(every[owner])
            if len(some) == 0:
                continue
            owner = owner[some]
            pairs = RecordPairs(self._gatherer, take_rays(rays, some), take_points(points, some))
            for is_in, needed, values in missing:
                rows = np.flatnonzero(needed[owner])
                if len(rows) == 0:
                    continue
                found = pairs.values(rows, owner[rows], is_in, cache)
                place = (np.cumsum(needed) - 1)[owner[rows]]
                for column, part in zip(values, found, strict=True):
                    part *= share[owner[rows]].reshape(-1, *(1,) * (part.ndim - 1))
                    # One hemisphere after another, whichever chunk it is in.
                    np.add.at(column, place, part)


def _no_values(n: int) -> RecordValues:
    return RecordValues(np.zeros((n, 3), np.float32), *(np.zeros((n, 3, 3), np.float32) for _ in range(2)))


class RecordPairs:
    """Rays of some records as pairs of their places and the casters that they end on."""

    def __init__(self, gatherer: Gatherer, rays: RecordRays, points: SurfacePoints) -> None:
        self._field = gatherer.field
        assert gatherer.solution is not None
        self._rays = rays
        self._flat = np.flatnonzero(_may_send(self._field, rays.sender.reshape(-1)))
        self._casters = self._field.casters(rays.ends(gatherer.snapshot, self._flat))
        self._receivers = self._field.receivers(points)
        self._located = _is_located(self._receivers, self._field)
        self._b, self._sent = gatherer.solution.b, gatherer.solution.sent

    def values(self, rows: I64, records: I64, is_in: Bool, cache: IrradianceCache) -> RecordValues:
        """Changes of the irradiance of records `rows`, where receivers are in these edits, and their gradients.

        `records` are their numbers in the cache.
        """
        masks = np.repeat(is_in.astype(np.float32)[:, None], len(self._rays.stream), axis=1)
        some = take_rays(self._rays, rows)
        values, _ = cache.sums(some, self.change(rows, masks))
        values.by_move[...] *= np.take(cache.shrink, records)[:, None, None]
        if not self._field.uses_receiver:
            return values
        # The gradients of hemispheres take what a pair brings as given. What it depends on the receiver is added, by
        # looking from beside it, and from a turned surface, at the same casters.
        place = self._receivers.place
        assert place is not None
        normal = place.normal
        axis = np.eye(3, dtype=np.float32)[np.argmin(np.abs(normal), axis=1)]
        first = np.cross(axis, normal)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(normal, first)
        step = _STEP * np.take(cache.table.reach, records)[:, None]
        for tangent, axis in ((first, second), (second, -first)):
            moved = (place.position + _spread(step, rows, len(normal)) * tangent).astype(np.float32)
            turned = (normal + np.float32(_STEP) * tangent).astype(np.float32)
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            for there, gradient, direction, size in (
                (place._replace(position=moved), values.by_move, tangent, step),
                (place._replace(normal=turned), values.by_turn, axis, np.float32(_STEP)),
            ):
                light, _ = cache.sums(some, self.change(rows, masks, there))
                slope = (light.irradiance - values.irradiance) / size
                gradient += slope[:, :, None] * direction[rows][:, None, :]
        return values

    def change(self, rows: I64, masks: F32, place: PairEnd | None = None) -> F32:
        """Change of the light that rays of records `rows` bring, (k, n_rays, 3).

        Parameters
        ----------
        masks : (n_rows, n) float32
            Of all records as receivers.
        place : PairEnd, optional
            Where the receivers are taken to be.
        """
        rays = self._rays
        inside = np.zeros(len(rays.stream), bool)
        inside[rows] = True
        row = self._flat // rays.n_rays
        reached = inside[row] & ((masks != 0)[:, row] & (self._casters.masks != 0)).any(axis=0)
        touched = np.flatnonzero(reached)
        out = np.zeros((len(rays.stream), rays.n_rays, 3), np.float32)
        if len(touched):
            flat = self._flat[touched]
            receivers = self._receivers._replace(masks=masks * self._located)
            if place is not None:
                receivers = receivers._replace(place=place)
            seen = np.take(self._b, np.take(rays.cell.reshape(-1), flat), axis=1)
            found = self._field.evaluate(seen, receivers.take(row[touched]), self._casters.take(touched))
            if self._sent is None:
                changed = found.light(seen) - seen.sum(axis=0)
            else:
                sent = np.take(self._sent, np.take(rays.cell.reshape(-1), flat), axis=1)
                changed = weighted(found.scale, sent) - sent.sum(axis=0)
            if len(rays.adjusted):
                entry = np.minimum(np.searchsorted(rays.adjusted, flat), len(rays.adjusted) - 1)
                went = rays.adjusted[entry] == flat
                changed[went] *= rays.throughput[entry[went]]
            out.reshape(-1, 3)[flat] = changed
        return out[rows]


def _may_send(field: EditField, instance: I32) -> Bool:
    """(n,) whether an edit may have casters on these instances, -1 for none."""
    weights = [casters.on_instances for bound in field.edits for casters in bound.casters]
    selected = np.append(np.stack(weights).any(axis=0), False)
    return np.take(selected, instance)


def _spread(values: F32, rows: I64, n: int) -> F32:
    """(k, 1) values of some rows among n, 0 elsewhere."""
    out = np.zeros((n, 1), np.float32)
    out[rows] = values
    return out


def _is_located(receivers: Ends, field: EditField) -> F32:
    """(n_rows, n) 0 where sampled rows have none for the receiver, 1 elsewhere and for all other payloads."""
    located = np.ones((field.n_rows, receivers.masks.shape[1]), np.float32)
    row = entry = 0
    for bound in field.edits:
        for rows in bound.rows:
            if rows is not None:
                located[row] = (receivers.located[entry].rows >= 0).any(axis=1)
                entry += 1
            row += 1
    return located
