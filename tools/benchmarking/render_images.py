"""Renders beside their reference, as pictures to look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from icheat_usd.image.png import encode_png
from icheat_usd.scene import F32, F64, U8
from tools.benchmarking.statistics import smoothed

#: Relative error that is shown as full red (too bright) or full blue (too dark).
_FULL = 0.25


def write_sheet(path: Path, image: F64, reference: F64) -> str:
    """Reference, image and signed relative difference side by side; (height, width, 3) scene-linear.

    The difference is smoothed over 5 x 5 pixels: the reference's noise would hide blotches.
    """
    mean = float(reference.mean()) or 1.0
    gap = np.full((image.shape[0], 4, 3), 255, np.uint8)
    off = smoothed(image - reference) / (smoothed(reference) + 0.1 * mean)
    sheet = [_as_light(reference / mean), gap, _as_light(image / mean), gap, _signed(off.mean(axis=2))]
    return write_png(path, np.concatenate(sheet, axis=1))


def write_png(path: Path, pixels: U8) -> str:
    """Write display-referred bytes; the name of the file, for the report."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_png(np.ascontiguousarray(pixels), srgb=True, text={}))
    return path.name


def as_bytes(image: F32) -> U8:
    """A scene-linear image as it is shown, with light of 1 as white."""
    return np.asarray(255 * np.clip(image, 0, 1) ** (1 / 2.2) + 0.5, np.uint8)


def _as_light(image: F64) -> U8:
    return np.asarray(255 * np.clip(image / 4, 0, 1) ** (1 / 2.2), np.uint8)


def _signed(values: F64) -> U8:
    """White is 0, red above, blue below."""
    share = np.clip(values / _FULL, -1, 1)[..., None]
    colour = np.where(share > 0, np.array([202.0, 0.0, 32.0]), np.array([5.0, 113.0, 176.0]))
    return np.asarray(255 + np.abs(share) * (colour - 255), np.uint8)
