"""Lights as tables of points spread evenly over them."""

from __future__ import annotations

import functools

import numpy as np

from icheat_usd.kernels.clear_light import BALL, RECTANGLE
from icheat_usd.kernels.random import sobol_pair
from icheat_usd.scene import F32, F64, LightKind, SceneSnapshot

N_POINTS = 256  # shadows of a light have so many steps
_OTHER = 0x9E3779B9  # of the seed, for points that know nothing of those of the seed
_ROUND = 1e-4  # how far a ball's squared axes may be from equal


def has_points(kind: int) -> bool:
    """Whether a light can be a table of points: every kind but domes and meshes."""
    return kind not in (LightKind.DOME, LightKind.MESH)


@functools.lru_cache(maxsize=64)
def _numbers(seed: int) -> F64:
    return np.array([sobol_pair(k, seed) for k in range(N_POINTS)], np.float64)


@functools.lru_cache(maxsize=64)
def _opposite_numbers(seed: int) -> F64:
    """Of a ball's points in groups of four: two, each with the one opposite, so that two face a place far away."""
    two = np.stack([_numbers(number)[: N_POINTS // 4] for number in (seed, seed ^ _OTHER)], axis=1)
    opposite = np.stack([1.0 - two[..., 0], (two[..., 1] + 0.5) % 1.0], axis=-1)
    return np.stack([two, opposite], axis=2).reshape(-1, 2)


def light_points(snapshot: SceneSnapshot, seed: int, *, opposite: bool = False) -> tuple[F32, bool]:
    """Points of the one light of a snapshot.

    Parameters
    ----------
    opposite
        Of a ball, two of every four points that follow one another lie opposite the other two. Any few of them are
        evener so, all of them less.

    Returns
    -------
    table : (N_POINTS, 12) float32
        Place, unit normal of the side that shines, colour (of mean 1), and radiance times the area that all points
        stand for; a distant light has directions, and radiance times solid angle (without an angle its radiance is
        an irradiance).
    distant : bool
    """
    lights = snapshot.lights
    kind = LightKind(int(lights.kind[0]))
    linear, origin = lights.to_world[0, :, :3].astype(np.float64), lights.to_world[0, :, 3].astype(np.float64)
    a, b = (float(size) for size in lights.size[0])
    u = (_opposite_numbers if opposite else _numbers)(seed & 0xFFFFFFFF)
    color: F64 = np.ones((1, 3))  # of all points, unless an image says more
    if kind == LightKind.DISTANT:
        place, area = _cone(linear, a, u)
        normal = np.zeros_like(place)
    elif kind in (LightKind.RECT, LightKind.DISK):
        flat = (u - 0.5) * (a, b) if kind == LightKind.RECT else _disk(u) * a
        place = origin + flat @ linear[:, :2].T
        across = _cross(linear[:, 0], linear[:, 1])
        scale = float(np.linalg.norm(across))
        normal = np.broadcast_to(_side(linear) * across / max(scale, 1e-300), place.shape)
        area = np.full(1, scale * (a * b if kind == LightKind.RECT else np.pi * a * a))
        if kind == LightKind.RECT and lights.texture[0] >= 0:
            color = _image(snapshot, 1.0 - u)
    else:
        local, outward, measure = _sphere(a, u) if kind == LightKind.SPHERE else _cylinder(a, b, u)
        place = origin + local @ linear.T
        # an area element with normal n becomes one along cofactor(M) n, larger by that vector's length
        x, y, z = linear
        turned = outward @ np.stack([_cross(y, z), _cross(z, x), _cross(x, y)]).T
        turned *= np.sign(np.linalg.det(linear))
        length = np.linalg.norm(turned, axis=1)
        normal = turned / np.maximum(length, 1e-300)[:, None]
        area = measure * length
    table = np.zeros((N_POINTS, 12), np.float32)
    table[:, :3], table[:, 3:6] = place, normal
    shining = color * lights.radiance[0] * area[:, None]
    mean = shining.mean(axis=1)
    table[:, 9] = mean
    table[:, 6:9] = shining / np.maximum(mean, 1e-300)[:, None]
    return table, kind == LightKind.DISTANT


def light_form(snapshot: SceneSnapshot) -> F32:
    """Form of the one light of a snapshot, for `kernels.clear_light`.

    Returns
    -------
    (6,) of a ball, (14,) of a rectangle without an image, (0,) of others, float32
    """
    lights = snapshot.lights
    kind, (a, b) = LightKind(int(lights.kind[0])), (float(size) for size in lights.size[0])
    linear, origin = lights.to_world[0, :, :3].astype(np.float64), lights.to_world[0, :, 3].astype(np.float64)
    radiance = float(lights.radiance[0].mean())
    if kind == LightKind.SPHERE:
        scale = float(np.linalg.norm(linear[:, 0]))
        if np.allclose(linear.T @ linear, np.eye(3) * scale**2, rtol=0.0, atol=_ROUND * scale**2):
            return np.array([BALL, np.pi * (a * scale) ** 2 * radiance, *origin, a * scale], np.float32)
    elif kind == LightKind.RECT and lights.texture[0] < 0:
        corners = np.array([(-a, -b), (a, -b), (a, b), (-a, b)]) / 2.0 @ linear[:, :2].T + origin
        return np.array([RECTANGLE, -_side(linear) * np.pi * radiance, *corners.ravel()], np.float32)
    return np.zeros(0, np.float32)


def _side(linear: F64) -> float:
    """Whether a flat light shines to where its first two axes turn as a right hand does: 1, or -1.

    The third axis decides it, so that a mirrored light still shines where its own -Z went.
    """
    return 1.0 if _cross(linear[:, 0], linear[:, 1]) @ linear[:, 2] < 0.0 else -1.0


def _cross(a: F64, b: F64) -> F64:
    """Of two vectors (3,): `np.cross` takes ten times as long."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _cone(linear: F64, angle: float, u: F64) -> tuple[F64, F64]:
    axis = linear[:, 2] / max(float(np.linalg.norm(linear[:, 2])), 1e-300)
    if angle <= 0.0:
        return np.broadcast_to(axis, (N_POINTS, 3)), np.ones(1)
    span = 2.0 * np.sin(0.5 * angle) ** 2
    c = u[:, 0] * span
    r, phi = np.sqrt(np.maximum(0.0, c * (2.0 - c))), 2.0 * np.pi * u[:, 1]
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    side = _cross(axis, helper)
    side /= np.linalg.norm(side)
    local = np.stack([r * np.cos(phi), r * np.sin(phi), 1.0 - c], 1)
    return local @ np.stack([side, _cross(axis, side), axis]), np.full(1, 2.0 * np.pi * span)


def _disk(u: F64) -> F64:
    """Concentric map of the unit square to the unit disk (Shirley & Chiu 1997)."""
    a, b = 2.0 * u.T - 1.0
    wide = np.abs(a) > np.abs(b)
    r = np.where(wide, a, b)
    ratio = np.where(wide, b, a) / np.where(r == 0.0, 1.0, r)
    phi = np.where(wide, np.pi / 4.0 * ratio, np.pi / 2.0 - np.pi / 4.0 * ratio)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], 1)


def _sphere(radius: float, u: F64) -> tuple[F64, F64, float]:
    z, phi = 1.0 - 2.0 * u[:, 0], 2.0 * np.pi * u[:, 1]
    r = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    outward = np.stack([r * np.cos(phi), r * np.sin(phi), z], 1)
    return outward * radius, outward, 4.0 * np.pi * radius * radius


def _cylinder(radius: float, length: float, u: F64) -> tuple[F64, F64, float]:
    phi = 2.0 * np.pi * u[:, 1]
    outward = np.stack([0.0 * phi, np.cos(phi), np.sin(phi)], 1)
    local = outward * radius + (u[:, :1] - 0.5) * np.array([length, 0.0, 0.0])
    return local, outward, 2.0 * np.pi * radius * length


def _image(snapshot: SceneSnapshot, st: F64) -> F64:
    """Bilinear lookup of the light's image, clamped at its edges."""
    textures, row = snapshot.textures, int(snapshot.lights.texture[0])
    begin, width, height = int(textures.begin[row]), int(textures.width[row]), int(textures.height[row])
    image = textures.texels[begin : begin + width * height, :3].reshape(height, width, 3)
    x, y = st[:, 0] * width - 0.5, st[:, 1] * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    result = np.zeros((len(st), 3))
    for dy, wy in ((0, 1.0 - (y - y0)), (1, y - y0)):
        for dx, wx in ((0, 1.0 - (x - x0)), (1, x - x0)):
            texel = image[np.clip(y0 + dy, 0, height - 1), np.clip(x0 + dx, 0, width - 1)]
            result += (wx * wy)[:, None] * np.where(np.isfinite(texel), texel, 0.0)
    return result
