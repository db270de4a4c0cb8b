"""Steps of a live session that can be taken back: states, and what layers said before and after."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from icheat_usd.session.kept_states import KeptState, StateShelf
from icheat_usd.session.live_state import LiveState
from icheat_usd.stage.layer_versions import LayerVersion

#: Pairs (what a layer says now, what it is to say).
Written = Sequence[tuple[LayerVersion, LayerVersion]]

#: Steps that undo goes back at most, and bytes of arrays that these keep; the last step stays, however large.
_LONGEST, _MOST_BYTES = 500, 128 << 20


@dataclass(frozen=True, eq=False)
class Step:
    """What one command did."""

    label: str
    before: LiveState
    after: LiveState
    written: tuple[tuple[LayerVersion, LayerVersion], ...] = ()  #: layers as they were, and as they were made
    is_about_lights: bool = False  #: what was written to them


class LiveHistory:
    """Done and undone steps. A step that cannot be taken back stays where it is.

    Steps share what their masks have in common. The oldest are forgotten when
    there are too many of them, or when they take too much memory; those since
    a mark become one, so that it leads back to there however long it gets.
    """

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._shelf = StateShelf()
        self._done: list[_KeptStep] = []
        self._undone: list[_KeptStep] = []
        self._n_forgotten = 0
        self._marks: list[int] = []  #: that are not joined yet

    @property
    def bytes(self) -> int:
        """Memory of the arrays of all steps, each counted once."""
        return self._shelf.bytes

    def add(self, step: Step) -> None:
        """Something was done; what was undone before cannot be done again."""
        self._forget(self._undone)
        self._undone = []
        self._done.append(self._kept(step))
        while len(self._done) > 1 and (len(self._done) > _LONGEST or self.bytes > self._most_bytes):
            self._shorten()

    def mark(self) -> int:
        """A place in the history; `join` it in any case."""
        mark = self._n_forgotten + len(self._done)
        self._marks.append(mark)
        return mark

    def join(self, mark: int, label: str) -> None:
        """Make one step of all that were added since."""
        self._marks.remove(mark)
        first = max(0, mark - self._n_forgotten)
        steps = self._done[first:]
        if steps:
            self._done[first:] = [self._joined(steps, label)]

    def undo(self, go: Callable[[LiveState, Written, bool], None]) -> str | None:
        """Have `go` bring back what was before the last step; its label, or None."""
        if not self._done:
            return None
        step = self._done[-1]
        go(step.before.whole(), [(after, before) for before, after in reversed(step.written)], step.is_about_lights)
        self._undone.append(self._done.pop())
        return step.label

    def redo(self, go: Callable[[LiveState, Written, bool], None]) -> str | None:
        """Have `go` bring back what was after the step that was undone last; its label, or None."""
        if not self._undone:
            return None
        step = self._undone[-1]
        go(step.after.whole(), step.written, step.is_about_lights)
        self._done.append(self._undone.pop())
        return step.label

    def _shorten(self) -> None:
        """Have one step less."""
        if self._marks and min(self._marks) <= self._n_forgotten:
            self._done[:2] = [self._joined(self._done[:2], self._done[1].label)]
        else:
            self._forget([self._done.pop(0)])
        self._n_forgotten += 1

    def _joined(self, steps: Sequence[_KeptStep], label: str) -> _KeptStep:
        """All of these steps as one; what lies between them is forgotten."""
        for step, following in pairwise(steps):
            self._shelf.forget(step.after)
            self._shelf.forget(following.before)
        written = tuple(pair for step in steps for pair in step.written)
        is_about_lights = any(step.is_about_lights for step in steps)
        return _KeptStep(label, steps[0].before, steps[-1].after, written, is_about_lights)

    def _kept(self, step: Step) -> _KeptStep:
        before, after = self._shelf.keep(step.before), self._shelf.keep(step.after)
        return _KeptStep(step.label, before, after, step.written, step.is_about_lights)

    def _forget(self, steps: Sequence[_KeptStep]) -> None:
        for step in steps:
            self._shelf.forget(step.before)
            self._shelf.forget(step.after)


class _KeptStep(NamedTuple):
    """A `Step`."""

    label: str
    before: KeptState
    after: KeptState
    written: tuple[tuple[LayerVersion, LayerVersion], ...]
    is_about_lights: bool
