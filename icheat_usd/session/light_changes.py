"""Changes of lights as an artist says them: moved, turned, dimmed, with another image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.errors import EditError
from icheat_usd.image.texture import read_texture
from icheat_usd.scene import F32, F64, LightKind, SceneSnapshot
from icheat_usd.session.live_state import LightChange, LiveState, colour, number, numbers
from icheat_usd.stage.textures import to_linear_rgba

#: What `set_light` takes as an image.
Image = str | Path | F32


def all_lights(snapshot: SceneSnapshot, state: LiveState) -> dict[str, LightChange]:
    """Every light as it is shown, by path, with every value filled in."""
    found = {path: light_of_stage(snapshot, path) for path in snapshot.light_paths}
    for path, change in state.lights.items():
        if path in found or change.added is not None:
            found[path] = _filled(change, found.get(path, LightChange()))
    return found


def light_of_stage(snapshot: SceneSnapshot, path: str) -> LightChange:
    """What a stage says about one of its lights, as a complete `LightChange`.

    Raises
    ------
    EditError
        It has no such light.
    """
    if path not in snapshot.light_paths:
        known = ", ".join(snapshot.light_paths) or "none"
        raise EditError(f"there is no light {path} at this frame; there are {known}")
    row = snapshot.light_paths.index(path)
    lights, textures = snapshot.lights, snapshot.textures
    to_world = lights.to_world[row].astype(np.float64)
    to_world[:, 3] += snapshot.centre
    image: F32 = np.zeros((0, 0, 3), np.float32)
    if lights.texture[row] >= 0:
        texture = int(lights.texture[row])
        begin, width, height = (int(t[texture]) for t in (textures.begin, textures.width, textures.height))
        image = textures.texels[begin : begin + width * height].reshape(height, width, 4)
    return LightChange(
        to_world=to_world,
        radiance=_triple(lights.radiance[row]),
        size=(float(lights.size[row, 0]), float(lights.size[row, 1])),
        texture=image,
    )


def _triple(values: Sequence[float] | F32) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def changed_light(
    path: str,
    now: LightChange,
    gain: float | Sequence[float] | None,
    move: Sequence[float] | None,
    turn: tuple[Sequence[float], float] | None,
    to_world: ArrayLike | None,
    radiance: float | Sequence[float] | None,
    size: Sequence[float] | None,
    image: Mapping[str, Any],
) -> dict[str, Any]:
    """What `LiveSession.set_light` says, as fields of a `LightChange`; `image` is one of `read_image`."""
    values: dict[str, Any] = {}
    if gain is not None:
        values["gain"] = colour(gain, f"{path}: gain")
    if radiance is not None:
        values["radiance"] = colour(radiance, f"{path}: radiance")
    if size is not None:
        values["size"] = _size(path, size)
    if to_world is not None or move is not None or turn is not None:
        values["to_world"] = _placed(path, now.to_world if to_world is None else to_world, move, turn)
    return values | dict(image)


def new_light(
    path: str,
    kind: LightKind | str,
    to_world: ArrayLike | None,
    at: Sequence[float],
    radiance: float | Sequence[float],
    size: Sequence[float],
    image: Mapping[str, Any],
) -> LightChange:
    """What `LiveSession.add_light` says; `image` is one of `read_image`."""
    if not path.startswith("/"):
        raise EditError(f"'{path}' is no path for a light, such as /World/Lights/Key")
    try:
        known = LightKind[kind.upper()] if isinstance(kind, str) else LightKind(kind)
    except (KeyError, ValueError):
        names = ", ".join(kind.name.lower() for kind in LightKind)
        raise EditError(f"'{kind}' is no kind of light; known are {names}") from None
    return LightChange(
        to_world=_placed(path, np.eye(3, 4) if to_world is None else to_world, at if to_world is None else None, None),
        radiance=colour(radiance, f"{path}: radiance"),
        size=_size(path, size),
        added=known,
        **image,
    )


def _filled(change: LightChange, own: LightChange) -> LightChange:
    names = ("to_world", "radiance", "size", "texture")
    return replace(change, **{name: getattr(own, name) for name in names if getattr(change, name) is None})


def _size(path: str, size: Sequence[float]) -> tuple[float, float]:
    values = (*np.atleast_1d(np.asarray(size, object)), 0.0)
    first, second = numbers(values if len(values) == 2 else values[:-1], 2, f"{path}: size")
    if first < 0 or second < 0:
        raise EditError(f"{path}: size is {size!r}, expected lengths, which are not negative")
    return float(first), float(second)


def _placed(
    path: str, now: ArrayLike | None, move: Sequence[float] | None, turn: tuple[Sequence[float], float] | None
) -> F64:
    try:
        place: F64 = np.array(np.eye(3, 4) if now is None else now, np.float64)
    except (TypeError, ValueError):
        place = np.zeros(0)
    if place.shape != (3, 4) or not np.isfinite(place).all():
        raise EditError(f"{path}: to_world needs shape (3, 4) and finite numbers, not {now!r}")
    if turn is not None:
        place[:, :3] = _rotation(path, turn) @ place[:, :3]
    if move is not None:
        place[:, 3] += numbers(move, 3, f"{path}: move")
    return place


def _rotation(path: str, turn: tuple[Sequence[float], float]) -> F64:
    if not isinstance(turn, Sequence) or len(turn) != 2:
        raise EditError(f"{path}: turn is {turn!r}, expected an axis and degrees, such as ((0, 1, 0), 30)")
    axis, degrees = numbers(turn[0], 3, f"{path}: axis of the turn"), number(turn[1], f"{path}: degrees of the turn")
    if not axis.any():
        raise EditError(f"{path}: the axis of a turn has a direction, {turn[0]!r} has none")
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    turned: F64 = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned


def read_image(texture: Image | None) -> dict[str, Any]:
    """What commands take as an image, as fields of a `LightChange`; "" takes the image away, None is none of them."""
    if texture is None:
        return {}
    if isinstance(texture, np.ndarray):
        return {"texture": np.ascontiguousarray(texture, np.float32), "texture_file": ""}
    if not str(texture):
        return {"texture": np.zeros((0, 0, 3), np.float32), "texture_file": ""}
    return {"texture": to_linear_rgba(read_texture(texture), "auto"), "texture_file": str(texture)}
