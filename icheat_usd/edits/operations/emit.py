"""Objects that send light of their own to chosen receivers: the paper's Fig. 3, gather offsets."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Encoding, Operation, PairCoefficients, Pairs, Parameter
from icheat_usd.edits.operations.scale import scaled_color


class Emit(Operation):
    """Adds the radiance ``intensity * color`` to what the casters send, whether they are lit or not.

    It travels by the same transport, so walls hold it back, and only to the
    receivers of the edit; light that it would bring elsewhere by further
    bounces does not exist.
    """

    name = "emit"
    doc = "Let the casters send light of their own to the receivers: the radiance intensity x color."
    parameters = (
        Parameter("color", (1.0, 1.0, 1.0), "Colour of the light, scene-linear", minimum=0.0),
        Parameter("intensity", 1.0, "Factor on the colour; their product is a radiance", minimum=0.0),
    )
    encodings = (Encoding.RANK_1, Encoding.RECIPE, Encoding.ROWS)

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        return self.constants(parameters)

    def constants(self, parameters: Mapping[str, Value]) -> PairCoefficients:
        return PairCoefficients(np.ones((1, 3), np.float32), emission=scaled_color(parameters, "intensity"))
