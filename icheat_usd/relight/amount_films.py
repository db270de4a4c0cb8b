"""Images between which an amount moves: while it does, a frame is what lies between two of them."""

from __future__ import annotations

import numpy as np

from icheat_usd.kernels.assemble import sum_films
from icheat_usd.scene import F32, I32

#: An amount that has changed so often, and nothing else in between, is taken for one that someone drags.
_CHANGES = 3
_NOBODY: I32 = np.zeros(0, np.int32)
_NOTHING: F32 = np.zeros((0, 3), np.float32)


class AmountFilms:
    """Keeps the image at an edit's full amount, and what it lacks of it at none.

    Light of edits that scale is affine in each amount. Where an edit changes
    nothing both images are the same bits, and so is all between them.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Something else than one amount has changed."""
        self.path = ""  #: of the edit
        self._n_changes = 0
        self._was_wanted = False
        self._whole: F32 | None = None
        self._lacks: F32 | None = None

    def changed(self, path: str) -> None:
        """The amount of an edit has changed, and nothing else; no path: something else has."""
        if path != self.path or not path:
            self.forget()
            self.path = path
        self._n_changes += bool(path)

    def are_wanted(self) -> bool:
        """Whether it is time to make the images, which it is once in a drag: a frame is the same if shown again."""
        is_time = self._n_changes >= _CHANGES and not self._was_wanted
        self._was_wanted |= is_time
        return is_time

    def put(self, whole: F32, half: F32) -> None:
        """Take the images (n_pixels, 3) at amounts of 1 and of a half; the second one is changed."""
        np.subtract(half, whole, out=half)
        half *= np.float32(2)
        self._whole, self._lacks = whole, half

    def hold(self, amount: float) -> bool:
        """Whether the image of an amount lies between the two."""
        return self._whole is not None and 0 < amount <= 1

    def between(self, amount: float, out: F32) -> None:
        """The image at an amount into `out` (n_pixels, 3)."""
        assert self._whole is not None and self._lacks is not None
        share = np.full((1, 48), 1 - amount, np.float32)
        sum_films((self._whole, self._lacks[None], share), _NOBODY, _NOTHING, out)
