"""A snapshot as a Mitsuba 3 scene, so that both render the same triangles, lights and camera.

Diffuse surfaces only: call `as_diffuse` first and render that with both.
Rect, disk and sphere lights become shapes, which block rays and show
themselves here; keep them out of the camera's view and of other lights' way.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from icheat_usd.materials import points_on_surface
from icheat_usd.scene import F32, F64, LightKind, SceneSnapshot

#: Radiance layers by the longest path that Mitsuba follows: camera to surface to light is 2.
EMISSION, DIRECT, ONE_BOUNCE, MANY = 1, 2, 3, 18


def as_diffuse(snapshot: SceneSnapshot) -> SceneSnapshot:
    """The same scene with every interface, metal and translucency taken away."""
    from dataclasses import replace

    materials = snapshot.materials
    ones, zeros = np.ones_like(materials.ior), np.zeros_like(materials.ior)
    textures = materials.texture.copy()
    textures[:, 2:] = -1
    changed = materials._replace(
        ior=ones,
        metallic=zeros,
        opacity=ones.copy(),
        opacity_threshold=zeros.copy(),
        use_specular=np.zeros_like(materials.use_specular),
        texture=textures,
    )
    return replace(snapshot, materials=changed)


def mitsuba_scene(mi: Any, snapshot: SceneSnapshot) -> Any:
    """Build the scene with the variant that is set on `mi`.

    Textures are baked to one colour per triangle corner, so use scenes whose
    textures are plain, or finely tessellated, where this must be exact.
    """
    scene: dict[str, Any] = {"type": "scene"}
    geometry = snapshot.geometry
    for instance in range(snapshot.n_instances):
        mesh = geometry.instance_mesh[instance]
        rows = np.arange(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1])
        for material in np.unique(geometry.material[rows]):
            scene.update(_mesh(mi, snapshot, instance, rows[geometry.material[rows] == material]))
    for light in range(len(snapshot.lights.kind)):
        scene.update(_light(mi, snapshot, light))
    return mi.load_dict(scene)


def render(mi: Any, scene: Any, snapshot: SceneSnapshot, *, depth: int, samples: int, seed: int = 0) -> F64:
    """Radiance (height, width, 3) of paths of up to `depth` segments."""
    integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 10_000})
    sensor = _sensor(mi, snapshot)
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=seed), np.float64)[..., :3]


def _world(snapshot: SceneSnapshot, instance: int, rows: Any) -> F32:
    matrix = snapshot.geometry.instance_to_world[instance]
    return (snapshot.geometry.points[rows] @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32)


def _mesh(mi: Any, snapshot: SceneSnapshot, instance: int, rows: Any) -> dict[str, Any]:
    corners = _world(snapshot, instance, rows).reshape(-1, 3)
    n = len(rows)
    bary = np.array([[0, 0], [1, 0], [0, 1]], np.float32)
    # Slightly inside the corners, so that nearest texels at seams belong to the triangle.
    bary = (bary + np.float32(1e-3) * (np.float32(1 / 3) - bary)).astype(np.float32)
    points = points_on_surface(
        snapshot,
        np.full(3 * n, instance, np.int32),
        np.repeat(rows, 3).astype(np.int32),
        np.tile(bary, (n, 1)),
        np.zeros(3 * n, np.uint8),
    )
    result: dict[str, Any] = {}
    emission = points.emission.mean(axis=0)
    sides = (1, -1) if emission.any() else (1,)
    for side in sides:
        normal = points.normal
        shift = np.float32(2e-5 * snapshot.radius) if emission.any() else np.float32(0)
        positions = corners + np.float32(side) * shift * normal
        faces = np.arange(3 * n, dtype=np.uint32).reshape(-1, 3)
        faces = faces if side > 0 else faces[:, ::-1]
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict(
            {
                "type": "twosided",
                "bsdf": {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}},
            }
        )
        if emission.any():
            properties["emitter"] = mi.load_dict(
                {"type": "area", "radiance": {"type": "rgb", "value": [float(x) for x in emission]}}
            )
        mesh = mi.Mesh(f"mesh{instance}_{rows[0]}_{side}", 3 * n, n, props=properties)
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = np.ascontiguousarray(positions).ravel()
        parameters["faces"] = np.ascontiguousarray(faces).ravel()
        mesh.add_attribute("vertex_color", 3, np.ascontiguousarray(points.albedo).ravel())
        parameters.update()
        result[f"mesh{instance}_{rows[0]}_{'front' if side > 0 else 'back'}"] = mesh
    return result


def _transform(mi: Any, matrix: F32) -> Any:
    return mi.ScalarTransform4f(np.vstack([matrix, [0, 0, 0, 1]]).astype(np.float64).tolist())


def _light(mi: Any, snapshot: SceneSnapshot, light: int) -> dict[str, Any]:
    lights = snapshot.lights
    kind = LightKind(int(lights.kind[light]))
    to_world = _transform(mi, lights.to_world[light])
    radiance = {"type": "rgb", "value": [float(x) for x in lights.radiance[light]]}
    size = [float(x) for x in lights.size[light]]
    about_y = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    name = f"light{light}"
    if kind == LightKind.MESH:
        return {}
    if kind == LightKind.RECT:
        place = to_world @ about_y @ mi.ScalarTransform4f().scale([size[0] / 2, size[1] / 2, 1])
        return {name: {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}}
    if kind == LightKind.DISK:
        place = to_world @ about_y @ mi.ScalarTransform4f().scale([size[0], size[0], 1])
        return {name: {"type": "disk", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}}
    if kind == LightKind.SPHERE:
        place = to_world @ mi.ScalarTransform4f().scale(size[0])
        return {name: {"type": "sphere", "to_world": place, "emitter": {"type": "area", "radiance": radiance}}}
    if kind == LightKind.DOME:
        if lights.texture[light] < 0:
            return {name: {"type": "constant", "radiance": radiance}}
        return {name: _dome(mi, snapshot, light)}
    raise ValueError(f"no Mitsuba counterpart of a {kind.name} light")


def _dome(mi: Any, snapshot: SceneSnapshot, light: int) -> dict[str, Any]:
    """A lat-long dome, resampled to Mitsuba's own parametrisation through our look-up."""
    from icheat_usd.lighting import environment_radiance

    height, width = 256, 512
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    # Mitsuba: direction (sin(phi) sin(theta), cos(theta), -cos(phi) sin(theta)) for its unrotated envmap.
    directions = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)
    pixels = environment_radiance(snapshot, np.ascontiguousarray(directions.reshape(-1, 3), np.float32))
    bitmap = mi.Bitmap(np.ascontiguousarray(pixels.reshape(height, width, 3), np.float32))
    return {"type": "envmap", "bitmap": bitmap}


def _sensor(mi: Any, snapshot: SceneSnapshot) -> Any:
    camera = snapshot.camera
    left, right, bottom, top = camera.window
    if abs(left + right) > 1e-6 * (right - left) or abs(bottom + top) > 1e-6 * (top - bottom):
        raise ValueError("only a centred camera window is exported")
    x, y, z, eye = (camera.to_world[:, k] for k in range(4))
    columns = np.stack([-x, y, -z, eye], axis=1)
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan((right - left) / 2))),
            "near_clip": 1e-4 * snapshot.radius,
            "far_clip": 100 * snapshot.radius,
            "to_world": _transform(mi, columns),
            "film": {
                "type": "hdrfilm",
                "width": camera.width,
                "height": camera.height,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
            "sampler": {"type": "independent"},
        }
    )
