"""Photometric files, written for tests."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike


def profile_text(
    vertical: Sequence[float],
    horizontal: Sequence[float],
    intensity: ArrayLike,
    *,
    kind: int = 1,
    multiplier: float = 1.0,
    ballast: float = 1.0,
    tilt: str = "NONE",
) -> str:
    """A file of LM-63-2002; `intensity` (horizontal, vertical), candela."""
    rows = np.broadcast_to(np.asarray(intensity, float), (len(horizontal), len(vertical)))
    lines = [
        "IESNA:LM-63-2002",
        "[TEST] none",
        "[MANUFAC] made for a test, 12 numbers 34",
        f"TILT={tilt}",
        f"1 -1 {multiplier} {len(vertical)} {len(horizontal)} {kind} 2 0.1 0.1 0.0",
        f"{ballast} 1.0 100",
        " ".join(str(angle) for angle in vertical),
        " ".join(str(angle) for angle in horizontal),
        *(" ".join(f"{value:.6g}" for value in row) for row in rows),
    ]
    return "\r\n".join(lines) + "\r\n"
