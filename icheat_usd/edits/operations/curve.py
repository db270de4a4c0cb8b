"""A curve through knots on the light from the casters: grading, as one does it on an image."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.edits.model import Value
from icheat_usd.edits.operations.base import Level, Operation, Parameter, numbers
from icheat_usd.edits.operations.gamma import GREATEST
from icheat_usd.errors import EditError
from icheat_usd.scene import F32, F64

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  #: Rec.709


class Curve(Operation):
    """Sends the light through a smooth curve: each channel by itself, or the luminance with the colour kept.

    The curve goes through its knots without overshoot, holds the first output
    before them, goes on straight after them, and never goes below 0. It acts
    on the sum over the casters, as 'gamma' does. Where there is no light, what
    the curve makes of it is grey; the casters send it, all alike, so that it
    comes only where they reach and are reflected, and stronger edits dim it.
    """

    name = "curve"
    doc = "Send all the light that a receiver gets from the casters through a smooth curve."
    parameters = (
        Parameter("inputs", (0.0, 1.0), "Radiance of the knots, rising", is_array=True),
        Parameter("outputs", (0.0, 1.0), "What each knot becomes, not falling; as many as inputs", is_array=True),
        Parameter("on", "channels", "Each channel by itself, or the luminance", choices=("channels", "luminance")),
    )
    level = Level.AGGREGATE
    uses_incident = True

    def complete(self, given: Mapping[str, Value], where: str) -> dict[str, Value]:
        found = super().complete(given, where)
        inputs, outputs = numbers(found, "inputs"), numbers(found, "outputs")
        if len(inputs) < 2 or len(inputs) != len(outputs):
            raise EditError(
                f"{where}: parameters 'inputs' and 'outputs' have {len(inputs)} and {len(outputs)} knots,"
                " expected two or more, as many in both; give both"
            )
        if not np.all(np.diff(inputs) > 0):
            raise EditError(f"{where}: parameter 'inputs' is {inputs!r}, expected rising numbers")
        if not np.all(np.diff(outputs) >= 0):
            raise EditError(f"{where}: parameter 'outputs' is {outputs!r}, expected numbers that do not fall")
        return found

    def evaluate_aggregate(self, parameters: Mapping[str, Value], light: F32) -> F32:
        knots = numbers(parameters, "inputs"), numbers(parameters, "outputs")
        given = np.maximum(light.astype(np.float64), 0.0)
        if parameters["on"] == "channels":
            wanted = monotone_curve(*knots, given)
        else:
            luminance = given @ LUMINANCE
            lit = luminance > 0
            color = np.where(lit[:, None], given / np.where(lit, luminance, 1.0)[:, None], 1.0)
            wanted = color * monotone_curve(*knots, luminance)[:, None]
        return np.clip(wanted, 0.0, GREATEST).astype(np.float32)


def monotone_curve(inputs: ArrayLike, outputs: ArrayLike, x: F64) -> F64:
    """Monotone cubic (PCHIP) through knots, at `x` of any shape; held before the first, straight after the last.

    References
    ----------
    Fritsch & Butland 1984, SIAM J. Sci. Stat. Comput. 5(2), for the slopes at inner knots; those at the ends are
    of the parabola through three knots, limited to keep the shape (Moler 2004, Numerical Computing with MATLAB, 3.6).
    """
    knot, value = np.asarray(inputs, np.float64), np.asarray(outputs, np.float64)
    width = np.diff(knot)
    secant = np.diff(value) / width
    slope = _slopes(width, secant)
    place = np.clip(x, knot[0], knot[-1])
    k = np.clip(np.searchsorted(knot, place, side="right") - 1, 0, len(width) - 1)
    t = (place - knot[k]) / width[k]
    rise = t * t * (3 - 2 * t)
    bend = width[k] * (t * (1 - t) ** 2 * slope[k] - t * t * (1 - t) * slope[k + 1])
    beyond = np.maximum(x - knot[-1], 0.0) * slope[-1]
    result: F64 = value[k] * (1 - rise) + value[k + 1] * rise + bend + beyond
    return result


def _slopes(width: F64, secant: F64) -> F64:
    if len(width) == 1:
        return np.repeat(secant, 2)
    before, after = secant[:-1], secant[1:]
    w1, w2 = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
    rises = before * after > 0
    mean = w1 / np.where(rises, before, 1.0) + w2 / np.where(rises, after, 1.0)
    inner = np.where(rises, (w1 + w2) / mean, 0.0)
    first = _end_slope(width[0], width[1], secant[0], secant[1])
    last = _end_slope(width[-1], width[-2], secant[-1], secant[-2])
    return np.concatenate([[first], inner, [last]])


def _end_slope(width: float, next_width: float, secant: float, next_secant: float) -> float:
    slope = ((2 * width + next_width) * secant - width * next_secant) / (width + next_width)
    # Secants of a curve that does not fall are at least 0.
    return float(min(max(slope, 0.0), 3 * secant))
