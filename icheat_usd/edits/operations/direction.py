"""Directionality: more light from one direction, less from the others (iCheat, Fig. 1)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import (
    Measure,
    Operation,
    PairCoefficients,
    Pairs,
    Parameter,
    number,
    numbers,
)
from icheat_usd.edits.operations.lobes import lobe, mean_lobe
from icheat_usd.errors import EditError
from icheat_usd.scene import F32


class Direction(Operation):
    """Scales light by ``1 + strength (lobe - mean)``, the lobe a power of the cosine to `direction`.

    The mean is the lobe's, cosine-weighted over the receiver's hemisphere, so
    that a receiver in light that comes equally from everywhere gets as much as
    before, however it is turned.

    Limits: with a strength above ``(sharpness + 2) / 2`` the scale is negative
    where little should come from, which keeps the mean; the receiver's sum is
    clamped at 0 in the end. The mean is that of a diffuse receiver.
    """

    name = "direction"
    doc = "Let the light come more from one direction and less from the others, in the mean as much as before."
    parameters = (
        Parameter(
            "direction",
            (0.0, 1.0, 0.0),
            "Where the light should come from, as seen from the receivers",
            measure=Measure.DIRECTION,
        ),
        Parameter("sharpness", 2.0, "Power of the cosine to the direction", minimum=0.0),
        Parameter("strength", 1.0, "How much is moved; below 0 it moves away from the direction"),
    )
    uses_receiver = True
    uses_caster = True

    def complete(self, given: Mapping[str, Value], where: str) -> dict[str, Value]:
        found = super().complete(given, where)
        direction = numbers(found, "direction")
        if not any(direction):
            raise EditError(f"{where}: parameter 'direction' is {direction!r}, expected a vector with a length")
        return found

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        sharpness, strength = number(parameters, "sharpness"), np.float32(number(parameters, "strength"))
        given = np.asarray(parameters["direction"], np.float64)
        axis: F32 = (given / np.linalg.norm(given)).astype(np.float32)
        towards = pairs.caster.position - pairs.receiver.position
        distance = np.sqrt(np.einsum("ij,ij->i", towards, towards))
        cosine = (towards @ axis) / np.maximum(distance, np.finfo(np.float32).tiny)
        mean = mean_lobe(pairs.receiver.normal @ axis, sharpness)
        scale = np.float32(1) + strength * (lobe(cosine, sharpness) - mean)
        return PairCoefficients(np.broadcast_to(scale[:, None], (len(scale), 3)))
