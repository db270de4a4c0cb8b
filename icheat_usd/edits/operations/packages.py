"""Operations that other packages bring: entry points of the group ``icheat_usd.operations``."""

from __future__ import annotations

from functools import cache
from importlib.metadata import EntryPoint, entry_points

from icheat_usd.edits.operations.base import Operation
from icheat_usd.errors import EditError

GROUP = "icheat_usd.operations"


@cache
def declared() -> dict[str, tuple[EntryPoint, ...]]:
    """Entry points by the operation's name, without importing any package; as of the first call."""
    found: dict[str, tuple[EntryPoint, ...]] = {}
    for entry in entry_points(group=GROUP):
        # A checkout and its installation may both be on the path; what they declare is the same.
        same = any(entry.value == other.value for other in found.get(entry.name, ()))
        if not same:
            found[entry.name] = (*found.get(entry.name, ()), entry)
    return found


def load(name: str) -> Operation | None:
    """Import the operation called `name`; None if no installed package declares it.

    Raises
    ------
    EditError
        Its package cannot be imported or gives something else, or two packages declare it.
    """
    entries = declared().get(name, ())
    if not entries:
        return None
    if len(entries) > 1:
        packages = " and ".join(_package(entry) for entry in entries)
        raise EditError(f"{packages} both bring an operation '{name}'; uninstall one of them")
    (entry,) = entries
    try:
        found = entry.load()
        operation = found() if isinstance(found, type) else found
    except Exception as error:  # Whatever their code does, the message names their package.
        raise EditError(
            f"operation '{name}' of {_package(entry)} cannot be loaded from {entry.value}"
            f" ({type(error).__name__}: {error}); update or uninstall that package"
        ) from error
    if not isinstance(operation, Operation) or getattr(operation, "name", None) != name:
        raise EditError(
            f"{_package(entry)} declares {entry.value} as operation '{name}', expected a subclass of"
            f" icheat_usd.edits.operations.Operation of that name, found {operation!r}; update that package"
        )
    return operation


def _package(entry: EntryPoint) -> str:
    if entry.dist is None:
        return f"the package of {entry.value}"
    return f"package '{entry.dist.metadata['Name']}' {entry.dist.version}"
