"""Light that is sent towards a point, such as a character's face."""

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
)
from icheat_usd.edits.operations.lobes import lobe, mean_lobe
from icheat_usd.errors import EditError
from icheat_usd.scene import F32


class Redirect(Operation):
    """Scales the light of each caster point by a lobe about its direction to the target.

    The lobe is a power of the cosine that falls to half at `spread`, divided
    by its cosine-weighted mean over the caster's hemisphere. So the power that
    a caster point sends stays, wherever the target lies.

    Limits: a caster point cannot send light to a target behind it. The edit
    fades away there, from full at the caster's horizon to none where the
    target lies `spread` below it; the power stays during that too. A caster
    point at the target itself sends as before.
    """

    name = "redirect"
    doc = "Send the casters' light towards a point; the power that each caster sends stays as it was."
    parameters = (
        Parameter("target", (0.0, 0.0, 0.0), "Point that the light is sent towards", measure=Measure.POINT),
        Parameter("spread", 30.0, "Angle in degrees from the lobe's axis at which it has fallen to half", minimum=1.0),
    )
    uses_receiver = True
    uses_caster = True

    def complete(self, given: Mapping[str, Value], where: str) -> dict[str, Value]:
        found = super().complete(given, where)
        if number(found, "spread") > 90.0:
            raise EditError(f"{where}: parameter 'spread' is {found['spread']!r}, expected at most 90 degrees")
        return found

    def evaluate(self, parameters: Mapping[str, Value], pairs: Pairs) -> PairCoefficients:
        spread = np.radians(number(parameters, "spread"))
        exponent = max(float(np.log(0.5) / np.log(np.cos(spread))), 0.0)
        caster = pairs.caster
        axis = _unit(np.asarray(parameters["target"], np.float32) - caster.position)
        away = _unit(pairs.receiver.position - caster.position)
        height = np.einsum("ij,ij->i", axis, caster.normal)
        full = _smooth(height / np.float32(np.sin(spread)) + np.float32(1)) * np.any(axis != 0, axis=1)
        mean = mean_lobe(height, exponent)
        safe = np.where(full > 0, mean, np.float32(1))
        ratio = lobe(np.einsum("ij,ij->i", axis, away), exponent) / safe
        scale = np.float32(1) + full * (ratio - np.float32(1))
        return PairCoefficients(np.broadcast_to(scale.astype(np.float32)[:, None], (len(scale), 3)))


def _unit(vectors: F32) -> F32:
    """Unit vectors; 0 stays 0."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    return (vectors / np.where(length > 0, length, np.float32(1))).astype(np.float32)


def _smooth(x: F32) -> F32:
    """0 below 0, 1 above 1, smooth in between."""
    t = np.clip(x, 0, 1)
    return (t * t * (np.float32(3) - np.float32(2) * t)).astype(np.float32)
