"""Baking edits for good: sampled rows in a new sidecar, named by the edit's keys in one layer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.edits.binding import bind
from icheat_usd.edits.encodings.bake import (
    EPSILON,
    BakedRows,
    at_full_amount,
    bake_field,
    check_bakeable,
)
from icheat_usd.edits.encodings.choose import choose
from icheat_usd.edits.facts import facts
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend, Edit, EditStack, Payload
from icheat_usd.edits.operations import Level, find
from icheat_usd.errors import EditError
from icheat_usd.progress import Progress, silent
from icheat_usd.scene import Bool, Finding
from icheat_usd.session.document import Session
from icheat_usd.session.inspection import describe_stack
from icheat_usd.session.keys import payload_at
from icheat_usd.session.origin import history_entry
from icheat_usd.session.quality import PREVIEW, Quality
from icheat_usd.sidecar import list_elements, write_payloads
from icheat_usd.stage import authoring, key_authoring, layers
from icheat_usd.stage.edit_stack import anchor_path
from icheat_usd.stage.keys import read_keys
from icheat_usd.stage.stacks import EditFinding, edit_prim
from icheat_usd.transport import sum_lights

#: Operation of an edit that is evaluated by what is baked.
BAKED = "baked"


@dataclass(frozen=True)
class BakedKey:
    """One payload with rows that was written."""

    edit: str
    time: float | None  #: stage time of the key; None: it holds at all times
    payload: str  #: digest
    file: str
    cheapest: str  #: the cheapest encoding that is exact
    view_samples: int  #: that the edit touches
    sites: int  #: places that rows are kept for
    rows: int  #: different ones among them
    gather_samples: int  #: that rows have a value for
    coefficients: int
    stored_bytes: int  #: of the rows in the file
    epsilon_scale: float  #: stated bounds, see `SampledRows`
    epsilon_emission: float
    epsilon_offset: float
    measured_error: float  #: of S at random view samples, between rows too
    lost_radiance: float  #: that an aggregate adds where nothing can be scaled; rows do not hold it


@dataclass(frozen=True)
class Baked:
    """What `bake_edits` and `flattening.flatten_stack` wrote."""

    keys: tuple[BakedKey, ...]
    findings: tuple[Finding, ...]


class Shot(NamedTuple):
    """What edits are baked for."""

    camera: str | None = None
    stack: str | None = None
    width: int | None = None
    height: int | None = None
    quality: Quality = PREVIEW


#: The camera, stack and size that the stage names.
ANYTHING = Shot()


class RowsAtKey(NamedTuple):
    """What one key is to hold."""

    time: float | None
    payload: Payload
    baked: BakedRows


def bake_edits(
    stage: Any,
    edits: Sequence[str],
    *,
    layer: str,
    shot: Shot = ANYTHING,
    frames: Sequence[float] | None = None,
    epsilon: float = EPSILON,
    coefficients: int | None = None,
    forget_recipe: bool = False,
    sidecar: str | Path | None = None,
    why: str = "",
    progress: Progress = silent,
) -> Baked:
    """Give each key of some edits a payload that holds sampled rows too, and save the layer.

    Rows hold an edit at full amount: amount, blend, collections and lights
    stay opinions in USD and act on rows as on recipes. Recipe and masks stay
    in the payload.

    Parameters
    ----------
    edits : paths of edits of the stack
    frames
        Times to bake at, each of which becomes a key. By default the edit's own keys; an edit without keys is baked
        for all times, as the scene is at the stage's first frame.
    epsilon, coefficients
        See `encodings.bake.bake_field`.
    forget_recipe : bool
        Let the rows be what is evaluated from now on: the operation becomes "baked".
    sidecar : path, optional
        Folder or file for the payloads; beside the layer's file by default.

    Raises
    ------
    EditError, SidecarError, StageError
        An edit cannot be baked, or nothing can be written. The layer is then
        as before, and no sidecar is left behind.
    """
    target = layers.find_layer(stage, layer)
    beside = sidecar or target.realPath
    if not beside:
        raise EditError(f"layer '{layer}' has no file to put a sidecar beside; name one with --sidecar")
    sessions = Sessions(stage, shot, progress)
    made: dict[str, list[RowsAtKey]] = {}
    findings: list[Finding] = []
    for path in edits:
        made[path] = [_bake_key(sessions, path, time, epsilon, coefficients) for time in _times(stage, path, frames)]
        findings += _warnings(sessions, path, made[path], forget_recipe)
    written: list[Path] = []
    keys: list[BakedKey] = []
    try:
        with layers.saving(stage, target):
            for path, parts in made.items():
                payloads = [key.payload for key in parts]
                anchor = anchor_path(edit_prim(stage, path))
                file, digests = write_payloads(beside, payloads, anchor=anchor, history=history_entry(why, path))
                written.append(file)
                for key, digest in zip(parts, digests, strict=True):
                    findings += key_authoring.set_payload_key(
                        stage, path, layer=target, time=key.time, payload=(file, digest)
                    )
                    keys.append(described(path, key, file, digest))
                if forget_recipe:
                    findings += authoring.set_edit(stage, path, layer=target, operation=BAKED)
    except Exception:
        # Not after an interruption: the layer may have been saved already, and then names these files.
        for file in written:
            file.unlink(missing_ok=True)
        raise
    return Baked(tuple(keys), tuple(dict.fromkeys(findings)))


def bakeable_edits(stage: Any, stack: str) -> list[str]:
    """Edits of a stack that can be baked anew: those whose operation is known, makes pairs, and needs no rays.

    Raises
    ------
    EditError
        There are none.
    """
    found = []
    for edit in describe_stack(stage, stack).edits:
        operation = find(str(edit.operation.value))
        if operation is not None and operation.level is not Level.VIEW and not operation.has_through:
            found.append(edit.path)
    if not found:
        raise EditError(f"{stack} has no edit that rows could hold; see `icheat tree` for what its edits do")
    return found


class Sessions:
    """A session for each frame that is baked at; the last two are kept, for what lies between."""

    def __init__(self, stage: Any, shot: Shot, progress: Progress) -> None:
        self._stage, self._shot, self.progress = stage, shot, progress
        self._open: dict[float | None, Session] = {}

    def at(self, frame: float | None) -> Session:
        if frame not in self._open:
            while len(self._open) > 1:
                self._open.pop(next(iter(self._open)))
            shot = self._shot
            self._open[frame] = Session.open(
                self._stage,
                camera=shot.camera,
                frame=frame,
                stack=shot.stack,
                width=shot.width,
                height=shot.height,
                quality=shot.quality,
                progress=self.progress,
            )
        return self._open[frame]


def _times(stage: Any, path: str, frames: Sequence[float] | None) -> Sequence[float | None]:
    if frames:
        return sorted(set(frames))
    track = read_keys(edit_prim(stage, path))
    # Keys that are the identity need no rows.
    times = [key.time for key in track.keys if key.digest] if track is not None else []
    return times or [None]


def _bake_key(sessions: Sessions, path: str, time: float | None, epsilon: float, coefficients: int | None) -> RowsAtKey:
    session = sessions.at(time)
    edit = next((edit for edit in session.stack.edits if edit.path == path), None)
    if edit is None:
        raise EditError(f"{path}: is no edit of the stack {session.stack_path}; name another one with --stack")
    if find(edit.operation) is None:
        raise EditError(f"{path}: operation '{edit.operation}' is not known here, so nothing can be baked anew from it")
    if any(key.payload is None and key.weight > 0 for key in edit.keys):
        at = "" if time is None else f" at frame {time:g}"
        raise EditError(f"{path}: is half way to the identity{at}, where it has no recipe to keep; bake it at its keys")
    field = bind(at_full_amount(edit), session.snapshot)
    baked = bake_rows(session, field, path, epsilon, coefficients, _lights_of(edit, session))
    anchor = anchor_path(edit_prim(session.stage, path))
    made_against = facts(session.snapshot, anchor, edit=edit)
    payload = payload_at(session.stage, path, time, made_against)
    return RowsAtKey(time, replace(payload, rows=baked.rows, made_against=made_against), baked)


def _lights_of(edit: Edit, session: Session) -> Bool:
    """(n_lights,) the lights whose light the edit looks at."""
    field = bind(EditStack(path="", edits=(replace(edit, amount=1.0, enabled=True),)), session.snapshot)
    acts = field.edits[0].groups if field.edits else np.zeros(field.n_groups, np.bool_)
    return np.asarray(acts[field.light_group], np.bool_)


def bake_rows(
    session: Session,
    field: EditField,
    where: str,
    epsilon: float,
    coefficients: int | None,
    lights: Bool | None = None,
) -> BakedRows:
    """Rows of a field as a session's view and gather samples see it.

    Raises
    ------
    EditError
        Rows cannot hold what the field does.
    """
    check_bakeable(field, where)
    radiance, transport = light_for(session, field, lights)
    return bake_field(
        field,
        session.view,
        session.gather,
        session.snapshot,
        where=where,
        radiance=radiance,
        transport=transport,
        epsilon=epsilon,
        coefficients=coefficients,
        progress=session.progress,
    )


def light_for(session: Session, field: EditField, lights: Bool | None = None) -> tuple[Any, Any]:
    """Radiance of some lights, all by default, and transport; computed only where the field looks at light."""
    if not field.uses_incident and not field.aggregates:
        return None, None
    per_light = session.cell_light.radiance
    radiance = sum_lights(per_light if lights is None else per_light[lights])
    return radiance, session.transport if field.aggregates else None


def _warnings(sessions: Sessions, path: str, keys: list[RowsAtKey], forget_recipe: bool) -> list[Finding]:
    session = sessions.at(keys[0].time)
    edit = next(edit for edit in session.stack.edits if edit.path == path)
    operation = find(edit.operation)
    found: list[Finding] = []
    if operation is not None and (operation.uses_incident or operation.level is Level.AGGREGATE):
        text = f"operation '{operation.name}' looks at the light, so its rows hold for the lights as they are now"
        if edit.blend is Blend.COMPOSE and any(other.path != path for other in session.stack.active[:1]):
            text += ", without what weaker edits make of it; to keep that, flatten the stack instead"
        found.append(EditFinding(path, "icheat:payload", text))
    soft = (
        edit.receivers.limits
        or edit.casters.limits
        or any(key.payload.receiver_mask is not None or key.payload.caster_mask is not None for key in keys)
    )
    if forget_recipe and edit.blend is Blend.OVER and soft:
        text = (
            "rows hold soft masks multiplied in, so that blend 'over' replaces weaker edits all over its collections;"
            " keep the recipe, or flatten the stack"
        )
        found.append(EditFinding(path, "icheat:blend", text))
    return found


def described(path: str, key: RowsAtKey, file: Path, digest: str) -> BakedKey:
    """What was written for one key."""
    rows = key.baked.rows
    operation = key.payload.operation
    return BakedKey(
        edit=path,
        time=key.time,
        payload=digest,
        file=str(file),
        cheapest=choose(operation, dict(key.payload.parameters), path).value,
        view_samples=key.baked.n_view,
        sites=len(rows.site_row),
        rows=len(rows.row_pattern),
        gather_samples=rows.n_leaves,
        coefficients=len(rows.indices),
        stored_bytes=sum(i.stored_bytes for i in list_elements(file) if i.payload == digest and i.element == "rows"),
        epsilon_scale=rows.epsilon_scale,
        epsilon_emission=rows.epsilon_emission,
        epsilon_offset=rows.epsilon_offset,
        measured_error=key.baked.measured,
        lost_radiance=key.baked.lost,
    )
