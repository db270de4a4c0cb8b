"""Hue, saturation and value of the light between two selections."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Operation, PairCoefficients, Pairs, Parameter, number
from icheat_usd.edits.operations.division import divide
from icheat_usd.scene import F32


class Hsv(Operation):
    """Rotates hue, scales saturation and value of each pair's incident colour.

    All three are homogeneous of degree one, ``op(k c) = k op(c)``, so the
    geometry between the two points cancels and the result does not depend on
    how finely the scene is sampled.

    Limits: hue is the hexcone's, on scene-linear Rec.709; value is the largest
    channel and has no upper bound. A colour without saturation has no hue to
    turn.
    """

    name = "hsv"
    doc = "Turn hue, scale saturation and value of the light that the receivers get from the casters."
    parameters = (
        Parameter("hue", 0.0, "Rotation in degrees"),
        Parameter("saturation", 1.0, "Factor on saturation, held to at most full saturation", minimum=0.0),
        Parameter("value", 1.0, "Factor on value", minimum=0.0),
    )
    uses_incident = True

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        incident = np.maximum(pairs.incident, np.float32(0))
        hue, saturation, value = (number(parameters, name) for name in ("hue", "saturation", "value"))
        return divide(incident, adjust_hsv(incident, hue, saturation, value))


def adjust_hsv(rgb: F32, hue: float, saturation: float, value: float) -> F32:
    """Rotate hue by `hue` degrees, scale saturation and value of (n, 3) non-negative colours."""
    v = rgb.max(axis=1)
    chroma = v - rgb.min(axis=1)
    lit = chroma > 0
    safe_chroma = np.where(lit, chroma, np.float32(1))
    r, g, b = rgb[:, 0], rgb[:, 1], rgb[:, 2]
    sector = np.where(
        v == r,
        (g - b) / safe_chroma,
        np.where(v == g, (b - r) / safe_chroma + np.float32(2), (r - g) / safe_chroma + np.float32(4)),
    )
    sector = np.where(lit, sector, np.float32(0)) + np.float32(hue / 60.0)
    s = np.where(v > 0, chroma / np.where(v > 0, v, np.float32(1)), np.float32(0))
    new_chroma = np.minimum(s * np.float32(saturation), np.float32(1)) * v * np.float32(value)
    new_v = v * np.float32(value)
    channels = []
    for offset in (5.0, 3.0, 1.0):
        k = np.mod(sector + np.float32(offset), np.float32(6))
        channels.append(new_v - new_chroma * np.clip(np.minimum(k, np.float32(4) - k), np.float32(0), np.float32(1)))
    return np.stack(channels, axis=1).astype(np.float32)
