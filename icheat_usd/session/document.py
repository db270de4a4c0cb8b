"""An open document: a stage, a camera, a time and an edit stack, and what is computed from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from icheat_usd.edits.binding import bind
from icheat_usd.edits.facts import facts
from icheat_usd.edits.model import EMPTY_STACK, Blend, EditStack, SurfaceMask, Value
from icheat_usd.edits.painting import Brush, paint_mask
from icheat_usd.errors import EditError, StageError
from icheat_usd.final_gather import GatherSettings
from icheat_usd.image.film import Film
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import Finding, SceneSnapshot
from icheat_usd.session import authoring, films, keys, layer_names
from icheat_usd.session.disk_cache import DiskCache
from icheat_usd.session.first_use import compile_first
from icheat_usd.session.quality import FINAL, PREVIEW, Quality
from icheat_usd.session.rendering import render_film
from icheat_usd.session.shot_parts import Memory, ShotParts
from icheat_usd.stage import open_stage, take_snapshot
from icheat_usd.stage.authoring import Members
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.stacks import find_stack

if TYPE_CHECKING:
    from icheat_usd.session.replaying import FrameReplay


_NO_LIGHTS = Finding(
    "/", "lights", "the stage shows no light at this time, so all is black; check visibility and payloads"
)


class Session(ShotParts):
    """One stage seen by one camera at one time, with one edit stack.

    Make one with `Session.open`. What is expensive (snapshot, samples,
    transport) is made when first needed and kept, on disk too where it takes
    seconds: edits are read anew each time, but after a change of geometry,
    lights or camera open a new session.
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
        disk: DiskCache | None = None,
        memory: Memory | None = None,
        product: str | None = None,
    ) -> None:
        super().__init__(quality, engine=tracer, progress=progress, disk=disk, memory=memory)
        self.stage = stage
        self.camera = camera
        self.frame = frame
        self._stack_path = stack
        self._size = (width, height)
        self._product = product

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
        quality: Quality = PREVIEW,
        tracer: str = "embree",
        progress: Progress = silent,
        disk: DiskCache | None = None,
        memory: Memory | None = None,
        product: str | None = None,
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
        disk : DiskCache, optional
            Where expensive parts are kept; by default in the user's cache folder, as ``$ICHEAT_CACHE_SIZE`` says.
        memory : Memory, optional
            Where sessions at other frames of the stage find parts that are the same.
        product : str, optional
            Prim path of the RenderProduct whose camera and resolution count; the render settings' first one by default.

        Raises
        ------
        StageError
            The stage, the camera or the frame cannot be used.
        """
        if isinstance(stage, (str, Path)):
            stage = open_stage(stage)
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
            disk=disk,
            memory=memory,
            product=product,
        )

    def at(self, frame: float | None, *, memory: Memory | None = None, quality: Quality | None = None) -> Session:
        """The same stage and choices at another frame; `memory` is for a session that has none."""
        return Session(
            self.stage,
            camera=self.camera,
            frame=frame,
            stack=self._stack_path,
            width=self._size[0],
            height=self._size[1],
            quality=self.quality if quality is None else quality,
            tracer=self._engine,
            progress=self.progress,
            disk=self._disk,
            memory=memory if self._memory is None else self._memory,
            product=self._product,
        )

    @cached_property
    def snapshot(self) -> SceneSnapshot:
        """The stage at the session's frame."""
        snapshot = self._take_snapshot()
        if len(snapshot.geometry.face) == 0:
            reasons = "; ".join(f"{f.prim}: {f.message}" for f in snapshot.findings[:3])
            raise StageError(
                f"{snapshot.stage_path} shows no surface at this frame, so there is nothing to light;"
                f" check visibility, purpose and the frame{' (' + reasons + ')' if reasons else ''}"
            )
        return snapshot

    def rough_snapshot(self) -> SceneSnapshot:
        """The stage at the session's frame, subdivision surfaces as their control meshes; not kept."""
        return self._take_snapshot(subdivision_level=None)

    def _take_snapshot(self, **choices: Any) -> SceneSnapshot:
        width, height = self._size
        return take_snapshot(
            self.stage,
            camera=self.camera,
            time=self.frame,
            width=width,
            height=height,
            product=self._product,
            progress=self.progress,
            **choices,
        )

    # Edits

    def _read_stack(self) -> tuple[EditStack, tuple[Finding, ...]]:
        path = find_stack(self.stage, self._stack_path, self.camera)
        if path is None:
            return EMPTY_STACK, ()
        surfaces = {surface.path for surface in self.snapshot.surfaces}
        stack, findings = read_edit_stack(self.stage, path, self.frame, surfaces, authoring.read_payload)
        return stack, tuple(findings)

    @property
    def stack(self) -> EditStack:
        """The edit stack as composed now: layers may have changed since the last look."""
        return self._read_stack()[0]

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What the stage has and is not supported, and what is wrong with its lights and edits."""
        stack, findings = self._read_stack()
        dark = () if self.snapshot.light_paths else (_NO_LIGHTS,)
        return self.snapshot.findings + dark + findings + bind(stack, self.snapshot).findings

    # Images

    def relight(self) -> Film:
        """Preview through the precomputed transport.

        Returns
        -------
        Film
            Layers `beauty`, `direct`, `indirect`, `indirect_edited`, `edit_delta`, `albedo`, `normal`, `depth`.
        """
        compile_first("relight", self.progress)
        stack = self.stack
        field = bind(stack, self.snapshot)
        relighter = self.relighter
        return films.relit_film(
            self.view, relighter.relight(field), self.metadata("relight", stack, asdict(self.quality))
        )

    def render(self, settings: GatherSettings = FINAL, layers: Sequence[str] = layer_names.DEFAULT) -> Film:
        """Final frame by gathering at every camera sample.

        Parameters
        ----------
        layers : names
            Of `LAYERS`, `FAMILIES` or `ALIASES` in `session.layer_names`, or members of a family such as ``edit.NAME``.

        Raises
        ------
        ImageError
            There is no such layer; the message lists those there are.
        """
        sources = [layer_names.canonical(name) for name in layers]
        compile_first("render", self.progress)
        return render_film(
            self, settings, [layer_names.Layer(source, layer_names.layer_name(source)) for source in sources]
        )

    def replay(self, settings: GatherSettings = FINAL, layers: Sequence[str] = layer_names.DEFAULT) -> FrameReplay:
        """Render a final frame and keep what its rays brought, to make it again whenever edits have changed."""
        from icheat_usd.session.replaying import FrameReplay

        compile_first("render", self.progress)
        return FrameReplay(self, settings, layers)

    def metadata(self, renderer: str, stack: EditStack, settings: Mapping[str, Any]) -> dict[str, str]:
        """What made an image, for its file."""
        return films.image_metadata(self.snapshot, renderer, stack, settings)

    # Authoring: opinions in one layer, payloads in a new sidecar beside it

    @property
    def stack_path(self) -> str | None:
        """Prim path of the edit stack, None if the stage has none."""
        return find_stack(self.stage, self._stack_path, self.camera)

    def add_edit(
        self,
        name: str,
        *,
        layer: str,
        operation: str = "scale",
        parameters: Mapping[str, Value] | None = None,
        receivers: Members | Sequence[str] = (),
        casters: Members | Sequence[str] = (),
        receiver_limits: Sequence[str] = (),
        caster_limits: Sequence[str] = (),
        occluders: Sequence[str] = (),
        lights: Sequence[str] = (),
        target: str | None = None,
        amount: float = 1.0,
        blend: Blend | str = Blend.COMPOSE,
        receiver_brush: Brush | None = None,
        caster_brush: Brush | None = None,
        frame: float | None = None,
        before: str | None = None,
        after: str | None = None,
        variant: tuple[str, str] | None = None,
        sidecar: str | Path | None = None,
        why: str = "",
    ) -> str:
        """Add an edit to the stack and save the layer; a stack is made if the stage has none.

        Parameters
        ----------
        name : str
            Name of the edit's prim.
        layer : str
            Layer of the stage's layer stack to write to, or "session".
        receivers, casters : paths or Members
            Prims that get, and prims that send, the edited light.
        receiver_limits, caster_limits : paths
            Materials, regions (Cube, Sphere), selections, collections or prims that narrow the two sides.
        occluders, lights, target : paths, path
            Prims that light passes, lights that the edit acts on, and the prim that it aims at.
        receiver_brush, caster_brush : Brush, optional
            Soft weights by position, painted on the selected surfaces; see `edits.painting`.
        frame : float, optional
            Time of the key; without it the edit holds at all times.
        variant : (str, str), optional
            Variant set and variant to write into, such as ("grade", "dusk") of the stack's prim.
        sidecar : path, optional
            Folder or file for the payload; beside the layer's file by default.
        why : str
            Kept with the payload's history.

        Returns
        -------
        str
            Path of the edit.

        Raises
        ------
        EditError, SidecarError
            Something named does not exist or cannot be written; the layer is then as before.
        """
        return authoring.add_edit(
            self.stage,
            self.stack_path,
            name,
            layer=layer,
            operation=operation,
            parameters=parameters or {},
            receivers=receivers,
            casters=casters,
            receiver_limits=receiver_limits,
            caster_limits=caster_limits,
            occluders=occluders,
            lights=lights,
            target=target,
            amount=amount,
            blend=blend,
            receiver_mask=self._paint(receivers, receiver_brush),
            caster_mask=self._paint(casters, caster_brush),
            made_against=self._made_against,
            frame=frame,
            before=before,
            after=after,
            variant=variant,
            sidecar=sidecar,
            why=why,
        )

    def _paint(self, selected: Members | Sequence[str], brush: Brush | None) -> SurfaceMask | None:
        if brush is None:
            return None
        members = selected if isinstance(selected, Members) else Members(tuple(selected))
        paths = authoring.surfaces_below(self.stage, members, [s.path for s in self.snapshot.surfaces])
        return _painted(self, paths, brush)

    def set_key(
        self,
        edit: str,
        *,
        layer: str,
        frame: float | None,
        receiver_brush: Brush | None = None,
        caster_brush: Brush | None = None,
        **values: Any,
    ) -> tuple[Finding, ...]:
        """Set one keyframe of an edit and save the layer; see `session.keys.set_key`.

        Parameters
        ----------
        receiver_brush, caster_brush : Brush, optional
            Masks for this key, painted on what the edit selects, as it stands at `frame`.
        """
        if receiver_brush is not None or caster_brush is not None:
            shot = self
            if frame is not None and self.frame != frame:
                shot = Session.open(self.stage, camera=self.camera, frame=frame)
            selected = next((found for found in self.stack.edits if found.path == edit), None)
            if selected is None:
                paintable = ", ".join(found.path for found in self.stack.edits) or "none"
                raise EditError(f"{edit} is no active edit of the stack {self.stack_path}; it has {paintable}")
            for side, selection, brush in (
                ("receiver_mask", selected.receivers, receiver_brush),
                ("caster_mask", selected.casters, caster_brush),
            ):
                if brush is not None:
                    values[side] = _painted(shot, selection.paths, brush)
            values["made_against"] = shot._made_against
        return keys.set_key(self.stage, edit, layer=layer, frame=frame, **values)

    @property
    def _made_against(self) -> dict[str, str | float | int]:
        """Only what is known without work: an edit without masks must not cost a snapshot."""
        if "snapshot" not in self.__dict__:
            return {}
        # Masks carry the topology of what they are painted on, and constants depend on nothing.
        return facts(self.snapshot, authoring.anchor_of(self.stage), geometry=False, lights=False)

    def set_edit(self, edit: str, *, layer: str, **values: Any) -> tuple[Finding, ...]:
        """Change values of an edit in one layer and save it; see `stage.authoring.set_edit`."""
        return authoring.set_edit(self.stage, edit, layer=layer, **values)

    def mute_edit(
        self, edit: str, *, layer: str, muted: bool = True, variant: tuple[str, str] | None = None
    ) -> tuple[Finding, ...]:
        """Mute or unmute an edit in one layer and save it."""
        return authoring.mute_edit(self.stage, edit, layer=layer, muted=muted, variant=variant)


def _painted(session: Session, paths: Sequence[str] | frozenset[str], brush: Brush) -> SurfaceMask:
    mask = paint_mask(session.snapshot, paths, brush)
    if not mask.texels.any():
        raise EditError("the brush touches none of the surfaces that it should paint; move it or make it larger")
    return mask
