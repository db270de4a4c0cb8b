"""Edited indirect light of view samples from transport rows: group by group, or pair by pair."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.bound import Aggregate, Ends
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend
from icheat_usd.edits.offsets import OffsetCasters, offset_casters, offset_sums
from icheat_usd.edits.operations import Level
from icheat_usd.edits.pairs import PAIRS_AT_ONCE, PairLight, arriving, edited_light
from icheat_usd.kernels.relight import multiply_rows
from icheat_usd.relight.receivers import ReceiverGroup, Receivers
from icheat_usd.scene import F32, I32, I64
from icheat_usd.transport import Lobe, SparseRows, Transport

ONE = np.float32(1)


class LitCasters(NamedTuple):
    """The gather samples as lit now, and what receivers make of offsets."""

    ends: Ends
    b: F32  #: (G, n_gather, 3) radiance that leaves them, by group of lights
    area: F32  #: (n_gather,) square metres
    albedo: F32  #: (n_view, 3) of the view samples


def edit_view(transport: Transport, lit: LitCasters, field: EditField, receivers: Receivers, indirect: F32) -> F32:
    """Edited indirect radiance of all view samples, (n_view, 3); untouched ones keep the bits of `indirect`."""
    edited = indirect.copy()
    light = np.take(indirect, receivers.samples, axis=0)
    edit_samples(transport, lit, field, receivers, light)
    edited[receivers.samples] = field.finish(light, receivers.ends)
    return edited


def edit_samples(transport: Transport, lit: LitCasters, field: EditField, receivers: Receivers, light: F32) -> None:
    """Replace the `light` (n, 3) of the receivers that edits of pairs and aggregates reach; views do not act yet."""
    offsets = offset_casters(field, lit.ends, lit.b, lit.area)
    for group in receivers.groups:
        shared = _SharedReceivers(transport, lit, field, receivers, group, offsets)
        light[group.where] = shared.light() if group.last is None else shared.light_with_last()
    for where in _chunks(transport, receivers):
        samples = receivers.samples[where]
        blocks = _blocks(transport, lit, receivers, samples)
        light[where] = edited_light(field, receivers.ends.take(where), blocks, offsets, lit.albedo[samples])


def unedited_samples(transport: Transport, samples: I64, radiance: F32) -> F32:
    """Light of some view samples from (n_gather, 3) radiance: (n, 3)."""
    light = np.zeros((len(samples), 3), np.float32)
    _add_products(transport.lobes, transport.interpolation, samples, radiance, light)
    return light


# Groups ---------------------------------------------------------------------------------------------------------------


class _SharedReceivers:
    """View samples for which one edited copy of the casters' radiance serves all."""

    def __init__(
        self,
        transport: Transport,
        lit: LitCasters,
        field: EditField,
        receivers: Receivers,
        group: ReceiverGroup,
        offsets: OffsetCasters | None,
    ) -> None:
        self.transport, self.lit, self.field, self.offsets = transport, lit, field, offsets
        self.held_back = receivers.held_back
        self.samples = receivers.samples[group.where]
        self.last = group.last
        self.ends = receivers.ends.take(group.where[:1])
        self.masks = None if group.last is None else receivers.ends.masks[field.rows_of(group.last)][:, group.where]

    def light_with_last(self) -> F32:
        """Light where the samples differ in their masks of `last`, in which it is linear."""
        assert self.last is not None and self.masks is not None
        bound = self.field.edits[self.last]
        rows = self.field.rows_of(self.last)
        below = self.light(upto=self.last)
        result = below.copy()
        for key, row in enumerate(range(rows.start, rows.stop)):
            mask = self.masks[key][:, None]
            if bound.level is Level.AGGREGATE:
                assert bound.edit.blend is Blend.COMPOSE
                aggregate = Aggregate(self.last, key, row, upto=self.last)
                seen = self.light(upto=aggregate.upto, aggregate=aggregate)
                scale, added = self.field.resolve(aggregate, seen)
                weight = np.float32(bound.edit.amount * bound.key_weights[key]) * mask
                result += weight * ((scale - ONE) * seen + np.where(self.reach(row) > 0, added, np.float32(0)))
            else:
                masks = self.ends.masks.copy()
                masks[rows] = 0
                masks[row] = 1
                result += mask * (self.light(self.ends._replace(masks=masks)) - below)
        return result

    def reach(self, row: int) -> F32:
        """Transport from the casters of one row of the masks, weighted by these: (n, 3)."""
        weight = np.repeat(self.lit.ends.masks[row][:, None], 3, axis=1)
        result = np.zeros((len(self.samples), 3), np.float32)
        _add_products(self.transport.lobes, self.transport.interpolation, self.samples, weight, result)
        return result

    def light(self, ends: Ends | None = None, upto: int | None = None, aggregate: Aggregate | None = None) -> F32:
        """Light of the samples under their masks, or under those of `ends`."""
        ends = self.ends if ends is None else ends
        lit, field = self.lit, self.field
        coefficients = field.evaluate(lit.b, ends, lit.ends, upto=upto)
        result = np.zeros((len(self.samples), 3), np.float32)
        changed = arriving(field, coefficients, lit.b, ONE, lit.ends, None, aggregate)
        assert changed is not None
        _add_products(self.transport.lobes, self.transport.interpolation, self.samples, changed, result)
        for slot, lobes in enumerate(self.held_back):
            passed = arriving(field, coefficients, lit.b, ONE, lit.ends, slot, aggregate)
            if passed is not None:
                _add_products(lobes, self.transport.interpolation, self.samples, passed, result)
        if self.offsets is not None:
            diffuse, paint = offset_sums(field, self.offsets, ends, np.zeros(1, np.int64), (), upto, aggregate)
            result += lit.albedo[self.samples] * diffuse.astype(np.float32) + paint.astype(np.float32)
        return result


