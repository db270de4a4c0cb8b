"""A preview that is there in seconds, gets better by itself, and follows every change at once.

    with LiveSession.open("shot.usda") as live:
        for i in range(20):
            live.set_amount("warm", i / 19)
            write_png(live.film(), f"warm_{i:02}.png")
        live.set_light("/World/Lamp", gain=0.5, move=(0, 0.4, 0))
        write_exr(live.film(), "dimmer.exr")
        live.undo()
        live.commit("shot.usda")

Commands change a `LiveState` in memory and return at once. `frame` shows it as well as it can be shown by now, `film`
when nothing is left to be done. `commit` writes it to a layer.
A coarse preview is made first, then, in a thread of its own, one with all that the quality asks for, and then the other
frames around the playhead. Listeners (`listen`) hear when there is something better to show.
"""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.edits.model import EditStack, SurfaceMask, Value
from icheat_usd.edits.operations.base import plain_values
from icheat_usd.errors import EditError, IcheatError
from icheat_usd.image.film import Film
from icheat_usd.scene import F32, F64, LightKind, SceneSnapshot
from icheat_usd.session import films
from icheat_usd.session.dabs import dabbed, filled_mask
from icheat_usd.session.document import Session
from icheat_usd.session.light_changes import all_lights, changed_light, new_light, read_image
from icheat_usd.session.live_authoring import LiveAuthoring
from icheat_usd.session.live_events import Level, Listener
from icheat_usd.session.live_frames import LiveFrames
from icheat_usd.session.live_history import LiveHistory, Step
from icheat_usd.session.live_state import LightChange, LiveState, moved, number, numbers
from icheat_usd.session.quality import LIVE, Quality
from icheat_usd.stage.layer_versions import LayerVersion, go_to_version

#: Memory for frames by default: a quarter of the machine's.
_SHARE_OF_MEMORY = 0.25

#: Field of an `EditChange` for each side of an edit.
_MASKS = {"receivers": "receiver_mask", "casters": "caster_mask"}


