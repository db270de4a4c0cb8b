"""Irradiance by textbook formulas and by plain quadrature, and points to receive it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from icheat_usd.scene import SurfacePoints

F64 = NDArray[np.float64]


def receivers(
    position: ArrayLike,
    normal: ArrayLike,
    *,
    shading_normal: ArrayLike | None = None,
    albedo: ArrayLike = 0.5,
    specular: ArrayLike = 0.0,
    specular_edge: ArrayLike = 0.0,
    roughness: float = 0.5,
) -> SurfacePoints:
    """Free-floating opaque surface points; the instance 0 they name need not be there."""
    position = np.atleast_2d(np.asarray(position, np.float32))
    n = len(position)

    def rows(value: ArrayLike) -> NDArray[np.float32]:
        return np.array(np.broadcast_to(np.asarray(value, np.float32), (n, 3)))

    def column(value: float) -> NDArray[np.float32]:
        return np.full(n, value, np.float32)

    none = np.zeros(n, np.int32)
    normal = rows(normal)
    return SurfacePoints(
        position=np.array(position),
        normal=normal,
        shading_normal=normal.copy() if shading_normal is None else rows(shading_normal),
        instance=none,
        triangle=none.copy(),
        barycentric=np.zeros((n, 2), np.float32),
        side=np.zeros(n, np.uint8),
        face=none.copy(),
        face_uv=np.zeros((n, 2), np.float32),
        albedo=rows(albedo),
        specular=rows(specular),
        specular_edge=rows(specular_edge),
        roughness=column(roughness),
        emission=rows(0.0),
        delta=np.zeros(n, np.uint8),
        opacity=column(1.0),
        ior=column(1.5),
    )


def polygon_irradiance(corners: ArrayLike, point: ArrayLike, normal: ArrayLike) -> float:
    """Lambert's formula for a polygon of radiance 1 that lies wholly above the horizon."""
    rays = np.asarray(corners, float) - np.asarray(point, float)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    total = 0.0
    for a, b in zip(rays, np.roll(rays, -1, axis=0), strict=True):
        edge = np.cross(a, b)
        total += np.arccos(a @ b) * (edge / np.linalg.norm(edge)) @ np.asarray(normal, float)
    return abs(total) / 2


def surface_irradiance(
    shape: Callable[[F64, F64], tuple[F64, F64]],
    to_world: ArrayLike,
    point: ArrayLike,
    normal: ArrayLike,
    n: int = 320,
) -> float:
    """Midpoint quadrature over a surface of radiance 1 that emits along its outward normal.

    `shape` maps (u, v) in [0, 1]^2 to local positions and outward normals; `to_world` carries both
    (normals by the inverse transpose), tangents come from finite differences.
    """
    m = np.asarray(to_world, float)[:3]
    grid = (np.arange(n) + 0.5) / n
    u, v = (axis.ravel() for axis in np.meshgrid(grid, grid, indexing="ij"))
    h = 1e-4

    def place(u: F64, v: F64) -> F64:
        return shape(u, v)[0] @ m[:, :3].T + m[:, 3]

    area = np.cross(place(u + h, v) - place(u - h, v), place(u, v + h) - place(u, v - h)) / (4 * h * h)
    outward = shape(u, v)[1] @ np.linalg.inv(m[:, :3])
    area *= np.sign((area * outward).sum(1, keepdims=True))
    ray = place(u, v) - np.asarray(point, float)
    d2 = (ray**2).sum(1)
    leaving = np.maximum(-(area * ray).sum(1), 0)
    arriving = np.maximum(ray @ np.asarray(normal, float), 0)
    return float((leaving * arriving / d2**2).mean())


def sphere_shape(radius: float) -> Callable[[F64, F64], tuple[F64, F64]]:
    def shape(u: F64, v: F64) -> tuple[F64, F64]:
        theta, phi = np.pi * u, 2 * np.pi * v
        normal = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
        return radius * normal, normal

    return shape


def disk_shape(radius: float) -> Callable[[F64, F64], tuple[F64, F64]]:
    def shape(u: F64, v: F64) -> tuple[F64, F64]:
        phi = 2 * np.pi * v
        place = np.stack([radius * u * np.cos(phi), radius * u * np.sin(phi), 0 * u], -1)
        return place, np.broadcast_to([0.0, 0.0, -1.0], place.shape)

    return shape


def rect_shape(width: float, height: float) -> Callable[[F64, F64], tuple[F64, F64]]:
    def shape(u: F64, v: F64) -> tuple[F64, F64]:
        place = np.stack([width * (u - 0.5), height * (v - 0.5), 0 * u], -1)
        return place, np.broadcast_to([0.0, 0.0, -1.0], place.shape)

    return shape


def cylinder_shape(radius: float, length: float) -> Callable[[F64, F64], tuple[F64, F64]]:
    def shape(u: F64, v: F64) -> tuple[F64, F64]:
        phi = 2 * np.pi * v
        normal = np.stack([0 * u, np.cos(phi), np.sin(phi)], -1)
        return radius * normal + np.stack([length * (u - 0.5), 0 * u, 0 * u], -1), normal

    return shape
