"""Which payload of an edit came when, from whom and why, over all files its layers have used."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from icheat_usd import sidecar
from icheat_usd.errors import SidecarError
from icheat_usd.sidecar import SUFFIX
from icheat_usd.stage.edit_stack import open_asset
from icheat_usd.stage.keys import read_keys
from icheat_usd.stage.pinned import keys_and_layers
from icheat_usd.stage.sidecar_uses import TRASH
from icheat_usd.stage.stacks import edit_prim


@dataclass(frozen=True)
class Event:
    """One payload that was written, and whether the edit names it now."""

    when: str
    who: str
    why: str
    edit: str
    payload: str
    file: str
    keys: tuple[str, ...]  #: stage times at which the edit names it now; "always" without a time


def file_history(file: str) -> list[Event]:
    """Everything that a sidecar says about its own making, oldest first. Raises `SidecarError` as `read_payload`."""
    return [
        Event(entry.when, entry.who, entry.why, entry.edit, digest, file, ())
        for entry in sidecar.read_history(file)
        for digest in entry.payloads
    ]


def edit_history(stage: Any, edit: str) -> tuple[list[Event], list[str]]:
    """The payloads of one edit, oldest first.

    Looked through are the files that the edit names, and every version beside
    the layers that say something about its payload, collected ones included.

    Returns
    -------
    (list of Event, list of str)
        What was written, and what could not be read.

    Raises
    ------
    EditError
        There is no such edit, or its keys cannot be read.
    """
    keys, layers = keys_and_layers(stage, edit)
    prim = edit_prim(stage, edit)
    track = read_keys(prim)
    named_in = {key.anchored: key for key in (track.keys if track else ()) if key.digest}
    now: dict[str, list[str]] = {}
    problems: list[str] = []
    events: dict[tuple[str, str, str], Event] = {}
    files = dict.fromkeys([*versions_beside(layers), *(key.file for key in keys)])
    entries: list[tuple[str, sidecar.History]] = []
    current: dict[str, set[str]] = {}
    for key in keys:
        now.setdefault(key.digest, []).append("always" if key.time is None else f"{key.time:g}")
    for file in files:
        try:
            source = open_asset(prim, named_in[file]) if file in named_in else file
            entries += [(file, entry) for entry in sidecar.read_history(source, name=file)]
            for old, new in sidecar.list_aliases(source, name=file).items():
                current.setdefault(old, set()).add(new)
        except SidecarError as problem:
            problems.append(str(problem))
    # A payload under its old and its new digest is one.
    named = set(now) | {new for digest in now for new in current.get(digest, ())}
    for file, entry in entries:
        for digest in entry.payloads:
            if entry.edit == edit or digest in named or current.get(digest, set()) & named:
                event = Event(entry.when, entry.who, entry.why, entry.edit, digest, file, tuple(now.get(digest, ())))
                events.setdefault((entry.when, digest, entry.why), event)
    return sorted(events.values(), key=lambda event: event.when), problems


def versions_beside(layers: Iterable[str]) -> list[str]:
    """Sidecars that were written beside these layers, by version, and those of them in the trash."""
    found: list[tuple[int, str]] = []
    for layer in layers:
        folder, name = os.path.split(os.path.abspath(layer))
        stem = os.path.splitext(name)[0]
        pattern = re.compile(re.escape(stem) + r"(?:\.published)?\.v(\d+)" + re.escape(SUFFIX))
        trash = os.path.join(folder, TRASH)
        places = [folder, *(os.path.join(trash, day) for day in (os.listdir(trash) if os.path.isdir(trash) else []))]
        for place in places:
            for file in os.listdir(place) if os.path.isdir(place) else []:
                if match := pattern.fullmatch(file):
                    found.append((int(match[1]), os.path.join(place, file)))
    return [file for _, file in sorted(found)]
