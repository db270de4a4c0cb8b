"""Reading sidecar files: payloads, lists of what is inside, and history. `guarded` keeps hostile files harmless."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from icheat_usd.edits.model import Payload
from icheat_usd.sidecar.canonical import kind_of
from icheat_usd.sidecar.elements import decode_payload
from icheat_usd.sidecar.guarded import (
    MAX_PAYLOAD_BYTES,
    Source,
    aliases_of,
    attribute,
    check_first_sight,
    child_group,
    datasets_below,
    element_mark,
    file_name,
    link_names,
    naming_damage,
    open_sidecar,
    payload_names,
    read_dataset,
    read_elements,
)
from icheat_usd.sidecar.values import shown

#: History beyond this is refused.
_MAX_HISTORY_BYTES = 1 << 24


@dataclass(frozen=True)
class History:
    """Who wrote payloads and why; nothing reads it to decide anything, and it is no part of a digest."""

    who: str = ""
    why: str = ""
    when: str = ""  #: UTC, as 2026-11-21T19:30:00Z
    payloads: tuple[str, ...] = ()
    edit: str = ""  #: path of the edit that the payloads were made for


@dataclass(frozen=True)
class ElementInfo:
    """One dataset of one element, as `icheat cat` lists it."""

    payload: str
    element: str
    type: str
    version: int
    dataset: str
    shape: tuple[int, ...]
    dtype: str
    stored_bytes: int
    raw_bytes: int


def read_payload(
    file: Source, digest: str, *, anchor: str, name: str | None = None, limit_bytes: int = MAX_PAYLOAD_BYTES
) -> Payload:
    """Read one payload and check that it is the one its name says.

    Parameters
    ----------
    file : path, bytes or binary file
    digest : str
        The payload's token, 64 hexadecimal digits.
    anchor : str
        Absolute prim path that the file's surface paths are relative to.
    name : str, optional
        What messages call the file; its path by default.
    limit_bytes : int
        The most the payload may declare to hold. Peak memory is about twice
        what it holds, and two chunks.

    Returns
    -------
    Payload
        Absolute surface paths; elements of unknown types in `unknown`.

    Raises
    ------
    SidecarError
        The file is missing, no sidecar, damaged, hostile or too new; the
        payload is not in it, larger than the limit, or not what its name says.
    """
    where = file_name(file, name)
    with open_sidecar(file, where) as root:
        elements = read_elements(root, digest, where, limit_bytes, refuse_newer=True)
    return decode_payload(elements, anchor=anchor, where=f"{where}: payload {digest[:12]}")


def list_payloads(file: Source, *, name: str | None = None) -> tuple[str, ...]:
    """Digests of the payloads in a file, sorted. Raises `SidecarError` as `read_payload`."""
    where = file_name(file, name)
    with open_sidecar(file, where) as root:
        return tuple(payload_names(root, where))


def list_aliases(file: Source, *, name: str | None = None) -> Mapping[str, str]:
    """Digests that payloads of a file had before an upgrade, each with the one it has now."""
    where = file_name(file, name)
    with open_sidecar(file, where) as root:
        return aliases_of(root, where)


def is_published(file: Source, *, name: str | None = None) -> bool:
    """Whether a file says that it was published. Raises `SidecarError` as `read_payload`."""
    where = file_name(file, name)
    with open_sidecar(file, where) as root, naming_damage(where):
        return attribute(root, "published", where) == 1


def list_elements(file: Source, *, name: str | None = None) -> tuple[ElementInfo, ...]:
    """Every dataset in a file, sorted, without reading their values. Raises `SidecarError` as `read_payload`."""
    where = file_name(file, name)
    infos: list[ElementInfo] = []
    seen: set[int] = set()
    with open_sidecar(file, where) as root, naming_damage(where):
        payloads = child_group(root, "payloads", where)
        for digest in payload_names(root, where):
            payload = child_group(payloads, digest, where)
            check_first_sight(payload, seen, where)
            for element in link_names(payload, where):
                group = child_group(payload, element, f"{where}: {digest[:12]}")
                check_first_sight(group, seen, where)
                type_, version = element_mark(group, f"{where}: {digest[:12]}: element '{shown(element)}'")
                for path, dataset in datasets_below(group, f"{where}: {digest[:12]}: element '{shown(element)}'", [0]):
                    check_first_sight(dataset, seen, where)
                    raw = math.prod(dataset.shape) * dataset.dtype.itemsize
                    stored = int(dataset.id.get_storage_size())
                    kind = kind_of(dataset.dtype) or str(dataset.dtype)
                    infos.append(
                        ElementInfo(digest, element, type_, version, path, tuple(dataset.shape), kind, stored, raw)
                    )
    return tuple(infos)


def read_history(file: Source, *, name: str | None = None) -> tuple[History, ...]:
    """Who wrote what and why, oldest first. Raises `SidecarError` as `read_payload`."""
    where = file_name(file, name)
    entries: list[History] = []
    with open_sidecar(file, where) as root, naming_damage(where):
        if not root.id.links.exists(b"history"):
            return ()
        history = child_group(root, "history", where)
        # For all entries together: hard links can make one of them many.
        budget, count = [_MAX_HISTORY_BYTES], [0]
        for number in link_names(history, where):
            texts: dict[str, list[str]] = {}
            for path, dataset in datasets_below(
                child_group(history, number, where), f"{where}: history {number}", count
            ):
                values = read_dataset(dataset, f"{where}: history {number}: '{path}'", budget)
                if values.dtype.kind == "S":
                    texts[path] = [item.decode("utf-8", "replace") for item in values.reshape(-1).tolist()]
            one = {key: (texts.get(key) or [""])[0] for key in ("who", "why", "when", "edit")}
            entries.append(History(**one, payloads=tuple(texts.get("payloads", ()))))
    return tuple(entries)


def describe(file: Source, *, name: str | None = None) -> str:
    """A file's contents as text for people: payloads, their elements, sizes, and history."""
    where = file_name(file, name)
    infos, lines = list_elements(file, name=where), [where]
    for digest in dict.fromkeys(info.payload for info in infos):
        lines.append(f"payload {digest}")
        mine = [info for info in infos if info.payload == digest]
        for element in dict.fromkeys(info.element for info in mine):
            rows = [info for info in mine if info.element == element]
            stored, raw = sum(row.stored_bytes for row in rows), sum(row.raw_bytes for row in rows)
            lines.append(f"  {element}  ({rows[0].type} {rows[0].version})  {stored:,} of {raw:,} bytes")
            for row in rows:
                shape = " x ".join(map(str, row.shape)) or "scalar"
                lines.append(f"    {row.dataset}  {row.dtype} {shape}")
    for old, new in list_aliases(file, name=where).items():
        lines.append(f"alias {old} of {new}")
    for entry in read_history(file, name=where):
        said = ", ".join(part for part in (entry.when, entry.who, entry.edit, entry.why) if part)
        lines.append(f"history  {said or '(not stated)'}: {len(entry.payloads)} payloads")
    return "\n".join([lines[0], *map(shown, lines[1:])])
