"""What a preview is made of, for suites that look at it from inside."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.edits.model import EditStack
from icheat_usd.relight.lights import LiveLights
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.relight.rest_weights import FitSource
from icheat_usd.samples import GatherSamples, ViewSamples
from icheat_usd.scene import F32, LightKind, SceneSnapshot
from icheat_usd.session.document import Session
from icheat_usd.session.frames import SharedParts
from icheat_usd.session.quality import PREVIEW, Quality
from icheat_usd.session.shot_parts import ShotParts
from icheat_usd.tracing import Tracer
from icheat_usd.transport import Transport
from icheat_usd.transport.packed import PackedTransport
from icheat_usd.transport.packing import pack
from tools.benchmarking.stage_names import short_name

AREA_KINDS = (LightKind.SPHERE, LightKind.DISK, LightKind.RECT, LightKind.CYLINDER)


@dataclass(frozen=True)
class Effort:
    """Size and quality of what is measured; None leaves the preview's own setting."""

    width: int = 640
    height: int = 480
    n_gather: int | None = None
    quality: str = "LIVE"  #: name of a quality of `icheat_usd.session`
    changes: tuple[tuple[str, Any], ...] = ()  #: to settings of that quality

    def settings(self) -> Quality:
        import icheat_usd.session.quality as qualities

        quality: Quality = replace(getattr(qualities, self.quality, PREVIEW), **dict(self.changes))
        return quality if self.n_gather is None else replace(quality, n_gather=self.n_gather)


class Parts:
    """One stage, ready to be relit; each part is made when it is first asked for.

    Parameters
    ----------
    snapshot : SceneSnapshot, optional
        In place of the stage's own, such as one under other lights.
    """

    def __init__(self, stage: str | Path, effort: Effort, snapshot: SceneSnapshot | None = None) -> None:
        self.name = short_name(str(stage))
        self.effort = effort
        self.session = Session.open(stage, width=effort.width, height=effort.height, quality=effort.settings())
        self.snapshot = self.session.snapshot if snapshot is None else snapshot
        self._memory = SharedParts()
        self._shot = ShotParts(effort.settings(), snapshot=self.snapshot, memory=self._memory)

    def under(self, snapshot: SceneSnapshot) -> Parts:
        """The same stage with other lights; what does not depend on them is shared."""
        other = Parts.__new__(Parts)
        other.name, other.effort, other.session, other.snapshot = self.name, self.effort, self.session, snapshot
        other._memory = self._memory
        other._shot = ShotParts(self.effort.settings(), snapshot=snapshot, memory=self._memory)
        return other

    def with_quality(self, **changes: Any) -> Parts:
        """The same with other settings of the quality; what these do not change is shared."""
        other = self.under(self.snapshot)
        other.effort = replace(self.effort, changes=(*self.effort.changes, *changes.items()))
        other._shot = ShotParts(other.effort.settings(), snapshot=self.snapshot, memory=self._memory)
        return other

    @property
    def tracer(self) -> Tracer:
        return self._shot.tracer

    @property
    def view(self) -> ViewSamples:
        return self._shot.view

    @property
    def gather(self) -> GatherSamples:
        return self._shot.gather

    @property
    def bounces(self) -> Any:
        return self._shot.bounces

    @property
    def transport(self) -> Transport:
        """Exact rows at the records."""
        return self._shot.transport

    @cached_property
    def packed(self) -> PackedTransport:
        """What frames multiply with."""
        return self._shot.packed

    def pack(self, tolerance: float) -> PackedTransport:
        """The transport packed to another tolerance than the preview's own."""
        return pack(self.transport, self.gather, self._shot.training, tolerance)

    @cached_property
    def lights(self) -> LiveLights:
        quality = self.effort.settings()
        lights = LiveLights(
            self.snapshot,
            self.tracer,
            self.view,
            self.gather,
            self.bounces,
            n_bounces=quality.n_bounces,
            light_samples=quality.light_samples,
            dome_samples=quality.dome_samples,
            seed=quality.seed,
            rows=self.transport,
        )
        lights.take_bounces(self._shot.rest_bounces)
        return lights

    @cached_property
    def live(self) -> LiveRelighter:
        return self.relighter(self.packed)

    def relighter(self, transport: PackedTransport) -> LiveRelighter:
        """One that was never at rest."""
        detail = self.effort.settings().moving_detail
        scene = self.snapshot, self.view, self.gather, transport, self.lights
        source = FitSource(self.tracer, self._shot.training)
        return LiveRelighter(*scene, moving_detail=detail, fit_source=source)

    def shown(self, light: int, *, at_rest: bool) -> F32:
        """Indirect light of every view sample under one light alone: at once, or when nothing is left to be done."""
        before = self.lights.gains.copy()
        self._set_gains(np.repeat(np.eye(len(before), dtype=np.float32)[light][:, None], 3, axis=1))
        self.live.relit()
        while at_rest and self.live.refine():
            pass
        indirect = self.live.relit().indirect
        self._set_gains(before)
        return indirect

    def refine_lights(self) -> None:
        """Bring the lights to the quality that they have at rest."""
        while self.lights.refine():
            pass

    def edit_change(self, stack: EditStack, gains: F32, *, at_rest: bool = False) -> F32:
        """What a stack changes of the indirect light of every view sample, at once or at rest, (n_view, 3)."""
        before = self.lights.gains.copy()
        self._set_gains(gains)
        # One that was at rest before may know more of the lights than a frame does.
        live = self.relighter(self.packed)
        live.set_stack(stack)
        live.relit()
        while at_rest and live.refine():
            pass
        lit = live.relit()
        self._set_gains(before)
        return lit.indirect_edited - lit.indirect

    def _set_gains(self, gains: F32) -> None:
        for light, gain in enumerate(np.asarray(gains, np.float32)):
            self.lights.set_gain(light, gain)


def with_movable_lights(parts: Parts) -> tuple[Parts, list[str]]:
    """The stage with an area light and a dome, and what had to be added."""
    from tools.benchmarking.test_lights import TestLight, add_lights

    added: list[TestLight] = []
    kinds = parts.snapshot.lights.kind
    camera = parts.snapshot.camera.to_world
    radius = parts.snapshot.radius
    if not np.isin(kinds, [int(kind) for kind in AREA_KINDS]).any():
        # Half way to what is seen, as the camera looks along -Z and rectangles shine: at the camera a wall may be next.
        size = (0.1 * radius, 0.1 * radius)
        to_world = np.array(camera, np.float64)
        to_world[:, 3] -= 0.5 * float(np.median(parts.view.depth)) * to_world[:, 2]
        added.append(TestLight("addedArea", LightKind.RECT, to_world, (5.0, 5.0, 5.0), size))
    if not (kinds == int(LightKind.DOME)).any():
        flat = np.full((16, 32, 3), 0.3, np.float32)
        flat[:6, :8] = 2.0
        added.append(TestLight("addedDome", LightKind.DOME, np.eye(3, 4), (1.0, 1.0, 1.0), image=flat))
    if not added:
        return parts, []
    return parts.under(add_lights(parts.snapshot, added)), [light.name for light in added]
