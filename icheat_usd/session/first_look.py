"""What can be shown before any light is known: the surfaces that the camera sees."""

from __future__ import annotations

import numpy as np

from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F32, F64, I64, Camera, Geometry, Materials, SceneSnapshot, Texture
from icheat_usd.tracing.uncompiled import nearest_triangles

#: Brightness of a surface seen edge-on, over one seen face-on.
_EDGE = 0.25

#: Of all placed triangles, beyond which copies of them would take too long to make.
_MOST_TRIANGLES = 4_000_000

#: Of a texture, that its mean is taken of.
_MOST_TEXELS = 65_521  # a prime: steps through an image do not follow its columns


def surfaces_by_headlight(view: ViewSamples) -> F32:
    """The surfaces in their colours, darker towards their edges, (height, width, 3) scene-linear.

    Needs no kernel but those that placed the view samples.
    """
    facing = np.abs((view.points.normal * view.to_eye).sum(axis=1, keepdims=True))
    image: F32 = develop(view, _lit(view.points.albedo, facing)).reshape(view.height, view.width, 3).astype(np.float32)
    return image


def rough_surfaces(snapshot: SceneSnapshot) -> F32 | None:
    """The same without any kernel, while they are being compiled: one flat colour for each triangle, one ray a pixel.

    None where there are no triangles, or too many to be looked at so.
    """
    camera, geometry = snapshot.camera, snapshot.geometry
    image = np.zeros((camera.height, camera.width, 3), np.float32)
    sizes = np.diff(geometry.mesh_begin)[geometry.instance_mesh]
    if not 0 < sizes.sum() <= _MOST_TRIANGLES:
        return None
    corners, row = _placed(geometry, sizes)
    origins, directions = _central_rays(camera)
    hit = nearest_triangles(corners, origins, directions)
    seen = np.flatnonzero(hit >= 0)
    triangle = corners[hit[seen]].astype(np.float64)
    normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    facing = np.abs((normal * directions[seen]).sum(axis=1, keepdims=True)) / np.maximum(length, 1e-300)
    image.reshape(-1, 3)[seen] = _lit(_colours(snapshot, row[hit[seen]]), facing)
    return image


def _lit(colour: F32, facing: F32 | F64) -> F32:
    """By a lamp at the eye, that leaves some light to what faces away."""
    return (colour * (_EDGE + (1 - _EDGE) * facing)).astype(np.float32)


def _placed(geometry: Geometry, sizes: I64) -> tuple[F32, I64]:
    """Corners (n, 3, 3) of all triangles where they stand, and the row of each in the geometry."""
    begin = np.cumsum(sizes) - sizes
    row = np.arange(sizes.sum()) - np.repeat(begin - geometry.mesh_begin[geometry.instance_mesh], sizes)
    corners = geometry.points[row]
    for i, (first, size) in enumerate(zip(begin.tolist(), sizes.tolist(), strict=True)):
        matrix, some = geometry.instance_to_world[i], corners[first : first + size]
        some[:] = some @ matrix[:, :3].T + matrix[:, 3]
    return corners, row


def _central_rays(camera: Camera) -> tuple[F64, F64]:
    """Origins, on the near plane, and unit directions (n_pixels, 3) through the middles of the pixels and the lens."""
    left, right, bottom, top = camera.window
    x = left + (np.arange(camera.width) + 0.5) / camera.width * (right - left)
    y = top - (np.arange(camera.height) + 0.5) / camera.height * (top - bottom)
    plane = np.stack([*np.broadcast_arrays(x[None], y[:, None]), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
    forward = np.array([0.0, 0.0, -1.0])
    local = (plane, np.broadcast_to(forward, plane.shape)) if camera.orthographic else (0 * plane, plane + forward)
    # In front of the camera -z is 1 on the plane of the window, so this scales directions to the near plane.
    origins = (local[0] + camera.near * local[1]) @ camera.to_world[:, :3].T + camera.to_world[:, 3]
    directions = local[1] @ camera.to_world[:, :3].T
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _colours(snapshot: SceneSnapshot, row: I64) -> F32:
    """Of triangles (n, 3): that of the material, the mean of its texture, or the primvar's at the first corner."""
    materials, material = snapshot.materials, snapshot.geometry.material[row]
    diffuse = np.array([_diffuse(snapshot, i) for i in range(len(materials.diffuse))], np.float32)
    display = materials.use_display_color[material, None] != 0
    found: F32 = np.where(display, snapshot.geometry.color[row, 0], diffuse[material])
    return found


def _diffuse(snapshot: SceneSnapshot, material: int) -> F32:
    materials: Materials = snapshot.materials
    texture = int(materials.texture[material, Texture.DIFFUSE])
    if texture < 0:
        constant: F32 = materials.diffuse[material]
        return constant
    textures = snapshot.textures
    begin = int(textures.begin[texture])
    n = int(textures.width[texture]) * int(textures.height[texture])
    texels = textures.texels[begin : begin + n : 1 + n // _MOST_TEXELS].astype(np.float64)
    scale, bias = materials.texture_scale[material, Texture.DIFFUSE], materials.texture_bias[material, Texture.DIFFUSE]
    # What is see-through does not count: leaves are often green on white.
    weight = np.maximum(texels[:, 3:], 1e-6)
    mean = (texels * weight).sum(axis=0) / weight.sum() * scale + bias
    channel = int(materials.texture_channel[material, Texture.DIFFUSE])
    colour: F32 = (mean[:3] if channel < 0 else np.repeat(mean[channel], 3)).astype(np.float32)
    return colour
