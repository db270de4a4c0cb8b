"""Direct-to-indirect relighting with edits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from icheat_usd.edits.field import EditField
from icheat_usd.errors import SampleSetMismatch
from icheat_usd.progress import Progress, silent
from icheat_usd.relight.editing import LitCasters, edit_view
from icheat_usd.relight.receivers import Receivers, behind_occluders, group_receivers
from icheat_usd.relight.view_light import light_view
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, SceneSnapshot
from icheat_usd.tracing import Tracer
from icheat_usd.transport import CellLight, HeldBack, Transport, sum_groups, sum_lights


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
    held_back: HeldBack | None = None  #: needed by edits that let light pass occluders

    def radiance(self, gains: F32 | None = None) -> F32:
        """Light `b` that leaves each gather cell, (n_gather, 3); `gains` (n_lights, 3) multiply the lights."""
        return _weighted_sum(self.cell_light.radiance, gains)

    def receivers(self, field: EditField) -> Receivers:
        """What `relight` needs to know about where the edits land; keep it while only amounts or lights change."""
        receivers = group_receivers(field, self.view)
        return behind_occluders(field, receivers, self.held_back)

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
        edited = edit_view(self.transport, self._lit(field, b, gains), field, receivers, indirect)
        return RelitView(direct, indirect, edited)

    def _lit(self, field: EditField, b: F32, gains: F32 | None) -> LitCasters:
        by_group = b[None]
        if field.n_groups > 1:
            per_light = self.cell_light.radiance
            per_light = per_light if gains is None else per_light * gains[:, None, :]
            by_group = sum_groups(per_light, field.light_group, field.n_groups)
        return LitCasters(field.casters(self.gather.points), by_group, self.gather.area, self.view.points.albedo)


def _weighted_sum(per_light: F32, gains: F32 | None) -> F32:
    """Sum over lights, in their order, of (n_lights, n, 3) arrays."""
    if gains is not None and gains.shape != (len(per_light), 3):
        raise SampleSetMismatch(
            f"gains have shape {gains.shape}, expected one colour for each of {len(per_light)} lights"
        )
    return sum_lights(per_light if gains is None else per_light * gains[:, None, :])


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
    light_samples, dome_samples : int
        See `light_view`.
    """
    direct = light_view(
        snapshot,
        tracer,
        view,
        light_samples=light_samples,
        dome_samples=dome_samples,
        seed=seed,
        progress=progress,
    )
    held_back = HeldBack(snapshot, tracer, view, gather, transport, progress)
    return Relighter(view, gather, transport, direct, cell_light, held_back)
