"""Scale and tint: the paper's plain scale of the transport (iCheat, section 3.3)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Operation, PairCoefficients, Pairs, Parameter, number


class Scale(Operation):
    """Multiplies the light by ``gain * color``: darken, brighten or tint it."""

    name = "scale"
    doc = "Multiply the light that the receivers get from the casters by gain x color."
    parameters = (
        Parameter("color", (1.0, 1.0, 1.0), "Factor per channel, scene-linear", minimum=0.0),
        Parameter("gain", 1.0, "Factor for all channels", minimum=0.0),
    )

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        color = np.asarray(parameters["color"], np.float32)
        return PairCoefficients(scale=(np.float32(number(parameters, "gain")) * color)[None, :])

    def constant_delta(self, parameters: Mapping[str, Value]) -> tuple[float, float, float]:
        red, green, blue = self.evaluate(parameters, Pairs(np.zeros((1, 3), np.float32))).scale[0]
        return float(red - 1), float(green - 1), float(blue - 1)
