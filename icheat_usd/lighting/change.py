"""Lights of a snapshot taken apart, changed, added and removed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from icheat_usd.errors import IcheatError
from icheat_usd.scene import F32, LightKind, Lights, SceneSnapshot, Textures

_SPARE_IMAGES = 4  # of the size of the first one, for which there is room before all is copied


class LightError(IcheatError):
    """A light cannot be changed the way that was asked for."""


def one_light(snapshot: SceneSnapshot, light: int) -> SceneSnapshot:
    """The scene with a single light, row `light`; everything else is shared with `snapshot`."""
    lights = snapshot.lights
    first, last = int(lights.triangle_begin[light]), int(lights.triangle_begin[light + 1])
    row = slice(light, light + 1)
    alone = Lights(
        kind=lights.kind[row].copy(),
        to_world=lights.to_world[row].copy(),
        radiance=lights.radiance[row].copy(),
        size=lights.size[row].copy(),
        texture=lights.texture[row].copy(),
        surface=lights.surface[row].copy(),
        triangle_begin=np.array([0, last - first], np.int64),
        triangle=lights.triangle[first:last].copy(),
        triangle_instance=lights.triangle_instance[first:last].copy(),
    )
    controls = snapshot.light_controls[row]
    return replace(snapshot, lights=alone, light_paths=(snapshot.light_paths[light],), light_controls=controls)


def join_lights(snapshot: SceneSnapshot, alone: list[SceneSnapshot]) -> SceneSnapshot:
    """The scene lit by the lights of `alone`, one-light snapshots, in their order; their images stand after its own."""
    textures, n_own = snapshot.textures, len(snapshot.textures.begin)
    parts = []
    for part in alone:
        lights = part.lights
        if lights.texture[0] >= n_own:
            textures, row = _with_row_of(textures, part.textures, int(lights.texture[0]))
            lights = lights._replace(texture=np.array([row], np.int32))
        parts.append(lights)
    begin = np.concatenate([[0], np.cumsum([len(part.triangle) for part in parts])]).astype(np.int64)
    empty = no_lights()
    columns = {
        name: np.concatenate([getattr(empty, name), *(getattr(part, name) for part in parts)])
        for name in Lights._fields
        if name != "triangle_begin"
    }
    paths = tuple(part.light_paths[0] for part in alone)
    lights = Lights(triangle_begin=begin, **columns)
    has_controls = any(part.light_controls for part in alone)
    controls = tuple(part.controls(0) for part in alone) if has_controls else ()
    return replace(snapshot, textures=textures, lights=lights, light_paths=paths, light_controls=controls)


def no_lights() -> Lights:
    """A table of lights without rows."""
    return Lights(
        kind=np.empty(0, np.int32),
        to_world=np.empty((0, 3, 4), np.float32),
        radiance=np.empty((0, 3), np.float32),
        size=np.empty((0, 2), np.float32),
        texture=np.empty(0, np.int32),
        surface=np.empty(0, np.int32),
        triangle_begin=np.zeros(1, np.int64),
        triangle=np.empty(0, np.int32),
        triangle_instance=np.empty(0, np.int32),
    )


class LightImages:
    """Images that lights get one after another, behind those of a scene.

    All texels lie in one array, so that a new image copies no others; when there is no room left, the next ones get
    an array of their own, behind the scene's. Where an image lies does not say which it is.
    """

    def __init__(self, textures: Textures) -> None:
        self._own = textures
        self._store: F32 | None = None
        self._used = len(textures.texels)

    def add(self, image: F32) -> tuple[Textures, int]:
        """The scene's images and this one (height, width, 3 or 4), and its row."""
        height, width, channels = image.shape
        begin, end = self._used, self._used + height * width
        if self._store is None or end > len(self._store):
            # None of the images before is copied: lights have them in the array before.
            begin, end = len(self._own.texels), len(self._own.texels) + height * width
            self._store = np.empty((end + _SPARE_IMAGES * height * width, 4), np.float32)
            self._store[:begin] = self._own.texels
        self._store[begin:end, channels:] = 1.0
        self._store[begin:end, :channels] = image.reshape(-1, channels)
        self._used = end
        return _with_row(self._own, self._store[:end], begin, width, height), len(self._own.begin)


def _with_row(textures: Textures, texels: F32, begin: int, width: int, height: int) -> Textures:
    return Textures(
        texels=texels,
        begin=np.append(textures.begin, begin).astype(np.int64),
        width=np.append(textures.width, width).astype(np.int32),
        height=np.append(textures.height, height).astype(np.int32),
        wrap=np.concatenate([textures.wrap, np.zeros((1, 2), np.int32)]),
    )


def _with_row_of(textures: Textures, other: Textures, row: int) -> tuple[Textures, int]:
    """`textures` and one row more of `other`, which begins with the same scene's; texels are copied if they must be."""
    begin, width, height = int(other.begin[row]), int(other.width[row]), int(other.height[row])
    texels = textures.texels
    if len(textures.begin) == row or _same_place(texels, other.texels):
        texels = max(texels, other.texels, key=len) if _same_place(texels, other.texels) else other.texels
        return _with_row(textures, texels, begin, width, height), len(textures.begin)
    return append_texture(textures, texture_image(other, row))


