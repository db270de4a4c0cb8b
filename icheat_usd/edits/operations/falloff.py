"""Another falloff of light with distance (iCheat, Fig. 1)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import (
    BoundScene,
    Measure,
    Operation,
    PairCoefficients,
    Pairs,
    Parameter,
    number,
)

#: Share of the pivot distance below which pairs count as being this far apart: light with an exponent above 2
#: would have no bound where receivers touch casters.
NEAREST = 1.0 / 32.0


class Falloff(Operation):
    """Scales light by ``(r / pivot)^(2 - exponent)``, r being the distance of the two points.

    At the pivot it stays as it is. An exponent of 2 is exactly the identity.
    Distances count as at least `NEAREST` of the pivot.
    """

    name = "falloff"
    doc = "Let the light fall with another power of distance; at the pivot distance it stays as it is."
    parameters = (
        Parameter("exponent", 2.0, "Power of distance by which light falls; 2 is physical, 0 does not fall"),
        Parameter(
            "pivot",
            0.0,
            "Distance at which the light stays as it is; 0 takes the mean distance of receivers and casters",
            minimum=0.0,
            measure=Measure.LENGTH,
        ),
    )
    uses_receiver = True
    uses_caster = True
    uses_normals = False

    def prepare(self, parameters: Mapping[str, Value], scene: BoundScene) -> Mapping[str, Value]:
        if number(parameters, "pivot") > 0:
            return parameters
        mean = scene.mean_distance()
        return {**parameters, "pivot": mean if mean > 0 else 1.0}  # Without a mean there are no pairs.

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        # Here, so that edits are read and authored without a compiler.
        from icheat_usd.kernels.distances import distance_powers

        receiver, caster = pairs.receiver.position, pairs.caster.position
        scale = np.empty(max(len(receiver), len(caster)), np.float32)
        pivot, power = np.float32(number(parameters, "pivot")), np.float32(2.0 - number(parameters, "exponent"))
        distance_powers(receiver, caster, pivot, np.float32(NEAREST), power, scale)
        return PairCoefficients(np.broadcast_to(scale[:, None], (len(scale), 3)))
