"""The live session: commands at once, better images by themselves, and every way to a state gives one image."""

from __future__ import annotations

import functools
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.errors import EditError, IcheatError
from icheat_usd.kernels.assemble import sum_films
from icheat_usd.relight.rest_weights import RestWeights
from icheat_usd.session import Quality, Session, shot_parts
from icheat_usd.session.disk_cache import DiskCache
from icheat_usd.session.live import LiveSession
from icheat_usd.session.live_events import Level, LiveEvent
from tests.session.test_session import ROOM

QUALITY = Quality(n_gather=192, rays_per_row=16, rays_per_bounce_row=16, light_samples=2, n_bounces=3)
PACKED = replace(QUALITY, record_error=0.05, record_rays=64, packing_error=0.05)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("room")
    path = folder / "room.usda"
    path.write_text(ROOM)
    for name in ("warm", "dim"):
        gain = {"warm": 3.0, "dim": 0.5}[name]
        session = Session.open(path)
        session.add_edit(
            name,
            layer="room.usda",
            parameters={"gain": gain},
            receivers=["/World/Room"],
            casters=["/World/Block"] if name == "warm" else ["/World/Room"],
        )
    return path


@pytest.fixture
def stage(room: Path, tmp_path: Path) -> Path:
    for file in room.parent.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    return tmp_path / "room.usda"


def open_live(stage: Path, **values: object) -> LiveSession:
    return LiveSession.open(stage, width=20, height=15, quality=QUALITY, **values)


@pytest.fixture(scope="module")
def live(room: Path):
    with open_live(room) as session:
        session.wait("rest")
        yield session
        assert session.undo() is None


@pytest.fixture(autouse=True)
def untouched(request: pytest.FixtureRequest):
    """Tests that share the session leave it as it was."""
    yield
    if "live" in request.fixturenames:
        session = request.getfixturevalue("live")
        while session.undo():
            pass


def test_a_preview_comes_first_then_the_whole_and_listeners_are_told(stage: Path) -> None:
    heard: list[LiveEvent] = []
    with open_live(stage) as live:
        live.listen(heard.append)
        assert live.wait(Level.PREVIEW)
        first = live.frame()
        live.wait("rest")
        last = live.frame()
    assert first.shape == last.shape == (15, 20, 3) and first.dtype == np.float32
    assert first.mean() == pytest.approx(last.mean(), rel=0.2) and not np.array_equal(first, last)
    better = [event.level for event in heard if event.kind == "better"]
    assert better[-1] is Level.REST and set(better) >= {Level.FULL, Level.REST}
    assert any(event.kind == "progress" and event.step == "gather rays" for event in heard)


def test_a_script_tries_amounts_and_each_is_the_edit_at_that_amount(live: LiveSession) -> None:
    off = (live.set_amount("warm", 0.0), live.frame())[1]
    means = []
    for amount in (0.5, 1.0):
        live.set_amount("warm", amount)
        means.append(float((live.frame() - off).mean()))
    assert means[1] == pytest.approx(2 * means[0], rel=1e-3) and means[0] > 0.001


