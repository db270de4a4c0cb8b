"""Frames that stay in memory, and what they share.

What two frames have in common (the transport, where only lights or keys
animate) is found by its content key and exists once. Frames are kept until
their parts exceed a limit; then those go that are least useful: far from the
playhead in the direction of play, and quickly made again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from types import MappingProxyType
from typing import Any, Generic, TypeVar, cast
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from icheat_usd.scene import SceneSnapshot

Part = TypeVar("Part")
Frame = TypeVar("Frame")

#: A frame behind the playhead is as useful as one this many times further ahead.
_BEHIND = 4.0


class SharedParts:
    """Parts by kind and content key, for as long as something uses them."""

    def __init__(self) -> None:
        self._parts: WeakValueDictionary[tuple[str, str], Any] = WeakValueDictionary()
        self._lock = threading.Lock()

    def get(self, kind: str, key: str, make: Callable[[], Part]) -> Part:
        """The part of this key, made if it is not there."""
        found = self.find(kind, key)
        return cast(Part, found) if found is not None else self.keep(kind, key, make())

    def find(self, kind: str, key: str) -> Any | None:
        with self._lock:
            return self._parts.get((kind, key))

    def keep(self, kind: str, key: str, part: Part) -> Part:
        """The part, or the one that was there first."""
        with self._lock:
            return cast(Part, self._parts.setdefault((kind, key), part))

    def __len__(self) -> int:
        return len(self._parts)


@dataclass
class _Resident(Generic[Frame]):
    state: Frame
    seconds: float  #: that making it took


class ResidentFrames(Generic[Frame]):
    """States by frame, within a limit.

    Parameters
    ----------
    limit : bytes
        Of all arrays of all frames, each counted once. The frame at the playhead stays, however large.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.playhead: float | None = None
        self.direction = 1  #: of play: 1 or -1
        self._frames: dict[float | None, _Resident[Frame]] = {}

    def get(self, frame: float | None) -> Frame | None:
        found = self._frames.get(frame)
        return None if found is None else found.state

    def put(self, frame: float | None, state: Frame, seconds: float) -> tuple[float | None, ...]:
        """Keep a frame, in place of what was there; which frames had to go for it."""
        previous = self._frames.get(frame)
        self._frames[frame] = _Resident(state, max(seconds, previous.seconds if previous else 0.0))
        return self.trim()

    def move(self, frame: float | None) -> None:
        """Put the playhead somewhere; where it came from says which way it goes."""
        if frame is not None and self.playhead is not None and frame != self.playhead:
            self.direction = 1 if frame > self.playhead else -1
        self.playhead = frame

    def frames(self) -> tuple[float | None, ...]:
        return tuple(self._frames)

    def drop(self) -> None:
        self._frames.clear()

    def bytes(self) -> int:
        """Of all arrays; what frames share counts once."""
        return array_bytes(entry.state for entry in self._frames.values())

    def bytes_of(self, frame: float | None) -> tuple[int, int]:
        """Of all arrays of one frame, and of those that no other frame uses."""
        whole = array_bytes([self._frames[frame].state])
        others = array_bytes(entry.state for key, entry in self._frames.items() if key != frame)
        return whole, self.bytes() - others

    def trim(self) -> tuple[float | None, ...]:
        """Let the least useful frames go until the limit holds."""
        gone: list[float | None] = []
        while len(self._frames) > 1 and self.bytes() > self.limit:
            candidates = [frame for frame in self._frames if frame != self.playhead]
            worst = min(candidates, key=self._usefulness)
            del self._frames[worst]
            gone.append(worst)
        return tuple(gone)

    def _usefulness(self, frame: float | None) -> float:
        if frame is None or self.playhead is None:
            return 0.0
        ahead = (frame - self.playhead) * self.direction
        distance = ahead if ahead >= 0 else -ahead * _BEHIND
        return self._frames[frame].seconds / (1.0 + distance)


def share_tables(snapshot: SceneSnapshot, other: SceneSnapshot) -> SceneSnapshot:
    """A snapshot whose arrays are those of another one wherever they are equal."""
    tables = {}
    for name in ("geometry", "materials", "textures", "lights"):
        here, there = getattr(snapshot, name), getattr(other, name)
        columns = [b if _equal(a, b) else a for a, b in zip(here, there, strict=True)]
        tables[name] = type(here)(*columns)
    return replace(snapshot, **tables)


def _equal(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return a.shape == b.shape and bool(np.array_equal(a, b))


def array_bytes(things: Iterable[Any]) -> int:
    """Memory of all arrays in dataclasses, named tuples, containers and objects of this package; each once."""
    seen: set[int] = set()
    total = 0
    pending: list[Any] = list(things)
    while pending:
        thing = pending.pop()
        if isinstance(thing, np.ndarray):
            while isinstance(thing.base, np.ndarray):
                thing = thing.base
            if id(thing) not in seen:
                seen.add(id(thing))
                total += thing.nbytes
            continue
        if thing is None or isinstance(thing, (bool, int, float, str, bytes, np.generic, type)) or id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, (tuple, list, set, frozenset)):
            pending.extend(thing)
        elif isinstance(thing, (dict, MappingProxyType)):
            pending.extend(thing.values())
        elif type(thing).__module__.startswith("icheat_usd."):
            if is_dataclass(thing):
                pending.extend(getattr(thing, field.name, None) for field in fields(thing))
            pending.extend(getattr(thing, "__dict__", {}).values())
    return total
