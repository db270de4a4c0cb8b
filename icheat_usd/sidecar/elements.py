"""Payloads to and from elements: every older version is read, the newest is written."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from icheat_usd.edits.model import Payload
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar import mask_elements, recipe_elements, row_elements  # noqa: F401  (they register themselves)
from icheat_usd.sidecar.canonical import Element, digest_of
from icheat_usd.sidecar.mask_elements import check_anchor
from icheat_usd.sidecar.registry import SLOTS, check_known, decoded, upgraded, written
from icheat_usd.sidecar.values import shown


def payload_digest(payload: Payload, *, anchor: str) -> str:
    """The token that names a payload in `icheat:payload`: SHA-256 of its canonical bytes.

    Raises
    ------
    SidecarError
        The payload cannot be written; see `encode_payload`.
    """
    return digest_of(encode_payload(payload, anchor=anchor))


def decode_payload(elements: Mapping[str, Element], *, anchor: str, where: str) -> Payload:
    """Elements to a payload with absolute surface paths.

    Parameters
    ----------
    elements : mapping of element name to Element
    anchor : str
        Absolute prim path that the surface paths of the file are relative to.
    where : str
        File and payload, for messages.

    Raises
    ------
    SidecarError
        An element is newer than this version, lacks a part or has a value out of range.
    """
    check_anchor(anchor)
    values: dict[str, Any] = {}
    unknown: dict[str, Element] = {}
    for name, element in elements.items():
        if name not in SLOTS:
            unknown[name] = element
            continue
        check_known(name, element.type, element.version, where)
        element = upgraded(element)
        try:
            values[SLOTS[name].field] = decoded(element, anchor)
        except KeyError as problem:
            raise SidecarError(
                f"{where}: element '{name}' ({element.type} version {element.version}) lacks {problem}; "
                "restore the file from a copy"
            ) from problem
        except SidecarError as problem:
            raise SidecarError(f"{where}: element '{name}': {_brief(problem)}") from problem
    if "operation" not in values:
        raise SidecarError(f"{where}: the payload has no element 'recipe'; restore the file from a copy")
    operation, parameters = values.pop("operation")
    return Payload(operation=operation, parameters=parameters, **values, unknown=MappingProxyType(unknown))


def encode_payload(payload: Payload, *, anchor: str) -> dict[str, Element]:
    """A payload to elements of the newest versions, surface paths relative to the anchor.

    Raises
    ------
    SidecarError
        A surface lies outside the anchor, a number is not finite, a mask does
        not fit its surfaces, or a name or text cannot be stored.
    """
    check_anchor(anchor)
    elements = written(payload, anchor)
    for name, element in payload.unknown.items():
        if name in SLOTS or not isinstance(element, Element):
            raise SidecarError(f"unknown element '{name}' is not one that a sidecar reader kept; leave it out")
        elements[name] = element
    return elements


def _brief(problem: SidecarError) -> str:
    """A message of one line, of a length that one reads, with its next step."""
    text = shown(str(problem), 400)
    return text if len(str(problem)) <= 400 else f"{text[:300]} ...; restore the file from a copy"
