"""Writing an edit's operation, parameters, amount and blend, checked, in the form that USD takes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pxr import Usd

from icheat_usd.edits import operations
from icheat_usd.edits.model import Blend, Value
from icheat_usd.errors import EditError
from icheat_usd.stage import schema
from icheat_usd.stage.selection_authoring import apply_schema


def set_value(prim: Usd.Prim, name: str, value: Any, time: float | None = None) -> None:
    """Author a value, without a time the default."""
    attribute = prim.GetAttribute(name)
    attribute.Set(value, schema.time_to_write(time))


def set_amount(prim: Usd.Prim, amount: float, time: float | None) -> None:
    """Author an amount, which must be finite."""
    if isinstance(amount, bool) or not isinstance(amount, (int, float)) or not math.isfinite(amount):
        raise EditError(f"{prim.GetPath()}: amount is {amount!r}, expected a finite number")
    set_value(prim, schema.AMOUNT, float(amount), time)


def checked_blend(blend: Blend | str) -> str:
    """The token of a blend that exists."""
    if blend not in list(Blend):
        raise EditError(f"no blend is called '{blend}'; there are {', '.join(b.value for b in Blend)}")
    return Blend(blend).value


def set_operation(
    prim: Usd.Prim,
    operation: str,
    parameters: Mapping[str, Value],
    time: float | None,
    *,
    has_payload: bool,
    write_token: bool = True,
) -> list[str]:
    """Author an operation and its parameters, all checked before the first is written.

    Returns
    -------
    list of str
        Attributes that were authored.

    Raises
    ------
    EditError
        The operation or a parameter is unknown, or a value does not fit.
    """
    found = schema.operations().get(operation)
    if found is None and (parameters or not has_payload):
        raise unknown_operation(str(prim.GetPath()), operation)
    written = [schema.OPERATION] if write_token else []
    if write_token:
        set_value(prim, schema.OPERATION, operation)
    if found is None:
        return written
    apply_schema(prim, found.api_schema)
    checked = {}
    for name, value in parameters.items():
        parameter = found.parameters.get(name)
        if parameter is None:
            listed = ", ".join(sorted(found.parameters))
            raise EditError(f"{prim.GetPath()}: operation '{operation}' has no parameter '{name}'; it has {listed}")
        checked[name] = _checked_value(prim, parameter, value)
    _check_together(prim, found, checked, time)
    for name, value in checked.items():
        set_value(prim, found.parameters[name].name, value, time)
        written.append(found.parameters[name].name)
    return written


def unknown_operation(edit: str, operation: str) -> EditError:
    """What to say about an operation that nobody knows."""
    return EditError(
        f"{edit}: no operation is called '{operation}'; there are {', '.join(sorted(schema.operations()))} "
        f"(another one needs its schema on PXR_PLUGINPATH_NAME, or a baked payload and no parameters)"
    )


def _check_together(
    prim: Usd.Prim, operation: schema.OperationSchema, given: Mapping[str, Any], time: float | None
) -> None:
    """Let the operation check what is given with what is there: it may know bounds that no schema can state."""
    implementation = operations.find(operation.name)
    if implementation is None or not given:
        return
    parameters = {}
    for known in implementation.parameters:
        parameter = operation.parameters.get(known.name)
        if parameter is not None:
            value = given.get(known.name, schema.read_attribute(prim, parameter.name, time))
            converted = None if value is None else schema.to_value(value)
            if converted is not None:
                parameters[known.name] = converted
    implementation.complete(parameters, str(prim.GetPath()))


def _checked_value(prim: Usd.Prim, parameter: schema.PropertySchema, value: Value) -> Any:
    """The value in the form that USD takes for the parameter's type."""
    expected = parameter.fallback
    assert parameter.type_name is not None
    size = len(expected) if not isinstance(expected, str) and hasattr(expected, "__len__") else 0
    error = EditError(
        f"{prim.GetPath()}: {parameter.name} is {value!r}, expected {parameter.type_name} such as {expected}"
    )
    if isinstance(expected, (bool, str)):
        if not isinstance(value, type(expected)):
            raise error
        return value
    if not size and not isinstance(expected, (int, float)):
        return value  # A third party's type: USD says whether it fits.
    numbers = tuple(value) if isinstance(value, (tuple, list)) else (value,)
    if any(isinstance(n, (bool, str)) or not isinstance(n, (int, float)) or not math.isfinite(n) for n in numbers):
        raise error
    if parameter.type_name.isArray:
        return type(expected)(numbers)
    if len(numbers) != max(size, 1) or bool(size) != isinstance(value, (tuple, list)):
        raise error
    return type(expected)(*numbers)
