"""States of a live session kept for undo, and what they take together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any
from weakref import WeakKeyDictionary, ref

from numpy.typing import NDArray

from icheat_usd.edits.kept_masks import KeptMask, MaskShelf
from icheat_usd.session.live_state import EditChange, LiveState

_MASKS = ("receiver_mask", "caster_mask")


class _KeptChange:
    """An `EditChange` with its masks apart."""

    def __init__(self, change: EditChange, masks: Mapping[str, KeptMask]) -> None:
        self._rest, self._whole = replace(change, receiver_mask=None, caster_mask=None), ref(change)
        self.masks = masks

    def whole(self) -> EditChange:
        """The change; the same object as long as something uses it."""
        found = self._whole()
        if found is None:
            receiver_mask, caster_mask = (self.masks[name].whole() if name in self.masks else None for name in _MASKS)
            found = replace(self._rest, receiver_mask=receiver_mask, caster_mask=caster_mask)
            self._whole = ref(found)
        return found


class KeptState:
    """A `LiveState` with the masks of its edits apart."""

    def __init__(self, state: LiveState, edits: Mapping[str, _KeptChange]) -> None:
        self._rest, self._edits = replace(state, edits=LiveState().edits), edits

    def whole(self) -> LiveState:
        """The state, to the bit."""
        edits = {path: change.whole() for path, change in self._edits.items()}
        return replace(self._rest, edits=MappingProxyType(edits))

    @property
    def arrays(self) -> list[NDArray[Any]]:
        """All that takes memory."""
        masks = [mask for change in self._edits.values() for mask in change.masks.values()]
        textures = [light.texture for light in self._rest.lights.values() if light.texture is not None]
        return [*(array for mask in masks for array in mask.arrays), *textures]


class StateShelf:
    """Keeps states, and knows the bytes of all their arrays, each counted once."""

    def __init__(self) -> None:
        self.bytes = 0
        self._masks = MaskShelf()
        self._changes: WeakKeyDictionary[EditChange, _KeptChange] = WeakKeyDictionary()
        self._uses: dict[int, int] = {}  # of each array

    def keep(self, state: LiveState) -> KeptState:
        """Keep a state until it is forgotten as often as it was kept."""
        kept = KeptState(state, {path: self._kept(path, change) for path, change in state.edits.items()})
        for array in kept.arrays:
            uses = self._uses.get(id(array), 0)
            self._uses[id(array)] = uses + 1
            self.bytes += array.nbytes if uses == 0 else 0
        return kept

    def forget(self, kept: KeptState) -> None:
        """Keep it once less."""
        for array in kept.arrays:
            self._uses[id(array)] -= 1
            if self._uses[id(array)] == 0:
                del self._uses[id(array)]
                self.bytes -= array.nbytes

    def _kept(self, path: str, change: EditChange) -> _KeptChange:
        known = self._changes.get(change)
        if known is None:
            masks = {name: getattr(change, name) for name in _MASKS}
            kept = {name: self._masks.keep((path, name), mask) for name, mask in masks.items() if mask is not None}
            known = self._changes[change] = _KeptChange(change, kept)
        return known
