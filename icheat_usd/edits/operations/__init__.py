"""What an edit can do to light: one file per operation, found by name.

An operation is a small declared unit. Adding one means adding its file here,
its applied schema and its tests. Another package brings one with an entry
point, so that installing the package suffices::

    [project.entry-points."icheat_usd.operations"]
    theirs = "their_package:Theirs"  # the operation's name; a subclass of Operation

    [project.entry-points."icheat_usd.schemas"]
    theirs = "their_package"  # has plugInfo.json and generatedSchema.usda beside its code

It is loaded when an edit first asks for it. Its applied schema, which holds
its parameters as ``icheat:theirs:<parameter>``, may also be found by USD as
any plug-in (PXR_PLUGINPATH_NAME).
"""

from __future__ import annotations

from icheat_usd.edits.operations import packages
from icheat_usd.edits.operations.albedo import Albedo
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
from icheat_usd.edits.operations.curve import Curve
from icheat_usd.edits.operations.direction import Direction
from icheat_usd.edits.operations.emit import Emit
from icheat_usd.edits.operations.falloff import Falloff
from icheat_usd.edits.operations.gamma import Gamma
from icheat_usd.edits.operations.hsv import Hsv
from icheat_usd.edits.operations.paint import Paint
from icheat_usd.edits.operations.receive import Receive
from icheat_usd.edits.operations.redirect import Redirect
from icheat_usd.edits.operations.scale import Scale
from icheat_usd.edits.operations.unshadow import Unshadow
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

#: Says that a payload's baked form is meant; never an operation.
BAKED = "baked"

_OPERATIONS: dict[str, Operation] = {}


def register(operation: Operation) -> None:
    """Make `operation` known by its name.

    Raises
    ------
    EditError
        An operation of that name is registered already, or the name is reserved.
    """
    if operation.name in _OPERATIONS:
        raise EditError(f"operation '{operation.name}' is registered already; choose another name")
    if operation.name == BAKED:
        raise EditError(f"no operation can be called '{BAKED}', which stands for baked payloads; choose another name")
    _OPERATIONS[operation.name] = operation


def find(name: str) -> Operation | None:
    """Return the operation called `name`, or None; one from another package is loaded now.

    Raises
    ------
    EditError
        An installed package declares the operation, and cannot be loaded.
    """
    if name not in _OPERATIONS:
        operation = None if name == BAKED else packages.load(name)
        if operation is None:
            return None
        register(operation)
    return _OPERATIONS[name]


def names() -> tuple[str, ...]:
    """Names of all operations, sorted; those of other packages need not have been loaded."""
    return tuple(sorted({*_OPERATIONS, *packages.declared()} - {BAKED}))


for _operation in (
    Scale(),
    Hsv(),
    Redirect(),
    Gamma(),
    Curve(),
    Falloff(),
    Direction(),
    Unshadow(),
    Paint(),
    Emit(),
    Albedo(),
    Receive(),
):
    register(_operation)
