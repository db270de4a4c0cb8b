"""Pixel filters: how far around its centre a pixel looks.

Camera samples are placed with the filter as their density, so that all of them
count the same and belong to one pixel (filter importance sampling: Ernst,
Stamminger, Greiner 2006). Filters are products of one dimension each, and are
never negative.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from icheat_usd.errors import SettingsError
from icheat_usd.scene import F64

_ENTRIES = 4096  # of the inverse distribution; linear between them


def _blackman_harris(x: F64) -> F64:
    """The window of four terms (Harris 1978, table 1) over -1 to 1."""
    phase = np.pi * (x + 1)
    return 0.35875 - 0.48829 * np.cos(phase) + 0.14128 * np.cos(2 * phase) - 0.01168 * np.cos(3 * phase)


#: Density over the support, from -1 to 1, and the usual width in pixels.
_SHAPES: dict[str, tuple[Callable[[F64], F64], float]] = {
    "box": (np.ones_like, 1.0),
    "triangle": (lambda x: 1 - np.abs(x), 2.0),
    "gaussian": (lambda x: np.exp(-2 * x * x), 2.0),  # two standard deviations fit
    "blackman-harris": (_blackman_harris, 3.0),
}

FILTERS = tuple(_SHAPES)


@dataclass(frozen=True)
class PixelFilter:
    """A filter by name ("box", "triangle", "gaussian", "blackman-harris") and the full width of its support.

    Raises
    ------
    SettingsError
        The name is unknown, or the width no positive number.
    """

    name: str = "box"
    width: float = 0.0  #: pixels; 0 is the usual one of each filter: 1, 2, 2 and 3

    def __post_init__(self) -> None:
        if self.name not in _SHAPES:
            raise SettingsError(f"there is no pixel filter '{self.name}'; use one of {', '.join(FILTERS)}")
        if not 0.0 <= self.width < math.inf:
            raise SettingsError(f"the pixel filter is {self.width:g} pixels wide; give it a positive width")

    @property
    def inverse(self) -> F64:
        """Place in the pixel, 0.5 the centre, by equal steps of the share of the filter left of it.

        Returns
        -------
        (n,) float64
            Linear in between; empty for the box of one pixel, which needs no table.
        """
        return _inverse(self.name, self.width or _SHAPES[self.name][1])


BOX = PixelFilter()


@functools.lru_cache(maxsize=16)
def _inverse(name: str, width: float) -> F64:
    if name == "box" and width == 1.0:
        return np.empty(0, np.float64)
    place = np.linspace(-1.0, 1.0, 16 * _ENTRIES + 1)
    density = _SHAPES[name][0](0.5 * (place[1:] + place[:-1]))
    share = np.concatenate([[0.0], np.cumsum(np.maximum(density, 1e-12))])
    return 0.5 + 0.5 * width * np.interp(np.linspace(0.0, share[-1], _ENTRIES + 1), share, place)
