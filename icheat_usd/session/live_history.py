"""Steps of a live session that can be taken back: states, and what layers said before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from icheat_usd.session.live_state import LiveState
from icheat_usd.stage.layer_versions import LayerVersion

#: Pairs (what a layer says now, what it is to say).
Written = Sequence[tuple[LayerVersion, LayerVersion]]

#: Steps that undo goes back at most.
_LONGEST = 500


@dataclass(frozen=True, eq=False)
class Step:
    """What one command did."""

    label: str
    before: LiveState
    after: LiveState
    written: tuple[tuple[LayerVersion, LayerVersion], ...] = ()  #: layers as they were, and as they were made
    is_about_lights: bool = False  #: what was written to them


class LiveHistory:
    """Done and undone steps. A step that cannot be taken back stays where it is."""

    def __init__(self) -> None:
        self._done: list[Step] = []
        self._undone: list[Step] = []
        self._n_forgotten = 0

    def add(self, step: Step) -> None:
        """Something was done; what was undone before cannot be done again."""
        self._undone.clear()
        self._done.append(step)
        self._n_forgotten += max(0, len(self._done) - _LONGEST)
        del self._done[:-_LONGEST]

    def mark(self) -> int:
        """A place in the history, for `join`."""
        return self._n_forgotten + len(self._done)

    def join(self, mark: int, label: str) -> None:
        """Make one step of all that were added since."""
        first = max(0, mark - self._n_forgotten)
        steps = self._done[first:]
        if steps:
            written = tuple(pair for step in steps for pair in step.written)
            is_about_lights = any(step.is_about_lights for step in steps)
            self._done[first:] = [Step(label, steps[0].before, steps[-1].after, written, is_about_lights)]

    def undo(self, go: Callable[[LiveState, Written, bool], None]) -> str | None:
        """Have `go` bring back what was before the last step; its label, or None."""
        if not self._done:
            return None
        step = self._done[-1]
        go(step.before, [(after, before) for before, after in reversed(step.written)], step.is_about_lights)
        self._undone.append(self._done.pop())
        return step.label

    def redo(self, go: Callable[[LiveState, Written, bool], None]) -> str | None:
        """Have `go` bring back what was after the step that was undone last; its label, or None."""
        if not self._undone:
            return None
        step = self._undone[-1]
        go(step.after, step.written, step.is_about_lights)
        self._done.append(self._undone.pop())
        return step.label
