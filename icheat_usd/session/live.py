"""A preview that is there in seconds, gets better by itself, and follows every change at once.

    with LiveSession.open("shot.usda") as live:
        for i in range(20):
            live.set_amount("warm", i / 19)
            write_png(live.film(), f"warm_{i:02}.png")
        live.set_light("/World/Lamp", gain=0.5, move=(0, 0.4, 0))
        live.wait("rest")
        write_exr(live.film(), "dimmer.exr")
        live.undo()
        live.commit("shot.usda")

Commands change a `LiveState` in memory and return at once; `frame` and `film` show it. `commit` writes it to a layer.
A coarse preview is made first, then, in a thread of its own, one with all that the quality asks for, and then the other
frames around the playhead. Listeners (`listen`) hear when there is something better to show.
"""

from __future__ import annotations

import atexit
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.edits.model import EMPTY_STACK, EditStack, Value
from icheat_usd.edits.operations.base import plain_values
from icheat_usd.errors import EditError, IcheatError
from icheat_usd.image.film import Film
from icheat_usd.image.texture import read_texture
from icheat_usd.kernels._jit import kernels_may_overlap
from icheat_usd.progress import silent
from icheat_usd.scene import F32, F64, LightKind, SceneSnapshot
from icheat_usd.session import authoring, films
from icheat_usd.session.background import Background, Job
from icheat_usd.session.content_keys import digest
from icheat_usd.session.document import Session
from icheat_usd.session.evaluator import Evaluator, light_of_stage
from icheat_usd.session.frames import ResidentFrames, SharedParts, share_tables
from icheat_usd.session.live_state import UNCHANGED, LightChange, LiveState, colour, moved
from icheat_usd.session.quality import PREVIEW, Quality, coarse
from icheat_usd.session.shot_parts import ShotParts
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.stage.textures import to_linear_rgba

#: Memory for frames by default: a quarter of the machine's.
_SHARE_OF_MEMORY = 0.25

#: Steps that undo goes back at most.
_HISTORY = 500


class Level(StrEnum):
    """How good the image of a frame is."""

    NONE = "none"
    PREVIEW = "preview"  #: coarse, for orientation
    FULL = "full"  #: all rows that the quality asks for; lights that moved may still be noisy
    REST = "rest"  #: nothing is left to be done


_ORDER = {level: i for i, level in enumerate(Level)}


@dataclass(frozen=True)
class LiveEvent:
    """What listeners hear; from the background thread, so hand it on to the window's own."""

    kind: str  #: "progress", "better" (show the frame again) or "error"
    frame: float | None
    level: Level
    step: str = ""
    fraction: float = 0.0
    error: Exception | None = None


@dataclass(frozen=True, eq=False)
class _Step:
    """One entry of the history."""

    label: str
    before: LiveState
    after: LiveState


class _Frame:
    """One frame: what the stage says at it, and the best that there is to show it with."""

    def __init__(self, snapshot: SceneSnapshot) -> None:
        self.snapshot = snapshot
        self.stack: EditStack | None = None
        self.stack_version = 0
        self.evaluator: Evaluator | None = None
        self.level = Level.NONE


