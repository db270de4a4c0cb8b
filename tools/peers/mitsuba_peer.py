"""A snapshot as a Mitsuba 3 scene, so that both render the same triangles, textures, lights and camera.

Diffuse surfaces only: call `as_diffuse` first and render what it returns with both.

Where the two renderers differ by design, the caller arranges the scene so that
the difference is nothing:

- Rect, disk and sphere lights become black shapes, which stop rays and show
  themselves in Mitsuba but not here. Put them behind an equal black mesh or
  outside the space that is looked into.
- Emissive surfaces shine to both sides here. They become two sheets, one for
  each side, 1e-4 of the scene's size apart.
- Distant lights are exported without an angle only.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from icheat_usd.materials import points_on_surface
from icheat_usd.scene import F32, F64, I64, PLAIN, LightKind, SceneSnapshot, Texture

#: Longest path that Mitsuba follows, in segments: camera to surface is 1, on to a light 2.
EMISSION, DIRECT, ONE_BOUNCE = 1, 2, 3

#: Distance from an emissive surface to each of its two sheets, in radii of the scene.
_SHEET = 5e-5

#: Where Debian and Ubuntu put the LLVM that Mitsuba's fast variants compile with; 15 and 16 lack an instruction.
_LLVM = ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", "/usr/lib/aarch64-linux-gnu/libLLVM.so.19.1")


def load(variant: str = "scalar_rgb") -> Any:
    """Mitsuba with a variant set; ``"fast"`` takes the vectorised one where LLVM 19 is installed.

    Raises
    ------
    ImportError
        Mitsuba is not installed.
    """
    import mitsuba as mi

    if variant == "fast":
        library = os.environ.get("DRJIT_LIBLLVM_PATH") or next((p for p in _LLVM if Path(p).exists()), None)
        if library:
            os.environ["DRJIT_LIBLLVM_PATH"] = library
        variant = "llvm_ad_rgb" if library else "scalar_rgb"
    mi.set_variant(variant)
    return mi


def as_diffuse(snapshot: SceneSnapshot) -> SceneSnapshot:
    """The same scene with flat normals and without interfaces, metals, translucency and cut-outs."""
    materials = snapshot.materials
    one, zero = np.ones_like(materials.ior), np.zeros_like(materials.ior)
    texture = materials.texture.copy()
    texture[:, Texture.EMISSION :] = -1
    changed = materials._replace(
        ior=one,
        metallic=zero,
        opacity=one.copy(),
        opacity_threshold=zero.copy(),
        use_specular=np.zeros_like(materials.use_specular),
        texture=texture,
    )
    p = snapshot.geometry.points.astype(float)
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    flat = np.ascontiguousarray(np.repeat(normal[:, None], 3, axis=1), dtype=np.float32)
    return replace(snapshot, materials=changed, geometry=snapshot.geometry._replace(normals=flat))


def with_lights(snapshot: SceneSnapshot, keep: list[int]) -> SceneSnapshot:
    """The same scene with some of its lights; emission of meshes cannot be left out this way."""
    lights = snapshot.lights
    gone = np.setdiff1d(np.flatnonzero(lights.kind == LightKind.MESH), keep)
    if len(gone):
        raise ValueError(f"light {gone[0]} is an emissive mesh, which would go on shining; change its material")
    order = sorted(keep)
    pieces = [np.arange(lights.triangle_begin[k], lights.triangle_begin[k + 1]) for k in order]
    rows = np.concatenate([np.zeros(0, np.int64), *pieces])
    counts = [len(piece) for piece in pieces]
    kept = lights._replace(
        **{name: np.ascontiguousarray(getattr(lights, name)[order]) for name in lights._fields[:6]},
        triangle_begin=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        triangle=np.ascontiguousarray(lights.triangle[rows]),
        triangle_instance=np.ascontiguousarray(lights.triangle_instance[rows]),
    )
    controls = tuple(snapshot.controls(k) for k in order) if snapshot.light_controls else ()
    paths = tuple(snapshot.light_paths[k] for k in order)
    return replace(snapshot, lights=kept, light_paths=paths, light_controls=controls)


def refuse_controls(snapshot: SceneSnapshot) -> None:
    """Raise a ValueError for lights that are linked, shaped or multiplied, which no peer does alike."""
    for path, controls in zip(snapshot.light_paths, snapshot.light_controls, strict=bool(snapshot.light_controls)):
        if controls is not PLAIN:
            raise ValueError(f"light {path} is linked, shaped or has multipliers, which peers do not get; leave it out")


def mitsuba_scene(mi: Any, snapshot: SceneSnapshot) -> Any:
    """Build the scene with the variant that is set on `mi`.

    Raises
    ------
    ValueError
        A light, texture or material has no counterpart in Mitsuba.
    """
    scene: dict[str, Any] = {"type": "scene"}
    for material, part in world_parts(snapshot).items():
        scene.update(_meshes(mi, snapshot, material, part))
    refuse_controls(snapshot)
    for light in range(len(snapshot.lights.kind)):
        scene.update(_light(mi, snapshot, light))
    return mi.load_dict(scene)


def render(
    mi: Any,
    scene: Any,
    snapshot: SceneSnapshot,
    *,
    depth: int,
    samples: int,
    seed: int = 0,
    hide_emitters: bool = False,
    roulette: int = 10_000,
) -> F64:
    """Radiance (height, width, 3) of paths of up to `depth` segments, by default without Russian roulette.

    With `hide_emitters` the light that the camera sees straight from its source is left out; from `roulette` segments
    on paths may be ended at random.
    """
    integrator = mi.load_dict(
        {"type": "path", "max_depth": depth, "rr_depth": roulette, "hide_emitters": hide_emitters}
    )
    image = mi.render(scene, sensor=_sensor(mi, snapshot), integrator=integrator, spp=samples, seed=seed)
    return np.array(image, np.float64)[..., :3]


class Part(NamedTuple):
    """Corners of n triangles in world space, (3 n, ...) each, counter-clockwise seen from the front."""

    position: F64
    normal: F32
    shading_normal: F32
    color: F32
    st: F32


def world_parts(snapshot: SceneSnapshot) -> dict[int, Part]:
    """Triangles by row of their material; those without a texture and emission are row -1, with their own colours.

    Fewer shapes compile and render faster.
    """
    geometry, materials = snapshot.geometry, snapshot.materials
    parts: dict[int, list[Part]] = {}
    for instance in range(snapshot.n_instances):
        mesh = geometry.instance_mesh[instance]
        rows = np.arange(geometry.mesh_begin[mesh], geometry.mesh_begin[mesh + 1])
        for material in np.unique(geometry.material[rows]):
            plain = materials.texture[material, Texture.DIFFUSE] < 0 and not materials.emission[material].any()
            part = _part(snapshot, instance, rows[geometry.material[rows] == material])
            parts.setdefault(-1 if plain else int(material), []).append(part)
    return {
        material: Part(*(np.concatenate(column) for column in zip(*pieces, strict=True)))
        for material, pieces in parts.items()
    }


def _part(snapshot: SceneSnapshot, instance: int, rows: I64) -> Part:
    geometry = snapshot.geometry
    n = len(rows)
    # Slightly inside the corners, so that normals and colours belong to the triangle and to no neighbour.
    bary = np.array([[0, 0], [1, 0], [0, 1]], np.float32)
    bary = (bary + np.float32(1e-3) * (np.float32(1 / 3) - bary)).astype(np.float32)
    points = points_on_surface(
        snapshot,
        np.full(3 * n, instance, np.int32),
        np.repeat(rows, 3).astype(np.int32),
        np.tile(bary, (n, 1)),
        np.zeros(3 * n, np.uint8),
    )
    to_world = geometry.instance_to_world[instance].astype(float)
    corners = geometry.points[rows].astype(float).reshape(-1, 3) @ to_world[:, :3].T + to_world[:, 3]
    part = Part(corners, points.normal, points.shading_normal, points.albedo, geometry.st[rows].reshape(-1, 2))
    if not geometry.instance_flip[instance]:
        return part
    order = np.arange(3 * n).reshape(-1, 3)[:, ::-1].ravel()
    return Part(*(column[order] for column in part))


def _meshes(mi: Any, snapshot: SceneSnapshot, material: int, part: Part) -> dict[str, Any]:
    """Triangles as one mesh, or as two where they emit; material -1 stands for colours at the corners."""
    n = len(part.position) // 3
    emission = np.zeros(3) if material < 0 else snapshot.materials.emission[material]
    front = np.arange(3 * n, dtype=np.uint32).reshape(-1, 3)
    smooth = bool(np.abs(part.shading_normal - part.normal).max() > 1e-3)
    if smooth and emission.any():
        raise ValueError(f"{snapshot.material_paths[material]} emits on smooth normals; call as_diffuse first")
    result: dict[str, Any] = {}
    for side in (1, -1) if emission.any() else (0,):
        properties = mi.Properties()
        reflectance = _reflectance(mi, snapshot, material, part)
        properties["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}})
        if side:
            properties["emitter"] = mi.load_dict(
                {"type": "area", "radiance": {"type": "rgb", "value": [float(x) for x in emission]}}
            )
        name = f"mesh{material % 10_000}_{side % 3}"
        textured = reflectance["type"] != "mesh_attribute"
        mesh = mi.Mesh(name, 3 * n, n, properties, smooth, textured)
        if not textured:
            colors = part.color[::3] if reflectance["name"] == "face_color" else part.color
            mesh.add_attribute(reflectance["name"], 3, np.ascontiguousarray(colors).ravel())
        parameters = mi.traverse(mesh)
        positions = part.position + side * _SHEET * snapshot.radius * part.normal
        parameters["vertex_positions"] = np.ascontiguousarray(positions, dtype=np.float32).ravel()
        parameters["faces"] = np.ascontiguousarray(front if side >= 0 else front[:, ::-1]).ravel()
        if smooth:
            parameters["vertex_normals"] = np.ascontiguousarray(part.shading_normal).ravel()
        if textured:
            parameters["vertex_texcoords"] = _texture_coordinates(snapshot, material, part.st).ravel()
        parameters.update()
        result[name] = mesh
    return result


def _reflectance(mi: Any, snapshot: SceneSnapshot, material: int, part: Part) -> dict[str, Any]:
    materials, textures = snapshot.materials, snapshot.textures
    image = -1 if material < 0 else int(materials.texture[material, Texture.DIFFUSE])
    if image < 0:
        # Colours of corners are interpolated by coordinates that Mitsuba finds anew, and that slivers do not have.
        corners = part.color.reshape(-1, 3, 3)
        even = bool((corners == corners[:, :1]).all())
        return {"type": "mesh_attribute", "name": "face_color" if even else "vertex_color"}
    if materials.texture_channel[material, Texture.DIFFUSE] != -1:
        raise ValueError(f"{snapshot.material_paths[material]}: only RGB textures are exported")
    wraps = {0: "repeat", 1: "clamp", 2: "mirror"}
    s, t = (int(x) for x in textures.wrap[image])
    if s != t or s not in wraps:
        raise ValueError(f"{snapshot.material_paths[material]}: only equal wrap modes, not black, are exported")
    width, height, begin = int(textures.width[image]), int(textures.height[image]), int(textures.begin[image])
    texels = textures.texels[begin : begin + width * height, :3].reshape(height, width, 3)
    texels = (
        texels * materials.texture_scale[material, Texture.DIFFUSE, :3]
        + materials.texture_bias[material, Texture.DIFFUSE, :3]
    )
    bitmap = mi.Bitmap(np.ascontiguousarray(np.clip(texels, 0, 1), dtype=np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear", "wrap_mode": wraps[s]}


def _texture_coordinates(snapshot: SceneSnapshot, material: int, st: F32) -> F32:
    """Mitsuba's v grows downwards from the first row of the image."""
    matrix = snapshot.materials.texture_transform[material, Texture.DIFFUSE].astype(float)
    moved = st.astype(float) @ matrix[:, :2].T + matrix[:, 2]
    return np.ascontiguousarray(np.stack([moved[:, 0], 1 - moved[:, 1]], axis=1), dtype=np.float32)


