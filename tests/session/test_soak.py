"""Random commands for some seconds: memory stays flat, and the end is what a fresh session shows."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import pytest

from icheat_usd.session import LiveSession, Quality, Session, live_history
from tests.session.test_session import ROOM
from tools.soaking import soak

QUALITY = Quality(n_gather=96, rays_per_row=8, rays_per_bounce_row=8, light_samples=1, n_bounces=2, packing_error=0.1)


def test_random_commands_leave_memory_flat_and_end_where_a_fresh_session_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_history, "_LONGEST", 100)
    path = tmp_path / "room.usda"
    path.write_text(ROOM)
    session = Session.open(path)
    for name, casters in (("a", "/World/Block"), ("b", "/World/Room"), ("c", "/World/Block")):
        values = {"layer": "room.usda", "receivers": ["/World/Room"], "casters": [casters]}
        session.add_edit(name, parameters={"gain": 2.0}, **values)

    def start() -> LiveSession:
        return LiveSession.open(path, width=12, height=9, quality=QUALITY, frame=1.0)

    with start() as live:
        live.wait("rest")
        # More than the history holds, so that memory has reached what it will need.
        first = soak(live, start, seconds=20, most_commands=220, frames=(1.0, 2.0), seed=1)
        assert first.is_equal, first.differences
        tracemalloc.start()
        try:
            before, _ = tracemalloc.get_traced_memory()
            second = soak(live, start, seconds=20, most_commands=110, frames=(1.0, 2.0), seed=2)
            after, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert second.is_equal, second.differences
    assert sum(first.commands.values()) == 220 and len(first.commands) >= 12
    # What is replaced in the history was allocated before tracing began: at most 100 steps of it, with their masks.
    assert after - before < 100 * 40_000
    assert all("Soak" in text or "light" in text for text in first.refused), first.refused
