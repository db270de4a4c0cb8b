"""What the keyframes of an edit say about its parameters, and which of them an authored value hides."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from icheat_usd.edits.model import Value
from icheat_usd.errors import EditError, SidecarError
from icheat_usd.sidecar import read_payload
from icheat_usd.stage.edit_stack import anchor_path, open_asset
from icheat_usd.stage.keys import Key, read_keys
from icheat_usd.stage.parameters import authored_parameters
from icheat_usd.stage.stacks import EditFinding, edit_prim


def parameters_at(prim: Any, key: Key) -> dict[str, Value]:
    """Parameters that hold at a key: those of its payload, and over them what is authored for all times.

    Raises
    ------
    EditError, SidecarError
        The payload cannot be read.
    """
    payload = read_payload(open_asset(prim, key), key.digest, anchor=anchor_path(prim), name=key.anchored)
    return {**payload.parameters, **authored_parameters(prim, payload.operation, key.time)}


def hidden_keys(stage: Any, edit: str, names: Iterable[str]) -> tuple[EditFinding, ...]:
    """A finding for each parameter that keys of an edit say different things about, as if none were authored.

    Payloads that cannot be read say nothing here.
    """
    prim = edit_prim(stage, edit)
    try:
        track = read_keys(prim)
        keys = [key for key in track.keys if key.digest and key.time is not None] if track else []
        said = [read_payload(open_asset(prim, key), key.digest, anchor=anchor_path(prim)) for key in keys]
    except (EditError, SidecarError):
        return ()
    findings = []
    for name in names:
        values = {repr(payload.parameters.get(name)) for payload in said}
        if len(values) > 1:
            times = ", ".join(f"{key.time:g}" for key in keys)
            operation = said[0].operation
            message = f"holds at all frames now and hides the keys at {times}; to change one, set a key at its frame"
            findings.append(EditFinding(edit, f"icheat:{operation}:{name}", message))
    return tuple(findings)