def _transform(mi: Any, matrix: F32) -> Any:
    return mi.ScalarTransform4f(np.vstack([matrix, [0, 0, 0, 1]]).astype(np.float64).tolist())


def _light(mi: Any, snapshot: SceneSnapshot, light: int) -> dict[str, Any]:
    lights = snapshot.lights
    kind = LightKind(int(lights.kind[light]))
    to_world = _transform(mi, lights.to_world[light])
    radiance = {"type": "rgb", "value": [float(x) for x in lights.radiance[light]]}
    size = [float(x) for x in lights.size[light]]
    name = f"light{light}"
    if kind == LightKind.MESH:
        return {}
    if kind == LightKind.DOME:
        if lights.texture[light] < 0:
            return {name: {"type": "constant", "radiance": radiance}}
        return {name: _dome(mi, snapshot, light)}
    if lights.texture[light] >= 0:
        raise ValueError(f"{snapshot.light_paths[light]}: textures are exported on domes only")
    # Mitsuba's flat shapes emit along +Z, ours along -Z.
    about_y = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    if kind == LightKind.RECT:
        shape, place = "rectangle", to_world @ about_y @ mi.ScalarTransform4f().scale([size[0] / 2, size[1] / 2, 1])
    elif kind == LightKind.DISK:
        shape, place = "disk", to_world @ about_y @ mi.ScalarTransform4f().scale([size[0], size[0], 1])
    elif kind == LightKind.SPHERE:
        shape, place = "sphere", to_world @ mi.ScalarTransform4f().scale(size[0])
    else:
        raise ValueError(f"{snapshot.light_paths[light]}: no Mitsuba counterpart of a {kind.name} light")
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    return {name: {"type": shape, "to_world": place, "bsdf": black, "emitter": {"type": "area", "radiance": radiance}}}


