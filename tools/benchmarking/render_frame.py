"""One frame of the final gather from a snapshot, and what its parts took."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

from icheat_usd.edits.binding import bind
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import EMPTY_STACK, EditStack
from icheat_usd.final_gather import FinalGather, final_gather
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, F64, SceneSnapshot
from icheat_usd.session.shot_parts import ShotParts
from icheat_usd.tracing import Tracer
from tools.benchmarking.render_efforts import RenderEffort


class Frame:
    """A scene that is rendered with one effort; what all renders of it share is made once.

    Attributes
    ----------
    light_seconds : float
        What the light that leaves the gather samples took, 0 where the method takes none.
    """

    def __init__(self, snapshot: SceneSnapshot, effort: RenderEffort) -> None:
        self.snapshot, self.effort = snapshot, effort
        self._parts = ShotParts(effort.quality, snapshot=snapshot)
        self.light_seconds = 0.0

    @property
    def tracer(self) -> Tracer:
        return self._parts.tracer

    @property
    def view(self) -> ViewSamples:
        return self._parts.view

    @property
    def gather(self) -> GatherSamples:
        return self._parts.gather

    @cached_property
    def cell_radiance(self) -> F32:
        """Light that leaves the gather samples, by light."""
        _ = self.tracer
        start = time.perf_counter()
        radiance = self._parts.cell_light.radiance
        self.light_seconds = time.perf_counter() - start
        return radiance

    def field(self, stack: EditStack = EMPTY_STACK) -> EditField:
        """A stack that knows the scene."""
        return bind(stack, self.snapshot)

    def render(self, field: EditField, *, is_kept: bool = False) -> tuple[FinalGather, float]:
        """The frame before denoising, and the seconds that it took with all that it needs but the tracer."""
        is_lit = self.effort.settings.uses_cells or field.uses_incident or field.has_offset
        _ = self.tracer
        start = time.perf_counter()
        gather, radiance = (self.gather, self.cell_radiance) if is_lit else (None, None)
        found = final_gather(
            self.snapshot,
            self.tracer,
            field,
            settings=self.effort.settings,
            gather=gather,
            gather_radiance=radiance,
            sampler=self._parts.light_sampler if self.effort.settings.method == "gathered" else None,
            is_kept=is_kept,
        )
        return found, time.perf_counter() - start


def replay(frame: Frame, stack: EditStack) -> Callable[[EditStack], F64] | None:
    """What makes the indirect light of a frame again under other stacks; None if its method keeps nothing."""
    kept = frame.render(frame.field(stack), is_kept=True)[0].replay
    return None if kept is None else lambda changed: kept.edited(bind(changed, frame.snapshot, kept.known))


def warm(snapshot: SceneSnapshot, effort: RenderEffort, stack: EditStack = EMPTY_STACK) -> None:
    """Compile, or load, all that a render of this kind runs, on a tiny image."""
    camera = replace(snapshot.camera, width=32, height=24)
    quality = replace(effort.quality, n_gather=min(512, effort.quality.n_gather), rays_per_bounce_row=16)
    frame = Frame(replace(snapshot, camera=camera), RenderEffort(effort.settings, quality))
    frame.render(frame.field(stack))
