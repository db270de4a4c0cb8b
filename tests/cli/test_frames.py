"""Frame specifications and file names of frames."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from icheat_usd.cli.frames import frame_path, has_frame, parse_frames


@pytest.mark.parametrize(
    ("text", "frames"),
    [
        ("7", (7,)),
        ("1:4", (1, 2, 3, 4)),
        ("1:10x2", (1, 3, 5, 7, 9)),
        ("1:9x2", (1, 3, 5, 7, 9)),
        ("4:1", (4, 3, 2, 1)),
        ("10:1x-3", (10, 7, 4, 1)),
        ("0:1x0.25", (0, 0.25, 0.5, 0.75, 1)),
        ("-2:0", (-2, -1, 0)),
        ("1,5,9:11", (1, 5, 9, 10, 11)),
        ("3,1:4", (3, 1, 2, 4)),
        ("5:5", (5,)),
    ],
)
def test_frame_ranges_mean_what_usdrecord_takes_them_for(text: str, frames: tuple[float, ...]) -> None:
    assert parse_frames(text) == frames


@pytest.mark.parametrize(
    "text", ["", "a", "1:", ":5", "1:5x", "1:5x0", "1:5x-1", "5:1x1", "1-5", "1::5", "1,,2", "1:9999999"]
)
def test_what_is_no_frame_range_is_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError):
        parse_frames(text)


@given(st.integers(-500, 500), st.integers(0, 400), st.integers(1, 50))
def test_a_range_is_python_range_with_its_end(start: int, length: int, stride: int) -> None:
    frames = parse_frames(f"{start}:{start + length}x{stride}")
    assert frames == tuple(map(float, range(start, start + length + 1, stride)))


def test_a_stride_that_binary_cannot_hold_keeps_the_last_frame() -> None:
    frames = parse_frames("0:1x0.1")
    assert len(frames) == 11 and frames[-1] == 1.0 and frames[3] == 0.3


@pytest.mark.parametrize(
    ("pattern", "frame", "name"),
    [
        ("out.####.exr", 7.0, "out.0007.exr"),
        ("out.####.exr", 12345.0, "out.12345.exr"),
        ("out.####.exr", -3.0, "out.-0003.exr"),
        ("out.####.##.exr", 7.25, "out.0007.25.exr"),
        ("#.png", 12.0, "12.png"),
        ("plain.exr", 12.0, "plain.exr"),
        ("plain.exr", None, "plain.exr"),
    ],
)
def test_hashes_become_the_padded_frame(pattern: str, frame: float | None, name: str) -> None:
    assert frame_path(pattern, frame) == Path(name)


def test_hashes_in_a_folder_name_are_left_alone() -> None:
    assert frame_path("take#2/out.##.exr", 5.0) == Path("take#2/out.05.exr")
    assert not has_frame("take#2/out.exr")


@pytest.mark.parametrize(("pattern", "frame"), [("out.####.exr", 1.5), ("out.####.exr", None)])
def test_a_pattern_that_cannot_name_the_frame_is_refused(pattern: str, frame: float | None) -> None:
    with pytest.raises(ValueError, match="####|frame"):
        frame_path(pattern, frame)
