"""The pair functions of a field at the samples of one view: what is baked, and what bakes are measured against."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.bound import Ends
from icheat_usd.edits.encodings.coding import RowCoder
from icheat_usd.edits.encodings.sampled import KINDS
from icheat_usd.edits.field import EditField
from icheat_usd.edits.operations import PairCoefficients
from icheat_usd.progress import Progress
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, F64, I64, Bool
from icheat_usd.transport import Transport

#: Pairs evaluated at once.
PAIRS_AT_ONCE = 1 << 19

_TEST_LEAVES, _TEST_SAMPLES = 48, 64
_BYTES_AT_ONCE = 48 << 20


class PairSamples:
    """A field at pairs of samples; leaves are those on sides of surfaces that its casters touch."""

    def __init__(
        self,
        field: EditField,
        view: ViewSamples,
        gather: GatherSamples,
        radiance: F32 | None = None,
        transport: Transport | None = None,
    ) -> None:
        self.field, self.view, self.gather = field, view, gather
        if radiance is None and (field.uses_incident or field.aggregates):
            raise ValueError("this field depends on light: give the radiance of the gather samples")
        casters = field.casters(gather.points)
        self.leaves = _whole_slots(gather, np.asarray(np.any(casters.masks > 0, axis=0), np.bool_))
        self.leaf_numbers = np.flatnonzero(self.leaves)
        self.receivers = field.receivers(view.points)
        self.touched: Bool = np.asarray(np.any(self.receivers.masks > 0, axis=0), np.bool_)
        b = np.ones((gather.n, 3), np.float32) if radiance is None else radiance
        self.resolved, self.lost = _resolve(field, self.receivers, casters, b, transport)
        self._casters, self._radiance, self._is_lit = casters, b, radiance is not None
        self.kinds = KINDS if field.has_offset else KINDS[:2]
        self.varies = field.uses_receiver or bool(self.resolved) or field.has_offset
        self.is_product = not self.varies and field.n_rows == 1

    @property
    def n_leaves(self) -> int:
        return len(self.leaf_numbers)

    def on_touched_sides(self) -> Bool:
        """View samples on those sides of surfaces on which any sample is touched."""
        points = self.view.points
        side = 2 * points.instance.astype(np.int64) + points.side
        return np.isin(side, side[self.touched])

    # Rows

    def pairs(self, samples: I64, leaves: I64) -> F32:
        """Values of all pairs, (n_samples, n_leaves, k)."""
        return self.pairs_of(samples, self.leaf_numbers[leaves])

    def pairs_of(self, samples: I64, gather: I64) -> F32:
        """The same for any gather samples."""
        n, m = len(samples), len(gather)
        receivers = self.receivers.take(np.repeat(samples, m))
        casters = self._casters.take(np.tile(gather, n))
        b = np.tile(self._radiance[gather], (n, 1))[None]
        resolved = [PairCoefficients(np.repeat(scale[samples], m, axis=0)) for scale in self.resolved]
        found = self.field.evaluate(b, receivers, casters, resolved)
        parts = [found.scale[0] - np.float32(1), found.emission]
        if len(self.kinds) == 3:
            offset = np.zeros((n * m, 3), np.float32)
            if found.offset_paint is not None:
                offset += found.offset_paint[0]
            if found.offset_diffuse is not None:
                offset += np.repeat(self.view.points.albedo[samples], m, axis=0) * found.offset_diffuse[0]
            parts.append(offset)
        return np.concatenate(parts, axis=1).reshape(n, m, -1)

    def _whole_row(self) -> F32:
        """The row of a receiver with mask 1, (1, n_leaves, k), where rows are products of masks and this."""
        one = self.receivers.take(np.flatnonzero(self.touched)[:1])
        one = one._replace(masks=np.ones_like(one.masks))
        found = self.field.evaluate(self._radiance[self.leaf_numbers][None], one, self._casters.take(self.leaf_numbers))
        return np.concatenate([found.scale[0] - np.float32(1), found.emission], axis=1)[None]

    def _like(self, samples: I64) -> tuple[I64, I64]:
        """One sample for each set of receivers that have the same row, and which set each sample is in."""
        if self.varies:
            return samples, np.arange(len(samples))
        _, first, of = np.unique(self.receivers.masks[:, samples], axis=1, return_index=True, return_inverse=True)
        return samples[first], of.reshape(-1)

    # What is allowed, and what is judged by it

    def test_leaves(self) -> I64:
        """Some leaves by chance, and those on which rows differ most."""
        tests = np.random.default_rng(0).permutation(self.n_leaves)[:_TEST_LEAVES]
        if not self.varies:
            return tests
        touched = np.flatnonzero(self.touched)
        samples = touched[np.random.default_rng(3).permutation(len(touched))[:_TEST_SAMPLES]]
        every = np.arange(self.n_leaves)
        step = max(1, PAIRS_AT_ONCE // self.n_leaves)
        low, high = np.full((self.n_leaves, 3), np.inf), np.full((self.n_leaves, 3), -np.inf)
        for begin in range(0, len(samples), step):
            values = self.pairs(samples[begin : begin + step], every)[:, :, :3]
            low, high = np.minimum(low, values.min(axis=0)), np.maximum(high, values.max(axis=0))
        spread = np.argsort(-(high - low).max(axis=1), kind="stable")[:_TEST_LEAVES]
        return np.unique(np.concatenate([tests, spread]))

    def tolerance(self, tests: I64, epsilon: float) -> F64:
        """Allowed difference of each column: of S as it is, of E and O relative to their largest value."""
        if self.is_product:
            peak = np.abs(self._whole_row()).max(axis=(0, 1))
        else:
            some = np.flatnonzero(self.touched)
            some = some[np.random.default_rng(1).permutation(len(some))[:256]]
            peak = np.abs(self.pairs(some, tests)).max(axis=(0, 1))
        result = np.full(len(peak), epsilon, np.float64)
        for k in range(1, len(self.kinds)):
            # Emission that is lost in what the casters send anyway is rounding of the operation's.
            least = 1e-3 * float(self._radiance.mean()) if self.kinds[k] == "emission" and self._is_lit else 1e-30
            result[3 * k : 3 * k + 3] *= max(float(peak[3 * k : 3 * k + 3].max()), least)
        return result

    def judged(self, tests: I64, allowed: F64, progress: Progress) -> F32:
        """Columns by which view samples are told apart, in units of what is allowed: (n_view, t)."""
        if self.is_product:
            peak = np.abs(self._whole_row()).max(axis=(0, 1)) / allowed
            return (self.receivers.masks[0] * np.float32(peak.max()))[:, None]
        touched = np.flatnonzero(self.touched)
        like, of = self._like(touched)
        columns = np.unique(self.alike_columns(tests))
        columns = columns[columns >= 0] if (columns >= 0).any() else np.zeros(1, np.int64)
        tests = tests[:: len(columns)]  # as many numbers for a coloured edit as for a grey one
        step = max(1, PAIRS_AT_ONCE // len(tests))
        found = np.empty((len(like), len(tests) * len(columns)), np.float32)
        for begin in range(0, len(like), step):
            part = self.pairs(like[begin : begin + step], tests)[:, :, columns] / allowed[columns].astype(np.float32)
            found[begin : begin + step] = part.reshape(len(part), -1)
            progress("judge rows", begin / len(like))
        values = np.zeros((self.view.n, found.shape[1]), np.float32)
        values[touched] = found[of]
        return values

    def alike_columns(self, tests: I64) -> I64:
        """An equal column of each of S, E and O, -1 where it is 0, as far as some samples tell."""
        some = np.flatnonzero(self.touched)
        some = some[np.random.default_rng(4).permutation(len(some))[:256]]
        values = self.pairs(some, tests).reshape(-1, 3 * len(self.kinds))
        alike = np.full(values.shape[1], -1, np.int64)
        for column in np.flatnonzero(values.any(axis=0)):
            equal = [c for c in range(column) if alike[c] == c and np.array_equal(values[:, column], values[:, c])]
            alike[column] = equal[0] if equal else column
        return alike

    def code(self, coder: RowCoder, sites: I64, progress: Progress) -> tuple[I64, F32]:
        """Code the rows of the sites: row of each (-1: identity), and its factor."""
        touched = self.touched[sites]
        row, factor = np.full(len(sites), -1, np.int64), np.ones(len(sites), np.float32)
        if self.is_product:
            coder.add(self._whole_row())
            row[touched] = 0
            return row, np.where(touched, self.receivers.masks[0, sites], 1).astype(np.float32)
        like, of = self._like(sites[touched])
        row[touched] = of
        every = np.arange(self.n_leaves)
        at_once = max(
            1, min(_BYTES_AT_ONCE // (4 * self.n_leaves * 3 * len(self.kinds)), PAIRS_AT_ONCE // self.n_leaves)
        )
        for begin in range(0, len(like), at_once):
            progress("bake rows", begin / len(like))
            coder.add(self.pairs(like[begin : begin + at_once], every))
        progress("bake rows", 1.0)
        return row, factor


def _whole_slots(gather: GatherSamples, edited: Bool) -> Bool:
    """All leaves of the sides of surfaces on which any leaf is edited."""
    begin = gather.locator.table.slot_begin.astype(np.int64)
    any_edited = np.maximum.reduceat(edited.astype(np.uint8), begin[:-1]) > 0
    return np.repeat(any_edited, np.diff(begin))


def _resolve(
    field: EditField, receivers: Ends, casters: Ends, b: F32, transport: Transport | None
) -> tuple[tuple[F32, ...], float]:
    """Scale (n_view, 3) of each aggregate, and the most radiance that no scale can give, which rows do not hold."""
    if not field.aggregates:
        return (), 0.0
    if transport is None:
        raise ValueError("this field looks at aggregates: give the transport to the view samples")
    resolved, lost = [], 0.0
    for aggregate in field.aggregates:
        light = transport.to_view(casters.masks[aggregate.row][:, None] * b)
        scale, added = field.resolve(aggregate, light)
        resolved.append(scale)
        lost = max(lost, float((receivers.masks[aggregate.row][:, None] * np.abs(added)).max(initial=0.0)))
    return tuple(resolved), lost
