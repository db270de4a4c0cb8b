"""A stage as every renderer of the suite `rivals` can have it: the same surfaces, lights and camera for all of them.

Surfaces are diffuse. Rectangles, disks and balls that shine block rays in other renderers but not here, so each gets
a black cover just behind it. Lights are neither linked nor shaped.
Those that others lack are left out, for all of them, and named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from icheat_usd.scene import F64, LightKind, SceneSnapshot, Surface
from icheat_usd.stage import open_stage, take_snapshot
from tools.benchmarking.stage_names import short_name
from tools.benchmarking.test_lights import TestLight, add_lights
from tools.peers.mitsuba_peer import as_diffuse, with_lights

EXPORTED = (LightKind.SPHERE, LightKind.DISK, LightKind.RECT, LightKind.DOME, LightKind.MESH)

#: How far behind a light its cover lies, in radii of the scene.
_BEHIND = 1e-4


class RivalScene(NamedTuple):
    """What all renderers render, and what was done to the stage for it."""

    name: str
    snapshot: SceneSnapshot
    left_out: tuple[str, ...]  #: paths of lights
    added: tuple[str, ...]  #: names of lights


def rival_scene(stage: str | Path, width: int, height: int) -> RivalScene:
    """The diffuse version of a stage; one without a light of finite size gets one at the camera."""
    snapshot = take_snapshot(open_stage(stage), width=width, height=height)
    snapshot = replace(as_diffuse(snapshot), light_controls=())
    kinds = [LightKind(int(kind)) for kind in snapshot.lights.kind]
    keep = [i for i, kind in enumerate(kinds) if kind in EXPORTED]
    left_out = tuple(snapshot.light_paths[i] for i in range(len(kinds)) if i not in keep)
    snapshot = with_lights(snapshot, keep)
    added = []
    if not any(kinds[i] != LightKind.DOME for i in keep):
        # At the camera, which stands in free space and looks along -Z as rectangles shine.
        size = (0.1 * snapshot.radius, 0.1 * snapshot.radius)
        added.append(TestLight("addedArea", LightKind.RECT, snapshot.camera.to_world, (5.0, 5.0, 5.0), size))
    if added:
        snapshot = add_lights(snapshot, added)
    return RivalScene(short_name(str(stage)), covered(snapshot), left_out, tuple(light.name for light in added))


def covered(snapshot: SceneSnapshot) -> SceneSnapshot:
    """The scene with a black cover behind every rectangle and disk that shines, and inside every ball."""
    covers = []
    for light in range(len(snapshot.lights.kind)):
        shape = _cover(snapshot, light)
        if shape is not None:
            covers.append((f"{snapshot.light_paths[light]}/Cover", shape))
    return with_black_meshes(snapshot, covers) if covers else snapshot


def with_black_meshes(snapshot: SceneSnapshot, meshes: Sequence[tuple[str, F64]]) -> SceneSnapshot:
    """The scene with more meshes, each a path and (n, 3, 3) world-space corners, that reflect nothing."""
    geometry, materials = snapshot.geometry, snapshot.materials
    black = len(materials.diffuse)
    more = materials._replace(**{name: np.concatenate([x, x[:1]]) for name, x in materials._asdict().items()})
    more.diffuse[black], more.emission[black], more.specular[black] = 0, 0, 0
    more.texture[black], more.use_display_color[black], more.use_specular[black] = -1, 0, 0
    more.metallic[black], more.opacity[black], more.opacity_threshold[black], more.ior[black] = 0, 1, 0, 1
    corners = np.concatenate([shape for _, shape in meshes]).astype(np.float32)
    counts = np.array([len(shape) for _, shape in meshes])
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    n, n_meshes = len(corners), len(meshes)
    columns = {
        "points": corners,
        "normals": np.repeat(normal[:, None], 3, axis=1),
        "st": np.zeros((n, 3, 2)),
        "color": np.zeros((n, 3, 3)),
        "face": np.concatenate([np.arange(count) for count in counts]),
        "face_uv": np.zeros((n, 3, 2)),
        "material": np.full(n, black),
        "mesh_begin": geometry.mesh_begin[-1] + np.cumsum(counts),
        "mesh_double_sided": np.ones(n_meshes),
        "instance_mesh": len(geometry.mesh_begin) - 1 + np.arange(n_meshes),
        "instance_surface": len(snapshot.surfaces) + np.arange(n_meshes),
        "instance_to_world": np.tile(np.eye(3, 4), (n_meshes, 1, 1)),
        "instance_to_object": np.tile(np.eye(3, 4), (n_meshes, 1, 1)),
        "instance_flip": np.zeros(n_meshes),
    }
    grown = {
        name: np.ascontiguousarray(
            np.concatenate([getattr(geometry, name), column.astype(getattr(geometry, name).dtype)])
        )
        for name, column in columns.items()
    }
    surfaces = tuple(Surface(path, n_faces=len(shape)) for path, shape in meshes)
    return replace(
        snapshot,
        geometry=geometry._replace(**grown),
        materials=more,
        material_paths=(*snapshot.material_paths, "/Black"),
        surfaces=(*snapshot.surfaces, *surfaces),
    )


def _cover(snapshot: SceneSnapshot, light: int) -> F64 | None:
    """World-space triangles (n, 3, 3) of the cover of a light; None for lights that are no shapes."""
    lights = snapshot.lights
    kind, size = LightKind(int(lights.kind[light])), lights.size[light].astype(float)
    if kind == LightKind.RECT:
        x, y = size / 2
        ring = np.array([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)])
    elif kind == LightKind.DISK:
        angle = np.linspace(0, 2 * np.pi, 128, endpoint=False)
        ring = size[0] * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    elif kind == LightKind.SPHERE:
        return _to_world(_ball(0.999 * size[0]), lights.to_world[light])
    else:
        return None
    fan = np.stack([np.repeat(ring[:1], len(ring) - 2, axis=0), ring[1:-1], ring[2:]], axis=1)
    flat = _to_world(fan, lights.to_world[light])
    behind = lights.to_world[light].astype(float)[:, 2]
    return flat + _BEHIND * snapshot.radius * behind / np.linalg.norm(behind)


def _ball(radius: float) -> F64:
    """Triangles (n, 3, 3) of a ball about the origin."""
    polar, around = np.linspace(0, np.pi, 33), np.linspace(0, 2 * np.pi, 65)
    place = radius * np.stack(
        [
            np.sin(polar)[:, None] * np.cos(around),
            np.cos(polar)[:, None] * np.ones(65),
            np.sin(polar)[:, None] * np.sin(around),
        ],
        axis=2,
    )
    a, b, c, d = place[:-1, :-1], place[1:, :-1], place[1:, 1:], place[:-1, 1:]
    low = np.stack([a[1:], c[1:], b[1:]], axis=2).reshape(-1, 3, 3)
    high = np.stack([a[:-1], d[:-1], c[:-1]], axis=2).reshape(-1, 3, 3)
    # Rows at the poles would have triangles without an area.
    pole = np.stack([a[0], c[0], b[0]], axis=1)
    other = np.stack([a[-1], d[-1], b[-1]], axis=1)
    return np.concatenate([low[:-64], high[64:], pole, other])


def _to_world(triangles: F64, matrix: np.ndarray) -> F64:
    matrix = matrix.astype(float)
    return np.asarray(triangles @ matrix[:, :3].T + matrix[:, 3])
