"""Undo and redo over stacks, which never change: a list of them and a place in it."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.edits.model import EMPTY_STACK, EditStack
from icheat_usd.errors import EditError

#: Steps that can be undone; the oldest are forgotten first, as stacks keep their painted masks.
MOST_STEPS = 256


@dataclass(frozen=True)
class History:
    """Committed stacks, oldest first, and which of them is shown; every method returns another history."""

    stacks: tuple[EditStack, ...] = (EMPTY_STACK,)
    cursor: int = 0

    @property
    def stack(self) -> EditStack:
        return self.stacks[self.cursor]

    @property
    def can_undo(self) -> bool:
        return self.cursor > 0

    @property
    def can_redo(self) -> bool:
        return self.cursor + 1 < len(self.stacks)

    def committed(self, stack: EditStack) -> History:
        """One step further; what was undone before is forgotten, and a stack that is shown already is no step."""
        if stack is self.stack:
            return self
        stacks = (*self.stacks[: self.cursor + 1], stack)[-MOST_STEPS - 1 :]
        return History(stacks, len(stacks) - 1)

    def undone(self) -> History:
        """One step back.

        Raises
        ------
        EditError
            There is nothing to undo.
        """
        if not self.can_undo:
            raise EditError("there is nothing to undo: this is the first state")
        return History(self.stacks, self.cursor - 1)

    def redone(self) -> History:
        """One step forward again.

        Raises
        ------
        EditError
            There is nothing to redo.
        """
        if not self.can_redo:
            raise EditError("there is nothing to redo: nothing was undone since the last change")
        return History(self.stacks, self.cursor + 1)
