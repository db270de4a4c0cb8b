"""A snapshot as a LuxCore scene, rendered by its path tracer with the PhotonGI cache.

Diffuse surfaces without textures, rectangles that shine and emissive meshes: what a Cornell box has.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from icheat_usd.scene import F64, LightKind, SceneSnapshot
from tools.peers.mitsuba_peer import Part, refuse_controls, world_parts

#: Radius of a look-up of the cache, in radii of the scene, and how many records it may have.
_LOOKUP_RADIUS, _MOST_RECORDS = 0.06, 100_000

#: Distance from an emissive surface to each of its two sheets, in radii of the scene.
_SHEET = 5e-5


class LuxCoreScene:
    """A scene in LuxCore.

    Raises
    ------
    ImportError
        `pyluxcore` is not installed.
    ValueError
        A light, texture or camera has no counterpart here.
    """

    def __init__(self, snapshot: SceneSnapshot) -> None:
        try:
            import pyluxcore  # NumPy has to be loaded first, which is done above
        except ImportError as error:
            raise ImportError("pyluxcore is not installed") from error
        pyluxcore.Init()
        self._lux, self._snapshot = pyluxcore, snapshot
        self._scene = pyluxcore.Scene()
        self._set(_camera(snapshot))
        self._set({"scene.textures.own.type": "hitpointcolor"})
        self._set({"scene.materials.painted.type": "matte", "scene.materials.painted.kd": "own"})
        for material, part in world_parts(snapshot).items():
            self._add_part(material, part)
        refuse_controls(snapshot)
        for light in range(len(snapshot.lights.kind)):
            self._add_light(light)

    def render(self, samples: int, depth: int, seed: int = 1) -> F64:
        """All light (height, width, 3) of paths of up to `depth` segments; the cache is made anew each time."""
        width, height = self._snapshot.camera.width, self._snapshot.camera.height
        settings = {
            "renderengine.type": "PATHCPU",
            "renderengine.seed": seed,
            "sampler.type": "SOBOL",
            "sampler.sobol.adaptive.strength": 0.0,
            "film.width": width,
            "film.height": height,
            "film.filter.type": "NONE",
            "film.outputs.0.type": "RGB",
            "film.outputs.0.filename": "none.exr",
            "path.pathdepth.total": depth - 1,
            "path.pathdepth.diffuse": depth - 1,
            "path.clamping.variance.maxvalue": 0.0,
            "batch.haltspp": samples,
            "path.photongi.sampler.type": "METROPOLIS",
            "path.photongi.photon.maxdepth": depth - 1,
            "path.photongi.indirect.enabled": True,
            "path.photongi.indirect.maxsize": _MOST_RECORDS,
            "path.photongi.indirect.lookup.radius": _LOOKUP_RADIUS * self._snapshot.radius,
            "path.photongi.caustic.enabled": False,
        }
        session = self._lux.RenderSession(self._lux.RenderConfig(self._properties(settings), self._scene))
        session.Start()
        while not session.HasDone():  # which is found out by looking at the statistics
            time.sleep(0.005)
            session.UpdateStats()
        image = np.zeros(width * height * 3, np.float32)
        session.GetFilm().GetOutputFloat(self._lux.FilmOutputType.RGB, image, 0)
        session.Stop()
        # From the bottom up, and one row too low: found by comparing with other renderers.
        rows = image.reshape(height, width, 3)[::-1]
        return np.concatenate([rows[1:], rows[-1:]]).astype(np.float64)

    def _add_part(self, material: int, part: Part) -> None:
        if material < 0:
            self._add_mesh("painted", part.position, part.color, "painted")
            return
        snapshot = self._snapshot
        emission = snapshot.materials.emission[material]
        if not emission.any():
            raise ValueError(f"textures are not exported to LuxCore, and {snapshot.material_paths[material]} has one")
        for side in (1, -1):
            name = f"shining{material}_{side % 3}"
            self._add_emitter(name, part.color[0], emission)
            corners = part.position + side * _SHEET * snapshot.radius * part.normal
            self._add_mesh(name, corners if side > 0 else corners.reshape(-1, 3, 3)[:, ::-1], None, name)

    def _add_light(self, light: int) -> None:
        lights = self._snapshot.lights
        kind = LightKind(int(lights.kind[light]))
        if kind == LightKind.MESH:
            return
        if kind != LightKind.RECT or lights.texture[light] >= 0:
            raise ValueError(f"{self._snapshot.light_paths[light]}: {kind.name} lights are not exported to LuxCore")
        x, y = lights.size[light].astype(float) / 2
        # Shines along -Z: counter-clockwise seen from there.
        ring = np.array([(-x, -y, 0), (-x, y, 0), (x, y, 0), (x, -y, 0)])
        matrix = lights.to_world[light].astype(float)
        corners = ring[[0, 1, 2, 0, 2, 3]] @ matrix[:, :3].T + matrix[:, 3]
        self._add_emitter(f"light{light}", np.zeros(3), lights.radiance[light])
        self._add_mesh(f"light{light}", corners, None, f"light{light}")

    def _add_emitter(self, name: str, reflectance: Any, radiance: Any) -> None:
        prefix = f"scene.materials.{name}"
        self._set(
            {
                f"{prefix}.type": "matte",
                f"{prefix}.kd": [float(x) for x in reflectance],
                f"{prefix}.emission": [float(x) for x in radiance],
                f"{prefix}.emission.gain": [1.0, 1.0, 1.0],
                f"{prefix}.emission.power": 0.0,
            }
        )

    def _add_mesh(self, name: str, corners: Any, color: Any, material: str) -> None:
        points = [tuple(map(float, point)) for point in np.asarray(corners).reshape(-1, 3)]
        triangles = [(3 * i, 3 * i + 1, 3 * i + 2) for i in range(len(points) // 3)]
        colors = None if color is None else [tuple(map(float, x)) for x in color]
        self._scene.DefineMesh(name, points, triangles, None, None, colors, None)
        self._set({f"scene.objects.{name}.shape": name, f"scene.objects.{name}.material": material})

    def _set(self, values: dict[str, Any]) -> None:
        self._scene.Parse(self._properties(values))

    def _properties(self, values: dict[str, Any]) -> Any:
        properties = self._lux.Properties()
        for name, value in values.items():
            properties.Set(self._lux.Property(name, value))
        return properties


def _camera(snapshot: SceneSnapshot) -> dict[str, Any]:
    camera = snapshot.camera
    left, right, bottom, top = camera.window
    if camera.orthographic or camera.lens_radius > 0 or abs(left + right) + abs(bottom + top) > 1e-6 * (right - left):
        raise ValueError(f"{camera.path}: only pinhole cameras with a centred window are exported to LuxCore")
    eye, up, behind = (camera.to_world[:, k].astype(float) for k in (3, 1, 2))
    return {
        "scene.camera.type": "perspective",
        "scene.camera.lookat.orig": eye.tolist(),
        "scene.camera.lookat.target": (eye - behind).tolist(),
        "scene.camera.up": up.tolist(),
        # For the wider of the two axes.
        "scene.camera.fieldofview": float(np.degrees(2 * np.arctan(max(right, top)))),
        "scene.camera.autofocus.enable": False,
    }
