"""One view with its lights and edits, kept at what an artist has changed: a `LiveState` in, an image out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from icheat_usd.edits.model import Edit, EditStack
from icheat_usd.errors import EditError
from icheat_usd.relight import RelitView
from icheat_usd.relight.light_work import SparseView
from icheat_usd.relight.lights import LiveLights
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.relight.rest_weights import FitSource
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, F64, LightKind
from icheat_usd.session.light_changes import light_of_stage
from icheat_usd.session.live_state import UNCHANGED, EditChange, LightChange, LiveState
from icheat_usd.session.seen_light import SeenLight
from icheat_usd.session.shot_parts import ShotParts
from icheat_usd.transport import Bounces, HeldBack, Transport
from icheat_usd.transport.packed import PackedTransport

_DARK = (0.0, 0.0, 0.0)


class Evaluator:
    """The live relighter and the live lights of one view, brought to a state by what differs from the last one.

    Not for two threads at once. The same state has the same image, whatever came before.

    Parameters
    ----------
    is_coarse : bool
        For a first look: domes are worked out where the transport has rows alone.
    """

    def __init__(self, parts: ShotParts, transport: Transport | PackedTransport, *, is_coarse: bool = False) -> None:
        quality = parts.quality
        sparse = None
        if is_coarse and isinstance(transport, Transport) and transport.interpolation is not None:
            sparse = SparseView(transport.row_view, transport.interpolation)
        rows = transport if isinstance(transport, Transport) else transport.source
        self._snapshot = parts.snapshot
        self.lights = LiveLights(
            parts.snapshot,
            parts.tracer,
            parts.view,
            parts.gather,
            parts.bounces,
            n_bounces=quality.n_bounces,
            light_samples=quality.light_samples,
            dome_samples=quality.dome_samples,
            seed=quality.seed,
            sparse=sparse,
            rows=None if is_coarse else rows,
        )
        held_back = None
        if rows is not None:
            held_back = HeldBack(parts.snapshot, parts.tracer, parts.view, parts.gather, rows)
        # As the settings ask, not as these rows are: packed ones may come later, and end in the same image.
        is_fitted = quality.record_error is not None and quality.packing_error is not None and not is_coarse
        fit_source = FitSource(parts.tracer, parts.training) if is_fitted else None
        self.relighter = LiveRelighter(
            parts.snapshot,
            parts.view,
            parts.gather,
            transport,
            self.lights,
            held_back=held_back,
            moving_detail=quality.moving_detail,
            fit_source=fit_source,
        )
        # That bounces of more rays come of, once all that takes less is at rest.
        self._parts = None if is_coarse or not parts.has_rest_bounces else parts
        self._seen = SeenLight(parts.snapshot, parts.view)
        self._shown = UNCHANGED
        self._stack: EditStack | None = None
        self._own_rows = {path: row for row, path in reversed(list(enumerate(parts.snapshot.light_paths)))}
        self._laid: dict[str, tuple[Edit, EditChange, Edit]] = {}

    def show(self, stack: EditStack, state: LiveState) -> None:
        """Take the edits of a stack and the changes laid over it.

        Raises
        ------
        EditError, LightError
            A value does not fit; show what was shown before, then, to bring it back.
        """
        if state is self._shown and stack is self._stack:
            return
        if state.lights is not self._shown.lights:
            before = self._shown
            # Known before it is done: some lights may have changed when another one refuses.
            self._shown = replace(before, lights=state.lights)
            self._show_lights(before, state)
            self._seen.update(self.lights.snapshot(), self.lights.images)
        self.relighter.set_stack(self._laid_over(stack, state))
        self._shown, self._stack = state, stack

    def frame(self, out: F32 | None = None) -> F32:
        """(height, width, 3) float32, scene-linear beauty."""
        image = self.relighter.frame(out)
        if self._seen.difference is not None:
            image += self._seen.difference
        return image

    @property
    def view(self) -> ViewSamples:
        """The view samples, with sky and glowing surfaces as they are now."""
        return self._seen.view

    def relit(self) -> RelitView:
        return self.relighter.relit()

    def refine(self) -> bool:
        """A bounded piece of work towards what the settings ask for; False when nothing is left."""
        return self.relighter.refine(fits=not self.wants_bounces)

    def leave(self) -> None:
        """It is not looked at for now: take less memory."""
        self.lights.stop_following()

    @property
    def wants_bounces(self) -> bool:
        """Whether lights at rest are still without the rays that the settings ask for; see `more_bounces`."""
        return self._parts is not None

    def more_bounces(self) -> Bounces:
        """What `take_bounces` takes; takes seconds, and touches nothing that is shown."""
        assert self._parts is not None
        return self._parts.rest_bounces

    def take_bounces(self, bounces: Bounces) -> None:
        """Lights at rest are worked out with these from now on: `refine` has work to do."""
        self.lights.take_bounces(bounces)
        self._parts = None

    def _laid_over(self, stack: EditStack, state: LiveState) -> EditStack:
        """As `LiveState.laid_over`; edits that did not change stay the same objects, which is how it is noticed."""
        laid = state.laid_over(stack)
        own = {edit.path: edit for edit in stack.edits}
        edits, known = [], {}
        for edit in laid.edits:
            change = state.edits.get(edit.path)
            if change is None:
                edits.append(edit)
                continue
            before = self._laid.get(edit.path)
            is_same = before is not None and before[0] is own[edit.path] and before[1] is change
            kept = before if is_same and before is not None else (own[edit.path], change, edit)
            known[edit.path] = kept
            edits.append(kept[2])
        self._laid = known
        return EditStack(laid.path, tuple(edits), laid.enabled, laid.digest)

    # Lights -----------------------------------------------------------------------------------------------------------

    def _show_lights(self, before: LiveState, after: LiveState) -> None:
        wanted = [path for path, change in after.lights.items() if change.added is not None and not change.removed]
        there = [path for path in self.lights.paths if path not in self._own_rows]
        # Their order decides the order of sums, and with it the last bits.
        same = next((i for i, (a, b) in enumerate(zip(there, wanted, strict=False)) if a != b), None)
        same = min(len(there), len(wanted)) if same is None else same
        for path in there[same:]:
            self.lights.remove(self.lights.paths.index(path))
        for path in wanted[same:]:
            self._add(path, after.lights[path])
        nothing = LightChange()
        for path in dict.fromkeys((*before.lights, *after.lights)):
            was, now = before.lights.get(path, nothing), after.lights.get(path, nothing)
            if was is now:
                continue
            if path in self._own_rows:
                for row in self._rows(path):
                    self._change(row, self._value_of_stage(path), was, now)
            elif path in wanted[:same]:
                self._change(self.lights.paths.index(path), None, was, now)

    def _rows(self, path: str) -> list[int]:
        """Several placements of a prototype share a path."""
        return [row for row, name in enumerate(self.lights.paths) if name == path]

    def _change(self, row: int, own: LightChange | None, was: LightChange, now: LightChange) -> None:
        values: dict[str, Any] = {}
        for name in ("to_world", "radiance", "size", "texture"):
            old, new = getattr(was, name), getattr(now, name)
            if old is new or (name != "texture" and old is not None and np.array_equal(old, new)):
                continue
            if new is None:
                new = getattr(own, name) if own is not None else None
            if new is not None:
                values[name] = self._to_scene(new) if name == "to_world" else new
        if values:
            self.lights.change(row, **values)
        gain = _DARK if now.removed else now.gain
        if gain != (_DARK if was.removed else was.gain):
            self.lights.set_gain(row, gain)

    def _add(self, path: str, change: LightChange) -> None:
        if change.added is None or change.to_world is None or change.radiance is None:
            raise EditError(f"{path}: a light that is added needs a place and a radiance")
        row = self.lights.add(
            path,
            LightKind(change.added),
            to_world=self._to_scene(change.to_world),
            radiance=change.radiance,
            size=change.size or (0.0, 0.0),
            texture=change.texture,
        )
        if change.gain != (1.0, 1.0, 1.0):
            self.lights.set_gain(row, change.gain)

    def _to_scene(self, to_world: F64) -> F32:
        moved = np.array(to_world, np.float64)
        moved[:, 3] -= self._snapshot.centre
        return moved.astype(np.float32)

    def _value_of_stage(self, path: str) -> LightChange:
        return light_of_stage(self._snapshot, path)
