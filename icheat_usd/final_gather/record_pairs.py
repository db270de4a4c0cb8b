"""Rays of cache records as pairs that a stack is evaluated for one by one: the way for every operation, and slow."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import Ends, weighted
from icheat_usd.edits.field import EditField
from icheat_usd.edits.operations import PairEnd
from icheat_usd.final_gather.gatherer import Gatherer
from icheat_usd.final_gather.irradiance_cache import IrradianceCache, RecordValues
from icheat_usd.final_gather.record_rays import RecordRays, take_rays
from icheat_usd.scene import F32, I32, I64, Bool, SurfacePoints

STEP = 0.1  # of a record's reach, or radians: from how far beside a record a receiver's own part is looked at


class Beside(NamedTuple):
    """Receivers beside some records, and turned at their places, n each."""

    where: PairEnd
    is_moved: bool  #: else turned
    direction: F32  #: (n, 3) of the gradient: that of the move, or the axis of the turn
    step: F32  #: (n, 1) metres, or radians


def places_beside(place: PairEnd, reach: F32, *, with_turns: bool = True) -> list[Beside]:
    """Two moves, and two turns, of n places; `reach` (n,) of the records there."""
    normal = place.normal
    axis = np.eye(3, dtype=np.float32)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(axis, normal)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(normal, first)
    step = np.float32(STEP) * reach[:, None]
    found = []
    for tangent, axis in ((first, second), (second, -first)):
        moved = (place.position + step * tangent).astype(np.float32)
        found.append(Beside(place._replace(position=moved), True, tangent, step))
        if with_turns:
            turned = (normal + np.float32(STEP) * tangent).astype(np.float32)
            turned /= np.linalg.norm(turned, axis=1, keepdims=True)
            found.append(Beside(place._replace(normal=turned), False, axis, np.full_like(step, STEP)))
    return found


class RecordPairs:
    """Rays of some records as pairs of their places and the casters that they end on."""

    def __init__(self, gatherer: Gatherer, rays: RecordRays, points: SurfacePoints) -> None:
        self._field = gatherer.field
        assert gatherer.solution is not None
        self._rays = rays
        self._flat = np.flatnonzero(may_send(self._field, rays.sender.reshape(-1)))
        self._casters = self._field.casters(rays.ends(gatherer.snapshot, self._flat))
        self._receivers = self._field.receivers(points)
        self._located = is_located(self._receivers, self._field)
        self._b, self._sent = gatherer.solution.b, gatherer.solution.sent

    def values(self, rows: I64, records: I64, is_in: Bool, cache: IrradianceCache) -> RecordValues:
        """Changes of the irradiance of records `rows`, where receivers are in these edits, and their gradients.

        `records` are their numbers in the cache.
        """
        masks = np.repeat(is_in.astype(np.float32)[:, None], len(self._rays.stream), axis=1)
        some = take_rays(self._rays, rows)
        values, _ = cache.sums(some, self.change(rows, masks))
        values.by_move[...] *= np.take(cache.shrink, records)[:, None, None]
        # The gradients of hemispheres take what a pair brings as given. What it depends on the receiver is added, by
        # looking from beside it, and from a turned surface, at the same casters.
        place = self._receivers.place
        if place is None:
            return values
        reach = np.zeros(len(place.position), np.float32)
        reach[rows] = np.take(cache.table.reach, records)
        for beside in places_beside(place, reach):
            light, _ = cache.sums(some, self.change(rows, masks, beside.where))
            slope = (light.irradiance - values.irradiance) / beside.step[rows]
            gradient = values.by_move if beside.is_moved else values.by_turn
            gradient += slope[:, :, None] * beside.direction[rows][:, None, :]
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
            sent = seen
            if self._sent is not None:
                sent = np.take(self._sent, np.take(rays.cell.reshape(-1), flat), axis=1)
            changed = weighted(found.scale, sent) - sent.sum(axis=0)
            added = found.emission if self._sent is None else np.zeros_like(changed)
            if len(rays.adjusted):
                entry = np.minimum(np.searchsorted(rays.adjusted, flat), len(rays.adjusted) - 1)
                went = rays.adjusted[entry] == flat
                changed[went] *= rays.throughput[entry[went]]
                added = added.copy()
                added[went] *= rays.way()[entry[went]]
            changed += added
            out.reshape(-1, 3)[flat] = changed
        return out[rows]


def may_send(field: EditField, instance: I32) -> Bool:
    """(n,) whether an edit may have casters on these instances, -1 for none."""
    weights = [casters.on_instances for bound in field.edits for casters in bound.casters]
    selected = np.append(np.stack(weights).any(axis=0), False)
    return np.take(selected, instance)


def is_located(receivers: Ends, field: EditField) -> F32:
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
