"""Changes of a live session written to a layer, with the functions that scripts author with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from icheat_usd.edits.model import EditStack
from icheat_usd.errors import EditError
from icheat_usd.scene import Finding
from icheat_usd.session import authoring, keys
from icheat_usd.session.document import Session
from icheat_usd.session.live_state import EditChange, LiveState
from icheat_usd.stage.layers import saving


def write_changes(
    session: Session,
    changes: LiveState,
    shown: EditStack,
    *,
    layer: str,
    frame: float | None,
    sidecar: str | Path | None,
    why: str,
) -> tuple[Finding, ...]:
    """Write what is changed about edits; all of it or, after an error, nothing.

    Parameters
    ----------
    shown
        The stack with the changes, whose order is written where they have one.
    frame
        Stage time of the values and of painted masks; None is all times.
    """
    findings: list[Finding] = []
    with saving(session.stage, layer):
        for path, change in changes.edits.items():
            findings += _write_edit(session, path, change, layer, frame, sidecar, why)
        if changes.order and session.stack_path is not None:
            order = [edit.path for edit in shown.edits]
            # From the strongest down: each takes its place just before one that has its own already.
            for path, above in zip(order[-2::-1], order[:0:-1], strict=True):
                authoring.move_edit(session.stage, session.stack_path, path, layer=layer, before=above)
    return tuple(findings)


def _write_edit(
    session: Session,
    path: str,
    change: EditChange,
    layer: str,
    frame: float | None,
    sidecar: str | Path | None,
    why: str,
) -> list[Finding]:
    found: list[Finding] = []
    values: dict[str, Any] = {
        name: getattr(change, name) for name in ("amount", "enabled", "blend") if getattr(change, name) is not None
    }
    masks = {name: getattr(change, name) for name in ("receiver_mask", "caster_mask")}
    masks = {name: mask for name, mask in masks.items() if mask is not None}
    if change.parameters:
        values["parameters"] = dict(change.parameters)
    if values:
        found += authoring.set_edit(session.stage, path, layer=layer, time=frame, **values)
    if masks:
        known = keys.list_keys(session.stage, path).keys
        if frame is None and len(known) > 1:
            raise EditError(f"{path} has {len(known)} keys, which one painted mask would replace; give the key's frame")
        found += keys.set_key(
            session.stage,
            path,
            layer=layer,
            frame=frame,
            made_against=session._made_against,
            sidecar=sidecar,
            why=why,
            **masks,
        )
    return found
