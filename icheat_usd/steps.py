"""Work in steps, so that others come to their turn."""

from __future__ import annotations

from collections.abc import Generator
from typing import TypeVar, cast

Result = TypeVar("Result")
Steps = Generator[None, None, Result]  #: work that may pause, and has something to give in the end


def all_steps(steps: Steps[Result]) -> Result:
    """What comes of some work, done without a pause."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return cast(Result, end.value)
