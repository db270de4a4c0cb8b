"""Undo in a live session: within a limit of memory, to the bit, and all of a step or nothing."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.edits.model import MaskedSurface, SurfaceMask
from icheat_usd.errors import EditError
from icheat_usd.scene import F32
from icheat_usd.session.live_history import LiveHistory, Step
from icheat_usd.session.live_state import UNCHANGED, LiveState
from tests.session.test_live import open_live, room, stage  # noqa: F401

_FACES = 512
_MASK = _FACES * 16 * 16 * 4  # bytes


class Painter:
    """The part of a session that has states and a history."""

    def __init__(self, history: LiveHistory) -> None:
        self.history, self.state = history, UNCHANGED
        self.digests: list[bytes] = []

    def paint(self, texels: F32, label: str = "dab") -> None:
        surfaces = (MaskedSurface("/Floor", len(texels)),)
        self.do(self.state.with_edit("/e", receiver_mask=SurfaceMask(surfaces, texels)), label)
        self.digests.append(self.digest)

    def dab(self, rng: np.random.Generator) -> None:
        texels = self.texels.copy()
        texels[rng.integers(len(texels)), :8, :8] = rng.uniform()
        self.paint(texels)

    def do(self, state: LiveState, label: str) -> None:
        self.history.add(Step(label, self.state, state))
        self.state = state

    def go(self, state: LiveState, written: object, is_about_lights: bool) -> None:
        self.state = state

    @property
    def texels(self) -> F32:
        mask = self.state.edits["/e"].receiver_mask
        assert mask is not None
        return mask.texels

    @property
    def digest(self) -> bytes:
        return self.texels.tobytes()


def test_many_dabs_take_the_memory_of_what_they_change_and_are_undone_to_the_bit() -> None:
    rng = np.random.default_rng(0)
    painter = Painter(LiveHistory(most_bytes=16 * _MASK))
    painter.paint(rng.uniform(0, 1, (_FACES, 16, 16)).astype(np.float32))
    painter.digests.clear()  # would take the memory that is measured
    seen: list[int] = []
    tracemalloc.start()
    try:
        for _ in range(300):
            painter.dab(rng)
            seen.append(hash(painter.digests.pop()))
        used, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # 300 whole masks would be 150 MiB; a dab is a block of 16 faces.
    assert 300 * _MASK // 32 <= painter.history.bytes <= 16 * _MASK
    assert used < 20 * _MASK
    for way in ("undo", "redo"):
        expected = seen[-2::-1] if way == "undo" else seen[1:]
        for digest in expected:
            assert getattr(painter.history, way)(painter.go) == "dab"
            assert hash(painter.digest) == digest
    assert hash(painter.digest) == seen[-1]


def test_the_oldest_steps_go_when_there_is_no_room_and_the_last_one_stays() -> None:
    rng = np.random.default_rng(1)
    painter = Painter(LiveHistory(most_bytes=5 * _MASK // 2))
    for k in range(6):
        painter.paint(rng.uniform(0, 1, (_FACES, 16, 16)).astype(np.float32), f"fill {k}")
        assert painter.history.bytes <= 5 * _MASK // 2
    assert painter.history.undo(painter.go) == "fill 5" and painter.digest == painter.digests[4]
    assert painter.history.undo(painter.go) is None and painter.history.redo(painter.go) == "fill 5"
    small = Painter(LiveHistory(most_bytes=_MASK // 2))
    small.paint(rng.uniform(0, 1, (_FACES, 16, 16)).astype(np.float32))
    small.paint(rng.uniform(0, 1, (_FACES, 16, 16)).astype(np.float32))
    assert small.history.undo(small.go) == "dab" and small.digest == small.digests[0]


def test_memory_is_given_back_with_the_steps_that_needed_it() -> None:
    rng = np.random.default_rng(2)
    painter = Painter(LiveHistory())
    painter.paint(np.zeros((64, 16, 16), np.float32))
    one = painter.history.bytes
    mark = painter.history.mark()
    for _ in range(20):
        painter.dab(rng)
    many = painter.history.bytes
    painter.history.join(mark, "stroke")
    assert one < painter.history.bytes < many
    texture = np.ones((64, 64, 3), np.float32)
    before = painter.history.bytes
    for gain in (0.5, 2.0):
        painter.do(painter.state.with_light("/Lamp", texture=texture, gain=(gain,) * 3), "light")
    assert painter.history.bytes == before + texture.nbytes
    while painter.history.undo(painter.go):
        pass
    painter.do(UNCHANGED.with_edit("/e", amount=0.5), "amount")
    assert painter.history.bytes == 0


def test_a_gesture_leads_back_to_where_it_began_however_long_it_is() -> None:
    painter = Painter(LiveHistory())
    painter.do(UNCHANGED.with_edit("/e", amount=-1.0), "before")
    start, mark = painter.state, painter.history.mark()
    for k in range(600):
        painter.do(painter.state.with_edit("/e", amount=float(k)), "amount")
    painter.history.join(mark, "drag")
    end = painter.state
    assert painter.history.undo(painter.go) == "drag" and painter.state.edits == start.edits
    assert painter.history.redo(painter.go) == "drag" and painter.state.edits == end.edits


def test_a_gesture_that_takes_too_much_memory_leads_back_too() -> None:
    rng = np.random.default_rng(3)
    painter = Painter(LiveHistory(most_bytes=5 * _MASK // 2))
    painter.paint(rng.uniform(0, 1, (_FACES, 16, 16)).astype(np.float32))
    mark = painter.history.mark()
    for _ in range(6):
        painter.paint(rng.uniform(0, 1, (_FACES, 16, 16)).astype(np.float32))
        assert painter.history.bytes <= 5 * _MASK // 2
    painter.history.join(mark, "stroke")
    assert painter.history.undo(painter.go) == "stroke" and painter.digest == painter.digests[0]
    assert painter.history.undo(painter.go) is None


def test_a_step_over_two_layers_is_undone_as_a_whole_or_not_at_all(stage: Path) -> None:  # noqa: F811
    with open_live(stage) as live:
        with live.gesture("both"):
            live.set_edit("dim", layer="room.usda", amount=0.25)
            live.set_edit("warm", layer="session", amount=0.5)
        shown, at_top = live.frame(level="rest"), live.session.stage.GetSessionLayer().ExportToString()
        live.session.set_edit("/World/Edits/dim", layer="room.usda", amount=0.1)
        text = stage.read_text()
        # The session layer is taken back first, which works; the other one has changed since.
        for _ in range(2):
            with pytest.raises(EditError, match="changed by something else since"):
                live.undo()
            assert live.session.stage.GetSessionLayer().ExportToString() == at_top
            assert stage.read_text() == text
            assert [edit.amount for edit in live.stack.edits] == pytest.approx([0.5, 0.1])
        live.session.set_edit("/World/Edits/dim", layer="room.usda", amount=0.25)
        live.refresh()
        np.testing.assert_array_equal(live.frame(level="rest"), shown)
