"""What figures were aimed at, and a sentence on whether they got there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Goal(NamedTuple):
    """One figure beside its bound."""

    name: str
    value: float
    bound: float

    def text(self) -> str:
        return f"{self.name} {self.value:.3g}"


def at_most(what: str, goals: Sequence[Goal]) -> str:
    """Which are at or below their bounds."""
    return _sentence(what, "at most", goals, [goal.value <= goal.bound for goal in goals])


def at_least(what: str, goals: Sequence[Goal]) -> str:
    """Which are at or above their bounds."""
    return _sentence(what, "at least", goals, [goal.value >= goal.bound for goal in goals])


def _sentence(what: str, side: str, goals: Sequence[Goal], is_met: list[bool]) -> str:
    bounds = " / ".join(f"{bound:g}" for bound in dict.fromkeys(goal.bound for goal in goals))
    parts = [
        f"{word}: {', '.join(goal.text() for goal, met in zip(goals, is_met, strict=True) if met is wanted)}"
        for word, wanted in (("met", True), ("missed", False))
        if wanted in is_met
    ]
    return f"Goal, {what} {side} {bounds}; {'; '.join(parts) or 'not measured'}."
