"""Which stages are measured, and what tables call them."""

from __future__ import annotations

import os
from pathlib import Path

#: An area light and a keyed edit; an area light, a dome behind a variant, a sun and painted edits.
_SAMPLES = ("sample_stages/animated_room/shot.usda", "sample_stages/furnished_room/shot.usda")
_OUTSIDE = ("bitterli_veach-ajar/veach-ajar.usda", "bitterli_living-room/living-room.usda")


def default_stages(root: Path) -> list[str]:
    """Two sample stages, and of the outside scenes in ``$ICHEAT_SHARED_SCENES`` those that are there."""
    stages = [str(root / name) for name in _SAMPLES]
    folder = os.environ.get("ICHEAT_SHARED_SCENES")
    if folder:
        stages += [str(Path(folder) / name) for name in _OUTSIDE if (Path(folder) / name).exists()]
    return stages


def short_name(stage: str) -> str:
    """Name of a stage in tables: its own, or its folder's where it has a name that many have."""
    path = Path(stage)
    return path.parent.name if path.stem in ("scene", "sequence", "shot") else path.stem
