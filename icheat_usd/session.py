"""An open document: a stage, a camera, a time and an edit stack, and what is computed from them.

    session = Session.open("shot.usda", camera="/World/Camera", frame=12)
    session.add_edit("warm", layer="shot.usda", operation="scale", parameters={"color": (1.4, 1.1, 0.8)},
                     receivers=["/World/Figure"], casters=["/World/Room/Wall"])
    write_exr(session.relight(), "preview.exr")
    write_exr(session.render(), "final.exr")

Nothing is computed before it is asked for, and each part is kept: a second
relight after an edit costs no ray.
"""

from __future__ import annotations

import datetime
import hashlib
import io
import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd import __version__
from icheat_usd.edits.field import EditField, bind
from icheat_usd.edits.model import EMPTY_STACK, EditStack, Payload, SurfaceMask, Value
from icheat_usd.edits.painting import Brush, paint_mask
from icheat_usd.errors import EditError
from icheat_usd.final_gather import FinalGather, GatherSettings, final_gather
from icheat_usd.image.film import Film
from icheat_usd.progress import Progress, silent
from icheat_usd.relight import Relighter, RelitView, build_relighter
from icheat_usd.samples import GatherSamples, ViewSamples, gather_samples, view_samples
from icheat_usd.samples.develop import average, develop
from icheat_usd.scene import F32, F64, Finding, SceneSnapshot
from icheat_usd.tracing import Tracer, build_tracer
from icheat_usd.transport import Transport, build_transport


@dataclass(frozen=True)
class Quality:
    """Effort of the preview.

    The defaults suit a 640 x 480 frame: 65,536 gather samples and 256 rays a row.
    """

    n_gather: int = 65_536
    rays_per_row: int = 256
    rays_per_bounce_row: int = 128
    row_spacing: int = 1  #: pixels between the points where rows are kept; the rest is interpolated
    light_samples: int = 16  #: shadow rays per light and point
    n_bounces: int = 16  #: diffuse reflections before the last one
    samples_per_pixel: int = 1
    seed: int = 0


DRAFT = Quality(n_gather=8_192, rays_per_row=64, rays_per_bounce_row=64, row_spacing=4, light_samples=8)


