"""Another diffuse colour of the casters, for indirect light alone: the paper's gather scales."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Encoding, Operation, PairCoefficients, Pairs, Parameter
from icheat_usd.edits.operations.division import bounded_ratio


class Albedo(Operation):
    """Scales the light of each caster point by `color` over its own diffuse reflectance, or by `color`.

    Limits: the ratio is held to `division.MAX_RATIO`. What a channel reflects
    with an albedo of 0 is 0, and no ratio makes light of that; such a channel
    stays dark, so a black object cannot be replaced ('emit' can light it).
    Light that a caster hands on by its gloss is scaled along. A renderer that
    gathers from cells takes one point's reflectance for its cell, so what is
    replaced should not have a texture finer than these. Only the last bounce
    sees the other colour.
    """

    name = "albedo"
    doc = "Let the casters reflect light to the receivers as if they had another diffuse colour."
    parameters = (
        Parameter("color", (1.0, 1.0, 1.0), "The other colour, or a factor on their own, scene-linear", minimum=0.0),
        Parameter("replace", True, "Take the place of their own colour, else multiply it"),
    )
    encodings = (Encoding.RANK_1, Encoding.RECIPE, Encoding.ROWS)
    uses_caster = True

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        color = np.asarray(parameters["color"], np.float32)[None, :]
        if not parameters["replace"]:
            return PairCoefficients(color)
        own = pairs.caster.albedo
        return PairCoefficients(bounded_ratio(color, own, own > 0))

    def constants(self, parameters: Mapping[str, Value]) -> PairCoefficients | None:
        if parameters["replace"]:
            return None  # It depends on the casters' own colours.
        return PairCoefficients(np.asarray(parameters["color"], np.float32)[None, :])
