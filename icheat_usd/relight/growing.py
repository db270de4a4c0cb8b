"""Arrays that grow at one end without being copied each time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Growing:
    """An array whose first axis grows; room for half as much again is kept behind it."""

    def __init__(self, empty: NDArray[Any]) -> None:
        self._room = empty
        self.n = len(empty)

    @property
    def values(self) -> NDArray[Any]:
        """(n, ...), to be read or written until it grows."""
        return self._room[: self.n]

    def append(self, rows: NDArray[Any]) -> None:
        """Put rows at the end."""
        self.extend(len(rows))[:] = rows

    def extend(self, n_more: int, fill: float = 0) -> NDArray[Any]:
        """Put rows of one value at the end, and return them."""
        n = self.n + n_more
        if n > len(self._room):
            room = np.empty((max(n, len(self._room) * 3 // 2), *self._room.shape[1:]), self._room.dtype)
            room[: self.n] = self.values
            self._room = room
        self._room[self.n : n] = fill
        self.n = n
        return self._room[n - n_more : n]
