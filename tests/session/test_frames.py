"""Frames in memory: what is the same exists once, and the least useful go first."""

from __future__ import annotations

from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest

from icheat_usd.resources import resource_path
from icheat_usd.session import LiveSession, Quality
from icheat_usd.session.frames import ResidentFrames, SharedParts, array_bytes
from tests.session.test_session import ROOM

QUALITY = Quality(n_gather=128, rays_per_row=8, rays_per_bounce_row=8, light_samples=1, n_bounces=2)
KIB = np.zeros(1024, np.uint8)


def resident(limit: int, frames: list[float], seconds: float = 1.0) -> ResidentFrames[list[np.ndarray]]:
    found: ResidentFrames[list[np.ndarray]] = ResidentFrames(limit)
    found.move(frames[0])
    for frame in frames:
        found.put(frame, [KIB.copy()], seconds)
    return found


def test_frames_that_are_far_behind_the_playhead_go_first() -> None:
    found = resident(10_000, [1, 2, 3, 4, 5, 6])
    found.move(3)  # forwards, from 1
    found.limit = 4096
    assert found.trim() == (1, 2) and set(found.frames()) == {3, 4, 5, 6}
    found.move(2.5)  # backwards now
    found.put(2.5, [KIB.copy()], 1.0)
    assert 6 not in found.frames() and {2.5, 3, 4} <= set(found.frames())


def test_frames_that_are_quickly_made_again_go_first_and_the_one_that_is_shown_never() -> None:
    found = resident(10_000, [1, 2])
    found.put(3, [KIB.copy()], 9.0)
    found.limit = 2048
    assert found.trim() == (2,)
    found.limit = 1
    assert found.trim() == (3,) and found.frames() == (1,)


def test_shared_arrays_count_once() -> None:
    shared = KIB.copy()
    found: ResidentFrames[list[np.ndarray]] = ResidentFrames(3000)
    found.move(1)
    for frame in range(1, 6):
        assert found.put(frame, [shared, shared[:10], np.zeros(100, np.uint8)], 1.0) == ()
    assert found.bytes() == 1024 + 5 * 100
    assert found.bytes_of(3) == (1124, 100)
    assert array_bytes([{"a": (shared, [shared])}, MappingProxyType({"b": shared[:8]}), None, 3]) == 1024
    assert array_bytes([MappingProxyType({"b": shared})]) == 1024


def test_parts_live_as_long_as_something_uses_them() -> None:
    parts = SharedParts()
    first = parts.get("view", "key", lambda: KIB.copy())
    assert parts.get("view", "key", lambda: KIB.copy()) is first
    assert parts.get("view", "other", lambda: KIB.copy()) is not first
    del first
    assert parts.find("view", "key") is None


def test_play_shows_every_frame_as_a_session_of_its_own_would_and_keeps_to_the_limit() -> None:
    stage = resource_path("sample_stages/animated_room/shot.usda")
    choices = {"width": 24, "height": 18, "quality": QUALITY}
    frames = (20.0, 21.0, 22.0, 23.0)
    with LiveSession.open(stage, frame=20.0, **choices) as live:
        images = dict(live.play(frames, level="rest"))
        assert set(live.resident) == set(frames)
        memory = live.memory()
        assert 0 < memory["own"] < memory["frame"] < memory["total"] < len(frames) * memory["frame"]
        live.scrub(21.0)
        np.testing.assert_array_equal(live.frame(level="rest"), images[21.0])
        limit = int(memory["frame"] + 1.5 * memory["own"])
        with LiveSession.open(stage, frame=20.0, memory=limit, **choices) as small:
            for frame, image in small.play(frames, level="rest"):
                np.testing.assert_array_equal(image, images[frame])
                assert small.memory()["total"] <= limit
            assert frames[-1] in small.resident and len(small.resident) < len(frames)


def test_where_only_keys_animate_frames_share_everything_and_keys_interpolate(tmp_path: Path) -> None:
    path = tmp_path / "room.usda"
    path.write_text(ROOM)
    with LiveSession.open(path, width=16, height=12, quality=QUALITY, frame=1.0) as live:
        live.add_edit("warm", layer="room.usda", receivers=["/World/Room"], casters=["/World/Room"], frame=1.0)
        live.set_edit("warm", layer="room.usda", amount=0.0, time=1.0)
        live.set_edit("warm", layer="room.usda", amount=1.0, parameters={"gain": 5.0}, time=11.0)
        images = dict(live.play((1.0, 6.0, 11.0), level="rest"))
        assert live.memory()["own"] < 1000
    still, half, full = (images[frame].astype(float) for frame in (1.0, 6.0, 11.0))
    # Half the amount; of the gain, which has one time sample, all.
    np.testing.assert_allclose(half - still, 0.5 * (full - still), rtol=1e-3, atol=1e-5)
    assert (full - still).max() > 0.01


def test_a_change_holds_at_every_frame(tmp_path: Path) -> None:
    path = tmp_path / "room.usda"
    path.write_text(ROOM)
    with LiveSession.open(path, width=16, height=12, quality=QUALITY, frame=1.0) as live:
        before = live.frame(level="rest")
        live.scrub(2.0)
        live.wait("rest")
        live.set_light("Lamp", gain=0.5)
        live.scrub(1.0)
        np.testing.assert_allclose(live.frame(level="rest"), 0.5 * before, rtol=1e-4, atol=1e-6)


def test_lights_in_motion_are_followed_where_the_playhead_is_alone() -> None:
    stage = resource_path("sample_stages/animated_room/shot.usda")
    with LiveSession.open(stage, frame=20.0, width=24, height=18, quality=QUALITY) as live:
        path = next(iter(live.lights))

        def followed() -> set[float | None]:
            resident = live._frames.resident
            lights = {frame: resident.get(frame).evaluator.lights._lights for frame in resident.frames()}
            return {frame for frame, states in lights.items() if any(state.following for state in states)}

        for frame in (20.0, 21.0):
            live.scrub(frame)
            live.wait("full")
        with live._frames.command():  # no light comes to rest meanwhile
            for frame in (20.0, 21.0, 20.0):
                live.scrub(frame)
                live.set_light(path, move=(0.01, 0.0, 0.0))
                live.frame()
                assert followed() == {frame}


@pytest.mark.parametrize("frame", [float("nan"), "x"])
def test_a_frame_that_is_no_time_is_refused(frame: object, tmp_path: Path) -> None:
    path = tmp_path / "room.usda"
    path.write_text(ROOM)
    with LiveSession.open(path, width=16, height=12, quality=QUALITY) as live:
        with pytest.raises(Exception, match="is no frame"):
            live.scrub(frame)  # type: ignore[arg-type]