def _dome(mi: Any, snapshot: SceneSnapshot, light: int) -> dict[str, Any]:
    """A lat-long dome in the same frame, centre of the image along +Z.

    Mitsuba's first and last rows lie on the poles, ours half a texel inside.
    Twice as many rows, interpolated, make both the same piecewise linear function.
    """
    lights, textures = snapshot.lights, snapshot.textures
    image = int(lights.texture[light])
    width, height, begin = int(textures.width[image]), int(textures.height[image]), int(textures.begin[image])
    texels = textures.texels[begin : begin + width * height, :3].reshape(height, width, 3).astype(float)
    place = np.clip(np.arange(2 * height + 1) / 2 - 0.5, 0, height - 1)
    low = np.minimum(place.astype(int), max(height - 2, 0))
    high, f = np.minimum(low + 1, height - 1), (place - low)[:, None, None]
    rows = (texels[low] * (1 - f) + texels[high] * f) * lights.radiance[light]
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(rows, dtype=np.float32)),
        "to_world": _transform(mi, lights.to_world[light]),
    }


def _sensor(mi: Any, snapshot: SceneSnapshot) -> Any:
    camera = snapshot.camera
    left, right, bottom, top = camera.window
    if camera.orthographic or camera.lens_radius > 0:
        raise ValueError(f"{camera.path}: only pinhole cameras are exported")
    if abs(left + right) > 1e-6 * (right - left) or abs(bottom + top) > 1e-6 * (top - bottom):
        raise ValueError(f"{camera.path}: only centred camera windows are exported")
    x, y, z, eye = (camera.to_world[:, k] for k in range(4))
    # Mitsuba looks along +Z with +X to the left.
    columns = np.stack([-x, y, -z, eye], axis=1)
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(np.degrees(2 * np.arctan((right - left) / 2))),
            "near_clip": max(camera.near, 1e-4 * snapshot.radius),
            "far_clip": min(camera.far, 1e3 * snapshot.radius),
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
