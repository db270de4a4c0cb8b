"""How good the image of a frame is, and what those hear who listen to a live session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from icheat_usd.scene import F32


class Level(StrEnum):
    """How good the image of a frame is."""

    NONE = "none"
    PREVIEW = "preview"  #: coarse, for orientation
    FULL = "full"  #: all rows that the quality asks for; lights that moved may still be noisy
    REST = "rest"  #: nothing is left to be done

    def reaches(self, other: Level) -> bool:
        return _ORDER[self] >= _ORDER[other]


_ORDER = {level: i for i, level in enumerate(Level)}


@dataclass(frozen=True)
class LiveEvent:
    """What listeners hear; from the background thread, so hand it on to the window's own."""

    kind: str  #: "surfaces" (an `image` until there is light), "progress", "better" (show the frame again) or "error"
    frame: float | None
    level: Level
    step: str = ""
    fraction: float = 0.0
    error: Exception | None = None
    image: F32 | None = None  #: (height, width, 3) scene-linear


Listener = Callable[[LiveEvent], None]
