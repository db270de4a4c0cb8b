"""A build that is killed goes on where it was, with the same result."""

from __future__ import annotations

import functools
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.session import Quality, Session
from icheat_usd.session.disk_cache import DiskCache
from icheat_usd.session.shot_parts import ShotParts
from icheat_usd.transport import Transport, progressive
from icheat_usd.transport.pieces import Pieces
from icheat_usd.transport.rays import RowBuilder
from tests.session.test_session import ROOM

QUALITY = Quality(
    n_gather=192, rays_per_bounce_row=16, light_samples=2, n_bounces=3, record_error=0.02, record_rays=1024
)
LIMIT = 1 << 30

#: Builds, and is gone once so many pieces are on the disk.
CHILD = """
import os, signal, sys
from pathlib import Path
from icheat_usd.session.disk_cache import Shelf
from tests.session.test_resume import build
save = Shelf.save
def save_and_die(shelf, name, value):
    save(shelf, name, value)
    if name == sys.argv[3]:
        os.kill(os.getpid(), signal.SIGKILL)
Shelf.save = save_and_die
build(Path(sys.argv[1]), Path(sys.argv[2]))
"""


def build(stage: Path, folder: Path | None) -> tuple[Transport, int]:
    """The transport in pieces of 20 rows or fewer, and how many times rows were traced."""
    traced = 0
    measure = RowBuilder.measure

    def counted(*args: object, **more: object) -> object:
        nonlocal traced
        traced += 1
        return measure(*args, **more)  # type: ignore[arg-type]

    before = progressive.Pieces
    progressive.Pieces = functools.partial(Pieces, rays_per_piece=20 * 1024)  # type: ignore[misc, assignment]
    RowBuilder.measure = counted  # type: ignore[method-assign, assignment]
    try:
        disk = DiskCache(folder, LIMIT) if folder else DiskCache(stage.parent, 0)
        shot = Session.open(stage, width=20, height=15, quality=QUALITY)
        parts = ShotParts(QUALITY, snapshot=shot.snapshot, disk=disk)
        *_, last = parts.transports()
        assert isinstance(last, Transport)
        return last, traced
    finally:
        progressive.Pieces, RowBuilder.measure = before, measure  # type: ignore[misc, method-assign]


def test_a_build_that_was_killed_goes_on_from_its_pieces_to_the_same_bits(tmp_path: Path) -> None:
    stage, folder = tmp_path / "room.usda", tmp_path / "cache"
    stage.write_text(ROOM)
    command = [sys.executable, "-c", CHILD, str(stage), str(folder), "piece-00012"]
    killed = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    shelves = [info for info in DiskCache(folder, LIMIT).list() if info.kind == "transport"]
    assert len(shelves) == 1
    resumed, few = build(stage, folder)
    whole, many = build(stage, None)
    assert few < many
    assert np.array_equal(resumed.row_view, whole.row_view)
    for a, b in zip(resumed.lobes, whole.lobes, strict=True):
        for column in ("indptr", "indices", "weights"):
            assert np.array_equal(getattr(a.rows, column), getattr(b.rows, column))
    names = {path.name.partition("-")[0] for path in (folder).rglob("*.npz") if "transport" in str(path)}
    assert names == {"whole"}
    assert build(stage, folder)[1] <= 1  # bounces are not worth keeping


@pytest.mark.parametrize("rays", [300, 1 << 20])
def test_the_size_of_pieces_does_not_show(rays: int, tmp_path: Path) -> None:
    stage = tmp_path / "room.usda"
    stage.write_text(ROOM)
    expected, _ = build(stage, None)
    before = progressive.Pieces
    progressive.Pieces = functools.partial(Pieces, rays_per_piece=rays)  # type: ignore[misc, assignment]
    try:
        shot = Session.open(stage, width=20, height=15, quality=QUALITY)
        *_, last = ShotParts(QUALITY, snapshot=shot.snapshot, disk=DiskCache(tmp_path, 0)).transports()
    finally:
        progressive.Pieces = before  # type: ignore[misc]
    assert isinstance(last, Transport)
    for a, b in zip(last.lobes, expected.lobes, strict=True):
        assert np.array_equal(a.rows.indices, b.rows.indices) and np.array_equal(a.rows.weights, b.rows.weights)
