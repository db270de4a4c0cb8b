"""Scale and offset of all indirect light of the receivers: the paper's view vectors (iCheat, equation 5)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Encoding, Level, Operation, Parameter, ViewCoefficients


class Receive(Operation):
    """Multiplies and adds to the indirect light of the receivers, whoever sent it, after every other edit."""

    name = "receive"
    doc = "Multiply all indirect light of the receivers by scale and add offset, after every other edit."
    parameters = (
        Parameter("scale", (1.0, 1.0, 1.0), "Factor per channel", minimum=0.0),
        Parameter("offset", (0.0, 0.0, 0.0), "Radiance that is added, scene-linear; may be negative"),
    )
    level = Level.VIEW
    encodings = (Encoding.VECTOR, Encoding.RECIPE)

    def evaluate_view(self, parameters: Mapping[str, Value]) -> ViewCoefficients:
        return ViewCoefficients(
            np.asarray(parameters["scale"], np.float32), np.asarray(parameters["offset"], np.float32)
        )
