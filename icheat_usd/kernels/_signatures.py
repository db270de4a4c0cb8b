"""Types of kernels' arguments as JSON, so that kernels can be compiled before anything calls them."""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import sys
from collections.abc import Iterator
from typing import Any

from numba.core import types
from numba.core.dispatcher import Dispatcher


class UnlistedTypeError(TypeError):
    """A type that a list of kernels has no word for."""


def encode(kind: types.Type) -> Any:
    """What `decode` makes the type from again: a name, or a list whose first word says what the others mean.

    Raises
    ------
    UnlistedTypeError
    """
    if isinstance(kind, types.IntegerLiteral | types.BooleanLiteral):
        return ["literal", kind.literal_value]
    if isinstance(kind, types.Number | types.Boolean) or kind == types.none:
        return str(kind)
    if isinstance(kind, types.Array):
        words = ["array", str(kind.dtype), kind.ndim, kind.layout]
        return words if kind.mutable else [*words, "readonly"]
    if isinstance(kind, types.BaseNamedTuple):
        made = kind.instance_class
        return ["named", f"{made.__module__}:{made.__qualname__}", *map(encode, kind)]
    if isinstance(kind, types.BaseTuple):
        return ["tuple", *map(encode, kind)]
    raise UnlistedTypeError(str(kind))


def decode(word: Any) -> types.Type:
    """Type that `encode` had."""
    if isinstance(word, str):
        return getattr(types, word)
    kind, *rest = word
    if kind == "literal":
        return types.literal(rest[0])
    if kind == "array":
        dtype, n_dimensions, layout, *readonly = rest
        return types.Array(getattr(types, dtype), n_dimensions, layout, readonly=bool(readonly))
    if kind == "named":
        module, _, name = rest[0].partition(":")
        return types.BaseTuple.from_types(tuple(map(decode, rest[1:])), getattr(importlib.import_module(module), name))
    return types.BaseTuple.from_types(tuple(map(decode, rest)))


def dispatchers() -> Iterator[tuple[str, Dispatcher]]:
    """All kernels, by ``module.function``."""
    package = importlib.import_module(__package__)
    for found in sorted(pkgutil.iter_modules(package.__path__), key=lambda found: found.name):
        module = importlib.import_module(f"{__package__}.{found.name}")
        for name, value in sorted(vars(module).items()):
            if isinstance(value, Dispatcher) and value.py_func.__module__ == module.__name__:
                yield f"{found.name}.{name}", value


def kernels_called(dispatcher: Dispatcher) -> list[str]:
    """Names of the kernels that a kernel calls, other than itself."""
    function = dispatcher.py_func
    called = (function.__globals__.get(name) for name in function.__code__.co_names)
    names = {
        f"{other.py_func.__module__.rpartition('.')[2]}.{other.py_func.__name__}"
        for other in called
        if isinstance(other, Dispatcher) and other is not dispatcher
    }
    return sorted(names)


def work(mark: str) -> None:
    """Compile the kernels that standard input names, and answer each with what went wrong.

    A line of input is JSON, ``[kernel, [type, ...]]``; an answer is `mark` and a string, empty if nothing went wrong.
    What else writes to standard output, such as Numba's diagnostics, writes to standard error.
    """
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    for line in sys.stdin:
        name, words = json.loads(line)
        module, _, function = name.partition(".")
        message = ""
        try:
            # What is not asked for is not imported: to import all kernels takes seconds.
            kernel = getattr(importlib.import_module(f"{__package__}.{module}"), function, None)
            if kernel is None:
                message = "there is no such kernel"
            else:
                kernel.compile(tuple(map(decode, words)))
        except Exception as error:  # whatever it is, the other kernels do not suffer for it
            message = (str(error).strip().splitlines() or [type(error).__name__])[0]
        print(mark + json.dumps(message), file=answers, flush=True)
