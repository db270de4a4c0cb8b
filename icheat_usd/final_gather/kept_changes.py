"""Changes of light that places were found to get, for stacks under which they get the same or a multiple of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from icheat_usd.final_gather.irradiance_cache import Lookup
from icheat_usd.scene import F32

_MOST = 64  #: calls whose changes are kept


class KeptChanges:
    """Changes by what was asked for: places with their records, and arrays that tell what is wanted of these."""

    def __init__(self) -> None:
        self._kept: list[tuple[Lookup, tuple[Any, ...], F32]] = []

    def find(self, found: Lookup, asked: Sequence[Any]) -> F32 | None:
        """What the same places got, (m, 3); None if they have not asked the same before."""
        for one, before, change in self._kept:
            if one is found and all(np.array_equal(a, b) for a, b in zip(asked, before, strict=True)):
                return change
        return None

    def keep(self, found: Lookup, asked: Sequence[Any], change: F32) -> None:
        """Remember it, in place of what is oldest."""
        self._kept = [*self._kept[1 - _MOST :], (found, tuple(asked), change)]
