"""What each element of a payload is called, how its versions are read, stepped up and written.

A module per kind of element registers itself here; a new one is a new module and no change elsewhere but its import
in `elements`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from icheat_usd.edits.model import Payload
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar.canonical import Element
from icheat_usd.sidecar.values import shown


class Slot(NamedTuple):
    """What an element of a given name must be, and the field of `Payload` that its value fills."""

    type: str
    field: str


#: From an element and the anchor to the value of its field.
Reader = Callable[[Element, str], Any]
#: From a payload and the anchor to the element of the newest version; None where the payload has nothing to store.
Writer = Callable[[Payload, str], Element | None]
Step = Callable[[Element], Element]

#: Elements this version understands, by their name in the payload.
SLOTS: dict[str, Slot] = {}

_READERS: dict[tuple[str, int], Reader] = {}
_STEPS: dict[tuple[str, int], Step] = {}
_WRITERS: dict[str, Writer] = {}


def reads(type_: str, version: int) -> Callable[[Reader], Reader]:
    """Register the decoder of one element type at one version; it receives the element and the anchor.

    It raises `KeyError` for a dataset that is missing and `SidecarError` for a value that is not allowed.
    """

    def register(reader: Reader) -> Reader:
        _READERS[type_, version] = reader
        return reader

    return register


def upgrades(type_: str, version: int) -> Callable[[Step], Step]:
    """Register the step that turns an element of `version` into one of ``version + 1``.

    An element is stepped up as long as there are steps, then decoded; a new
    version needs one step and one reader, and no older reader changes.
    """

    def register(step: Step) -> Step:
        _STEPS[type_, version] = step
        return step

    return register


def writes(name: str, type_: str, field: str) -> Callable[[Writer], Writer]:
    """Declare the element `name` of a payload: its type, the `Payload` field that it fills, and its writer."""

    def register(writer: Writer) -> Writer:
        SLOTS[name] = Slot(type_, field)
        _WRITERS[name] = writer
        return writer

    return register


def newest_version(type_: str) -> int:
    """Highest version of an element type that can be read; 0 for an unknown type."""
    known = [version for name, version in (*_READERS, *_STEPS) if name == type_]
    return max(known, default=0)


def check_known(name: str, type_: str, version: int, where: str) -> None:
    """Refuse an element that has a known purpose but an unknown type, or a version newer than this package reads.

    Raises
    ------
    SidecarError
        It names the element and asks for an update.
    """
    if name in SLOTS and (type_ != SLOTS[name].type or version > newest_version(type_)):
        raise SidecarError(
            f"{where}: element '{name}' is {shown(type_)} version {version}, and this icheat_usd reads "
            f"{SLOTS[name].type} up to version {newest_version(SLOTS[name].type)}; update icheat_usd"
        )


def upgraded(element: Element) -> Element:
    """The element after every registered step from its version on."""
    while (step := _STEPS.get((element.type, element.version))) is not None:
        after = step(element)
        if (after.type, after.version) != (element.type, element.version + 1):
            raise AssertionError(
                f"the step from {element.type} {element.version} leads to {after.type} {after.version}"
            )
        element = after
    return element


def decoded(element: Element, anchor: str) -> Any:
    """The value of an element that `upgraded` returned. Raises `KeyError` and `SidecarError` as its reader does."""
    return _READERS[element.type, element.version](element, anchor)


def written(payload: Payload, anchor: str) -> dict[str, Element]:
    """Every declared element that the payload has something for."""
    elements = {name: writer(payload, anchor) for name, writer in _WRITERS.items()}
    return {name: element for name, element in elements.items() if element is not None}
