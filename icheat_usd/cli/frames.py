"""Frame specifications (`1:10x2`) and the file names of frames (`out.####.exr`)."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path

_NUMBER = r"-?\d+(?:\.\d+)?"
_RANGE = re.compile(rf"({_NUMBER})(?::({_NUMBER})(?:x({_NUMBER}))?)?")

#: More frames than this in one specification is taken for a slip of the keyboard.
MAX_FRAMES = 100_000


def parse_frames(text: str) -> tuple[float, ...]:
    """Frames of a specification as usdrecord takes it: `7`, `1:10`, `1:10x2`, `10:1x-3`, `1:2x0.25`, `1,5,9:12`.

    Raises
    ------
    argparse.ArgumentTypeError
        It is none.
    """
    frames: list[float] = []
    for part in text.split(","):
        match = _RANGE.fullmatch(part.strip())
        if match is None:
            raise argparse.ArgumentTypeError(f"'{part}' is no frame range; write one such as 7, 1:10 or 1:10x2")
        start = float(match[1])
        end = float(match[2]) if match[2] else start
        stride = float(match[3]) if match[3] else math.copysign(1.0, end - start)
        if stride == 0 or (end - start) * stride < 0:
            raise argparse.ArgumentTypeError(f"'{part}': stepping by {stride:g} never gets from {start:g} to {end:g}")
        # A stride such as 0.1 is not exact in binary: keep the last frame when it is missed by rounding only.
        count = math.floor((end - start) / stride + 1e-6) + 1
        if len(frames) + count > MAX_FRAMES:
            raise argparse.ArgumentTypeError(f"'{text}' means more than {MAX_FRAMES} frames")
        frames += [round(start + index * stride, 6) for index in range(count)]
    return tuple(dict.fromkeys(frames))


_HASHES = re.compile(r"(#+)(?:\.(#+))?")


def has_frame(pattern: str) -> bool:
    """True if the file name holds a place for the frame number."""
    return _HASHES.search(Path(pattern).name) is not None


def frame_path(pattern: str, frame: float | None) -> Path:
    """The file for a frame: `####` is the number, zero-padded; `####.##` also has that many decimals.

    Raises
    ------
    ValueError
        The frame needs decimals that the pattern has no place for, or there is no frame to name.
    """
    path = Path(pattern)
    match = _HASHES.search(path.name)
    if match is None:
        return path
    if frame is None:
        raise ValueError(f"'{pattern}' asks for a frame number; give --frame or --frames")
    decimals = len(match[2] or "")
    if round(frame, decimals) != frame:
        raise ValueError(f"'{pattern}' has no place for the decimals of frame {frame:g}; write for example ####.##")
    width = len(match[1]) + (1 + decimals if decimals else 0) + (frame < 0)
    number = f"{frame:0{width}.{decimals}f}"
    return path.with_name(path.name[: match.start()] + number + path.name[match.end() :])
