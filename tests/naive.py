"""A slow, plain renderer that shares no code with the package's kernels.

Brute-force ray casting against every triangle in double precision, NumPy's own
random numbers, light sampling by area, and one path per sample. Diffuse, opaque, untextured
surfaces; rect lights, emissive triangles and an untextured dome.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from icheat_usd.scene import LightKind, SceneSnapshot

Array = NDArray[np.float64]

#: Edited light of one gather ray: (pixel hits, caster hits, light) -> light. Indices are rows of world triangles.
PairEdit = Callable[[NDArray[np.int64], NDArray[np.int64], Array], Array]


@dataclass
class NaiveScene:
    """World-space triangles with constant colours, and lights as (corner, edge, edge, radiance, one_sided)."""

    corners: Array  #: (n, 3, 3)
    normals: Array  #: (n, 3)
    albedo: Array  #: (n, 3)
    emission: Array  #: (n, 3)
    instance: NDArray[np.int64]
    patches: list[tuple[Array, Array, Array, Array, bool, bool]]  #: corner, edges, radiance, triangle?, one-sided?
    dome: Array  #: (3,)
    size: float

    @classmethod
    def of(cls, snapshot: SceneSnapshot) -> NaiveScene:
        geometry, materials, lights = snapshot.geometry, snapshot.materials, snapshot.lights
        corners, albedo, emission, instance = [], [], [], []
        for i in range(snapshot.n_instances):
            mesh = geometry.instance_mesh[i]
            rows = slice(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1])
            m = geometry.instance_to_world[i].astype(float)
            corners.append(geometry.points[rows].astype(float) @ m[:, :3].T + m[:, 3])
            material = geometry.material[rows]
            colour = np.where(
                materials.use_display_color[material][:, None] == 1,
                geometry.color[rows][:, 0],
                materials.diffuse[material],
            )
            albedo.append(colour.astype(float))
            emission.append(materials.emission[material].astype(float))
            instance.append(np.full(len(material), i))
        corner = np.concatenate(corners)
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        patches, dome = [], np.zeros(3)
        light_emission = np.concatenate(emission)
        for k in np.flatnonzero(light_emission.any(axis=1)):
            a, b, c = corner[k]
            patches.append((a, b - a, c - a, light_emission[k], True, False))
        for light in range(len(lights.kind)):
            m = lights.to_world[light].astype(float)
            radiance = lights.radiance[light].astype(float)
            if lights.kind[light] == LightKind.RECT:
                w, h = lights.size[light].astype(float)
                low = m @ np.array([-w / 2, -h / 2, 0, 1])
                # Edges in this order make the cross product point along local -Z, where it emits (unless mirrored).
                patches.append((low, m[:, :3] @ [0, h, 0], m[:, :3] @ [w, 0, 0], radiance, False, True))
            elif lights.kind[light] == LightKind.DOME:
                dome = dome + radiance
        normals = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        return cls(
            corner,
            normals,
            np.concatenate(albedo),
            light_emission,
            np.concatenate(instance),
            patches,
            dome,
            float(np.ptp(corner.reshape(-1, 3), axis=0).max()),
        )

    def cast(self, origin: Array, direction: Array) -> tuple[Array, NDArray[np.int64]]:
        """Distance and triangle of the nearest hit; -1 for none (Moller-Trumbore against all).

        Its triple products are written as products of matrices, (rays, triangles): a loop over triangles took eight
        times as long.
        """
        a, e1, e2 = self.corners[:, 0], self.corners[:, 1] - self.corners[:, 0], self.corners[:, 2] - self.corners[:, 0]
        n, moment = np.cross(e1, e2), np.cross(origin, direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = -1 / (direction @ n.T)
            t = (origin @ n.T - np.einsum("ij,ij->i", a, n)) * inverse
            u = (moment @ e2.T - direction @ np.cross(e2, a).T) * inverse
            v = (direction @ np.cross(e1, a).T - moment @ e1.T) * inverse
            is_hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-7 * self.size)
        t = np.where(is_hit, t, np.inf)
        triangle = t.argmin(axis=1)
        distance = t[np.arange(len(t)), triangle]
        return distance, np.where(distance < np.inf, triangle, -1)

    def facing(self, triangle: NDArray[np.int64], direction: Array) -> Array:
        """Normals on the side that rays along `direction` hit."""
        normal = self.normals[triangle]
        return np.where(np.einsum("ij,ij->i", normal, direction)[:, None] > 0, -normal, normal)

    def irradiance(self, position: Array, normal: Array, rng: np.random.Generator) -> Array:
        """One sample of each light and of the dome."""
        n = len(position)
        start = position + normal * 1e-6 * self.size
        total = np.zeros((n, 3))
        for corner, e1, e2, radiance, is_triangle, one_sided in self.patches:
            u, v = rng.random((2, n))
            if is_triangle:
                outside = u + v > 1
                u, v = np.where(outside, 1 - u, u), np.where(outside, 1 - v, v)
            cross = np.cross(e1, e2)
            area = np.linalg.norm(cross) * (0.5 if is_triangle else 1.0)
            towards = corner + u[:, None] * e1 + v[:, None] * e2 - start
            r2 = np.einsum("ij,ij->i", towards, towards)
            w = towards / np.sqrt(r2)[:, None]
            cos_light = -(w @ cross) / np.linalg.norm(cross)
            cos_light = np.maximum(cos_light, 0) if one_sided else np.abs(cos_light)
            cos_here = np.maximum(np.einsum("ij,ij->i", w, normal), 0)
            distance, _ = self.cast(start, w)
            seen = distance > np.sqrt(r2) - 1e-5 * self.size
            total += (seen * cos_here * cos_light / r2 * area)[:, None] * radiance
        if self.dome.any():
            w = cosine_directions(normal, rng)
            _, triangle = self.cast(start, w)
            total += np.pi * (triangle < 0)[:, None] * self.dome
        return total


def cosine_directions(normal: Array, rng: np.random.Generator) -> Array:
    """Cosine-weighted: a point on the unit sphere about the tip of the normal."""
    z = rng.uniform(-1, 1, len(normal))
    phi = rng.uniform(0, 2 * np.pi, len(normal))
    r = np.sqrt(1 - z * z)
    w = normal * (1 + 1e-9) + np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)
    return w / np.linalg.norm(w, axis=1, keepdims=True)


def render(
    snapshot: SceneSnapshot, *, samples: int, n_bounces: int, seed: int = 0, edit: PairEdit | None = None
) -> dict[str, Array]:
    """Layers (height, width, 3): emission, direct, indirect, indirect_edited; rays through pixel centres.

    `n_bounces` diffuse reflections before the last one.
    """
    rng = np.random.default_rng(seed)
    scene, camera = NaiveScene.of(snapshot), snapshot.camera
    left, right, bottom, top = camera.window
    x = left + (np.arange(camera.width) + 0.5) / camera.width * (right - left)
    y = top - (np.arange(camera.height) + 0.5) / camera.height * (top - bottom)
    local = np.stack([*np.meshgrid(x, y), -np.ones((camera.height, camera.width))], axis=-1).reshape(-1, 3)
    direction = local @ camera.to_world[:, :3].T
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    eye = np.repeat(camera.to_world[None, :, 3], len(direction), axis=0)
    distance, triangle = scene.cast(eye, direction)
    hit = np.flatnonzero(triangle >= 0)
    first = triangle[hit]
    position = eye[hit] + distance[hit, None] * direction[hit]
    normal = scene.facing(first, direction[hit])
    layers = {name: np.zeros((len(direction), 3)) for name in ("emission", "direct", "indirect", "indirect_edited")}
    layers["emission"][hit] = scene.emission[first]
    layers["emission"][triangle < 0] = scene.dome
    for _ in range(samples):
        layers["direct"][hit] += scene.albedo[first] / np.pi * scene.irradiance(position, normal, rng) / samples
        caster, brought = _gather(scene, position, normal, n_bounces, rng)
        layers["indirect"][hit] += scene.albedo[first] * brought / samples
        changed = brought if edit is None else edit(first, caster, brought)
        layers["indirect_edited"][hit] += scene.albedo[first] * changed / samples
    return {name: values.reshape(camera.height, camera.width, 3) for name, values in layers.items()}


def _gather(
    scene: NaiveScene, position: Array, normal: Array, n_bounces: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """One gather ray per point: the triangle it hits (-1: none) and the reflected light it brings."""
    carried = np.ones((len(position), 3))
    brought = np.zeros((len(position), 3))
    caster = np.full(len(position), -1)
    alive = np.arange(len(position))
    for bounce in range(n_bounces):
        direction = cosine_directions(normal, rng)
        distance, triangle = scene.cast(position + normal * 1e-6 * scene.size, direction)
        on = triangle >= 0
        alive, triangle = alive[on], triangle[on]
        if bounce == 0:
            caster[alive] = triangle
        position = position[on] + distance[on, None] * direction[on]
        normal = scene.facing(triangle, direction[on])
        carried = carried[on] * scene.albedo[triangle]
        brought[alive] += carried / np.pi * scene.irradiance(position, normal, rng)
    return caster, brought
