"""A picture of where an irradiance cache has its records, to judge how densely they stand and why.

Two panels over the frame in grey: records by how far they reach, and by the round of the overture that placed them.
Below each is what its colours mean, in pixels.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

#: Pixels that a panel is wide, at least.
PANEL = 1200

#: From short reaches to long ones; all of them stand out from grey.
_REACHES = np.array([(225, 40, 50), (250, 140, 30), (235, 220, 60), (60, 190, 110), (70, 130, 255)], np.float64)
#: By spacing, from 32 pixels to 1.
_ROUNDS = np.array(
    [(255, 255, 255), (255, 225, 60), (255, 150, 40), (235, 60, 60), (205, 70, 200), (80, 120, 255)], np.uint8
)
_SPACINGS = (32, 16, 8, 4, 2, 1)
_GAP, _LEGEND = 8, 28

#: Glyphs of 3 x 5 dots, a bit each, rows from the top.
_GLYPHS = {
    "0": "75557", "1": "26227", "2": "71747", "3": "71717", "4": "55711", "5": "74717", "6": "74757", "7": "71222",
    "8": "75757", "9": "75717", ".": "00002",
}  # fmt: skip


def record_map(records: F32, light: F32) -> U8:
    """Draw the layer of records over light.

    Parameters
    ----------
    records : (height, width, 3) float32
        How many records stand in a pixel, how far the widest reaches, and the spacing of the earliest round; pixels.
    light : (height, width, 3) float32, scene-linear

    Returns
    -------
    (rows, columns, 3) uint8, display-encoded
        A record is a square in the middle of its pixel.
    """
    rows, columns = np.nonzero(records[..., 0] > 0)
    reach, spacing = records[rows, columns, 1].astype(np.float64), records[rows, columns, 2].astype(np.float64)
    scale = max(3, -(-PANEL // records.shape[1]))
    backdrop = np.repeat(np.repeat(_backdrop(light), scale, axis=0), scale, axis=1)
    low, high = (float(reach.min()), float(reach.max())) if len(reach) else (1.0, 1.0)
    number = np.clip(np.log2(_SPACINGS[0] / np.maximum(spacing, 1)), 0, len(_SPACINGS) - 1).astype(np.int64)
    small = max(2, 3 * scale // 4)
    # The last rounds first, so that the few early records lie on top, and are larger.
    order = np.argsort(-number, kind="stable")
    at = np.stack([rows, columns], axis=1)[order]
    left = _dots(backdrop, at, np.full(len(at), small), _reach_colours(reach, low, high)[order], scale)
    right = _dots(backdrop, at, np.maximum(scale - number, small)[order], _ROUNDS[number][order], scale)
    ticks = np.geomspace(low, high, 6)
    panels = [
        np.concatenate([left, _legend(_reach_colours(ticks, low, high), [f"{t:.1f}" for t in ticks], left.shape[1])]),
        np.concatenate([right, _legend(_ROUNDS, [str(one) for one in _SPACINGS], right.shape[1])]),
    ]
    gap = np.zeros((len(panels[0]), _GAP, 3), np.uint8)
    return np.concatenate([panels[0], gap, panels[1]], axis=1)


def _backdrop(light: F32) -> U8:
    """Light as dim grey."""
    grey = np.maximum(light.mean(axis=2, dtype=np.float64), 0)
    white = float(np.quantile(grey, 0.98)) or 1.0
    shown = 20 + 90 * np.clip(grey / white, 0, 1) ** (1 / 2.2)
    return np.repeat(shown[:, :, None], 3, axis=2).astype(np.uint8)


def _dots(backdrop: U8, at: I64, size: I64, colour: U8, scale: int) -> U8:
    """Squares in the middle of pixels `at`, (n, 2) rows and columns, over a backdrop enlarged by `scale`."""
    panel = backdrop.copy()
    corner = at * scale + (scale - size[:, None]) // 2
    for (top, left), side, ink in zip(corner.tolist(), size.tolist(), colour, strict=True):
        panel[top : top + side, left : left + side] = ink
    return panel


def _reach_colours(reach: F64, low: float, high: float) -> U8:
    """(n, 3) by the logarithm of the reach."""
    place = np.log(reach / low) / np.log(high / low) if high > low else np.zeros(len(reach))
    steps = np.linspace(0, 1, len(_REACHES))
    return np.stack([np.interp(place, steps, channel) for channel in _REACHES.T], axis=1).astype(np.uint8)


def _legend(colours: U8, labels: list[str], width: int) -> U8:
    """Patches of colour, each with its number."""
    strip = np.zeros((_LEGEND, width, 3), np.uint8)
    for number, (colour, label) in enumerate(zip(colours, labels, strict=True)):
        left = 6 + number * (width - 6) // len(labels)
        strip[8:20, left : left + 12] = colour
        text = _written(label)[:, : max(0, width - left - 18)]
        strip[9 : 9 + len(text), left + 18 : left + 18 + text.shape[1]] = text[:, :, None]
    return strip


def _written(text: str) -> U8:
    """Digits as white on black, (10, n)."""
    rows = [[[int(bits) >> shift & 1 for shift in (2, 1, 0)] + [0] for bits in _GLYPHS[letter]] for letter in text]
    dots = np.concatenate([np.array(glyph, np.uint8) for glyph in rows], axis=1)
    return np.repeat(np.repeat(dots * np.uint8(255), 2, axis=0), 2, axis=1)
