"""A live session shows what its state says, by whatever way it came there."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest

from icheat_usd.edits.model import EditStack
from icheat_usd.errors import EditError, IcheatError
from icheat_usd.kernels.compiling import told_of_compiling
from icheat_usd.relight.live import LiveRelighter
from icheat_usd.session import Quality, Session, shot_parts
from icheat_usd.session.live import LiveSession
from icheat_usd.session.live_events import LiveEvent
from icheat_usd.session.live_frames import LiveFrames
from icheat_usd.session.live_state import UNCHANGED
from tests.session.test_session import ROOM

# Coarsely packed, so that what is not refined shows.
QUALITY = Quality(
    n_gather=192, rays_per_row=64, rays_per_bounce_row=16, light_samples=2, n_bounces=3, packing_error=0.2
)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("room") / "room.usda"
    path.write_text(ROOM)
    session = Session.open(path)
    session.add_edit(
        "warm", layer="room.usda", parameters={"gain": 3.0}, receivers=["/World/Room"], casters=["/World/Block"]
    )
    return path


def open_live(stage: Path) -> LiveSession:
    return LiveSession.open(stage, width=20, height=15, quality=QUALITY)


def pulsing(stage: Path) -> Path:
    """The stage with a light that differs at frames 1 and 2."""
    path = stage.with_name("pulsing.usda")
    samples = "float inputs:intensity.timeSamples = { 1: 20, 2: 10 }"
    path.write_text(stage.read_text().replace("float inputs:intensity = 20", samples))
    return path


def within(seconds: float, act: Callable[[], object]) -> None:
    """Fail where `act` does not come back."""
    thread = threading.Thread(target=act, daemon=True)
    thread.start()
    thread.join(seconds)
    assert not thread.is_alive()


def test_looking_at_once_waits_and_does_not_hang(stage: Path) -> None:
    with open_live(stage) as live:
        within(300, lambda: live.stack)
        live.scrub(5)
        within(300, lambda: live.stack)
        assert live.frame(level="none").shape == (15, 20, 3)


def test_at_rest_an_image_depends_on_the_state_alone(stage: Path) -> None:
    with open_live(stage) as live:
        live.wait("rest")
        live.set_amount("warm", 0.5)
        changed = live.frame(level="rest")
        live.undo()
        back = live.frame(level="rest")
    with open_live(stage) as live:
        untouched = live.frame(level="rest")
        live.set_amount("warm", 0.5)
        fresh = live.frame(level="rest")
    np.testing.assert_array_equal(changed, fresh)
    np.testing.assert_array_equal(back, untouched)
    assert not np.array_equal(back, changed)


def test_a_refused_state_leaves_the_lights_as_they_were(stage: Path) -> None:
    with open_live(stage) as live:
        before = live.frame(level="rest")
        light = next(iter(live.lights))
        refused = live.state.with_light(light, gain=(3.0, 3.0, 3.0))
        refused = refused.with_parameters(live.stack.edits[0].path, {"gain": "nonsense"})
        with pytest.raises(IcheatError):
            live.show(refused)
        assert live.state == UNCHANGED or live.state is UNCHANGED
        np.testing.assert_array_equal(live.frame(level="rest"), before)


def test_a_gesture_joins_its_own_steps_alone(stage: Path) -> None:
    with open_live(stage) as live:
        live.set_amount("warm", 0.1)
        with live.gesture("drag"):
            live.set_amount("warm", 0.2)
            live.undo()
            live.set_amount("warm", 0.3)
        assert live.undo() == "drag"
        assert live.stack.edits[0].amount == pytest.approx(0.1)
        with pytest.raises(RuntimeError), live.gesture("broken off"):
            live.set_amount("warm", 0.4)
            live.set_amount("warm", 0.5)
            raise RuntimeError
        assert live.undo() == "broken off"
        assert live.stack.edits[0].amount == pytest.approx(0.1)


def test_commands_of_two_threads_lose_nothing_of_each_other(stage: Path, tmp_path: Path) -> None:
    shutil.copytree(stage.parent, tmp_path, dirs_exist_ok=True)
    with open_live(tmp_path / stage.name) as live:
        live.wait("rest")
        light = next(iter(live.lights))

        def meanwhile(act: Callable[[], object], other: Callable[[], object]) -> None:
            """`act` in another thread, which has to wait until `other` is done."""
            with live._frames.command():
                thread = threading.Thread(target=act, daemon=True)
                thread.start()
                time.sleep(0.2)
                other()
            thread.join(60)
            assert not thread.is_alive()

        meanwhile(lambda: live.set_light(light, gain=0.5), lambda: live.set_amount("warm", 0.5))
        assert live.state.lights[light].gain == (0.5, 0.5, 0.5)
        assert live.state.edits["/World/Edits/warm"].amount == 0.5
        meanwhile(lambda: live.commit("session"), lambda: live.set_light(light, gain=0.25))
        assert live.state.lights[light].gain == (0.25, 0.25, 0.25) and not live.state.edits
        meanwhile(lambda: live.commit_lights("session"), lambda: live.set_amount("warm", 0.75))
        assert live.state.edits["/World/Edits/warm"].amount == 0.75 and not live.state.lights


def test_mistakes_are_one_clear_error(stage: Path) -> None:
    with open_live(stage) as live:
        light = next(iter(live.lights))
        mistakes: dict[str, Callable[[], object]] = {
            "move": lambda: live.set_light(light, move=(1,)),
            "axis": lambda: live.set_light(light, turn=((0, 0, 0), 30)),
            "turn": lambda: live.set_light(light, turn=(30,)),
            "size": lambda: live.set_light(light, size=(-1, 1)),
            "to_world": lambda: live.set_light(light, to_world="here"),
            "place of a dab": lambda: live.dab("warm", (0, 0), 1.0),
            "radius": lambda: live.dab("warm", (0, 0, 0), "big"),
            "amount": lambda: live.set_amount("warm", "lots"),
            "pixel": lambda: live.pick(20, 3),
        }
        for named, mistake in mistakes.items():
            with pytest.raises(EditError, match=named):
                mistake()
        assert live.undo() is None


def test_after_a_refused_command_the_session_comes_to_rest_again(stage: Path) -> None:
    with open_live(stage) as live:
        before = live.frame(level="rest")
        light = next(iter(live.lights))
        moved = live.lights[light].to_world + np.array([[0, 0, 0, 0.5], [0, 0, 0, 0], [0, 0, 0, 0]])
        refused = live.state.with_light(light, to_world=moved)
        refused = refused.with_parameters(live.stack.edits[0].path, {"gain": "nonsense"})
        with pytest.raises(EditError):
            live.show(refused)
        assert live.wait("rest", timeout=300)
        np.testing.assert_array_equal(live.frame(), before)


def test_frames_that_share_rows_need_no_coarse_ones(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the first frame is shown coarsely: the second finds its rows measured, whatever its lights are."""
    made: list[int] = []
    build = shot_parts.build_transport

    def counted(*given: object, row_spacing: int, **values: object) -> object:
        made.append(row_spacing)
        return build(*given, row_spacing=row_spacing, **values)

    monkeypatch.setattr(shot_parts, "build_transport", counted)
    heard: list[tuple[float | None, str]] = []
    with LiveSession.open(pulsing(stage), width=20, height=15, quality=QUALITY, frame=1.0) as live:
        live.listen(lambda event: heard.append((event.frame, str(event.level))) if event.kind == "better" else None)
        first = live.frame(level="rest")
        live.scrub(2.0)
        second = live.frame(level="rest")
    assert made == [8, 1]
    assert (1.0, "preview") in heard and (2.0, "preview") not in heard[heard.index((2.0, "full")) :]
    np.testing.assert_allclose(second, first / 2, rtol=1e-3, atol=1e-5)


