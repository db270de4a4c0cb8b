"""Which form of an edit a file should hold: the cheapest that loses nothing."""

from __future__ import annotations

from collections.abc import Mapping

from icheat_usd.edits import operations
from icheat_usd.edits.model import Payload, Value
from icheat_usd.edits.operations import Encoding, Level
from icheat_usd.edits.operations.constants import baked_constants


def choose(operation: str, parameters: Mapping[str, Value], where: str = "") -> Encoding:
    """The cheapest encoding that holds an edit exactly, for a reader with this package's operations.

    Selections never decide it: collections and limits stay in USD, and painted
    masks stay masks, in whatever form the operation is held.

    Parameters
    ----------
    parameters
        Of the operation; what is missing is its default.

    Raises
    ------
    EditError
        A parameter is unknown, of the wrong kind or out of range.
    """
    known = operations.find(operation)
    if known is None:
        return Encoding.ROWS
    if known.level is Level.VIEW:
        return Encoding.VECTOR
    return Encoding.RANK_1 if baked_constants(known, known.complete(parameters, where)) else Encoding.RECIPE


def encodings_of(payload: Payload) -> tuple[Encoding, ...]:
    """Every form that a payload holds, cheapest first."""
    known = operations.find(payload.operation)
    found = []
    if known is not None and known.level is Level.VIEW:
        found.append(Encoding.VECTOR)
    if (payload.scale_delta, payload.emission, payload.offset) != (None, None, None):
        found.append(Encoding.RANK_1)
    if known is not None and known.level is not Level.VIEW:
        found.append(Encoding.RECIPE)
    if payload.rows is not None:
        found.append(Encoding.ROWS)
    return tuple(found)
