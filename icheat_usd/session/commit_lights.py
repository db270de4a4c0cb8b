"""Lights that were changed in a live session, written to a layer."""

from __future__ import annotations

from typing import Any

from icheat_usd.errors import EditError
from icheat_usd.scene import Finding, SceneSnapshot
from icheat_usd.session.light_changes import all_lights
from icheat_usd.session.live_state import LightChange, LiveState
from icheat_usd.session.origin import history_entry
from icheat_usd.stage.layers import saving
from icheat_usd.stage.light_authoring import LightValues, write_light


def write_lights(
    stage: Any, snapshot: SceneSnapshot, changes: LiveState, *, layer: str, frame: float | None, why: str
) -> tuple[Finding, ...]:
    """Write what is changed about lights; all of it or, after an error, nothing.

    Parameters
    ----------
    snapshot
        The stage without the changes, at the frame that they were made at.
    frame
        Stage time of the values; None is all times.
    """
    shown = all_lights(snapshot, changes)
    entry = history_entry(why)
    about = {"who": entry.who, "when": entry.when, "why": entry.why}
    findings: list[Finding] = []
    with saving(stage, layer):
        for path, change in changes.lights.items():
            if path in shown:  # else the stage has no such light any more
                values = _values(path, change, shown[path])
                findings += write_light(stage, path, values, layer=layer, time=frame, about=about)
    return tuple(findings)


def _values(path: str, change: LightChange, shown: LightChange) -> LightValues:
    if change.removed:
        return LightValues(removed=True)
    if change.texture is not None and change.texture.size and not change.texture_file:
        raise EditError(f"{path}: its image is in memory alone; save it, and set it by its file's path")
    is_new = change.added is not None
    assert shown.radiance is not None
    # Always all of it: a size or scale that changes would change the radiance of a light that is normalized.
    radiance = tuple(value * gain for value, gain in zip(shown.radiance, change.gain, strict=True))
    return LightValues(
        kind=change.added,
        to_world=shown.to_world if is_new else change.to_world,
        radiance=(radiance[0], radiance[1], radiance[2]),
        size=shown.size if is_new else change.size,
        texture_file=None if change.texture is None else change.texture_file,
    )
