"""What edits make of the light of cache records, for each set of edits that a receiver may be in.

A receiver's masks are no part of a record: a hard edge within its reach would be smeared (50 % wrong around the
edge of a painted mask, measured). Pair functions are linear in each receiver mask, so that a record needs the
change of its light for masks of 0 and 1 alone; what lies between is mixed at the camera sample.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icheat_usd.edits.bound import Ends, weighted
from icheat_usd.edits.field import EditField
from icheat_usd.edits.operations import PairEnd
from icheat_usd.final_gather.caster_light import CasterLight, is_of_objects
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup, RecordValues
from icheat_usd.final_gather.record_rays import RecordRays, take_rays
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I32, I64, U8, Bool, SurfacePoints

#: Masks of one receiver between 0 and 1; with more, mixtures would be of more than 16 sets.
MOST_SOFT = 4
_RAYS_AT_ONCE = 1 << 18
_STEP = 0.1  # of a record's reach, or radians: from how far beside a record a receiver's own part is looked at


class EditedRecords:
    """Changes of records' irradiance, found when a camera sample first asks for them.

    Parameters
    ----------
    cache : IrradianceCache
        Its rays are kept.
    by_caster : CasterLight, optional
        Of another stack that tells the same groups of lights apart.
    """

    def __init__(self, gatherer: Gatherer, cache: IrradianceCache, by_caster: CasterLight | None = None) -> None:
        self._gatherer, self._cache = gatherer, cache
        self.by_caster: CasterLight | None = None
        if is_of_objects(gatherer.field):
            assert gatherer.solution is not None
            self.by_caster = by_caster or CasterLight(cache, gatherer.solution)
        self._slots: dict[bytes, np.ndarray] = {}
        self._values = RecordValues(
            np.empty((0, 3), np.float32), np.empty((0, 3, 3), np.float32), np.empty((0, 3, 3), np.float32)
        )

    def change(self, found: Lookup, position: F32, normal: F32, masks: F32) -> F32:
        """Change of irradiance at m places with records.

        Parameters
        ----------
        masks : (n_rows, m) float32
            Receiver masks; no more than `MOST_SOFT` of a place lie between 0 and 1.

        Returns
        -------
        (m, 3) float32
        """
        result = np.zeros((len(position), 3), np.float32)
        mixtures = list(_mixtures(masks))
        wanted: dict[bytes, tuple[Bool, Bool]] = {}
        for is_in, places, _ in mixtures:
            needed = wanted.setdefault(is_in.tobytes(), (is_in, np.zeros(self._cache.n, bool)))[1]
            number = found.number[places]
            entries = np.arange(found.record.shape[1]) < number[:, None]
            needed[found.record[places][entries]] = True
        self._prepare(list(wanted.values()))
        for is_in, places, weight in mixtures:
            part = self._cache.interpolate(
                found.take(places), position[places], normal[places], self._values, self._slots[is_in.tobytes()]
            )
            result[places] += weight[:, None] * part
        return result

    def _prepare(self, wanted: list[tuple[Bool, Bool]]) -> None:
        """Changes of records in some sets of edits; `wanted` are masks (n_rows,) and records (n_records,)."""
        missing = []
        for is_in, needed in wanted:
            slots = self._slots.setdefault(is_in.tobytes(), np.full(self._cache.n, -1, np.int32))
            missing.append((is_in, slots, needed & (slots < 0)))
        every = np.zeros(self._cache.n, bool)
        for _, _, needed in missing:
            every |= needed
        if not every.any():
            return
        cache = self._cache
        n = len(self._values.irradiance)
        total = 0
        for _, slots, needed in missing:
            count = int(needed.sum())
            slots[needed] = n + total + np.arange(count, dtype=np.int32)
            total += count
        if self.by_caster is not None:
            field = self._gatherer.field
            parts = [self.by_caster.change(field, is_in, needed) for is_in, _, needed in missing]
            self._values = RecordValues(*(np.concatenate(c) for c in zip(self._values, *parts, strict=True)))
            return
        shape = (total, 3)
        fresh = RecordValues(np.zeros(shape, np.float32), *(np.zeros((*shape, 3), np.float32) for _ in range(2)))
        share = (1 / np.bincount(cache.owner, minlength=cache.n)).astype(np.float32)
        hemispheres = np.flatnonzero(every[cache.owner])
        at_once = max(1, _RAYS_AT_ONCE // cache.rays.n_rays)
        for begin in range(0, len(hemispheres), at_once):
            chunk = hemispheres[begin : begin + at_once]
            owner = cache.owner[chunk]
            pairs = RecordPairs(self._gatherer, take_rays(cache.rays, chunk), take_points(cache.points, chunk))
            for is_in, slots, needed in missing:
                rows = np.flatnonzero(needed[owner])
                if len(rows):
                    found = pairs.values(rows, owner[rows], is_in, cache)
                    weight = share[owner[rows]]
                    for column, part in zip(fresh, found, strict=True):
                        part *= weight.reshape(-1, *(1,) * (part.ndim - 1))
                        # One hemisphere after another, whichever chunk it is in.
                        np.add.at(column, slots[owner[rows]] - n, part)
        self._values = RecordValues(*(np.concatenate(pair) for pair in zip(self._values, fresh, strict=True)))


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
            if len(rays.detour):
                entry = np.minimum(np.searchsorted(rays.detour, flat), len(rays.detour) - 1)
                went = rays.detour[entry] == flat
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


def soft_masks(masks: F32) -> I64:
    """(m,) how many masks (n_rows, m) of each receiver lie between 0 and 1."""
    found: I64 = ((masks > 0) & (masks < 1)).sum(axis=0)
    return found


def _mixtures(masks: F32) -> Iterator[tuple[Bool, I64, F32]]:
    """Sets of edits (n_rows,) with the receivers (k,) that are in them to a degree (k,), which is given too."""
    hard, soft = masks >= 1, (masks > 0) & (masks < 1)
    first, which = _patterns(np.packbits(np.concatenate([hard, soft]), axis=0))
    order = np.argsort(which, kind="stable")
    begin = np.searchsorted(which[order], np.arange(len(first) + 1))
    for pattern, example in enumerate(first.tolist()):
        places = order[begin[pattern] : begin[pattern + 1]]
        rows = np.flatnonzero(soft[:, example])
        for bits in range(1 << len(rows)):
            is_in = hard[:, example].copy()
            weight = np.ones(len(places), np.float32)
            for k, row in enumerate(rows.tolist()):
                inside = bool(bits >> k & 1)
                is_in[row] = inside
                weight *= masks[row, places] if inside else 1 - masks[row, places]
            if is_in.any():
                yield is_in, places, weight


def _patterns(columns: U8) -> tuple[I64, I64]:
    """Different columns of (k, m) bytes: the first place of each, and which one every place has.

    ``np.unique(columns, axis=1)``, which sorts whole columns, took a quarter of a frame with 64 edits.
    """
    k, m = columns.shape
    words = np.zeros((m, -(-k // 8) * 8), np.uint8)
    words[:, :k] = columns.T
    key = np.zeros(m, np.uint64)
    for word in words.view(np.uint64).T:
        key = (key ^ word) * np.uint64(0x9E3779B97F4A7C15)
        key ^= key >> np.uint64(29)
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    if not (columns == columns[:, first[which]]).all():  # Two patterns share a key.
        _, first, which = np.unique(columns, axis=1, return_index=True, return_inverse=True)
    return first, which.reshape(-1)
