"""How long work reports where it stands."""

from __future__ import annotations

from typing import Protocol


class Progress(Protocol):
    """Called with the step's name and the fraction of it that is done, in [0, 1]."""

    def __call__(self, step: str, fraction: float) -> None: ...


def silent(step: str, fraction: float) -> None:
    """Report nothing."""
