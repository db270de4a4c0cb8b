"""Frozen tables of arrays as one plain .npz file, and back.

The file holds the arrays `a0`, `a1`, … and `structure`, JSON text that says
how they belong together: which dataclass or named tuple of this package has
which fields. An array that several fields share is kept once and shared again.
"""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

_PACKAGE = "icheat_usd."


def write(file: IO[bytes], value: Any) -> None:
    """Write a value as an .npz file.

    Parameters
    ----------
    value
        None, a flag, number, text, array, or a tuple, list, dict (with text for keys), dataclass or named tuple
        of such.

    Raises
    ------
    TypeError
        Something in it is none of these.
    """
    arrays: list[NDArray[Any]] = []
    text = json.dumps(_taken_apart(value, arrays, {}))
    named = {f"a{i}": array for i, array in enumerate(arrays)}
    np.savez(file, structure=np.frombuffer(text.encode(), np.uint8), **named)  # type: ignore[arg-type]


def read(file: IO[bytes]) -> Any:
    """The value that `write` was given.

    Raises
    ------
    ValueError
        The file is something else, or belongs to another version of this package.
    """
    try:
        with np.load(file, allow_pickle=False) as content:
            structure = json.loads(content["structure"].tobytes())
            arrays = [content[f"a{i}"] for i in range(len(content.files) - 1)]
        return _put_together(structure, arrays)
    except Exception as error:
        raise ValueError(f"this is no part of a cache ({type(error).__name__}: {error})") from error


def _taken_apart(value: Any, arrays: list[NDArray[Any]], known: dict[int, int]) -> Any:
    def inner(part: Any) -> Any:
        return _taken_apart(part, arrays, known)

    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("an array of objects cannot be kept")
        if id(value) not in known:  # `arrays` keeps it alive, so that no other array gets its id
            known[id(value)] = len(arrays)
            arrays.append(value)
        return {"array": known[id(value)]}
    if isinstance(value, np.generic):
        return {"array": inner(np.asarray(value))["array"], "scalar": True}
    if value is None or type(value) in (bool, int, float, str):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        content = {field.name: inner(getattr(value, field.name)) for field in fields(value) if field.init}
        return {"type": _name(type(value)), "fields": content}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return {"type": _name(type(value)), "fields": {name: inner(getattr(value, name)) for name in value._fields}}
    if type(value) in (tuple, list):
        return {"list": [inner(part) for part in value], "tuple": type(value) is tuple}
    if type(value) is dict and all(type(name) is str for name in value):
        return {"dict": {name: inner(part) for name, part in value.items()}}
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _put_together(node: Any, arrays: list[NDArray[Any]]) -> Any:
    if not isinstance(node, dict):
        return node
    if "array" in node:
        array = arrays[node["array"]]
        return array[()] if node.get("scalar") else array
    if "list" in node:
        parts = [_put_together(part, arrays) for part in node["list"]]
        return tuple(parts) if node["tuple"] else parts
    if "dict" in node:
        return {name: _put_together(part, arrays) for name, part in node["dict"].items()}
    return _type(node["type"])(**{name: _put_together(part, arrays) for name, part in node["fields"].items()})


def _name(kind: type) -> str:
    if not kind.__module__.startswith(_PACKAGE) or "." in kind.__qualname__:
        raise TypeError(f"a {kind.__module__}.{kind.__qualname__} cannot be kept")
    return f"{kind.__module__}:{kind.__qualname__}"


def _type(name: str) -> Any:
    """Only tables of this package: a file must not make anything else happen."""
    module, _, kind = name.partition(":")
    found = getattr(import_module(module), kind) if module.startswith(_PACKAGE) else None
    if not isinstance(found, type) or not (is_dataclass(found) or hasattr(found, "_fields")):
        raise ValueError(f"{name} is no table")
    return found