def _add_products(
    lobes: Sequence[Lobe], interpolation: SparseRows | None, samples: I64, radiance: F32, out: F32
) -> None:
    for lobe in lobes:
        out += lobe.tint[samples] * _rows_at(lobe.rows, interpolation, samples, radiance)


def _rows_at(rows: SparseRows, interpolation: SparseRows | None, samples: I64, b: F32) -> F32:
    """Products of the (interpolated) rows of some view samples with `b`: (n, 3)."""
    out = np.empty((len(samples), 3), np.float32)
    if interpolation is None:
        multiply_rows(rows.indptr, rows.indices, rows.weights, samples, b, out)
        return out
    _, used, _ = _row_entries(interpolation, samples)
    used = np.unique(used)
    at_rows = np.zeros((rows.n_rows, 3), np.float32)
    products = np.empty((len(used), 3), np.float32)
    multiply_rows(rows.indptr, rows.indices, rows.weights, used.astype(np.int64), b, products)
    at_rows[used] = products
    multiply_rows(interpolation.indptr, interpolation.indices, interpolation.weights, samples, at_rows, out)
    return out


# Pairs ----------------------------------------------------------------------------------------------------------------


def _chunks(transport: Transport, receivers: Receivers) -> Iterator[I64]:
    """Positions of single samples, as many at once as have at most `PAIRS_AT_ONCE` pairs."""
    single = receivers.single
    if len(single) == 0:
        return
    counts = np.zeros(len(single), np.int64)
    for lobes in (transport.lobes, *receivers.held_back):
        for _, rows in _shared_columns(lobes):
            counts += _entry_counts(rows[0], transport.interpolation, receivers.samples[single])
    before = np.cumsum(counts) - counts
    chunk = before // (PAIRS_AT_ONCE // 2)
    yield from np.split(single, np.flatnonzero(np.diff(chunk)) + 1)


def _entry_counts(rows: SparseRows, interpolation: SparseRows | None, samples: I64) -> I64:
    per_row = np.diff(rows.indptr)
    if interpolation is None:
        return per_row[samples]
    owner, row, _ = _row_entries(interpolation, samples)
    return np.bincount(owner, per_row[row], len(samples)).astype(np.int64)


def _blocks(transport: Transport, lit: LitCasters, receivers: Receivers, samples: I64) -> list[PairLight]:
    """Everything that the samples receive, as pairs."""
    blocks = []
    for through, lobes in ((None, transport.lobes), *enumerate(receivers.held_back)):
        for members, rows in _shared_columns(lobes):
            owner, place, share = _entries(rows[0], transport.interpolation, samples)
            if len(owner) == 0:
                continue
            cell = rows[0].indices[place].astype(np.int64)
            weight = np.zeros((len(owner), 3), np.float32)
            for lobe, matrix in zip(members, rows, strict=True):
                tint = np.take(lobe.tint[samples], owner, axis=0)
                weight += tint * (share * matrix.weights[place])[:, None]
            b = np.take(lit.b, cell, axis=1)
            blocks.append(PairLight(owner, lit.ends.take(cell), b, weight * b, weight, through))
    return blocks


def _shared_columns(lobes: Sequence[Lobe]) -> list[tuple[list[Lobe], list[SparseRows]]]:
    """Lobes that stand on the same rays, and so on the same pairs, together."""
    found: list[tuple[list[Lobe], list[SparseRows]]] = []
    for lobe in lobes:
        for members, rows in found:
            if rows[0].indices is lobe.rows.indices:
                members.append(lobe)
                rows.append(lobe.rows)
                break
        else:
            found.append(([lobe], [lobe.rows]))
    return found


def _row_entries(rows: SparseRows, which: I64) -> tuple[I64, I32, F32]:
    """Entries of some rows: position in `which`, column and weight of each."""
    owner, place = _row_places(rows, which)
    return owner, rows.indices[place], rows.weights[place]


def _row_places(rows: SparseRows, which: I64) -> tuple[I64, I64]:
    begin = rows.indptr[which]
    counts = rows.indptr[which + 1] - begin
    owner = np.repeat(np.arange(len(which)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(begin, counts)


def _entries(rows: SparseRows, interpolation: SparseRows | None, samples: I64) -> tuple[I64, I64, F32]:
    """Entries of the (interpolated) rows of some view samples: position in `samples`, place in `rows`, share."""
    if interpolation is None:
        owner, place = _row_places(rows, samples)
        return owner, place, np.ones(len(owner), np.float32)
    owner, row, share = _row_entries(interpolation, samples)
    position, place = _row_places(rows, row.astype(np.int64))
    return owner[position], place, share[position]