def test_a_frame_that_cannot_be_shown_is_tried_once(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it is made in full where a coarse one was asked for, as it shares the rows of another frame."""
    show, asked = LiveFrames._show, LiveFrames._next_job
    n_asked = 0

    def refused(frames: LiveFrames, number: float | None, *rest: object) -> None:
        if number == 2.0:
            raise EditError("does not fit frame 2")
        show(frames, number, *rest)  # type: ignore[arg-type]

    def counted(frames: LiveFrames) -> object:
        nonlocal n_asked
        n_asked += 1
        return asked(frames)

    monkeypatch.setattr(LiveFrames, "_show", refused)
    monkeypatch.setattr(LiveFrames, "_next_job", counted)
    errors: list[LiveEvent] = []
    with LiveSession.open(pulsing(stage), width=20, height=15, quality=QUALITY, frame=1.0) as live:
        live.wait("rest")
        live.listen(lambda event: errors.append(event) if event.kind == "error" else None)
        live.scrub(2.0)
        with pytest.raises(EditError, match="does not fit frame 2"):
            live.frame()
        time.sleep(0.5)
        known = len(errors), n_asked
        time.sleep(0.5)
        assert (len(errors), n_asked) == known and len(errors) <= 2, "the background has nothing to do"
        live.scrub(1.0)
        assert live.wait("rest", timeout=60)


def test_what_was_worked_out_ahead_is_what_is_shown(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another look at the stage would bring other objects for the same edits: their light would be found anew."""
    stacks: dict[int, list[object]] = {}
    set_stack = LiveRelighter.set_stack

    def counted(relighter: LiveRelighter, stack: EditStack) -> None:
        stacks.setdefault(id(relighter), []).append(stack)
        set_stack(relighter, stack)

    monkeypatch.setattr(LiveRelighter, "set_stack", counted)
    with open_live(stage) as live:
        live.wait("rest")
        shown = list(stacks.values())
    assert [len(given) for given in shown] == [1, 1], "of a coarse relighter and of one in full"


def test_surfaces_are_shown_before_there_is_light(stage: Path) -> None:
    heard: list[LiveEvent] = []
    with open_live(stage) as live:
        live.listen(heard.append)
        live.frame()
    told = [(event.kind, event.level) for event in heard if event.kind != "progress"]
    # Finer rows may have come before the session was closed: what follows the first image is not for this test.
    assert [kind for kind, _ in told].count("surfaces") == 1 and told[0][0] == "surfaces"
    assert told[1] == ("better", "preview")
    image = next(event.image for event in heard if event.kind == "surfaces")
    assert image is not None and image.shape == (15, 20, 3) and image.dtype == np.float32
    assert 0 < image.min() and image.max() < 1
    redness = image[..., 0] / image[..., 2]
    assert redness.min() == pytest.approx(1) and redness.max() == pytest.approx(8), "a red block in a grey room"


def test_listeners_hear_which_kernels_are_compiled() -> None:
    heard: list[tuple[int, str]] = []

    def twice(x: float) -> float:
        return 2 * x

    compiled = numba.njit(twice)
    with told_of_compiling(lambda n, name: heard.append((n, name))):
        compiled(1.0)
        compiled(2.0)
        compiled(1)
    compiled(True)
    assert heard == [(1, "twice"), (2, "twice")]
