"""Direct-to-indirect relighting with edits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icheat_usd.edits.field import EditField, StackCoefficients
from icheat_usd.edits.offsets import offset_radiance
from icheat_usd.errors import SampleSetMismatch
from icheat_usd.kernels.relight import multiply_rows
from icheat_usd.lighting import build_light_sampler, reflected_direct, samples_per_light
from icheat_usd.progress import Progress, silent
from icheat_usd.relight.receivers import Receivers, group_receivers
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, I32, I64, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport import CellLight, SparseRows, Transport, sum_lights

#: View samples evaluated pair by pair at once; bounds the memory of a relight.
SAMPLES_AT_ONCE = 4096


class RelitView(NamedTuple):
    """Radiance that the view samples send to the eye, (n_view, 3) each, scene-linear."""

    direct: F32
    indirect: F32
    indirect_edited: F32


@dataclass(frozen=True, eq=False)
class Relighter:
    """One view of one scene, ready to be relit.

    Limits: the lights' positions are those of the snapshot; colours and
    intensities change through `gains`.
    """

    view: ViewSamples
    gather: GatherSamples
    transport: Transport
    view_direct: F32  #: (n_lights, n_view, 3) reflected direct light
    cell_light: CellLight

    def radiance(self, gains: F32 | None = None) -> F32:
        """Light `b` that leaves each gather cell, (n_gather, 3); `gains` (n_lights, 3) multiply the lights."""
        return _weighted_sum(self.cell_light.radiance, gains)

    def receivers(self, field: EditField) -> Receivers:
        """What `relight` needs to know about where the edits land; keep it while only amounts or lights change."""
        return group_receivers(field, self.view)

    def relight(self, field: EditField, gains: F32 | None = None, receivers: Receivers | None = None) -> RelitView:
        """Light of every view sample under the edits.

        Parameters
        ----------
        field : EditField
            The stack, bound to this relighter's scene.
        gains : (n_lights, 3) float32, optional
            Factor per light and channel.
        receivers : Receivers, optional
            Result of `receivers` for this field, to save finding it again.

        Returns
        -------
        RelitView
            `indirect_edited` is `indirect`, the same bits, wherever no receiver mask is above 0.
        """
        b = self.radiance(gains)
        indirect = self.transport.to_view(b)
        direct = _weighted_sum(self.view_direct, gains)
        if field.is_identity:
            return RelitView(direct, indirect, indirect)
        receivers = receivers or self.receivers(field)
        casters = field.caster_masks(self.gather.points)
        edited = indirect.copy()
        for group in receivers.groups:
            coefficients = field.evaluate(b, group.masks[:, None], casters)
            edited[group.samples] = self._edited_group(coefficients, b, group.samples)
            if field.has_offset:
                masks = np.repeat(group.masks[:, None], len(group.samples), axis=1)
                edited[group.samples] += self._offsets(field, b, group.samples, masks, casters)
        for begin in range(0, len(receivers.single), SAMPLES_AT_ONCE):
            some = slice(begin, begin + SAMPLES_AT_ONCE)
            samples = receivers.single[some]
            masks = receivers.single_masks[:, some]
            edited[samples] = self._edited_singles(field, b, samples, masks, casters)
            if field.has_offset:
                edited[samples] += self._offsets(field, b, samples, masks, casters)
        # Once, at the end: a weaker edit's negative light may be lifted by a stronger one.
        return RelitView(direct, indirect, np.maximum(edited, np.float32(0)))

    def _offsets(self, field: EditField, b: F32, samples: I64, masks: F32, casters: F32) -> F32:
        return offset_radiance(field, b, self.gather.area, masks, casters, self.view.points.albedo[samples])

    def _edited_group(self, coefficients: StackCoefficients, b: F32, samples: I64) -> F32:
        changed = coefficients.scale * b + coefficients.emission
        result = np.zeros((len(samples), 3), np.float32)
        for lobe in self.transport.lobes:
            result += lobe.tint[samples] * _rows_at(lobe.rows, self.transport.interpolation, samples, changed)
        return result

    def _edited_singles(self, field: EditField, b: F32, samples: I64, masks: F32, casters: F32) -> F32:
        """Pair by pair over the entries of the samples' rows."""
        result = np.zeros((len(samples), 3), np.float32)
        for lobe in self.transport.lobes:
            owner, cell, weight = _entries(lobe.rows, self.transport.interpolation, samples)
            coefficients = field.evaluate(b[cell], masks[:, owner], casters[:, cell])
            light = weight[:, None] * (coefficients.scale * b[cell] + coefficients.emission)
            result += lobe.tint[samples] * _sum_by(owner, light, len(samples))
        return result


def _weighted_sum(per_light: F32, gains: F32 | None) -> F32:
    """Sum over lights, in their order, of (n_lights, n, 3) arrays."""
    if gains is not None and gains.shape != (len(per_light), 3):
        raise SampleSetMismatch(
            f"gains have shape {gains.shape}, expected one colour for each of {len(per_light)} lights"
        )
    return sum_lights(per_light if gains is None else per_light * gains[:, None, :])


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


def _row_entries(rows: SparseRows, which: I64) -> tuple[I64, I32, F32]:
    """Entries of some rows: position in `which`, column and weight of each."""
    begin = rows.indptr[which]
    counts = rows.indptr[which + 1] - begin
    owner = np.repeat(np.arange(len(which)), counts)
    place = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(begin, counts)
    return owner, rows.indices[place], rows.weights[place]


def _entries(rows: SparseRows, interpolation: SparseRows | None, samples: I64) -> tuple[I64, I32, F32]:
    """Entries of the (interpolated) rows of some view samples: position in `samples`, column and weight of each."""
    if interpolation is None:
        return _row_entries(rows, samples)
    owner, row, share = _row_entries(interpolation, samples)
    position, cell, weight = _row_entries(rows, row.astype(np.int64))
    return owner[position], cell, weight * share[position]


def _sum_by(owner: I64, values: F32, n: int) -> F32:
    """Sum (m, 3) values by owner, (n, 3); serial and in float64."""
    sums = [np.bincount(owner, values[:, channel], n) for channel in range(3)]
    return np.stack(sums, axis=1).astype(np.float32)


def build_relighter(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    view: ViewSamples,
    gather: GatherSamples,
    transport: Transport,
    cell_light: CellLight,
    *,
    light_samples: int = 16,
    dome_samples: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Relighter:
    """Light the view samples and put the parts together.

    Parameters
    ----------
    light_samples : int
        Shadow rays per light and view sample.
    dome_samples : int, optional
        The same for domes; four times `light_samples` by default.
    """
    progress("light the view samples", 0.0)
    sampler = build_light_sampler(snapshot, tracer, view.points, seed)
    counts = samples_per_light(snapshot, light_samples, dome_samples)
    direct = reflected_direct(snapshot, tracer, sampler, view.points, view.to_eye, seed, counts)
    progress("light the view samples", 1.0)
    return Relighter(view, gather, transport, direct, cell_light)