@pytest.mark.parametrize("module", ["light_films", "amount_films"])
def test_gains_and_amounts_at_rest_are_sums_of_images(
    stage: Path, module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also though a session sets its stack again whatever has changed, and refines between the commands."""
    sums: list[object] = []
    of, name = f"icheat_usd.relight.{module}.sum_films", module.partition("_")[0]
    monkeypatch.setattr(of, lambda *values: (sums.append(values), sum_films(*values)))
    with LiveSession.open(stage, width=20, height=15, quality=PACKED) as live:
        live.wait("rest")
        for k in range(5):
            if name == "light":
                live.set_light("Lamp", gain=0.5 + 0.1 * k)
            else:
                live.set_amount("dim", 0.5 + 0.1 * k)
            found, n = live.frame(), len(sums)
        live.wait("rest")
        np.testing.assert_allclose(found, live.frame(), rtol=1e-3, atol=1e-4)
    assert n >= (5 if name == "light" else 2)


@pytest.mark.parametrize("quality", [QUALITY, PACKED], ids=["exact", "packed"])
def test_bounces_of_more_rays_come_once_lights_are_at_rest(stage: Path, quality: Quality) -> None:
    """They are nearer to the truth, and the same bits in another session and after a light was moved and put back."""
    images = {}
    for rays in (None, 256):
        with LiveSession.open(stage, quality=replace(quality, rest_bounce_rays=rays)) as live:
            live.wait("full")
            full = live.frame()
            live.wait("rest")
            images[rays] = live.frame()
            np.testing.assert_allclose(images[rays].mean(), full.mean(), rtol=0.2)
    with LiveSession.open(stage, quality=replace(quality, rest_bounce_rays=256)) as live:
        live.wait("rest")
        np.testing.assert_array_equal(live.frame(), images[256])
        live.set_light(next(iter(live.lights)), move=(0.05, 0, 0))
        live.frame()
        live.undo()
        live.wait("rest")
        np.testing.assert_array_equal(live.frame(), images[256])
    with LiveSession.open(stage, quality=replace(quality, rays_per_bounce_row=4096)) as live:
        live.wait("rest")
        true = live.frame()
    off = {rays: np.linalg.norm(image - true) for rays, image in images.items()}
    assert 0 < off[256] < 0.6 * off[None]


def test_rows_built_or_found_on_disk_end_in_the_same_image(
    stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who builds them sees coarser ones first, and the packed ones later."""
    fitted: list[int] = []
    put = RestWeights._put
    monkeypatch.setattr(RestWeights, "_put", lambda *values: (fitted.append(len(values[1])), put(*values)))
    few_records = replace(PACKED, record_error=0.5)
    images = []
    for size in (0, 10**9, 10**9):
        monkeypatch.setattr(shot_parts, "DiskCache", functools.partial(DiskCache, tmp_path / "cache", size))
        with LiveSession.open(stage, width=40, height=30, quality=few_records) as live:
            images.append(live.frame(level="rest"))
    assert fitted == [fitted[0]] * 3 and fitted[0] > 0
    np.testing.assert_array_equal(images, images[:1] * 3)


def test_film_has_the_layers_of_a_relight_and_the_same_image(live: LiveSession) -> None:
    film = live.film()
    np.testing.assert_allclose(film.layer("beauty"), live.frame(), rtol=1e-5, atol=1e-6)
    assert film.metadata["edits"] == "/World/Edits/warm, /World/Edits/dim" and "level=rest" in film.metadata["settings"]


def test_undo_and_redo_bring_back_every_bit_and_a_gesture_is_one_step(live: LiveSession) -> None:
    live.wait("rest")
    before = live.frame()
    with live.gesture("drag"):
        for i in range(5):
            live.set_amount("warm", i / 7)
            live.set_light("Lamp", move=(0.05, 0, 0))
    live.set_parameters("dim", gain=0.9)
    live.mute("warm")
    live.wait("rest")
    after = live.frame()
    assert [live.undo() for _ in range(4)] == ["mute /World/Edits/warm", "parameters /World/Edits/dim", "drag", None]
    live.wait("rest")
    np.testing.assert_array_equal(live.frame(), before)
    assert [live.redo() for _ in range(4)] == ["drag", "parameters /World/Edits/dim", "mute /World/Edits/warm", None]
    live.wait("rest")
    np.testing.assert_array_equal(live.frame(), after)


def test_lights_are_dimmed_moved_added_and_removed(live: LiveSession) -> None:
    live.wait("rest")
    start = live.frame()
    live.set_light("Lamp", gain=0.5)
    np.testing.assert_allclose(live.frame(), 0.5 * start, rtol=1e-4, atol=1e-6)
    live.set_light("Lamp", gain=(1, 0, 1))
    assert live.frame()[..., 1].max() == 0
    live.remove_light("Lamp")
    assert live.frame().max() == 0
    live.add_light("/World/Key", "sphere", at=(0.5, 1, 0), radiance=4, size=(0.2,))
    assert live.frame().mean() > 0.001
    assert list(live.lights) == ["/World/Lamp", "/World/Key"] and live.lights["/World/Lamp"].removed
    live.remove_light("Key")
    assert live.frame().max() == 0
    for _ in range(5):
        live.undo()
    live.wait("rest")
    np.testing.assert_array_equal(live.frame(), start)


def test_the_same_state_in_a_session_of_its_own_gives_the_same_bits(live: LiveSession, stage: Path) -> None:
    live.set_amount("warm", 0.3)
    live.add_light("/World/A", "sphere", at=(0, 1, 0), size=(0.1,))
    live.add_light("/World/B", "disk", at=(1, 1.5, 0), size=(0.3,), radiance=3)
    live.set_light("Lamp", move=(0.3, 0, 0.1), gain=(0.5, 0.4, 1))
    live.remove_light("A")
    live.add_light("/World/A", "sphere", at=(0, 0.5, 0), size=(0.1,))
    live.undo()
    live.undo()
    live.move_edit("dim", before="warm")
    live.wait("rest")
    with open_live(stage) as fresh:
        fresh.show(live.state)
        fresh.wait("rest")
        np.testing.assert_array_equal(fresh.frame(), live.frame())


def test_order_decides_where_edits_do_not_commute(stage: Path) -> None:
    with open_live(stage) as live:
        live.set_edit("warm", layer="room.usda", blend="over", amount=0.5, casters=["/World/Room"])
        one = live.frame(level="rest")
        live.move_edit("dim", before="warm")
        other = live.frame()
        assert np.abs(one - other).max() > 1e-3
        assert [edit.name for edit in live.stack.edits] == ["dim", "warm"]
        live.undo()
        np.testing.assert_array_equal(live.frame(), one)


def test_a_muted_edit_refuses_what_its_operation_would(stage: Path) -> None:
    with open_live(stage) as live:
        for muted in (False, True):
            live.mute("dim", muted)
            before = live.state
            for values, reason in (
                ({"gain": 1e48}, "'gain' is 1e"),
                ({"gain": "much"}, "'gain'"),
                ({"hue": 1.0}, "hue"),
            ):
                with pytest.raises(EditError, match=reason):
                    live.set_parameters("dim", **values)
            assert live.state is before
        live.set_parameters("dim", gain=0.25)
        live.mute("dim", False)
        assert live.stack.edits[-1].parameters["gain"] == 0.25


def test_commit_writes_what_is_shown_and_can_be_undone(stage: Path) -> None:
    with open_live(stage) as live:
        live.wait("rest")
        live.set_amount("warm", 0.25)
        live.set_parameters("dim", gain=0.75)
        live.mute("dim")
        live.move_edit("dim", before="warm")
        live.fill_mask("warm", 0.0)
        found = live.pick(10, 12)
        assert found is not None and found[0] == "/World/Room"
        live.dab("warm", found[1], 0.8)
        live.set_light("Lamp", gain=0.5)
        shown, text = live.frame(level="rest"), stage.read_text()
        assert live.commit("room.usda") == ()
        assert live.state.edits == {} and "/World/Lamp" in live.state.lights
        np.testing.assert_allclose(live.frame(), shown, rtol=1e-6, atol=1e-7)
        written = Session.open(stage).stack
        assert [(edit.name, edit.amount, edit.enabled) for edit in written.edits] == [
            ("dim", 1.0, False),
            ("warm", 0.25, True),
        ]
        assert live.undo() == "commit"
        assert stage.read_text() == text
        np.testing.assert_array_equal(live.frame(), shown)
        assert live.redo() == "commit" and stage.read_text() != text


def test_undo_of_a_commit_is_refused_when_someone_else_wrote_to_the_layer(stage: Path) -> None:
    with open_live(stage) as live:
        live.set_amount("warm", 0.25)
        live.commit("room.usda")
        live.session.set_edit("/World/Edits/dim", layer="room.usda", amount=0.1)
        live.refresh()
        text = stage.read_text()
        with pytest.raises(EditError, match="changed by something else since"):
            live.undo()
        assert stage.read_text() == text and live.stack.edits[1].amount == pytest.approx(0.1)


def test_a_dab_changes_what_lies_under_it_and_nothing_else(live: LiveSession) -> None:
    live.fill_mask("warm", 0.0)
    none, kept = live.frame(), live.memory()["history"]
    surface, place = live.pick(4, 13)
    assert surface == "/World/Room"
    live.dab("warm", place, 0.6)
    changed = np.abs(live.frame() - none).max(axis=2)
    assert changed[13, 4] > 0 and (changed == 0).mean() > 0.5
    assert live.memory()["history"] > kept > 0, "masks that undo brings back take memory"
    live.dab("warm", place, 0.6, strength=-1.0)
    assert np.abs(live.frame() - none).max() <= changed.max()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (lambda live: live.set_amount("cold", 1), "there is no edit 'cold'; there are /World/Edits/warm"),
        (lambda live: live.set_amount("warm", float("nan")), "the amount is nan"),
        (lambda live: live.set_light("Sun", gain=1), "there is no light 'Sun'; there are /World/Lamp"),
        (lambda live: live.set_light("Lamp", gain=-1), "gain is -1; it must be finite and not negative"),
        (lambda live: live.set_light("Lamp", texture="/no/such.exr"), "no/such.exr"),
        (lambda live: live.add_light("/World/Lamp", "rect"), "is a light already"),
        (lambda live: live.add_light("/World/X", "laser"), "'laser' is no kind of light"),
        (lambda live: live.set_parameters("warm", gian=2.0), "gian"),
        (lambda live: live.dab("warm", (0, 0, 0), -1.0), "a dab has a strength"),
        (lambda live: live.fill_mask("warm", 1.0, side="both"), "not 'both'"),
        (lambda live: live.move_edit("warm", before="dim", after="dim"), "one of before and after"),
        (lambda live: live.commit("nowhere.usda"), "nowhere.usda"),
        (lambda live: live.wait("best"), "'best' is no level"),
    ],
)
def test_a_mistake_is_one_sentence_and_changes_nothing(live: LiveSession, command, message: str) -> None:
    live.set_amount("warm", 0.9)
    before, state = live.frame(), live.state
    with pytest.raises(IcheatError, match=message):
        command(live)
    assert live.state is state
    np.testing.assert_array_equal(live.frame(), before)