class Session:
    """One stage seen by one camera at one time, with one edit stack.

    Make one with `Session.open`. What is expensive (snapshot, samples,
    transport) is made when first needed and kept until `close` or until the
    stage's geometry, lights or camera change (`reload`).
    """

    def __init__(
        self,
        stage: Any,
        *,
        camera: str | None,
        frame: float | None,
        stack: str | None,
        width: int | None,
        height: int | None,
        quality: Quality,
        tracer: str,
        progress: Progress,
    ) -> None:
        self.stage = stage
        self.camera = camera
        self.frame = frame
        self.quality = quality
        self.progress = progress
        self._stack_path = stack
        self._size = (width, height)
        self._engine = tracer

    @classmethod
    def open(
        cls,
        stage: str | Path | Any,
        *,
        camera: str | None = None,
        frame: float | None = None,
        stack: str | None = None,
        width: int | None = None,
        height: int | None = None,
        quality: Quality = Quality(),
        tracer: str = "embree",
        progress: Progress = silent,
    ) -> Session:
        """Open a stage.

        Parameters
        ----------
        stage : path or Usd.Stage
        camera : str, optional
            Prim path; otherwise the render settings' camera, else the only one. "auto" frames the scene.
        frame : float, optional
            Time code; the stage's first by default.
        stack : str, optional
            Prim path of the edit stack; otherwise found as the stage says.
        width, height : int, optional
            Pixels; otherwise the render settings' resolution.

        Raises
        ------
        StageError
            The stage, the camera or the frame cannot be used.
        """
        if isinstance(stage, (str, Path)):
            stage = stage_io.open_stage(stage)
        return cls(
            stage,
            camera=camera,
            frame=frame,
            stack=stack,
            width=width,
            height=height,
            quality=quality,
            tracer=tracer,
            progress=progress,
        )

    # What is computed, each part once

    @cached_property
    def snapshot(self) -> SceneSnapshot:
        """The stage at the session's frame."""
        width, height = self._size
        return stage_io.take_snapshot(
            self.stage, camera=self.camera, time=self.frame, width=width, height=height, progress=self.progress
        )

    @cached_property
    def tracer(self) -> Tracer:
        return build_tracer(self.snapshot, self._engine)

    @cached_property
    def view(self) -> ViewSamples:
        self.progress("place view samples", 0.0)
        quality = self.quality
        return view_samples(
            self.snapshot, self.tracer, samples_per_pixel=quality.samples_per_pixel, seed=quality.seed
        )

    @cached_property
    def gather(self) -> GatherSamples:
        self.progress("place gather samples", 0.0)
        return gather_samples(
            self.snapshot, self.tracer, self.view, n=self.quality.n_gather, seed=self.quality.seed
        )

    @cached_property
    def transport(self) -> Transport:
        quality = self.quality
        return build_transport(
            self.snapshot,
            self.tracer,
            self.view,
            self.gather,
            rays_per_row=quality.rays_per_row,
            rays_per_bounce_row=quality.rays_per_bounce_row,
            row_spacing=quality.row_spacing,
            seed=quality.seed,
            progress=self.progress,
        )

    @cached_property
    def relighter(self) -> Relighter:
        quality = self.quality
        return build_relighter(
            self.snapshot,
            self.tracer,
            self.view,
            self.gather,
            self.transport,
            n_bounces=quality.n_bounces,
            light_samples=quality.light_samples,
            seed=quality.seed,
            progress=self.progress,
        )

    # Edits

    def _read_stack(self) -> tuple[EditStack, tuple[Finding, ...]]:
        path = stage_io.find_stack(self.stage, self._stack_path, self.camera)
        if path is None:
            return EMPTY_STACK, ()
        surfaces = {surface.path for surface in self.snapshot.surfaces}
        stack, findings = stage_io.read_edit_stack(self.stage, path, self.frame, surfaces, read_payload)
        return stack, tuple(findings)

    @property
    def stack(self) -> EditStack:
        """The edit stack as composed now: layers may have changed since the last look."""
        return self._read_stack()[0]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the stage has and is not supported, and what is wrong with its edits."""
        return self.snapshot.findings + self._read_stack()[1]

    # Images

    def relight(self) -> Film:
        """Preview through the precomputed transport.

        Returns
        -------
        Film
            Layers `beauty`, `direct`, `indirect`, `indirect_edited`, `edit_delta`, `albedo`, `normal`, `depth`.
        """
        stack = self.stack
        field = bind(stack, self.snapshot)
        relighter = self.relighter
        return self._relit_film(relighter.relight(field), stack)

    def render(self, settings: GatherSettings = GatherSettings()) -> Film:
        """Final frame by gathering at every camera sample; same layers as `relight`."""
        stack = self.stack
        field = bind(stack, self.snapshot)
        gather, radiance = None, None
        if field.uses_incident or field.has_offset:
            gather, radiance = self.gather, self.relighter.radiance()
        result = final_gather(
            self.snapshot,
            self.tracer,
            field,
            settings=settings,
            gather=gather,
            gather_radiance=radiance,
            progress=self.progress,
        )
        return self._final_film(result, stack, settings)

    def _relit_film(self, light: RelitView, stack: EditStack) -> Film:
        view = self.view
        seen = view.background.reshape(view.height, view.width, 3) + develop(view, view.points.emission)
        return _film(
            view.width,
            view.height,
            direct=seen + develop(view, light.direct),
            indirect=develop(view, light.indirect),
            indirect_edited=develop(view, light.indirect_edited),
            albedo=average(view, view.points.albedo),
            normal=average(view, view.points.shading_normal),
            depth=average(view, view.depth[:, None]),
            metadata=self._metadata("relight", stack, asdict(self.quality)),
        )

    def _final_film(self, result: FinalGather, stack: EditStack, settings: GatherSettings) -> Film:
        height, width, _ = result.indirect.shape
        return _film(
            width,
            height,
            direct=result.background + result.emission + result.direct,
            indirect=result.indirect,
            indirect_edited=result.indirect_edited,
            albedo=result.albedo,
            normal=result.normal,
            depth=result.depth,
            metadata=self._metadata("final gather", stack, asdict(settings)),
        )

    def _metadata(self, renderer: str, stack: EditStack, settings: Mapping[str, Any]) -> dict[str, str]:
        snapshot = self.snapshot
        return {
            "stage": snapshot.stage_path,
            "camera": snapshot.camera.path,
            "frame": "default" if snapshot.time_code is None else f"{snapshot.time_code:g}",
            "renderer": renderer,
            "settings": ", ".join(f"{name}={value}" for name, value in settings.items()),
            "stack": stack.path,
            "stackDigest": stack.digest,
            "edits": ", ".join(edit.path for edit in stack.active),
            "colorSpace": "lin_rec709_scene",
            "version": __version__,
            "software": f"icheat_usd {__version__}, Python {platform.python_version()}, NumPy {np.__version__}",
        }


def _film(
    width: int,
    height: int,
    *,
    direct: F64,
    indirect: F64,
    indirect_edited: F64,
    albedo: F64,
    normal: F64,
    depth: F64,
    metadata: Mapping[str, str],
) -> Film:
    layers = {
        "beauty": direct + indirect_edited,
        "direct": direct,
        "indirect": indirect,
        "indirect_edited": indirect_edited,
        "edit_delta": indirect_edited - indirect,
        "albedo": albedo,
        "normal": normal,
        "depth": depth[..., 0],
    }
    pixels = {name: np.ascontiguousarray(values, np.float32) for name, values in layers.items()}
    return Film(width, height, pixels, metadata)
