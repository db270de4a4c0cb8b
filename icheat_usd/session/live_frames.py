"""The frames of a live session: made in the background, coarse ones first, and kept at one `LiveState`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from weakref import WeakMethod

from icheat_usd.edits.model import EMPTY_STACK, EditStack
from icheat_usd.errors import IcheatError
from icheat_usd.freed_memory import give_freed_memory_back
from icheat_usd.kernels._jit import kernels_may_overlap
from icheat_usd.kernels.compiling import told_of_compiling
from icheat_usd.kernels.workers import start_workers
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import SceneSnapshot
from icheat_usd.session import authoring
from icheat_usd.session.background import Background, Job, Stopped
from icheat_usd.session.content_keys import digest
from icheat_usd.session.dabs import TexelPlaces
from icheat_usd.session.document import Session
from icheat_usd.session.evaluator import Evaluator
from icheat_usd.session.first_look import rough_surfaces, surfaces_by_headlight
from icheat_usd.session.first_use import begin_use, end_use
from icheat_usd.session.frames import ResidentFrames, SharedParts, share_tables
from icheat_usd.session.live_events import Level, Listener, LiveEvent
from icheat_usd.session.live_state import UNCHANGED, LiveState
from icheat_usd.session.quality import coarse
from icheat_usd.session.shot_parts import ShotParts
from icheat_usd.stage.edit_stack import read_edit_stack
from icheat_usd.transport import Transport
from icheat_usd.transport.packed import PackedTransport

#: Frames whose parts are kept while they are being made, or when another one interrupted them.
_MOST_UNFINISHED = 2


class LiveFrame:
    """One frame: what the stage says at it, and the best that there is to show it with."""

    def __init__(self, snapshot: SceneSnapshot, lights_version: int) -> None:
        self.snapshot = snapshot
        self.lights_version = lights_version  #: where it is old, this is kept for what the next one shares with it
        self.stack: EditStack | None = None
        self.stack_version = 0
        self.places = TexelPlaces(snapshot)
        self.evaluator: Evaluator | None = None
        self.level = Level.NONE


class LiveFrames:
    """Frames around a playhead, getting better by themselves, all at one state.

    Parameters
    ----------
    session : Session
        Stage, camera, size and quality; its frame is where the playhead stands first.
    memory : bytes
        Limit of all frames together.
    """

    def __init__(self, session: Session, memory: int) -> None:
        self.session = session
        self.state = UNCHANGED
        self.prefetch: tuple[float, ...] = ()  #: frames to prepare when the one at the playhead is done
        self.stage_lock = threading.RLock()  #: held after that of commands, never before it
        self.resident: ResidentFrames[LiveFrame] = ResidentFrames(memory)
        self.resident.move(session.frame)
        self._shared = SharedParts()
        self._stack_version = 0  #: grows when edits are written to the stage
        self._lights_version = 0  #: grows when lights are
        self._listeners: list[Listener] = []
        self._failed: dict[tuple[float | None, Level], Exception] = {}
        self._building: dict[tuple[float | None, Level], ShotParts] = {}
        self._building_version = 0  #: of the lights in `_building`
        self._asked: tuple[float | None, Level] = (None, Level.NONE)  #: what the background is to make
        self._job: tuple[float | None, Level] = self._asked  #: what it makes for that, which may be better
        self._first_use = begin_use(self)
        start_workers()
        self._background = Background(self._next_job, self._on_error, kernels_may_overlap, give_freed_memory_back)
        self._background.start()

    # For commands -----------------------------------------------------------------------------------------------------

    def command(self) -> AbstractContextManager[None]:
        """Held while frames are looked at or changed; the background lets it go first."""
        return self._background.command()

    @contextmanager
    def looking(self, level: Level = Level.PREVIEW) -> Iterator[LiveFrame]:
        """A command that needs the frame at the playhead: waits for it first, since none can come while one is held."""
        while True:
            self.wait(level)
            with self.command():
                frame = self.resident.get(self.resident.playhead)
                if frame is not None and frame.level.reaches(level):
                    yield frame
                    return

    @property
    def level(self) -> Level:
        """How good the image at the playhead is."""
        frame = self.resident.get(self.resident.playhead)
        return Level.NONE if frame is None else frame.level

    def wait(self, level: Level, timeout: float | None = None) -> bool:
        """Wait until the frame at the playhead is this good; false if `timeout` seconds were not enough.

        Raises
        ------
        IcheatError
            It cannot be made, or the session is closed.
        """
        if self.level.reaches(level):
            return True
        done = self._background.wait_for(lambda: self.level.reaches(level) or self._failure() is not None, timeout)
        if not self.level.reaches(level):
            failure = self._failure()
            if failure is not None:
                raise failure
            if self._background.is_closing:
                raise IcheatError("the live session is closed; open another one")
        return done

    def here(self) -> LiveFrame:
        """The frame at the playhead, with something to show it with."""
        self.wait(Level.PREVIEW)
        frame = self.resident.get(self.resident.playhead)
        assert frame is not None
        return frame

    def shown(self) -> Evaluator:
        """What shows the frame at the playhead, at the state."""
        frame = self.here()
        assert frame.evaluator is not None
        frame.evaluator.show(self.stack_of(frame), self.state)
        return frame.evaluator

    def set_state(self, state: LiveState) -> None:
        """Show a state, or say why it cannot be shown and stay.

        Raises
        ------
        EditError, LightError
            A value does not fit the scene.
        """
        frame, before = self.resident.get(self.resident.playhead), self.state
        if frame is not None and frame.evaluator is not None:
            stack = self.stack_of(frame)
            try:
                frame.evaluator.show(stack, state)
            except IcheatError:
                frame.evaluator.show(stack, before)
                self._changed()  # some of it was shown: lights may have to come to rest again
                raise
        self.state = state
        self._failed.clear()
        if state is not before:
            self._changed()

    def stack_of(self, frame: LiveFrame) -> EditStack:
        """What the stage says about edits at a frame."""
        if frame.stack is None or frame.stack_version != self._stack_version:
            version = self._stack_version
            frame.stack, frame.stack_version = self._read_stack(frame.snapshot), version
        return frame.stack

    def stacks_changed(self) -> None:
        """Edits were written to the stage."""
        self._stack_version += 1
        self._failed.clear()

    def lights_changed(self) -> None:
        """Lights were written to the stage: every frame is made again, of the same rows."""
        self._lights_version += 1
        for number in self.resident.frames():
            frame = self.resident.get(number)
            if frame is not None:
                frame.level = Level.NONE
        self._failed.clear()
        self._background.wake(stop_job=True)

    def scrub(self, frame: float | None) -> bool:
        """Put the playhead at a frame; whether it can be shown without waiting."""
        with self.command():
            if frame != self.resident.playhead:
                self._changed()  # frames share what shows them: it has to come back to this one's edits
            self.resident.move(frame)
            self.session.frame = frame
            self._leave_others()
            ready = self.level is not Level.NONE
        self._background.wake(stop_job=self._job[0] != frame)
        return ready

    def listen(self, listener: Listener) -> Callable[[], None]:
        self._listeners.append(listener)
        return lambda: self._listeners.remove(listener)

    def close(self) -> None:
        self._background.close()
        end_use(self._first_use, self)

    def _changed(self) -> None:
        """What is shown is to be refined again."""
        for number in self.resident.frames():
            frame = self.resident.get(number)
            if frame is not None and frame.level is Level.REST:
                frame.level = Level.FULL
        self._background.wake()

    def _leave_others(self) -> None:
        """What shows other frames than that at the playhead needs nothing that is for lights in motion alone."""
        here = self.resident.get(self.resident.playhead)
        shown = None if here is None else here.evaluator
        for number in self.resident.frames():
            frame = self.resident.get(number)
            if frame is not None and frame.evaluator not in (None, shown):
                frame.evaluator.leave()

    def _read_stack(self, snapshot: SceneSnapshot) -> EditStack:
        surfaces = {surface.path for surface in snapshot.surfaces}
        with self.stage_lock:
            path = self.session.stack_path
            if path is None:
                return EMPTY_STACK
            time, read = snapshot.time_code, authoring.read_payload
            return read_edit_stack(self.session.stage, path, time, surfaces, read, with_muted=True)[0]

    # Background -------------------------------------------------------------------------------------------------------

    def _next_job(self) -> Job | None:
        playhead = self.resident.playhead
        for frame, level in self._wanted():
            entry = self.resident.get(frame)
            reached = Level.NONE if entry is None else entry.level
            if (frame, level) in self._failed or reached.reaches(level):
                continue
            if level is Level.REST and reached is not Level.FULL:
                continue  # what comes before it has failed
            self._asked = self._job = frame, level
            if level is Level.REST:
                return lambda frame=frame: self._refine(frame)  # type: ignore[misc]
            return lambda frame=frame, level=level: self._make(frame, level)  # type: ignore[misc]
        self._job = playhead, Level.REST
        return None

    def _wanted(self) -> Iterator[tuple[float | None, Level]]:
        """What to make, in this order."""
        playhead, direction = self.resident.playhead, self.resident.direction
        for level in (Level.PREVIEW, Level.FULL, Level.REST):
            yield playhead, level
        if playhead is None:
            return
        ahead = sorted(self.prefetch, key=lambda frame: ((frame - playhead) * direction < 0, abs(frame - playhead)))
        for level in (Level.PREVIEW, Level.FULL):
            for frame in ahead:
                if frame != playhead and not self._is_full(frame):
                    yield frame, level

    def _is_full(self, frame: float) -> bool:
        """Whether making this frame would only push out another one that is as useful."""
        if self.resident.get(frame) is not None:
            return False
        return self.resident.bytes() >= self.resident.limit

    def _make(self, number: float | None, level: Level) -> None:
        with told_of_compiling(self._compiles):
            self._make_of_parts(number, level)

    def _make_of_parts(self, number: float | None, level: Level) -> None:
        if not self._first_use.is_done("look"):
            self._look_roughly(number)
            self._first_use.wait("look", self._progress)
        began, version = time.perf_counter(), self._lights_version
        if self._building_version != version:
            self._building.clear()
            self._building_version = version
        if level is Level.PREVIEW and self._parts(number, Level.FULL).is_shared:
            # Another frame has measured all rows: coarse ones would take longer.
            level = Level.FULL
            self._job = number, level
        parts = self._parts(number, level)
        with self._background.lock:
            entry = self.resident.get(number)
        frame = LiveFrame(parts.snapshot, version) if entry is None or entry.lights_version != version else entry
        key = digest(_keys_of_image(parts), parts.snapshot.centre)
        evaluator = self._shared.find("evaluator", key)
        if evaluator is None:
            if frame.evaluator is None:
                look = surfaces_by_headlight(parts.view)
                self._tell(LiveEvent("surfaces", number, frame.level, image=look))
            self._first_use.wait("preview" if level is Level.PREVIEW else "live", self._progress)
            for transport in parts.transports():
                if evaluator is None:
                    evaluator = self._evaluator(parts, frame, transport, level)
                    self._show(
                        number,
                        frame,
                        evaluator,
                        frame.level if frame.level.reaches(Level.PREVIEW) else Level.PREVIEW,
                        began,
                    )
                    continue
                with self._background.lock:
                    evaluator.relighter.set_transport(transport)
                self._tell(LiveEvent("better", number, frame.level))
            assert evaluator is not None
            self._shared.keep("evaluator", key, evaluator)
        if frame.evaluator is not evaluator or frame.level is not level:
            self._show(number, frame, evaluator, level, began)
        self._forget_parts(number, *((level,) if level is Level.PREVIEW else Level))

    def _look_roughly(self, number: float | None) -> None:
        """Show the surfaces while what would show them better is compiled."""
        if self.resident.get(number) is not None:
            return
        look = None
        # What is wrong with the stage is told by who reads it in earnest; whatever else fails here is no loss.
        with suppress(Exception):
            shot = self.session.at(number)
            shot.progress = silent
            with self.stage_lock:
                snapshot = shot.rough_snapshot()
            self._background.progress()
            look = rough_surfaces(snapshot)
        if look is not None:
            self._tell(LiveEvent("surfaces", number, Level.NONE, image=look))

    def _evaluator(
        self, parts: ShotParts, frame: LiveFrame, transport: Transport | PackedTransport, level: Level
    ) -> Evaluator:
        """At the state already: without the lock, as lights that were changed are worked out here."""
        with self._background.lock:
            stack, state = self.stack_of(frame), self.state
        evaluator = Evaluator(parts, transport, is_coarse=level is Level.PREVIEW)
        evaluator.show(stack, state)
        # Its kernels are compiled here if need be: who asks for the image would wait for whatever is compiled next.
        evaluator.frame()
        return evaluator

    def _show(self, number: float | None, frame: LiveFrame, evaluator: Evaluator, level: Level, began: float) -> None:
        """Have a frame shown by something better."""
        with self._background.lock:
            if frame.lights_version != self._lights_version:
                raise Stopped
            evaluator.show(self.stack_of(frame), self.state)
            frame.evaluator, frame.level = evaluator, level
            self.resident.put(number, frame, time.perf_counter() - began)
            self._leave_others()
        self._tell(LiveEvent("better", number, level))

    def _parts(self, number: float | None, level: Level) -> ShotParts:
        """The parts of a frame at a level; those that are done are kept when another job is more urgent."""
        if (number, level) not in self._building:
            session = self.session
            quality = session.quality if level is Level.FULL else coarse(session.quality)
            snapshot = self._snapshot_of(number)
            others = [frame for frame in dict.fromkeys(frame for frame, _ in self._building) if frame != number]
            for frame in others[: 1 - _MOST_UNFINISHED]:
                self._forget_parts(frame, *Level)
            self._building[number, level] = ShotParts(
                quality,
                snapshot=snapshot,
                engine=session._engine,
                progress=_while_it_lives(self._progress),
                disk=session._disk,
                memory=self._shared,
            )
        return self._building[number, level]

    def _forget_parts(self, number: float | None, *levels: Level) -> None:
        for level in levels:
            self._building.pop((number, level), None)

    def _snapshot_of(self, number: float | None) -> SceneSnapshot:
        """The stage at a frame, read once for all levels."""
        building = [parts.snapshot for (frame, _), parts in self._building.items() if frame == number]
        if building:
            return building[0]
        entry = self.resident.get(number)
        if entry is None or entry.lights_version != self._building_version:
            return self._read_snapshot(number)
        return entry.snapshot

    def _read_snapshot(self, number: float | None) -> SceneSnapshot:
        """The stage at a frame; tables that are as in a resident frame are the same objects."""
        shot = self.session.at(number)
        shot.progress = silent
        with self.stage_lock:
            snapshot = shot.snapshot
        for other in (self.resident.playhead, *self.resident.frames()):
            entry = self.resident.get(other)
            if entry is not None:
                return share_tables(snapshot, entry.snapshot)
        return snapshot

    def _refine(self, number: float | None) -> None:
        while True:
            self._background.progress()
            with self._background.lock:
                frame = self.resident.get(number)
                if frame is None or frame.evaluator is None or frame.level is not Level.FULL:
                    return
                evaluator = frame.evaluator
                evaluator.show(self.stack_of(frame), self.state)
                if evaluator.refine():
                    continue
                if not evaluator.wants_bounces:
                    frame.level = Level.REST
                    break
            bounces = evaluator.more_bounces()
            with self._background.lock:
                if evaluator.wants_bounces:
                    evaluator.take_bounces(bounces)
        self._tell(LiveEvent("better", number, Level.REST))

    def _progress(self, step: str, fraction: float) -> None:
        self._background.progress()
        self._tell(LiveEvent("progress", self._job[0], self._job[1], step, fraction))

    def _compiles(self, n: int, name: str) -> None:
        self._tell(LiveEvent("progress", self._job[0], self._job[1], f"first use: compile kernel {n} ({name})"))

    def _failure(self) -> Exception | None:
        playhead = self.resident.playhead
        return next((error for (frame, _), error in self._failed.items() if frame == playhead), None)

    def _on_error(self, error: Exception) -> None:
        self._failed[self._asked] = self._failed[self._job] = error
        self._forget_parts(self._job[0], *Level)
        self._tell(LiveEvent("error", self._job[0], self._job[1], error=error))

    def _tell(self, event: LiveEvent) -> None:
        self._background.notify()
        for listener in tuple(self._listeners):
            listener(event)


def _while_it_lives(progress: Progress) -> Progress:
    """A method that does not keep its object: frames keep their parts, and parts what they report to."""
    method = WeakMethod(progress)

    def report(step: str, fraction: float) -> None:
        if (alive := method()) is not None:
            alive(step, fraction)

    return report


def _keys_of_image(parts: ShotParts) -> tuple[str, ...]:
    """Of everything that an evaluator shows but the edits: frames that agree in these share one."""
    keys = parts.keys
    return keys.packed, keys.view, keys.cell_light, keys.view_light
