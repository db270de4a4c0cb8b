"""Undo and redo over stacks, which never change: a list of them and a place in it."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.edits.model import EMPTY_STACK, Edit, EditStack
from icheat_usd.errors import EditError

#: Steps that can be undone, and bytes of painted masks that they keep; the oldest are forgotten first.
MOST_STEPS, MOST_BYTES = 256, 256 << 20


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
        stacks = _newest((*self.stacks[: self.cursor + 1], stack))
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


def _newest(stacks: tuple[EditStack, ...]) -> tuple[EditStack, ...]:
    """As many of the last stacks as there is room for; at least the last one and that before it."""
    seen: set[int] = set()
    n, size = 0, 0
    for stack in stacks[: -MOST_STEPS - 2 : -1]:
        for edit in stack.edits:
            if id(edit) not in seen:
                seen.add(id(edit))
                size += _unseen_bytes(edit, seen)
        if n >= 2 and size > MOST_BYTES:
            break
        n += 1
    return stacks[-n:]


def _unseen_bytes(edit: Edit, seen: set[int]) -> int:
    """Memory of the masks of an edit that are not among those seen, which they join."""
    payloads = [key.payload for key in edit.keys if key.payload is not None]
    masks = [mask for payload in payloads for mask in (payload.receiver_mask, payload.caster_mask) if mask is not None]
    size = 0
    for array in (array for mask in masks for array in (mask.texels, mask.rest) if array is not None):
        size += 0 if id(array) in seen else array.nbytes
        seen.add(id(array))
    return size