def test_closing_ends_the_background_at_once_and_commands_say_so(stage: Path) -> None:
    n_threads = threading.active_count()
    live = open_live(stage)
    live.close()
    live.close()
    assert threading.active_count() == n_threads
    with pytest.raises(IcheatError, match="is closed"):
        live.frame()


def test_what_cannot_be_made_is_said_to_who_waits(tmp_path: Path) -> None:
    path = tmp_path / "empty.usda"
    path.write_text('#usda 1.0\ndef Camera "Camera" {}\n')
    with open_live(path) as live, pytest.raises(IcheatError, match="no surface at this frame"):
        live.frame()


def test_the_sky_and_what_glows_are_seen_as_they_are_lit(tmp_path: Path) -> None:
    path = tmp_path / "sky.usda"
    path.write_text(
        "#usda 1.0\n(\n    metersPerUnit = 1\n)\n"
        'def Sphere "Ball"\n{\n    double radius = 0.5\n}\n'
        'def Cube "Floor"\n{\n    double3 xformOp:translate = (0, -1.6, 0)\n'
        '    uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
        'def DomeLight "Sky"\n{\n    float inputs:intensity = 2\n}\n'
        'def Camera "Camera"\n{\n    double3 xformOp:translate = (0, 0, 5)\n'
        '    uniform token[] xformOpOrder = ["xformOp:translate"]\n}\n'
    )
    image = np.ones((4, 8, 3), np.float32)
    image[:, :4] = 0
    with LiveSession.open(path, width=16, height=12, quality=QUALITY) as live:
        plain = live.frame(level="rest")
        assert plain[0, 0, 0] == pytest.approx(2)
        live.set_light("Sky", gain=0.25)
        np.testing.assert_allclose(live.frame(level="rest"), 0.25 * plain, rtol=1e-3, atol=1e-5)
        live.set_light("Sky", gain=1, texture=image)
        halves = live.frame()
        live.set_light("Sky", turn=((0, 1, 0), 180))
        turned = live.frame(level="rest")
        # What was bright is dark, and the other way round.
        assert abs(halves[0, 0, 0] - 1) > 0.2
        np.testing.assert_allclose(turned[0] + halves[0], 2, rtol=1e-3)
        np.testing.assert_allclose(live.film().layer("beauty"), turned, rtol=1e-5, atol=1e-5)
        while live.undo():
            pass
        np.testing.assert_array_equal(live.frame(level="rest"), plain)