def _same_place(a: F32, b: F32) -> bool:
    return a.ctypes.data == b.ctypes.data


def changed_light(
    images: LightImages,
    alone: SceneSnapshot,
    *,
    to_world: ArrayLike | None = None,
    radiance: ArrayLike | None = None,
    size: ArrayLike | None = None,
    texture: F32 | None = None,
) -> SceneSnapshot:
    """A one-light snapshot with some properties of its light replaced.

    Parameters
    ----------
    images : LightImages
        Of the scene that `alone` was taken from.
    to_world : (3, 4), metres, about the scene's centre
    radiance : (3,), scene-linear
    size : (2,), local; see `scene.Lights`
    texture : (height, width, 3 or 4) float32, linear
        For domes (lat-long) and rectangles; an array of size 0 takes the image away.

    Raises
    ------
    LightError
        A value has another shape, is no number or not finite; a radiance or size is negative (what the stage
        made negative stays so until it is changed); the light consists of a mesh's triangles, whose place,
        size and image belong to the mesh; its kind has no image.
    """
    lights, path = alone.lights, alone.light_paths[0]
    kind = LightKind(int(lights.kind[0]))
    if kind == LightKind.MESH and any(value is not None for value in (to_world, size, texture)):
        raise LightError(
            f"{path} is a mesh that glows: its place, size and image are the mesh's; only dim or recolour it"
        )
    columns: dict[str, np.ndarray] = {}
    for name, value, shape in (("to_world", to_world, (3, 4)), ("radiance", radiance, (3,)), ("size", size, (2,))):
        if value is not None:
            columns[name] = checked_numbers(path, name, value, shape)[None]
            if name != "to_world" and (columns[name] < 0.0).any():
                raise LightError(f"{name} of {path} must not be negative: {value!r}")
    if texture is not None:
        texture = _image(path, texture)
        if kind not in (LightKind.DOME, LightKind.RECT):
            raise LightError(f"{path} is a {kind.name.lower()} light; only domes and rectangles have an image")
        if texture.size == 0:
            columns["texture"] = np.array([-1], np.int32)
        else:
            textures, row = images.add(texture)
            alone = replace(alone, textures=textures)
            columns["texture"] = np.array([row], np.int32)
    return replace(alone, lights=lights._replace(**columns))


def checked_numbers(path: str, name: str, value: ArrayLike, shape: tuple[int, ...]) -> F32:
    """A property `name` of the light `path` as a finite float32 array of a shape, or a LightError."""
    try:
        with np.errstate(over="ignore"):  # what float32 can't hold is refused below
            array = np.array(value, np.float32)
    except (TypeError, ValueError):  # text, or rows of unequal length
        array = np.empty(0, np.float32)
    if array.shape != shape or not np.isfinite(array).all():
        raise LightError(f"{name} of {path} needs finite numbers of shape {shape}, not {value!r}")
    return array


def _image(path: str, value: ArrayLike) -> F32:
    try:
        image = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        raise LightError(f"the image of {path} needs numbers of shape (height, width, 3 or 4)") from None
    if image.size and (image.ndim != 3 or image.shape[2] not in (3, 4)):
        raise LightError(f"the image of {path} needs shape (height, width, 3 or 4), not {image.shape}")
    return image


def append_texture(textures: Textures, image: F32) -> tuple[Textures, int]:
    """`textures` with one more image (height, width, 3 or 4), and its row."""
    height, width, channels = image.shape
    texels = np.ones((height * width, 4), np.float32)
    texels[:, :channels] = image.reshape(-1, channels)
    every = np.concatenate([textures.texels, texels])
    return _with_row(textures, every, len(textures.texels), width, height), len(textures.begin)


def texture_image(textures: Textures, row: int) -> F32:
    """Image `row` as (height, width, 4)."""
    begin, width, height = int(textures.begin[row]), int(textures.width[row]), int(textures.height[row])
    return textures.texels[begin : begin + width * height].reshape(height, width, 4)


def new_light(
    scene: SceneSnapshot,
    images: LightImages,
    path: str,
    kind: LightKind,
    *,
    to_world: ArrayLike,
    radiance: ArrayLike,
    size: ArrayLike = (0.0, 0.0),
    texture: F32 | None = None,
) -> SceneSnapshot:
    """A one-light snapshot of `scene` with a light that the stage does not have; see `changed_light`."""
    if kind == LightKind.MESH:
        raise LightError(f"{path}: a mesh light is geometry, which can't be added live; add it to the stage")
    row = Lights(
        kind=np.array([kind], np.int32),
        to_world=np.zeros((1, 3, 4), np.float32),
        radiance=np.zeros((1, 3), np.float32),
        size=np.zeros((1, 2), np.float32),
        texture=np.full(1, -1, np.int32),
        surface=np.full(1, -1, np.int32),
        triangle_begin=np.zeros(2, np.int64),
        triangle=np.empty(0, np.int32),
        triangle_instance=np.empty(0, np.int32),
    )
    alone = replace(scene, lights=row, light_paths=(path,), light_controls=())
    return changed_light(images, alone, to_world=to_world, radiance=radiance, size=size, texture=texture)
