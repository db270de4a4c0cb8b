"""Contrast of the light from the casters: a power curve on what each receiver gets from all of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Level, Operation, Parameter, number
from icheat_usd.scene import F32

#: No radiance that a curve makes is above this, so that what follows stays finite in float32.
GREATEST = 1e30


class Gamma(Operation):
    """Raises the light, in units of `pivot`, to a power: ``pivot * (light / pivot)^exponent`` per channel.

    It acts on the sum over the casters, because the sum of powers of small
    parts depends on how many parts there are. No light stays no light.
    """

    name = "gamma"
    doc = "Raise all the light that a receiver gets from the casters to a power; the pivot stays as it is."
    parameters = (
        Parameter("exponent", 1.0, "Above 1 for more contrast, below 1 for less", minimum=0.0),
        Parameter("pivot", 0.18, "Radiance that stays as it is", minimum=1e-6),
    )
    level = Level.AGGREGATE
    uses_incident = True

    def evaluate_aggregate(self, parameters: Mapping[str, Value], light: F32) -> F32:
        exponent, pivot = number(parameters, "exponent"), number(parameters, "pivot")
        given = np.maximum(light.astype(np.float64), 0.0)
        lit = given > 0
        # By logarithms, which cannot overflow on the way; where nothing shines, any number will do.
        stops = exponent * np.log(np.where(lit, given, pivot) / pivot) + np.log(pivot)
        wanted = np.where(lit, np.exp(np.minimum(stops, np.log(GREATEST))), 0.0)
        return wanted.astype(np.float32)
