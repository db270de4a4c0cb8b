"""What an operation may ask about the scene and the selections that it is bound to."""

from __future__ import annotations

from dataclasses import dataclass

from icheat_usd.edits.selection import BoundSelection
from icheat_usd.scene import SceneSnapshot


@dataclass(frozen=True, eq=False)
class Measures:
    """Measures of one key of an edit; computed when asked for."""

    snapshot: SceneSnapshot
    receivers: BoundSelection
    casters: BoundSelection

    def mean_distance(self) -> float:
        """Mean distance of receivers and casters, metres."""
        raise NotImplementedError

    def caster_area(self) -> float:
        """Area of the casters, weighted by their masks, square metres."""
        raise NotImplementedError
