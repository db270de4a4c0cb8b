"""Parameters of an operation: what the stage says, what payloads recommend, and fallbacks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

from pxr import Usd

from icheat_usd.edits.model import Value
from icheat_usd.errors import EditError
from icheat_usd.stage import schema


def read_parameters(prim: Usd.Prim, operation: str, time: float | None) -> Mapping[str, Value]:
    """Parameters of an operation: authored opinions over schema fallbacks."""
    complete = {**fallback_parameters(operation), **authored_parameters(prim, operation, time)}
    return MappingProxyType(complete)


def authored_parameters(prim: Usd.Prim, operation: str, time: float | None) -> dict[str, Value]:
    """What the stage itself says about the parameters of an operation, known or not.

    Raises
    ------
    EditError
        A value is not finite.
    """
    prefix = f"icheat:{operation}"
    known = schema.operations().get(operation)
    found: dict[str, Value] = {}
    for attribute in prim.GetAuthoredPropertiesInNamespace(prefix):
        if not isinstance(attribute, Usd.Attribute) or not attribute.HasAuthoredValue():
            continue
        if known is not None and attribute.GetName()[len(prefix) + 1 :] not in known.parameters:
            continue  # Mistyped: means nothing, as anywhere in USD; `check` reports it.
        value = attribute.Get(schema.time_code(time))
        converted = None if value is None else schema.to_value(value)
        if converted is not None:
            require_finite(prim, attribute.GetName(), converted)
            found[attribute.GetName()[len(prefix) + 1 :]] = converted
    return found


def fallback_parameters(operation: str) -> dict[str, Value]:
    """Schema fallbacks of an operation's parameters; empty for an operation that is not known."""
    known = schema.operations().get(operation)
    if known is None:
        return {}
    values = {name: schema.to_value(parameter.fallback) for name, parameter in known.parameters.items()}
    return {name: value for name, value in values.items() if value is not None}


def mix_parameters(recipes: list[tuple[Mapping[str, Value], float]]) -> dict[str, Value]:
    """Weighted mean of numbers, and of vectors of one length; of anything else what the heaviest recipe says."""
    heaviest = max(recipes, key=lambda recipe: recipe[1])[0]
    total = sum(weight for _, weight in recipes)
    mixed: dict[str, Value] = {}
    for name, value in heaviest.items():
        values = [(recipe.get(name, value), weight / total) for recipe, weight in recipes]
        alike = all(isinstance(v, tuple) and len(v) == len(value) for v, _ in values if isinstance(value, tuple))
        if isinstance(value, (bool, str)) or not alike or all(v == value for v, _ in values):
            mixed[name] = value
        elif isinstance(value, tuple):
            mixed[name] = tuple(sum(w * v[i] for v, w in values if isinstance(v, tuple)) for i in range(len(value)))
        else:
            mixed[name] = sum(w * float(v) for v, w in values if isinstance(v, (int, float)))
    return mixed


def read_number(prim: Usd.Prim, name: str, time: float | None) -> float:
    """The composed number.

    Raises
    ------
    EditError
        It is no number, or not finite.
    """
    value = schema.read_attribute(prim, name, time)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise EditError(f"{prim.GetPath()}: {name} is {value!r}, expected a number")
    require_finite(prim, name, float(value))
    return float(value)


def read_flag(prim: Usd.Prim, name: str, time: float | None) -> bool:
    """The composed flag.

    Raises
    ------
    EditError
        It is neither true nor false, but of another type.
    """
    value = schema.read_attribute(prim, name, time)
    if not isinstance(value, bool):
        raise EditError(f"{prim.GetPath()}: {name} is {value!r}, expected true or false")
    return value


def require_finite(prim: Usd.Prim, name: str, value: Value) -> None:
    """Raise EditError if a number in `value` is not finite."""
    numbers = value if isinstance(value, tuple) else (value,)
    if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
        raise EditError(f"{prim.GetPath()}: {name} is {value!r}, expected a finite number; author it again")
