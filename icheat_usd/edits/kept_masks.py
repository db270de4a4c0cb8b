"""Painted masks kept for undo: in blocks of faces, of which a dab makes few new ones."""

from __future__ import annotations

from collections.abc import Hashable
from weakref import WeakKeyDictionary, ref

import numpy as np

from icheat_usd.edits.model import MaskedSurface, SurfaceMask
from icheat_usd.scene import F32

#: Faces of a block: 16 kB at 16 x 16 texels, about what a dab touches.
_FACES = 16


class KeptMask:
    """One mask as blocks of texels, each of which other kept masks may share."""

    def __init__(
        self, surfaces: tuple[MaskedSurface, ...], blocks: tuple[F32, ...], rest: F32 | None, whole: SurfaceMask
    ) -> None:
        self._surfaces, self._rest = surfaces, rest
        self.blocks = blocks
        self._whole = ref(whole)

    def whole(self) -> SurfaceMask:
        """The mask, to the bit; the same object as long as something uses it."""
        found = self._whole()
        if found is None:
            found = SurfaceMask(self._surfaces, np.concatenate(self.blocks), self._rest)
            self._whole = ref(found)
        return found

    @property
    def arrays(self) -> tuple[F32, ...]:
        """All that takes memory."""
        return self.blocks if self._rest is None else (*self.blocks, self._rest)


class MaskShelf:
    """Keeps masks; what a mask has in common with the one that was kept before it is there once."""

    def __init__(self) -> None:
        self._kept: WeakKeyDictionary[SurfaceMask, KeptMask] = WeakKeyDictionary()
        self._last: dict[Hashable, ref[KeptMask]] = {}

    def keep(self, name: Hashable, mask: SurfaceMask) -> KeptMask:
        """Keep a mask; `name` says which of them it is a later state of."""
        known = self._kept.get(mask)
        if known is None:
            last = self._last[name]() if name in self._last else None
            blocks, rest = _blocks(mask.texels, last), mask.rest
            if last is not None and rest is not None and _same(last._rest, rest):
                rest = last._rest
            known = self._kept[mask] = KeptMask(mask.surfaces, blocks, rest, mask)
        self._last[name] = ref(known)
        return known


def _blocks(texels: F32, last: KeptMask | None) -> tuple[F32, ...]:
    """Parts of texels (n_faces, resolution, resolution): those of `last` where they are equal, else copies."""
    parts = [texels[first : first + _FACES] for first in range(0, len(texels), _FACES)] or [texels]
    before = [] if last is None else last.blocks[: len(parts)]
    known = [part if k >= len(before) or not _same(before[k], part) else before[k] for k, part in enumerate(parts)]
    # A part as it is would keep all of the texels in memory.
    return tuple(part.copy() if part is parts[k] else part for k, part in enumerate(known))


def _same(a: F32 | None, b: F32) -> bool:
    return a is b or (a is not None and a.shape == b.shape and a.tobytes() == b.tobytes())
