"""Scale and tint: the paper's plain scale of the transport (iCheat, section 3.3)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Encoding, Operation, PairCoefficients, Pairs, Parameter, number
from icheat_usd.scene import F32


class Scale(Operation):
    """Multiplies the light by ``gain * color``: darken, brighten or tint it."""

    name = "scale"
    doc = "Multiply the light that the receivers get from the casters by gain x color."
    parameters = (
        Parameter("color", (1.0, 1.0, 1.0), "Factor per channel, scene-linear", minimum=0.0),
        Parameter("gain", 1.0, "Factor for all channels", minimum=0.0),
    )
    encodings = (Encoding.RANK_1, Encoding.RECIPE, Encoding.ROWS)

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        return self.constants(parameters)

    def constants(self, parameters: Mapping[str, Value]) -> PairCoefficients:
        return PairCoefficients(scaled_color(parameters, "gain"))


def scaled_color(parameters: Mapping[str, Value], factor: str) -> F32:
    """Parameter `color` times parameter `factor`, (1, 3)."""
    color = np.asarray(parameters["color"], np.float32)
    return (np.float32(number(parameters, factor)) * color)[None, :]
