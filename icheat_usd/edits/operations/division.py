"""The paper's division rule: coefficients that turn one colour into another (iCheat, section 5.2)."""

from __future__ import annotations

import numpy as np

from icheat_usd.edits.operations.base import PairCoefficients
from icheat_usd.scene import F32, Bool

#: A channel's ratio is formed where the channel holds more than this share of the pair's largest one ...
RELATIVE_EPSILON = np.float32(1e-4)
#: ... and is held to this, so that a faint channel cannot explode under another light.
MAX_RATIO = np.float32(64.0)


def divide(incident: F32, wanted: F32) -> PairCoefficients:
    """Scale and added emission that turn `incident` into `wanted` exactly.

    Per channel, with a relative threshold. What no bounded ratio can reach,
    such as green out of a purely red surface, is light that the caster adds;
    it travels by the same transport.

    Parameters
    ----------
    incident, wanted : (n, 3) float32, radiance, at least 0
    """
    floor = RELATIVE_EPSILON * incident.max(axis=1, keepdims=True)
    divisible = incident > np.maximum(floor, np.float32(0))
    ratio = bounded_ratio(wanted, incident, divisible)
    return PairCoefficients(scale=ratio, emission=(wanted - ratio * incident).astype(np.float32))


def bounded_ratio(wanted: F32, given: F32, divisible: Bool) -> F32:
    """``wanted / given`` up to `MAX_RATIO` where `divisible`, else 1; `given` is positive there."""
    one = np.float32(1)
    # Clipped before the division, which so cannot overflow however faint the light.
    reached = np.minimum(wanted, MAX_RATIO * given)
    ratio: F32 = np.where(divisible, reached / np.where(divisible, given, one), one).astype(np.float32)
    return ratio
