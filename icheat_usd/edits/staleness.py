"""Whether what a payload was made against has changed, and what, in an artist's words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.edits import operations
from icheat_usd.edits.facts import (
    OTHERS,
    Facts,
    LightFacts,
    facts,
    read_lights,
    read_surfaces,
    selection_facts,
    sum_lights,
    sum_surfaces,
)
from icheat_usd.edits.model import Payload, Value
from icheat_usd.edits.operations.base import Level, Operation
from icheat_usd.scene import F64

__all__ = [
    "Aspect",
    "Change",
    "Facts",
    "Needs",
    "baked_parameters",
    "camera_changes",
    "changes",
    "facts",
    "needs",
    "selection_facts",
    "stale_because",
]

#: Share of the scene's radius by which something must have moved: a few hundred times what rounding does.
_MOVED = 1e-4
#: Relative difference of radiance and size that counts.
_CHANGED = 1e-4
#: How many things of one kind are named before they are counted.
_NAMED = 3

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


class Aspect(StrEnum):
    """What part of the scene a change is in."""

    CAMERA = "camera"
    GEOMETRY = "geometry"
    LIGHTS = "lights"
    SELECTION = "selection"


class Change(NamedTuple):
    """One thing that is not as it was."""

    aspect: Aspect
    text: str


class Needs(NamedTuple):
    """What a payload's baked form depends on; pass it on to `facts`."""

    geometry: bool
    lights: bool


def needs(operation: Operation | None, *, has_rows: bool) -> Needs:
    """What the baked form of an operation depends on.

    Masks depend on the topology of what they are painted on, which they carry
    themselves; constants depend on nothing. Sampled rows belong to the
    geometry they were sampled on, and where the operation looks at the light,
    to the lights and materials as well. Of an unknown operation the worst is assumed.
    """
    if not has_rows:
        return Needs(False, False)
    sees_light = operation is None or operation.uses_incident or operation.level is Level.AGGREGATE
    return Needs(True, sees_light)


def stale_because(payload: Payload, operation: str, now: Mapping[str, str | float | int]) -> tuple[str, ...]:
    """What has changed since a payload's baked form was made, of what it depends on; nothing if it is up to date.

    Parameters
    ----------
    operation
        Of the edit; "baked" stands for the payload's own.
    now
        `facts` at the time of the payload's key, with `limit=False`.
    """
    known = operations.find(payload.operation) or operations.find(operation)
    wanted = needs(known, has_rows=payload.rows is not None)
    aspects = {Aspect.GEOMETRY: wanted.geometry, Aspect.SELECTION: wanted.geometry, Aspect.LIGHTS: wanted.lights}
    return tuple(change.text for change in changes(payload.made_against, now) if aspects.get(change.aspect, False))


def camera_changes(payload: Payload, now: Mapping[str, str | float | int]) -> tuple[str, ...]:
    """How the camera has changed that a payload's rows were sampled for; they hold, but for what it did not see."""
    if payload.rows is None:
        return ()
    return tuple(change.text for change in changes(payload.made_against, now) if change.aspect is Aspect.CAMERA)


def baked_parameters(payload: Payload, parameters: Mapping[str, Value]) -> tuple[str, ...]:
    """Parameters that are no longer those that the payload's baked form was made with, in words."""
    has_baked = payload.rows is not None or payload.scale_delta is not None
    if not has_baked:
        return ()
    found = []
    known = operations.find(payload.operation)
    defaults = {parameter.name: parameter.default for parameter in known.parameters} if known else {}
    for name, value in sorted(parameters.items()):
        was = payload.parameters.get(name, defaults.get(name))
        if was is not None and not _same_value(was, value):
            found.append(f"{name} is {value_text(value)}, and was {value_text(was)} when it was baked")
    return tuple(found)


def changes(then: Mapping[str, str | float | int], now: Mapping[str, str | float | int]) -> tuple[Change, ...]:
    """What differs between two sets of facts, of what both state.

    Parameters
    ----------
    then
        As stored in a payload.
    now
        `facts` with ``limit=False``.
    """
    with np.errstate(all="ignore"):  # Anyone may have written `then`, with numbers that overflow.
        motion = _common_motion(then, now)
        found = [*_camera_changes(then, now, motion), *_surface_changes(then, now, motion)]
        found += [*_light_changes(then, now, motion), *_selection_changes(then, now)]
        return tuple(found)


# --------------------------------------------------------------------------- each aspect


