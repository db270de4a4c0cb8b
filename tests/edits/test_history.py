"""Undo and redo over stacks that never change."""

from __future__ import annotations

import pytest

from icheat_usd.edits.history import MOST_STEPS, History
from icheat_usd.edits.model import EditStack
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
