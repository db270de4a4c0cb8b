"""Undo and redo over stacks that never change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits import history as history_module
from icheat_usd.edits.history import MOST_STEPS, History
from icheat_usd.edits.model import Edit, EditStack, KeyedPayload, MaskedSurface, Payload, Selection, SurfaceMask
from icheat_usd.errors import EditError


def stack(name: str) -> EditStack:
    return EditStack(f"/{name}", ())


def test_undo_and_redo_walk_over_commits():
    history = History((stack("a"),)).committed(stack("b")).committed(stack("c"))
    back = history.undone().undone()
    assert (back.stack.path, back.can_undo, back.can_redo) == ("/a", False, True)
    assert back.redone().stack.path == "/b"
    assert history.stack.path == "/c"


def test_what_was_undone_is_forgotten_by_the_next_commit():
    history = History((stack("a"),)).committed(stack("b")).undone().committed(stack("d"))
    assert [found.path for found in history.stacks] == ["/a", "/d"]
    assert not history.can_redo


def test_a_stack_that_is_shown_already_is_no_step():
    history = History((stack("a"),))
    assert history.committed(history.stack) is history


def test_there_is_an_end_on_both_sides():
    with pytest.raises(EditError, match="nothing to undo"):
        History().undone()
    with pytest.raises(EditError, match="nothing to redo"):
        History().redone()


def test_the_oldest_steps_are_forgotten():
    history = History((stack("0"),))
    for k in range(1, MOST_STEPS + 10):
        history = history.committed(stack(str(k)))
    assert (len(history.stacks), history.stacks[0].path) == (MOST_STEPS + 1, "/9")
    assert history.stack.path == f"/{MOST_STEPS + 9}"


def test_masks_of_old_steps_are_forgotten_when_they_take_too_much_memory(monkeypatch):
    """Each counts once, however many steps show it; the last step can be undone however large it is."""
    monkeypatch.setattr(history_module, "MOST_BYTES", 5 * 1024)

    def painted(value: float) -> Edit:
        mask = SurfaceMask((MaskedSurface("/a", 1),), np.full((1, 16, 16), value, np.float32))
        keys = (KeyedPayload(Payload("scale", {}, receiver_mask=mask), 1.0),)
        return Edit("/e", "scale", {}, Selection(frozenset()), Selection(frozenset()), keys=keys)

    history = History((EditStack("/0", (painted(0.0),)),))
    for k in range(1, 9):
        history = history.committed(EditStack(f"/{k}", (painted(k / 9),)))
    assert [found.path for found in history.stacks] == ["/4", "/5", "/6", "/7", "/8"]
    for amount in range(50):
        edit = replace(history.stack.edits[0], amount=float(amount))
        history = history.committed(EditStack(f"/amount{amount}", (edit,)))
    assert len(history.stacks) == 55
    monkeypatch.setattr(history_module, "MOST_BYTES", 100)
    history = history.committed(EditStack("/last", (painted(0.5),)))
    assert [found.path for found in history.stacks] == ["/amount49", "/last"]