def _camera_changes(then: Mapping[str, Any], now: Mapping[str, Any], motion: F64) -> list[Change]:
    found = []
    if _differ(then, now, "camera"):
        gone = f"camera {then['camera']} is gone"
        found.append(f"another camera: {then['camera']} became {now['camera']}" if now["camera"] else gone)
    sizes = _differ(then, now, "width") or _differ(then, now, "height")
    if sizes and not (_differ(then, now, "camera") and not now["camera"]):
        was, is_ = (f"{f.get('width', '?')}x{f.get('height', '?')}" for f in (then, now))
        found.append(f"the resolution is {is_}, and was {was}")
    views = [_view(f) for f in (then, now)]
    if views[0] is not None and views[1] is not None and not _differ(then, now, "camera"):
        places = [view[:12].reshape(3, 4) for view in views if view is not None]
        if _is_moved(_moved(places[0], motion), _about(places[1], then, now), then):
            found.append(f"camera {now.get('camera', '')} moved")
        # The window scales with the image where the aspect changes; then the resolution has been named already.
        same_size = not _differ(then, now, "width") and not _differ(then, now, "height")
        if same_size and not np.allclose(views[0][12:], views[1][12:], rtol=_CHANGED, atol=1e-6):
            found.append(f"camera {now.get('camera', '')} has another lens")
    return [Change(Aspect.CAMERA, text) for text in found]


def _surface_changes(then: Mapping[str, Any], now: Mapping[str, Any], motion: F64) -> list[Change]:
    tables = _tables(then, now, "surfaces", read_surfaces)
    if tables is None:
        return []
    were, are = _paired(*tables, sum_surfaces)
    kinds: dict[str, list[str]] = {"gone": [], "faces": [], "shape": [], "count": [], "moved": [], "look": []}
    for path, was in were.items():
        is_ = are.get(path)
        if is_ is None:
            kinds["gone"].append(path)
        elif was.n != is_.n:
            kinds["count"].append(path)
        elif was.topology != is_.topology:
            kinds["faces"].append(path)
        else:
            if was.look != is_.look and int(was.look, 16) and int(is_.look, 16):
                kinds["look"].append(path)
            if was.shape != is_.shape:
                kinds["shape"].append(path)
            if _is_moved(_moved(was.place, motion), _about(is_.place, then, now), then) or _is_moved(
                np.array(was.spread), np.array(is_.spread), then
            ):
                kinds["moved"].append(path)
    added = [path for path in are if path not in were]
    surface = Aspect.GEOMETRY
    return [
        *_counted(surface, kinds["moved"], "surface", "moved", "moved"),
        *_counted(surface, kinds["shape"], "surface", "has another shape", "have another shape"),
        *_counted(surface, kinds["faces"], "surface", "has other faces", "have other faces"),
        *_counted(surface, kinds["count"], "surface", "has another number of instances", "have other instances"),
        *_counted(surface, added, "surface", "is new", "are new"),
        *_counted(surface, kinds["gone"], "surface", "is gone", "are gone"),
        *_counted(Aspect.LIGHTS, kinds["look"], "surface", "has another material", "have other materials"),
    ]


def _light_changes(then: Mapping[str, Any], now: Mapping[str, Any], motion: F64) -> list[Change]:
    tables = _tables(then, now, "lights", read_lights)
    if tables is None:
        return []
    were, are = _paired(*tables, sum_lights)
    texts: list[str] = []
    for path, was in were.items():
        is_ = are.get(path)
        texts += (
            [f"light {path} is gone or off"]
            if is_ is None
            else [f"light {path} {how}" for how in _light_words(was, is_, motion, then, now)]
        )
    texts += [f"light {path} is new" for path in are if path not in were]
    return [Change(Aspect.LIGHTS, text.replace("light * ", "one of the other lights ")) for text in texts]


def _light_words(
    was: LightFacts, is_: LightFacts, motion: F64, then: Mapping[str, Any], now: Mapping[str, Any]
) -> list[str]:
    words = []
    if was.kind != is_.kind:
        words.append(f"is a {is_.kind} light, and was a {was.kind} light")
    before, after = float(was.radiance @ _LUMINANCE), float(is_.radiance @ _LUMINANCE)
    if abs(after - before) > _CHANGED * max(abs(before), abs(after)):
        times = f" ({after / before:.3g} times)" if before > 0 else ""
        words.append(("got brighter" if after > before else "got dimmer") + times)
    colours = [row.radiance / max(float(np.abs(row.radiance).max()), 1e-30) for row in (was, is_)]
    if before > 0 and after > 0 and np.abs(colours[0] - colours[1]).max() > _CHANGED:
        words.append("has another colour")
    if was.image != is_.image:
        words.append("has another texture, other links or other shaping")
    if not np.allclose(was.size, is_.size, rtol=_CHANGED, atol=1e-7):
        words.append("has another size")
    if was.kind == "dome" or was.kind == "distant":  # Where they stand does not matter, only how they are turned.
        turned = [_rotation(motion) @ was.place[:, :3], is_.place[:, :3]]
        if np.abs(turned[0] - turned[1]).max() > 1e-4 * max(np.abs(turned[0]).max(), 1e-30):
            words.append("was turned")
    elif was.kind != "mesh" and _is_moved(_moved(was.place, motion), _about(is_.place, then, now), then):
        words.append("moved")
    return words


def _selection_changes(then: Mapping[str, Any], now: Mapping[str, Any]) -> list[Change]:
    words = {"receivers": "other receivers", "casters": "other casters", "aims": "another target, lights or occluders"}
    return [
        Change(Aspect.SELECTION, f"the edit has {text}") for name, text in words.items() if _differ(then, now, name)
    ]


# --------------------------------------------------------------------------- comparing


