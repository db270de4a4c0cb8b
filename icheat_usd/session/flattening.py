"""Freezing a whole stack into one baked edit, with keys until what lies between them holds the bound too."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from icheat_usd.edits.binding import bind
from icheat_usd.edits.encodings.bake import EPSILON, BakedRows, largest_error
from icheat_usd.edits.encodings.pair_samples import PairSamples
from icheat_usd.edits.facts import facts
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Edit, EditStack, Payload
from icheat_usd.edits.operations import Level, find
from icheat_usd.errors import EditError
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import Finding
from icheat_usd.session.authoring import anchor_of
from icheat_usd.session.baking import (
    ANYTHING,
    BAKED,
    Baked,
    RowsAtKey,
    Sessions,
    Shot,
    bake_rows,
    described,
    light_for,
)
from icheat_usd.session.document import Session
from icheat_usd.session.origin import history_entry
from icheat_usd.sidecar import write_payloads
from icheat_usd.stage import authoring, key_authoring, layers
from icheat_usd.stage.authoring import Members

#: Keys of a frozen stack are put no closer than this, in frames.
_CLOSEST_KEYS = 1.0


def flatten_stack(
    stage: Any,
    name: str,
    *,
    layer: str,
    shot: Shot = ANYTHING,
    frames: Sequence[float] | None = None,
    epsilon: float = EPSILON,
    coefficients: int | None = None,
    sidecar: str | Path | None = None,
    why: str = "",
    progress: Progress = silent,
) -> Baked:
    """Freeze a stack into one edit of operation "baked", mute what it was made of, and save the layer.

    Edits that act on receivers after all others stay live behind it. Over
    several frames, keys are put at the first and the last of them and, by
    halving, wherever the rows in between are off by more than `epsilon`.

    Parameters
    ----------
    name : str
        Of the new edit's prim.
    frames
        Times that the result must hold at; otherwise one payload for all times.

    Raises
    ------
    EditError, SidecarError, StageError
        As `bake_edits`.
    """
    target = layers.find_layer(stage, layer)
    beside = sidecar or target.realPath
    if not beside:
        raise EditError(f"layer '{layer}' has no file to put a sidecar beside; name one with --sidecar")
    sessions = Sessions(stage, shot, progress)
    first = sessions.at(frames[0] if frames else None)
    stack_path, stack = first.stack_path, first.stack
    parts = [edit.path for edit in _pair_edits(stack).edits if edit.enabled] if stack.enabled else []
    if stack_path is None or not parts:
        raise EditError(f"{stack_path or 'the stage'} has no active edit to flatten; name another stack with --stack")
    baked = _keys_within_bound(sessions, stack_path, frames, epsilon, coefficients)
    anchor = anchor_of(stage)
    if not any(baked.values()):
        raise EditError(f"{stack_path}: none of its edits does anything at these frames; choose others with --frames")
    made = []
    identity = []
    for time, found in sorted(baked.items(), key=lambda item: (item[0] is not None, item[0] or 0.0)):
        if found is None:
            identity.append(time)
            continue
        facts_then = facts(sessions.at(time).snapshot, anchor)
        made.append(RowsAtKey(time, Payload(BAKED, {}, rows=found.rows, made_against=facts_then), found))
    file: Path | None = None
    findings: list[Finding] = []
    try:
        history = history_entry(why, f"{stack_path}/{name}")
        file, digests = write_payloads(beside, [key.payload for key in made], anchor=anchor, history=history)
        with layers.saving(stage, target):
            path = authoring.add_edit(
                stage,
                stack_path,
                name,
                layer=target,
                operation=BAKED,
                receivers=Members((anchor,)),
                casters=Members((anchor,)),
                payload=(file, digests[0]),
                time=made[0].time,
            )
            for key, digest in zip(made[1:], digests[1:], strict=True):
                findings += key_authoring.set_payload_key(
                    stage, path, layer=target, time=key.time, payload=(file, digest)
                )
            for time in identity:
                findings += key_authoring.set_payload_key(stage, path, layer=target, time=time, payload=None)
            for part in parts:
                findings += authoring.set_edit(stage, part, layer=target, enabled=False)
    except Exception:
        if file is not None:
            file.unlink(missing_ok=True)
        raise
    keys_written = tuple(described(path, key, file, digest) for key, digest in zip(made, digests, strict=True))
    return Baked(keys_written, tuple(dict.fromkeys(findings)))


def _keys_within_bound(
    sessions: Sessions, stack_path: str, frames: Sequence[float] | None, epsilon: float, coefficients: int | None
) -> dict[float | None, BakedRows | None]:
    """Rows by time: at both ends, and by halving wherever what lies between two keys is off by more than epsilon."""
    times: Sequence[float | None] = sorted(set(frames)) if frames else [None]
    baked = {time: _bake_stack(sessions, time, stack_path, epsilon, coefficients) for time in {times[0], times[-1]}}
    pending = [(times[0], times[-1])] if len(times) > 1 else []
    while pending:
        low, high = pending.pop()
        assert low is not None and high is not None
        inside = [time for time in times if time is not None and low + _CLOSEST_KEYS <= time <= high - _CLOSEST_KEYS]
        if not inside:
            continue
        middle = min(inside, key=lambda time: abs(time - (low + high) / 2))
        weight = (middle - low) / (high - low)
        session, field = _stack_at(sessions, middle)
        work = PairSamples(field, session.view, session.gather, *light_for(session, field))
        ends = [(found, share) for found, share in ((baked[low], 1 - weight), (baked[high], weight)) if found]
        keys = [(found.rows, share) for found, share in ends]
        allowed = max([epsilon, *(found.measured for found, _ in ends)])
        if largest_error(work, keys, session.snapshot) > allowed:
            baked[middle] = _bake_stack(sessions, middle, stack_path, epsilon, coefficients)
            pending += [(low, middle), (middle, high)]
    return baked


def _pair_edits(stack: EditStack) -> EditStack:
    """The stack without edits that act on receivers alone, which come last wherever they stand."""
    return replace(stack, edits=tuple(edit for edit in stack.edits if not _is_view(edit)))


def _is_view(edit: Edit) -> bool:
    operation = find(edit.operation)
    return operation is not None and operation.level is Level.VIEW


def _stack_at(sessions: Sessions, time: float | None) -> tuple[Session, EditField]:
    session = sessions.at(time)
    return session, bind(_pair_edits(session.stack), session.snapshot)


def _bake_stack(
    sessions: Sessions, time: float | None, where: str, epsilon: float, coefficients: int | None
) -> BakedRows | None:
    """Rows of a stack, None where none of its edits does anything at that time."""
    session, field = _stack_at(sessions, time)
    if field.is_identity:
        return None
    return bake_rows(session, field, where, epsilon, coefficients)
