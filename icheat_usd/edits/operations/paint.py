"""Additive paint of the transport's offset (iCheat, section 3.3)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import (
    BoundScene,
    Encoding,
    Operation,
    PairCoefficients,
    Pairs,
    Parameter,
    numbers,
)


class Paint(Operation):
    """Adds to each receiver `color` times what the casters send: their mean radiance, or radiance times area.

    The offset is a density per square metre of casters, and so the same
    however finely these are sampled. Nothing holds it back: neither walls, nor
    distance, nor the receiver's albedo. Casters in the dark give nothing.

    Limits: what both sides of a surface send adds up, over its area counted
    once; a wall whose far side lies in the dark has the mean of its near side.
    """

    name = "paint"
    doc = "Add color x the casters' mean radiance to the receivers, seen or not, whatever the receivers' own colour."
    parameters = (
        Parameter("color", (0.0, 0.0, 0.0), "Factor per channel, scene-linear; may be negative"),
        Parameter("relative", True, "Multiply the casters' mean radiance, else their radiance times area in m^2"),
    )
    encodings = (Encoding.RANK_1, Encoding.RECIPE, Encoding.ROWS)
    has_offset = True
    offset_times_albedo = False

    def prepare(self, parameters: Mapping[str, Value], scene: BoundScene) -> Mapping[str, Value]:
        if not parameters["relative"]:
            return parameters
        area = scene.caster_area()
        density = tuple(component / area if area > 0 else 0.0 for component in numbers(parameters, "color"))
        return {"color": density, "relative": False}

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        offset = np.asarray(parameters["color"], np.float32)[None, :]
        return PairCoefficients(np.ones((1, 3), np.float32), offset=offset)

    def constants(self, parameters: Mapping[str, Value]) -> PairCoefficients | None:
        if parameters["relative"]:
            return None  # It depends on the area of the casters.
        offset = np.asarray(parameters["color"], np.float32)[None, :]
        return PairCoefficients(np.ones((1, 3), np.float32), offset=offset)
