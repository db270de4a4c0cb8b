"""What edits make of the light of cache records, for each set of edits that a receiver may be in.

A receiver's masks are no part of a record: a hard edge within its reach would be smeared (50 % wrong around the
edge of a painted mask, measured). Pair functions are linear in each receiver mask, so that a record needs the
change of its light for masks of 0 and 1 alone; what lies between is mixed at the camera sample.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icheat_usd.edits.bound import Ends
from icheat_usd.edits.field import EditField
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, Lookup, RecordValues
from icheat_usd.final_gather.record_rays import RecordRays, take_rays
from icheat_usd.materials import take_points
from icheat_usd.scene import F32, I64, Bool, SurfacePoints

#: Masks of one receiver between 0 and 1; with more, mixtures would be of more than 16 sets.
MOST_SOFT = 4
_RAYS_AT_ONCE = 1 << 18


class EditedRecords:
    """Changes of records' irradiance, found when a camera sample first asks for them.

    Parameters
    ----------
    cache : IrradianceCache
        Its rays are kept.
    """

    def __init__(self, gatherer: Gatherer, cache: IrradianceCache) -> None:
        self._gatherer, self._cache = gatherer, cache
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
        records = np.flatnonzero(every)
        if len(records) == 0:
            return
        cache = self._cache
        rays = cache.rays
        parts = [self._values]
        n = len(self._values.irradiance)
        at_once = max(1, _RAYS_AT_ONCE // rays.n_rays)
        for begin in range(0, len(records), at_once):
            chunk = records[begin : begin + at_once]
            pairs = _RecordPairs(self._gatherer, take_rays(rays, chunk), take_points(cache.points, chunk))
            for is_in, slots, needed in missing:
                rows = np.flatnonzero(needed[chunk])
                if len(rows) == 0:
                    continue
                brought = pairs.change(rows, is_in)
                values, _ = self._cache.sums(take_rays(pairs.rays, rows), brought)
                slots[chunk[rows]] = n + np.arange(len(rows), dtype=np.int32)
                n += len(rows)
                parts.append(values)
        self._values = RecordValues(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class _RecordPairs:
    """Rays of some records as pairs of their places and the casters that they end on."""

    def __init__(self, gatherer: Gatherer, rays: RecordRays, points: SurfacePoints) -> None:
        self._field = gatherer.field
        assert gatherer.solution is not None
        self.rays = rays
        self._flat = np.flatnonzero(rays.cell.reshape(-1) >= 0)
        self._casters = self._field.casters(rays.ends(gatherer.snapshot, self._flat))
        self._receivers = self._field.receivers(points)
        self._b = gatherer.solution.b

    def change(self, rows: I64, is_in: Bool) -> F32:
        """Change of the light that rays of records `rows` bring, (n, n_rays, 3), where receivers are in these edits."""
        n_rays = self.rays.n_rays
        inside = np.zeros(len(self.rays.stream), bool)
        inside[rows] = True
        row = self._flat // n_rays
        touched = np.flatnonzero(inside[row] & (self._casters.masks[is_in] != 0).any(axis=0))
        out = np.zeros((len(self.rays.stream), n_rays, 3), np.float32)
        if len(touched):
            flat = self._flat[touched]
            masks = np.repeat(is_in.astype(np.float32)[:, None], len(inside), axis=1)
            masks *= _is_located(self._receivers, self._field)
            receivers = self._receivers._replace(masks=masks).take(row[touched])
            seen = np.take(self._b, np.take(self.rays.cell.reshape(-1), flat), axis=1)
            found = self._field.evaluate(seen, receivers, self._casters.take(touched))
            changed = found.light(seen) - seen.sum(axis=0)
            if len(self.rays.detour):
                place = np.searchsorted(self.rays.detour, flat)
                place = np.minimum(place, len(self.rays.detour) - 1)
                went = self.rays.detour[place] == flat
                changed[went] *= self.rays.throughput[place[went]]
            out.reshape(-1, 3)[flat] = changed
        return out[rows]


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
    _, first, which = np.unique(
        np.packbits(np.concatenate([hard, soft]), axis=0), axis=1, return_index=True, return_inverse=True
    )
    for pattern, example in enumerate(first.tolist()):
        places = np.flatnonzero(which.reshape(-1) == pattern)
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