class LiveSession(LiveAuthoring):
    """A stage whose preview is being worked on. Make one with `open`, and close it, or use it in a `with` block.

    Commands may be given from several threads; they are served one after another.

    Parameters
    ----------
    session : Session
        Stage, camera, size and quality; its frame is where the playhead stands first.
    memory : bytes, optional
        Limit of all frames together; a quarter of the machine's by default.
    prefetch : frames, optional
        Frames to prepare around the playhead when the one at it is done: a range that play repeats.
    """

    def __init__(self, session: Session, *, memory: int | None = None, prefetch: Sequence[float] = ()) -> None:
        self.session = session
        self._frames = LiveFrames(session, _default_memory() if memory is None else memory)
        self._frames.prefetch = tuple(prefetch)
        self._history = LiveHistory()
        atexit.register(self.close)

    @classmethod
    def open(
        cls,
        stage: str | Path | Any,
        *,
        quality: Quality = LIVE,
        memory: int | None = None,
        prefetch: Sequence[float] = (),
        **choices: Any,
    ) -> LiveSession:
        """Open a stage; `choices` are those of `Session.open`."""
        return cls(Session.open(stage, quality=quality, **choices), memory=memory, prefetch=prefetch)

    # Life -------------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Stop the background; what it has kept on disk stays. Closing twice does nothing."""
        atexit.unregister(self.close)
        self._frames.close()

    def __enter__(self) -> LiveSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Have a listener told of progress; calling what is returned ends that."""
        return self._frames.listen(listener)

    def wait(self, level: Level | str = Level.PREVIEW, timeout: float | None = None) -> bool:
        """Wait until the frame at the playhead is this good; false if `timeout` seconds were not enough.

        Raises
        ------
        IcheatError
            It cannot be made.
        """
        return self._frames.wait(_level(level), timeout)

    # What is shown ----------------------------------------------------------------------------------------------------

    @property
    def level(self) -> Level:
        """How good the image at the playhead is."""
        return self._frames.level

    def frame(self, out: F32 | None = None, *, level: Level | str = Level.PREVIEW) -> F32:
        """The image as it is now, (height, width, 3) float32, scene-linear; waits until it is at least this good."""
        with self._frames.looking(_level(level)):
            return self._frames.shown().frame(out)

    def film(self, *, level: Level | str = Level.REST) -> Film:
        """The image in layers, as `Session.relight` gives it, to be written; waits until it is at least this good."""
        with self._frames.looking(_level(level)) as frame:
            evaluator, stack = self._frames.shown(), self.stack
            settings = {**asdict(self.session.quality), "level": str(self.level)}
            metadata = films.image_metadata(frame.snapshot, "live relight", stack, settings)
            return films.relit_film(evaluator.view, evaluator.relit(), metadata)

    @property
    def stack(self) -> EditStack:
        """The edit stack at the playhead with all changes."""
        with self._frames.looking() as frame:
            return self._frames.state.laid_over(self._frames.stack_of(frame))

    @property
    def state(self) -> LiveState:
        """Everything that was changed and not yet committed; `show` takes it back."""
        return self._frames.state

    def show(self, state: LiveState, label: str = "state") -> None:
        """Show another state, as one step that can be undone."""
        self._do(label, state)

    @property
    def snapshot(self) -> SceneSnapshot:
        """The stage at the playhead, without changes."""
        return self._frames.here().snapshot

    def pick(self, x: int, y: int) -> tuple[str, F64] | None:
        """Surface and place (metres, stage axes) that a pixel shows, counted from the top left; None: the sky.

        Raises
        ------
        EditError
            The image has no such pixel.
        """
        with self._frames.looking() as frame:
            assert frame.evaluator is not None
            view = frame.evaluator.view
            if not (0 <= x < view.width and 0 <= y < view.height):
                raise EditError(f"pixel ({x}, {y}) is not in the image of {view.width} x {view.height}")
            sample = int(np.searchsorted(view.pixel, y * view.width + x))
            if sample >= view.n or view.pixel[sample] != y * view.width + x:
                return None
            surface = frame.snapshot.geometry.instance_surface[view.points.instance[sample]]
            place: F64 = view.points.position[sample].astype(np.float64) + frame.snapshot.centre
            return frame.snapshot.surfaces[surface].path, place

    # Lights -----------------------------------------------------------------------------------------------------------

    @property
    def lights(self) -> Mapping[str, LightChange]:
        """All lights at the playhead as they are shown now, by path, with every value filled in."""
        return all_lights(self.snapshot, self.state)

    def set_light(
        self,
        light: str,
        *,
        gain: float | Sequence[float] | None = None,
        move: Sequence[float] | None = None,
        turn: tuple[Sequence[float], float] | None = None,
        to_world: ArrayLike | None = None,
        radiance: float | Sequence[float] | None = None,
        size: Sequence[float] | None = None,
        texture: str | Path | F32 | None = None,
    ) -> None:
        """Change a light; what is not given stays.

        Parameters
        ----------
        light
            Its path, or the last name of it.
        gain
            Factor of its radiance, one number or three; 0 turns it off.
        move : metres, stage axes
            Where it goes from where it is.
        turn : (axis, degrees)
            About an axis through its own place: a dome with ((0, 1, 0), 30).
        to_world : (3, 4), metres, stage axes
        size
            As in `scene.Lights`: radius, width and height, half-angle.
        texture : path or (height, width, 3 or 4) linear
            Image of a dome or rectangle; "" takes it away.

        Raises
        ------
        EditError, LightError, ImageError
            There is no such light, or a value does not fit it.
        """
        image = read_image(texture)
        with self._changing() as state:
            path = self._light(light)
            change = changed_light(path, self.lights[path], gain, move, turn, to_world, radiance, size, image)
            self._do(f"light {path}", state.with_light(path, **change))

    def add_light(
        self,
        path: str,
        kind: LightKind | str,
        *,
        to_world: ArrayLike | None = None,
        at: Sequence[float] = (0.0, 0.0, 0.0),
        radiance: float | Sequence[float] = 1.0,
        size: Sequence[float] = (0.0, 0.0),
        texture: str | Path | F32 | None = None,
    ) -> None:
        """Add a light, at a place in metres and stage axes or with a whole transform; see `set_light`."""
        change = new_light(path, kind, to_world, at, radiance, size, read_image(texture))
        with self._changing() as state:
            if path in self.lights:
                raise EditError(f"{path} is a light already; choose another path")
            self._do(f"add light {path}", state.with_light(path, **vars(change)))

    def remove_light(self, light: str) -> None:
        """Take a light away."""
        with self._changing() as state:
            path = self._light(light)
            added = path in state.lights and state.lights[path].added is not None
            without = state.without_light(path) if added else state.with_light(path, removed=True)
            self._do(f"remove light {path}", without)

    # Edits ------------------------------------------------------------------------------------------------------------

    def set_amount(self, edit: str, amount: float) -> None:
        """How much of an edit is laid over the weaker ones, by its name or path; 0 leaves it out."""
        with self._changing() as state:
            path = self._edit(edit)
            amount = number(amount, f"{path}: the amount")
            self._do(f"amount {path}", state.with_edit(path, amount=amount))

    def set_parameters(self, edit: str, **values: Value) -> None:
        """Parameters of an edit's operation, at all its keys."""
        with self._changing() as state:
            path = self._edit(edit)
            changed = state.with_parameters(path, plain_values(values))
            # A muted edit is bound only when it takes part again, too late to say what is wrong.
            changed.check_parameters(path, self._frames.stack_of(self._frames.here()))
            self._do(f"parameters {path}", changed)

    def mute(self, edit: str, muted: bool = True) -> None:
        """Mute an edit, or let it take part again."""
        with self._changing() as state:
            path = self._edit(edit)
            self._do(f"{'mute' if muted else 'unmute'} {path}", state.with_edit(path, enabled=not muted))

    def move_edit(self, edit: str, *, before: str | None = None, after: str | None = None) -> None:
        """Move an edit before or after another one; to the end, the strongest place, if neither is given."""
        with self._changing() as state:
            path = self._edit(edit)
            others = {"before": before, "after": after}
            named = {name: self._edit(other) for name, other in others.items() if other is not None}
            order = moved([edit.path for edit in self.stack.edits], path, **named)
            self._do(f"move {path}", replace(state, order=order))

    def dab(
        self, edit: str, at: Sequence[float], radius: float, *, side: str = "receivers", strength: float = 1.0
    ) -> None:
        """Paint one dab on a side of an edit: weights under the brush go towards 1, or towards 0 if it is negative.

        Parameters
        ----------
        at : metres, stage axes
            Such as `pick` says; `radius` is in metres too.
        side : "receivers" or "casters"
            A side without a mask has full weight everywhere: `fill_mask` it with 0 first to paint where it acts.
        strength : in [-1, 1]
        """
        with self._changing() as state:
            path, frame = self._edit(edit), self._frames.here()
            selected, mask = self._side(path, side)
            centre = (numbers(at, 3, "the place of a dab") - frame.snapshot.centre).astype(np.float32)
            painted = dabbed(
                frame.places,
                selected,
                mask,
                centre,
                number(radius, "the radius of a dab"),
                number(strength, "the strength of a dab"),
            )
            self._do(f"dab {path}", state.with_edit(path, **{_MASKS[side]: painted}))

    def fill_mask(self, edit: str, weight: float, *, side: str = "receivers") -> None:
        """Give all surfaces that a side of an edit selects one weight."""
        with self._changing() as state:
            path, frame = self._edit(edit), self._frames.here()
            mask = filled_mask(frame.places, self._side(path, side)[0], weight)
            self._do(f"fill mask {path}", state.with_edit(path, **{_MASKS[side]: mask}))

    def _side(self, path: str, side: str) -> tuple[frozenset[str], SurfaceMask | None]:
        """What one side of an edit selects, and its mask as it is now."""
        if side not in _MASKS:
            raise EditError(f"an edit has the sides {' and '.join(_MASKS)}, not '{side}'")
        edit = next(edit for edit in self.stack.edits if edit.path == path)
        payloads = [key.payload for key in edit.keys if key.payload is not None]
        masks = [getattr(payload, _MASKS[side]) for payload in payloads]
        if len(masks) > 1 and any(mask is not masks[0] for mask in masks):
            raise EditError(f"{path} has several masks around this frame; go to one of its keys to paint")
        return getattr(edit, side).paths, masks[0] if masks else None

    # History ----------------------------------------------------------------------------------------------------------

    @contextmanager
    def gesture(self, label: str) -> Iterator[None]:
        """Commands in the block are one step for undo: a drag, from press to release."""
        with self._frames.command():
            first = self._history.mark()
        try:
            yield
        finally:
            with self._frames.command():
                self._history.join(first, label)

    def undo(self) -> str | None:
        """Take back the last step; what it was, None if there is none.

        Raises
        ------
        EditError
            It was written to a layer that something else has changed since.
        """
        with self._frames.command():
            return self._history.undo(self._go)

    def redo(self) -> str | None:
        """Do again what was taken back last; what it was, None if there is nothing."""
        with self._frames.command():
            return self._history.redo(self._go)

    def _go(
        self, state: LiveState, written: Sequence[tuple[LayerVersion, LayerVersion]], is_about_lights: bool
    ) -> None:
        """All of it or, after an error, nothing."""
        before, done = self._frames.state, list[tuple[LayerVersion, LayerVersion]]()
        with self._frames.stage_lock:
            try:
                for now, then in written:
                    go_to_version(now, then)
                    done.append((then, now))
                self._show_again(state, bool(written))
            except Exception:
                for now, then in reversed(done):
                    go_to_version(now, then)
                self._show_again(before, bool(done))
                raise
        if is_about_lights:
            self._frames.lights_changed()

    def _show_again(self, state: LiveState, with_layers: bool) -> None:
        if with_layers:
            self._frames.stacks_changed()
        self._frames.set_state(state)

    # Time -------------------------------------------------------------------------------------------------------------

    def scrub(self, frame: float | None) -> bool:
        """Put the playhead at a frame; whether it can be shown without waiting.

        Raises
        ------
        EditError
            It is no time.
        """
        if frame is not None:
            if not isinstance(frame, (int, float)) or not np.isfinite(frame):
                raise EditError(f"{frame!r} is no frame, such as 24 or 12.5")
            frame = float(frame)
        return self._frames.scrub(frame)

    def play(self, frames: Sequence[float], *, level: Level | str = Level.PREVIEW) -> Iterator[tuple[float, F32]]:
        """Go through frames, each at least this good, and prepare those ahead."""
        self._frames.prefetch = tuple(frames)
        for frame in frames:
            self.scrub(frame)
            self.wait(level)
            yield frame, self.frame()

    @property
    def playhead(self) -> float | None:
        """The frame that is shown; None is the stage's first."""
        return self._frames.resident.playhead

    @property
    def resident(self) -> Mapping[float | None, Level]:
        """Frames in memory, and how good each is."""
        resident = self._frames.resident
        found = {frame: resident.get(frame) for frame in resident.frames()}
        return {frame: entry.level for frame, entry in found.items() if entry is not None}

    def memory(self) -> dict[str, int]:
        """Bytes of arrays: `total` of all frames, `limit`, and of the frame at the playhead `frame` and its `own`.

        Beside them `history`: of the steps that can be undone and redone, which has a limit of its own.
        """
        with self._frames.command():
            resident = self._frames.resident
            whole, own = resident.bytes_of(resident.playhead) if self.level is not Level.NONE else (0, 0)
            found = {"total": resident.bytes(), "limit": resident.limit, "frame": whole, "own": own}
            return found | {"history": self._history.bytes}

    # Inside -----------------------------------------------------------------------------------------------------------

    @contextmanager
    def _changing(self) -> Iterator[LiveState]:
        """A command that goes on from the state: no other one comes in between."""
        with self._frames.looking():
            yield self._frames.state

    def _do(self, label: str, state: LiveState) -> None:
        with self._frames.command():
            before = self._frames.state
            self._frames.set_state(state)
            self._history.add(Step(label, before, state))

    def _light(self, light: str) -> str:
        return _named(light, self.lights, "light")

    def _edit(self, edit: str) -> str:
        return _named(edit, [found.path for found in self._frames.stack_of(self._frames.here()).edits], "edit")


def _level(level: Level | str) -> Level:
    try:
        return Level(level)
    except ValueError:
        raise IcheatError(f"'{level}' is no level; known are {', '.join(Level)}") from None


def _named(name: str, paths: Sequence[str] | Mapping[str, Any], what: str) -> str:
    found = [path for path in paths if path == name] or [path for path in paths if path.endswith(f"/{name}")]
    if len(found) != 1:
        known = ", ".join(paths) or "none"
        raise EditError(f"there is {'no' if not found else 'more than one'} {what} '{name}'; there are {known}")
    return found[0]


def _default_memory() -> int:
    try:
        return int(_SHARE_OF_MEMORY * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return 4 << 30
