"""What the few rays of quick bounces get wrong of a light at rest, taken from its bounces while it moves."""

from __future__ import annotations

import numpy as np

from icheat_usd.scene import F32, F64

#: One of so many cells tells how much of the light at rest is in another.
_ASKED = 16

#: A cell keeps so much of what it reflected at rest, times the share of that light, if it still reflects that. An error
#: may be that of one ray that hit what is bright, which it misses once the light has moved.
_KEPT = 0.5


class KnownBounces:
    """Errors of bounce rows in the light of all bounces, as if they were direct light: a control variate nearby.

    The rows' rays are the same from one look to the next. Of noise that is independent from ray to ray, as much is in
    other light as that of the rest is in it by least squares, and what is different has noise of its own.

    Parameters
    ----------
    error : (n_gather, 3)
        What few rays would add to `radiance`, of `QuickBounces.off_balance`.
    radiance, direct : (n_gather, 3)
        Light of all bounces of that direct light.
    """

    def __init__(self, error: F32, radiance: F32, direct: F32) -> None:
        self._error, self._light = error, radiance[::_ASKED].astype(np.float64)
        self._square = np.square(self._light).sum(axis=0)
        self._direct = direct[::_ASKED].astype(np.float64)  # of the look before
        self._kept = np.float32(_KEPT) * (radiance - direct)
        self.before: F32 = direct - error  #: what `take_from` gave last, at first for the light at rest

    def take_from(self, direct: F32, radiance: F32) -> tuple[F32, F32]:
        """Direct light less the errors of its bounces, and `least` of `QuickBounces.follow`, (n_gather, 3) each.

        By `radiance` of the look before.
        """
        share = _ratio((self._light * radiance[::_ASKED]).sum(axis=0), self._square)
        before, self._direct = self._direct, direct[::_ASKED].astype(np.float64)
        # Where a light is dimmed or jumps, the look before says too much.
        share *= np.minimum(_ratio(self._direct.sum(axis=0), before.sum(axis=0)), 1)
        if np.abs(self._direct - before).sum() > self._direct.sum():
            share[:] = 0
        self.before = direct - self._error * share.astype(np.float32)
        return self.before, self._kept * share.astype(np.float32)


def _ratio(a: F64, b: F64) -> F64:
    """Channel by channel, 0 over 0."""
    return np.divide(a, b, out=np.zeros(3), where=b > 0)
