"""Removal of indirect shadows between named objects (iCheat, section 3.3)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Operation, PairCoefficients, Pairs, Parameter


class Unshadow(Operation):
    """Lets the light that the edit's occluders hold back pass, `color` times.

    A scale cannot do it, as there is no light to scale behind an occluder.
    What the occluders themselves send to the receivers stays.
    """

    name = "unshadow"
    doc = "Let the light from the casters pass the edit's occluders; what these send themselves stays."
    parameters = (
        Parameter("color", (1.0, 1.0, 1.0), "Share of the held-back light that arrives, per channel", minimum=0.0),
    )
    has_through = True

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        color = np.asarray(parameters["color"], np.float32)[None, :]
        return PairCoefficients(np.ones((1, 3), np.float32), through=color)