def _differ(then: Mapping[str, Any], now: Mapping[str, Any], name: str) -> bool:
    return name in then and name in now and then[name] != now[name]


def _tables(then: Mapping[str, Any], now: Mapping[str, Any], name: str, read: Any) -> tuple[Any, Any] | None:
    """Both tables of that name; None where one is missing or was written by something else."""
    try:
        return read(str(then[name])), read(str(now[name]))
    except (KeyError, ValueError):
        return None


def _paired(were: dict[str, Any], are: dict[str, Any], add: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Sum up those of `are` that the stored table does not name, if it sums up some itself."""
    if OTHERS not in were or OTHERS in are:
        return were, are
    named = {path: row for path, row in are.items() if path in were}
    rest = add(row for path, row in are.items() if path not in were)
    return were, named | ({OTHERS: rest} if rest else {})


def _counted(aspect: Aspect, paths: Sequence[str], noun: str, one: str, many: str) -> list[Change]:
    if not paths:
        return []
    if OTHERS in paths:
        paths = [path for path in paths if path != OTHERS]
        text = f"some of the other {noun}s {many}"
        return [*_counted(aspect, paths, noun, one, many), Change(aspect, text)]
    if len(paths) <= _NAMED:
        return [Change(aspect, f"{noun} {path} {one}") for path in paths]
    return [Change(aspect, f"{len(paths)} {noun}s {many} ({', '.join(paths[:_NAMED])}, ...)")]


def _view(found: Mapping[str, Any]) -> F64 | None:
    try:
        values = np.array([float(word) for word in str(found["camera-view"]).split()])
    except (KeyError, ValueError):
        return None
    return values if values.shape == (18,) else None


def _about(place: F64, then: Mapping[str, Any], now: Mapping[str, Any]) -> F64:
    """A place now about the centre of then: the centre moves with the bounds of the scene."""
    try:
        centres = [np.array([float(word) for word in str(f["centre"]).split()]) for f in (then, now)]
        shift = (centres[1] - centres[0]).reshape(3)
    except (KeyError, ValueError):
        return place
    moved = place.copy()
    moved[:, 3] += shift
    return moved


def _is_moved(was: F64, is_: F64, then: Mapping[str, Any]) -> bool:
    try:
        radius = float(then["radius"])
    except (KeyError, ValueError):
        radius = 1.0
    if was.ndim == 0:
        return bool(abs(was - is_) > _MOVED * radius)
    linear = np.abs(was[:, :3] - is_[:, :3]).max() > 1e-4 * max(float(np.abs(was[:, :3]).max()), 1e-30)
    return bool(linear or np.abs(was[:, 3] - is_[:, 3]).max() > _MOVED * radius)


def _common_motion(then: Mapping[str, Any], now: Mapping[str, Any]) -> F64:
    """(3, 4) rigid motion that all surfaces share, as where a set is referenced at another place; else the identity.

    Light does not know about it, so neither do the comparisons.
    """
    identity = np.eye(3, 4)
    tables = _tables(then, now, "surfaces", read_surfaces)
    if tables is None:
        return identity
    were, are = tables
    pairs = [(were[path].place, _about(are[path].place, then, now)) for path in were if path in are and path != OTHERS]
    for was, is_ in pairs:
        size = float(np.abs(was[:, :3]).max())
        if size > 0 and np.linalg.cond(was[:, :3] / size) < 1e6:
            linear = is_[:, :3] @ np.linalg.inv(was[:, :3])
            motion = np.concatenate([linear, (is_[:, 3] - linear @ was[:, 3])[:, None]], axis=1)
            break
    else:
        return identity
    if len(pairs) < 2 or not np.allclose(linear @ linear.T, np.eye(3), atol=1e-4) or np.linalg.det(linear) < 0:
        return identity
    lights = _tables(then, now, "lights", read_lights)
    if lights is not None:  # Where all surfaces went and the lights stayed, it is better to say that surfaces moved.
        fixed = {"mesh", "dome", "distant", OTHERS}
        names = [path for path, row in lights[0].items() if path in lights[1] and row.kind not in fixed]
        pairs += [(lights[0][path].place, _about(lights[1][path].place, then, now)) for path in names]
    return identity if any(_is_moved(_moved(was, motion), is_, then) for was, is_ in pairs) else motion


def _moved(place: F64, motion: F64) -> F64:
    moved = motion[:, :3] @ place
    moved[:, 3] += motion[:, 3]
    return moved


def _rotation(motion: F64) -> F64:
    return motion[:, :3]


def _same_value(a: Value, b: Value) -> bool:
    if isinstance(a, (str, bool)) or isinstance(b, (str, bool)):
        return a == b
    numbers = [np.atleast_1d(np.asarray(value, np.float32)) for value in (a, b)]
    return numbers[0].shape == numbers[1].shape and bool(np.allclose(numbers[0], numbers[1], rtol=1e-6, atol=1e-9))


def value_text(value: Value) -> str:
    """A parameter value as people write it."""
    if isinstance(value, tuple):
        return "(" + ", ".join(f"{number:g}" for number in value) + ")"
    return f"{value:g}" if isinstance(value, float) else str(value)