class LiveSession:
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
        self._shared = SharedParts()
        self._stage_lock = threading.RLock()  #: held after the background's, never before it
        self._stack_version = 0  #: grows when edits are written to the stage
        self._frames: ResidentFrames[_Frame] = ResidentFrames(_default_memory() if memory is None else memory)
        self._frames.move(session.frame)
        self._prefetch = tuple(prefetch)
        self._state = UNCHANGED
        self._done: list[_Step] = []
        self._undone: list[_Step] = []
        self._gesture: str | None = None
        self._listeners: list[Callable[[LiveEvent], None]] = []
        self._failed: dict[tuple[float | None, Level], Exception] = {}
        self._building: dict[tuple[float | None, Level], ShotParts] = {}
        self._background = Background(self._next_job, self._on_error, kernels_may_overlap)
        self._job: tuple[float | None, Level] = (None, Level.NONE)
        atexit.register(self.close)
        self._background.start()

    @classmethod
    def open(
        cls,
        stage: str | Path | Any,
        *,
        quality: Quality = PREVIEW,
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
        self._background.close()

    def __enter__(self) -> LiveSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def listen(self, listener: Callable[[LiveEvent], None]) -> Callable[[], None]:
        """Have a listener told of progress; calling what is returned ends that."""
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def wait(self, level: Level | str = Level.PREVIEW, timeout: float | None = None) -> bool:
        """Wait until the frame at the playhead is this good; false if `timeout` seconds were not enough.

        Raises
        ------
        IcheatError
            It cannot be made.
        """
        wanted = _ORDER[_level(level)]

        def reached() -> bool:
            return _ORDER[self.level] >= wanted or self._failure() is not None

        done = self._background.wait_for(reached, timeout)
        failure = self._failure()
        if failure is not None and _ORDER[self.level] < wanted:
            raise failure
        if self._background.is_closing and not done:
            raise IcheatError("the live session is closed")
        return done

    # What is shown ----------------------------------------------------------------------------------------------------

    @property
    def level(self) -> Level:
        """How good the image at the playhead is."""
        frame = self._frames.get(self._frames.playhead)
        return Level.NONE if frame is None else frame.level

    def frame(self, out: F32 | None = None) -> F32:
        """The image as it is now, (height, width, 3) float32, scene-linear; waits for the first preview of a frame."""
        self.wait(Level.PREVIEW)
        with self._background.command():
            return self._shown().frame(out)

    def film(self) -> Film:
        """The image in layers, as `Session.relight` gives it."""
        self.wait(Level.PREVIEW)
        with self._background.command():
            evaluator, stack = self._shown(), self.stack
            settings = {**asdict(self.session.quality), "level": str(self.level)}
            metadata = films.image_metadata(self._here().snapshot, "live relight", stack, settings)
            return films.relit_film(evaluator.view, evaluator.relit(), metadata)

    @property
    def stack(self) -> EditStack:
        """The edit stack at the playhead with all changes."""
        with self._background.command():
            return self._state.laid_over(self._stack_of(self._here()))

    @property
    def state(self) -> LiveState:
        """Everything that was changed and not yet committed; `show` takes it back."""
        return self._state

    def show(self, state: LiveState, label: str = "state") -> None:
        """Show another state, as one step that can be undone."""
        self._do(label, state)

    @property
    def snapshot(self) -> SceneSnapshot:
        """The stage at the playhead, without changes."""
        self.wait(Level.PREVIEW)
        return self._here().snapshot

    def pick(self, x: int, y: int) -> tuple[str, F64] | None:
        """Surface and place (metres, stage axes) that a pixel shows, counted from the top left; None: the sky."""
        self.wait(Level.PREVIEW)
        with self._background.command():
            evaluator, frame = self._here().evaluator, self._here()
            assert evaluator is not None
            view = evaluator.view
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
        snapshot = self.snapshot
        found = {path: light_of_stage(snapshot, path) for path in snapshot.light_paths}
        for path, change in self._state.lights.items():
            if path in found or change.added is not None:
                found[path] = _filled(change, found.get(path, LightChange()))
        return found

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
        path = self._light(light)
        now = self.lights[path]
        values: dict[str, Any] = {}
        if gain is not None:
            values["gain"] = colour(gain, f"{path}: gain")
        if radiance is not None:
            values["radiance"] = colour(radiance, f"{path}: radiance")
        if size is not None:
            values["size"] = tuple(float(v) for v in size)
        if to_world is not None or move is not None or turn is not None:
            values["to_world"] = _placed(now.to_world if to_world is None else np.array(to_world, float), move, turn)
        if texture is not None:
            values |= _image(texture)
        self._do(f"light {path}", self._state.with_light(path, **values))

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
        if path in self.lights:
            raise EditError(f"{path} is a light already; choose another path")
        if not path.startswith("/"):
            raise EditError(f"'{path}' is no path for a light, such as /World/Lights/Key")
        try:
            known = LightKind[kind.upper()] if isinstance(kind, str) else LightKind(kind)
        except (KeyError, ValueError):
            raise EditError(f"'{kind}' is no light; known are {', '.join(k.name.lower() for k in LightKind)}") from None
        place = np.concatenate([np.eye(3), np.reshape(np.asarray(at, float), (3, 1))], axis=1)
        values = {} if texture is None else _image(texture)
        change = LightChange(
            to_world=place if to_world is None else np.array(to_world, np.float64).reshape(3, 4),
            radiance=colour(radiance, f"{path}: radiance"),
            size=(float(size[0]), float(size[1]) if len(size) > 1 else 0.0),
            added=known,
            **values,
        )
        self._do(f"add light {path}", replace(self._state, lights={**self._state.lights, path: change}))

    def remove_light(self, light: str) -> None:
        """Take a light away."""
        path = self._light(light)
        added = path in self._state.lights and self._state.lights[path].added is not None
        state = self._state.without_light(path) if added else self._state.with_light(path, removed=True)
        self._do(f"remove light {path}", state)

    # Edits ------------------------------------------------------------------------------------------------------------

    def set_amount(self, edit: str, amount: float) -> None:
        """How much of an edit is laid over the weaker ones, by its name or path; 0 leaves it out."""
        path = self._edit(edit)
        if not np.isfinite(amount):
            raise EditError(f"{path}: the amount is {amount!r}, expected a finite number")
        self._do(f"amount {path}", self._state.with_edit(path, amount=float(amount)))

    def set_parameters(self, edit: str, **values: Value) -> None:
        """Parameters of an edit's operation, at all its keys."""
        path = self._edit(edit)
        self._do(f"parameters {path}", self._state.with_parameters(path, plain_values(values)))

    def mute(self, edit: str, muted: bool = True) -> None:
        """Mute an edit, or let it take part again."""
        path = self._edit(edit)
        self._do(f"{'mute' if muted else 'unmute'} {path}", self._state.with_edit(path, enabled=not muted))

    def move_edit(self, edit: str, *, before: str | None = None, after: str | None = None) -> None:
        """Move an edit before or after another one; to the end, the strongest place, if neither is given."""
        path = self._edit(edit)
        others = {"before": before, "after": after}
        named = {name: self._edit(other) for name, other in others.items() if other is not None}
        order = moved([edit.path for edit in self.stack.edits], path, **named)
        self._do(f"move {path}", replace(self._state, order=order))

    # History ----------------------------------------------------------------------------------------------------------

    @contextmanager
    def gesture(self, label: str) -> Iterator[None]:
        """Commands in the block are one step for undo: a drag, from press to release."""
        with self._background.command():
            first, before = len(self._done), self._state
        yield
        with self._background.command():
            if len(self._done) > first or self._state is not before:
                del self._done[first:]
                self._done.append(_Step(label, before, self._state))

    def undo(self) -> str | None:
        """Take back the last step; what it was, None if there is none."""
        with self._background.command():
            if not self._done:
                return None
            step = self._done.pop()
            self._set(step.before)
            self._undone.append(step)
            return step.label

    def redo(self) -> str | None:
        """Do again what was taken back last; what it was, None if there is nothing."""
        with self._background.command():
            if not self._undone:
                return None
            step = self._undone.pop()
            self._set(step.after)
            self._done.append(step)
            return step.label

    # Time -------------------------------------------------------------------------------------------------------------

    def scrub(self, frame: float | None) -> bool:
        """Put the playhead at a frame; whether it can be shown without waiting."""
        with self._background.command():
            self._frames.move(frame)
            self.session.frame = frame
            ready = self.level is not Level.NONE
        self._background.wake(stop_job=not ready or self._job[0] != frame)
        return ready

    def play(self, frames: Sequence[float], *, level: Level | str = Level.PREVIEW) -> Iterator[tuple[float, F32]]:
        """Go through frames, each at least this good, and prepare those ahead."""
        self._prefetch = tuple(frames)
        for frame in frames:
            self.scrub(frame)
            self.wait(level)
            yield frame, self.frame()

    @property
    def resident(self) -> Mapping[float | None, Level]:
        """Frames in memory, and how good each is."""
        found = {frame: self._frames.get(frame) for frame in self._frames.frames()}
        return {frame: entry.level for frame, entry in found.items() if entry is not None}

    def memory(self) -> dict[str, int]:
        """Bytes of arrays: `total` of all frames, `limit`, and of the frame at the playhead `frame` and its `own`."""
        with self._background.command():
            whole, own = self._frames.bytes_of(self._frames.playhead) if self._here_or_none() else (0, 0)
            return {"total": self._frames.bytes(), "limit": self._frames.limit, "frame": whole, "own": own}

    # Inside -----------------------------------------------------------------------------------------------------------

    def _here_or_none(self) -> _Frame | None:
        return self._frames.get(self._frames.playhead)

    def _here(self) -> _Frame:
        self.wait(Level.PREVIEW)
        frame = self._here_or_none()
        assert frame is not None
        return frame

    def _shown(self) -> Evaluator:
        frame = self._here()
        assert frame.evaluator is not None
        frame.evaluator.show(self._stack_of(frame), self._state)
        return frame.evaluator

    def _stack_of(self, frame: _Frame) -> EditStack:
        if frame.stack is None or frame.stack_version != self._stack_version:
            version = self._stack_version
            frame.stack, frame.stack_version = self._read_stack(frame.snapshot), version
        return frame.stack

    def _read_stack(self, snapshot: SceneSnapshot) -> EditStack:
        surfaces = {surface.path for surface in snapshot.surfaces}
        with self._stage_lock:
            path = self.session.stack_path
            if path is None:
                return EMPTY_STACK
            time, read = snapshot.time_code, authoring.read_payload
            return read_edit_stack(self.session.stage, path, time, surfaces, read, with_muted=True)[0]

    def _do(self, label: str, state: LiveState) -> None:
        with self._background.command():
            before = self._state
            self._set(state)
            self._undone.clear()
            self._done.append(_Step(label, before, state))
            del self._done[:-_HISTORY]

    def _set(self, state: LiveState) -> None:
        """Show a state, or say why it cannot be shown and stay."""
        frame, before = self._here_or_none(), self._state
        if frame is not None and frame.evaluator is not None:
            try:
                frame.evaluator.show(self._stack_of(frame), state)
            except IcheatError:
                frame.evaluator.show(self._stack_of(frame), before)
                raise
            if frame.level is Level.REST:
                frame.level = Level.FULL
        self._state = state
        self._background.wake()

    def _light(self, light: str) -> str:
        return _named(light, self.lights, "light")

    def _edit(self, edit: str) -> str:
        return _named(edit, [found.path for found in self._stack_of(self._here()).edits], "edit")

    # Background -------------------------------------------------------------------------------------------------------

    def _next_job(self) -> Job | None:
        playhead = self._frames.playhead
        for frame, level in self._wanted():
            entry = self._frames.get(frame)
            reached = Level.NONE if entry is None else entry.level
            if (frame, level) in self._failed or _ORDER[reached] >= _ORDER[level]:
                continue
            self._job = frame, level
            if level is Level.REST:
                return lambda frame=frame: self._refine(frame)  # type: ignore[misc]
            return lambda frame=frame, level=level: self._make(frame, level)  # type: ignore[misc]
        self._job = playhead, Level.REST
        return None

    def _wanted(self) -> Iterator[tuple[float | None, Level]]:
        """What to make, in this order."""
        playhead, direction = self._frames.playhead, self._frames.direction
        for level in (Level.PREVIEW, Level.FULL, Level.REST):
            yield playhead, level
        if playhead is None:
            return
        ahead = sorted(self._prefetch, key=lambda frame: ((frame - playhead) * direction < 0, abs(frame - playhead)))
        for level in (Level.PREVIEW, Level.FULL):
            for frame in ahead:
                if frame != playhead and not self._is_full(frame):
                    yield frame, level

    def _is_full(self, frame: float) -> bool:
        """Whether making this frame would only push out another one that is as useful."""
        if self._frames.get(frame) is not None:
            return False
        return self._frames.bytes() >= self._frames.limit

    def _make(self, number: float | None, level: Level) -> None:
        began = time.perf_counter()
        parts = self._parts(number, level)
        with self._background.lock:
            state, entry = self._state, self._frames.get(number)
        frame = _Frame(parts.snapshot) if entry is None else entry
        stack = self._read_stack(parts.snapshot)
        evaluator, is_new = self._evaluator(parts)
        if is_new:
            # Without the lock: lights that were changed are worked out here.
            evaluator.show(stack, state)
        with self._background.lock:
            evaluator.show(self._stack_of(frame), self._state)
            frame.evaluator, frame.level = evaluator, level
            self._frames.put(number, frame, time.perf_counter() - began)
        self._building.pop((number, level), None)
        self._tell(LiveEvent("better", number, level))

    def _evaluator(self, parts: ShotParts) -> tuple[Evaluator, bool]:
        """One for all frames that look the same but for their edits; whether it was made now."""
        keys = parts.keys
        key = digest(keys.transport, keys.view, keys.cell_light, keys.view_light, parts.snapshot.centre)
        made: list[Evaluator] = []

        def make() -> Evaluator:
            made.append(Evaluator(parts, parts.transport, parts.quality.light_samples))
            return made[0]

        return self._shared.get("evaluator", key, make), bool(made)

    def _parts(self, number: float | None, level: Level) -> ShotParts:
        """The parts of a frame at a level; those that are done are kept when another job is more urgent."""
        if (number, level) not in self._building:
            session = self.session
            quality = session.quality if level is Level.FULL else coarse(session.quality)
            entry = self._frames.get(number)
            snapshot = self._read_snapshot(number) if entry is None else entry.snapshot
            self._building[number, level] = ShotParts(
                quality,
                snapshot=snapshot,
                engine=session._engine,
                progress=self._progress,
                disk=session._disk,
                memory=self._shared,
            )
        return self._building[number, level]

    def _read_snapshot(self, number: float | None) -> SceneSnapshot:
        """The stage at a frame; tables that are as in a resident frame are the same objects."""
        shot = self.session.at(number)
        shot.progress = silent
        with self._stage_lock:
            snapshot = shot.snapshot
        for other in (self._frames.playhead, *self._frames.frames()):
            entry = self._frames.get(other)
            if entry is not None:
                return share_tables(snapshot, entry.snapshot)
        return snapshot

    def _refine(self, number: float | None) -> None:
        while True:
            self._background.progress()
            with self._background.lock:
                frame = self._frames.get(number)
                if frame is None or frame.evaluator is None or frame.level is not Level.FULL:
                    return
                frame.evaluator.show(self._stack_of(frame), self._state)
                if not frame.evaluator.refine():
                    frame.level = Level.REST
                    break
        self._tell(LiveEvent("better", number, Level.REST))

    def _progress(self, step: str, fraction: float) -> None:
        self._background.progress()
        self._tell(LiveEvent("progress", self._job[0], self._job[1], step, fraction))

    def _failure(self) -> Exception | None:
        playhead = self._frames.playhead
        return next((error for (frame, _), error in self._failed.items() if frame == playhead), None)

    def _on_error(self, error: Exception) -> None:
        self._failed[self._job] = error
        self._building.pop(self._job, None)
        self._tell(LiveEvent("error", self._job[0], self._job[1], error=error))

    def _tell(self, event: LiveEvent) -> None:
        self._background.notify()
        for listener in tuple(self._listeners):
            listener(event)


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


def _filled(change: LightChange, own: LightChange) -> LightChange:
    names = ("to_world", "radiance", "size", "texture")
    return replace(change, **{name: getattr(own, name) for name in names if getattr(change, name) is None})


def _placed(now: F64 | None, move: Sequence[float] | None, turn: tuple[Sequence[float], float] | None) -> F64:
    place: F64 = np.array(np.eye(3, 4) if now is None else now, np.float64)
    if place.shape != (3, 4) or not np.isfinite(place).all():
        raise EditError(f"a light's transform has shape (3, 4) and finite numbers, not {place.tolist()}")
    if turn is not None:
        place[:, :3] = _rotation(*turn) @ place[:, :3]
    if move is not None:
        place[:, 3] += np.asarray(move, np.float64)
    return place


def _rotation(axis: Sequence[float], degrees: float) -> F64:
    x, y, z = np.asarray(axis, np.float64) / (float(np.linalg.norm(axis)) or 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    turned: F64 = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


def _image(texture: str | Path | F32) -> dict[str, Any]:
    if isinstance(texture, np.ndarray):
        return {"texture": np.ascontiguousarray(texture, np.float32), "texture_file": ""}
    if not str(texture):
        return {"texture": np.zeros((0, 0, 3), np.float32), "texture_file": ""}
    return {"texture": to_linear_rgba(read_texture(texture), "auto"), "texture_file": str(texture)}


def _default_memory() -> int:
    try:
        return int(_SHARE_OF_MEMORY * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return 4 << 30
