"""A snapshot as a LuxCore scene, rendered by its path tracer with the PhotonGI cache.

Diffuse surfaces without textures, rectangles that shine and emissive meshes: what a Cornell box has.
"""

from __future__ import annotations

import importlib.util
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from icheat_usd.scene import F64, LightKind, SceneSnapshot
from tools.peers.mitsuba_peer import Part, refuse_controls, world_parts

#: Radius of a look-up of the cache, in radii of the scene, and how many records it may have. With three times the
#: radius a Cornell box was 20 % too bright, with this one 1.5 % too dark, after the same time.
_LOOKUP_RADIUS, _MOST_RECORDS = 0.02, 100_000

#: Distance from an emissive surface to each of its two sheets, in radii of the scene.
_SHEET = 5e-5


class LuxCoreScene:
    """A scene for LuxCore.

    Raises
    ------
    ImportError
        `pyluxcore` is not installed.
    ValueError
        A light, texture or camera has no counterpart here.
    """

    def __init__(self, snapshot: SceneSnapshot) -> None:
        if importlib.util.find_spec("pyluxcore") is None:
            raise ImportError("pyluxcore is not installed")
        self._snapshot = snapshot
        self._meshes: list[dict[str, Any]] = []
        self._scene = _camera(snapshot) | {
            "scene.textures.own.type": "hitpointcolor",
            "scene.materials.painted.type": "matte",
            "scene.materials.painted.kd": "own",
        }
        for material, part in world_parts(snapshot).items():
            self._add_part(material, part)
        refuse_controls(snapshot)
        for light in range(len(snapshot.lights.kind)):
            self._add_light(light)

    def render(self, samples: Sequence[int], depth: int) -> list[tuple[F64, float]]:
        """All light (height, width, 3) of paths of up to `depth` segments with so many samples, and seconds.

        The cache is made anew for each, and its time counts.

        Raises
        ------
        RuntimeError
            LuxCore failed.
        """
        told = {"scene": self._scene, "meshes": self._meshes, "renders": [self._settings(n, depth) for n in samples]}
        with tempfile.TemporaryDirectory() as scratch:
            description, images = Path(scratch) / "told.pickle", Path(scratch) / "images.npz"
            description.write_bytes(pickle.dumps(told))
            child = Path(__file__).with_name("luxcore_child.py")
            command = [sys.executable, str(child), str(description), str(images)]
            done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
            if not images.exists():
                raise RuntimeError(f"LuxCore ended with {done.returncode}: {done.stdout[-500:]}")
            with np.load(images) as found:
                return [
                    (found[f"image{i}"].astype(np.float64), float(seconds))
                    for i, seconds in enumerate(found["seconds"])
                ]

    def _settings(self, samples: int, depth: int) -> dict[str, Any]:
        return {
            "renderengine.type": "PATHCPU",
            "renderengine.seed": 1,
            "sampler.type": "SOBOL",
            "sampler.sobol.adaptive.strength": 0.0,
            "film.width": self._snapshot.camera.width,
            "film.height": self._snapshot.camera.height,
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
            "path.photongi.indirect.lookup.radius": float(_LOOKUP_RADIUS * self._snapshot.radius),
            "path.photongi.caustic.enabled": False,
        }

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
        self._scene |= {
            f"{prefix}.type": "matte",
            f"{prefix}.kd": [float(x) for x in reflectance],
            f"{prefix}.emission": [float(x) for x in radiance],
            f"{prefix}.emission.gain": [1.0, 1.0, 1.0],
            f"{prefix}.emission.power": 0.0,
        }

    def _add_mesh(self, name: str, corners: Any, colors: Any, material: str) -> None:
        self._meshes.append({"name": name, "corners": np.asarray(corners), "colors": colors, "material": material})


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
