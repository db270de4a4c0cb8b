"""What a live session writes to layers, each time as one step that can be undone."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from icheat_usd.edits.model import EditStack
from icheat_usd.errors import IcheatError
from icheat_usd.scene import Finding
from icheat_usd.session import authoring
from icheat_usd.session.commit import write_changes
from icheat_usd.session.commit_lights import write_lights
from icheat_usd.session.document import Session
from icheat_usd.session.live_frames import LiveFrames
from icheat_usd.session.live_history import LiveHistory, Step
from icheat_usd.session.live_state import UNCHANGED, LiveState
from icheat_usd.stage.layer_versions import go_to_version, layer_version

Written = TypeVar("Written")


class LiveAuthoring:
    """The part of `LiveSession` that writes."""

    session: Session
    _frames: LiveFrames
    _history: LiveHistory

    @property
    @abstractmethod
    def stack(self) -> EditStack:
        """The edit stack at the playhead with all changes."""

    @abstractmethod
    def _edit(self, edit: str) -> str: ...

    def commit(
        self, layer: str, *, frame: float | None = None, sidecar: str | Path | None = None, why: str = ""
    ) -> tuple[Finding, ...]:
        """Write what was changed about edits to a layer and save it, as one step that can be undone.

        Changes of lights stay what they are, changes that are shown; `commit_lights` writes them.

        Parameters
        ----------
        frame
            Stage time to key the values at; without it they hold at all times.

        Returns
        -------
        tuple of Finding
            What has no effect, because a stronger layer decides it.

        Raises
        ------
        EditError, SidecarError
            Something cannot be written; the layer is then as before.
        """
        with self._frames.looking():
            session, stack, changes = self.session, self.stack, self._frames.state
            if not (changes.edits or changes.order):
                return ()

            def write() -> tuple[Finding, ...]:
                return write_changes(session, changes, stack, layer=layer, frame=frame, sidecar=sidecar, why=why)

            return self._author("commit", layer, write, replace(changes, edits=UNCHANGED.edits, order=()))

    def commit_lights(self, layer: str, *, frame: float | None = None, why: str = "") -> tuple[Finding, ...]:
        """Write what was changed about lights to a layer and save it, as one step that can be undone.

        A light that was moved gets one matrix, one that was dimmed another intensity, one that was recoloured a color
        and an intensity too; one that was removed is deactivated. Who, when and `why` are kept in the custom data of
        each. Every frame is made again then, of the rows that are there.

        Parameters
        ----------
        frame
            Stage time to key the values at; without it they hold at all times.

        Returns
        -------
        tuple of Finding
            What has no effect, because a stronger layer decides it.

        Raises
        ------
        EditError
            Something cannot be written, such as a light inside an instance; the layer is then as before.
        """
        with self._frames.looking() as shown:
            session, snapshot, changes = self.session, shown.snapshot, self._frames.state
            if not changes.lights:
                return ()

            def write() -> tuple[Finding, ...]:
                return write_lights(session.stage, snapshot, changes, layer=layer, frame=frame, why=why)

            after = replace(changes, lights=UNCHANGED.lights)
            return self._author("commit lights", layer, write, after, is_about_lights=True)

    def add_edit(self, name: str, *, layer: str = "session", **values: Any) -> str:
        """Add an edit to the stack, in the stage's session layer unless said otherwise; see `Session.add_edit`."""
        return self._author(f"add {name}", layer, lambda: self.session.add_edit(name, layer=layer, **values))

    def remove_edit(self, edit: str, *, layer: str) -> None:
        """Take an edit out of the stack in a layer."""
        path, session = self._edit(edit), self.session

        def write() -> None:
            authoring.remove_edit(session.stage, str(session.stack_path), path, layer=layer)

        self._author(f"remove {path}", layer, write)

    def set_edit(self, edit: str, *, layer: str, **values: Any) -> tuple[Finding, ...]:
        """Write values of an edit to a layer at once; see `Session.set_edit`."""
        path = self._edit(edit)
        return self._author(f"set {path}", layer, lambda: self.session.set_edit(path, layer=layer, **values))

    def set_key(self, edit: str, *, layer: str, frame: float | None, **values: Any) -> tuple[Finding, ...]:
        """Write a keyframe to a layer at once; see `Session.set_key`."""
        path = self._edit(edit)
        return self._author(
            f"key {path}", layer, lambda: self.session.set_key(path, layer=layer, frame=frame, **values)
        )

    def refresh(self) -> None:
        """Look at the edits of the stage again, after something else has written to it."""
        with self._frames.command():
            self._frames.stacks_changed()
            self._frames.set_state(self._frames.state)

    def _author(
        self,
        label: str,
        layer: str,
        write: Callable[[], Written],
        after: LiveState | None = None,
        *,
        is_about_lights: bool = False,
    ) -> Written:
        """Write to a layer; after any error the layer and what is shown are as before."""
        with self._frames.command(), self._frames.stage_lock:
            before, state = layer_version(self.session.stage, layer), self._frames.state
            result = write()
            made = layer_version(self.session.stage, layer)
            self._frames.stacks_changed()
            try:
                self._frames.set_state(state if after is None else after)
            except IcheatError:
                go_to_version(made, before)
                self._frames.stacks_changed()
                self._frames.set_state(state)
                raise
            if is_about_lights:
                self._frames.lights_changed()
            self._history.add(Step(label, state, self._frames.state, ((before, made),), is_about_lights))
            return result
