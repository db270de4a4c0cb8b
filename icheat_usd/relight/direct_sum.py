"""Direct light as an image takes it: the lights that did not change as one sum, the others one by one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from icheat_usd.kernels.assemble import sum_scaled
from icheat_usd.scene import F32


class SummedLight(NamedTuple):
    """Reflected direct light; see `kernels.assemble.assemble_film`."""

    kept: F32  #: (n_view, 3) sum of the first lights, or (0, 3)
    lights: F32  #: (n_more, n_view, 3) the others, at gain 1
    gains: F32  #: (n_more, 48) theirs, each 16 times


class DirectSum:
    """Keeps the sum of the lights before the first that changes.

    Lights are always added up in their order, so what is kept does not show in the bits.
    """

    def __init__(self) -> None:
        self._kept: F32 = np.zeros((0, 3), np.float32)
        self._n_kept = 0
        self._gains: F32 = np.zeros((0, 3), np.float32)
        self._moves: list[int] | None = None

    def now(self, view_direct: F32, gains: F32, moves: Sequence[int] | None) -> SummedLight:
        """Direct light (n_lights, n_view, 3) under gains (n_lights, 3).

        Parameters
        ----------
        moves
            Of each light a number that grows when it is not the light it was at gain 1; None if that is not known.
        """
        first = self._first_change(gains, moves)
        if first < self._n_kept or first == len(gains) != self._n_kept:
            self._keep(view_direct, gains, first)
        self._gains, self._moves = gains.copy(), None if moves is None else list(moves)
        rest = slice(self._n_kept, None)
        return SummedLight(self._kept, view_direct[rest], np.tile(gains[rest], (1, 16)).astype(np.float32))

    def _first_change(self, gains: F32, moves: Sequence[int] | None) -> int:
        """The first light that is not as it was; the number of lights if all are."""
        if moves is None or self._moves is None or len(gains) != len(self._gains):
            return 0
        same = (gains == self._gains).all(axis=1) & np.equal(moves, self._moves)
        return int(np.argmin(np.append(same, False)))

    def _keep(self, view_direct: F32, gains: F32, n: int) -> None:
        self._n_kept = n
        if n == 0:
            self._kept = np.zeros((0, 3), np.float32)
            return
        if not len(self._kept):
            self._kept = np.empty(view_direct.shape[1:], np.float32)
        sum_scaled(view_direct[:n], gains[:n], self._kept)
