"""What an edit can do to light: one file per operation, found by name.

An operation is a small declared unit. Adding one means adding its file here
(or calling `register` from another package), its applied schema and its tests.
"""

from __future__ import annotations

from icheat_usd.edits.operations.base import (
    BoundScene,
    Encoding,
    Level,
    Measure,
    Operation,
    PairCoefficients,
    PairEnd,
    Pairs,
    Parameter,
    ViewCoefficients,
)
from icheat_usd.edits.operations.hsv import Hsv
from icheat_usd.edits.operations.scale import Scale
from icheat_usd.errors import EditError

__all__ = [
    "BoundScene",
    "Encoding",
    "Level",
    "Measure",
    "Operation",
    "PairCoefficients",
    "PairEnd",
    "Pairs",
    "Parameter",
    "ViewCoefficients",
    "find",
    "names",
    "register",
]

_OPERATIONS: dict[str, Operation] = {}


def register(operation: Operation) -> None:
    """Make `operation` known by its name; a second one of that name is an error."""
    if operation.name in _OPERATIONS:
        raise EditError(f"operation '{operation.name}' is registered already; choose another name")
    _OPERATIONS[operation.name] = operation


def find(name: str) -> Operation | None:
    """Return the operation called `name`, or None."""
    return _OPERATIONS.get(name)


def names() -> tuple[str, ...]:
    """Names of all operations, sorted."""
    return tuple(sorted(_OPERATIONS))


for _operation in (Scale(), Hsv()):
    register(_operation)
