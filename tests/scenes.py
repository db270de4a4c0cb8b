"""Small scenes built straight from arrays, so that tests of the core need no USD.

`make_snapshot` is the one builder; `quad_scene`, `closed_box` and `cornell`
are scenes with known answers made with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from icheat_usd.scene import (
    Camera,
    Geometry,
    LightKind,
    Lights,
    Materials,
    SceneSnapshot,
    Surface,
    Texture,
    Textures,
)

Array = NDArray[np.float32]
IDENTITY = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))


@dataclass(frozen=True, eq=False)
class Image:
    """Texels (h, w, 4 or fewer channels), row 0 at the top; `wrap` 0 repeat, 1 clamp, 2 mirror, 3 black."""

    texels: Array
    wrap: tuple[int, int] = (0, 0)


@dataclass(frozen=True, eq=False)
class TextureUse:
    image: Image
    channel: int = -1
    transform: ArrayLike = ((1, 0, 0), (0, 1, 0))
    scale: ArrayLike = (1, 1, 1, 1)
    bias: ArrayLike = (0, 0, 0, 0)


@dataclass(frozen=True, eq=False)
class Material:
    """UsdPreviewSurface inputs; the defaults are a grey diffuse surface WITHOUT an interface (ior 1)."""

    diffuse: ArrayLike = 0.5
    emission: ArrayLike = 0.0
    specular: ArrayLike = 0.0
    use_specular: bool = False
    metallic: float = 0.0
    roughness: float = 0.5
    opacity: float = 1.0
    opacity_threshold: float = 0.0
    ior: float = 1.0
    use_display_color: bool = False
    textures: Mapping[Texture, TextureUse] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in object space and the transforms (3, 4) or (4, 4) that place them (one instance each)."""

    points: ArrayLike  #: (n, 3, 3)
    material: Material | Sequence[Material] | None = None  #: one, or one per triangle; None: the fallback
    transforms: Sequence[ArrayLike] = (IDENTITY,)
    path: str = ""
    normals: ArrayLike | None = None  #: (n, 3, 3); None: flat
    st: ArrayLike | None = None  #: (n, 3, 2)
    color: ArrayLike = 0.18  #: displayColor
    face: ArrayLike | None = None  #: (n,); None: every triangle is a face
    face_uv: ArrayLike | None = None
    double_sided: bool = False


@dataclass(frozen=True, eq=False)
class Light:
    """An analytic light or dome; emissive meshes become lights by themselves."""

    kind: LightKind
    radiance: ArrayLike = 1.0
    to_world: ArrayLike = IDENTITY
    size: tuple[float, float] = (0.0, 0.0)
    image: Image | None = None
    path: str = ""


def scaling(x: float, y: float | None = None, z: float | None = None) -> NDArray[np.float64]:
    """(4, 4) scale."""
    return np.diag([x, x if y is None else y, x if z is None else z, 1.0])


def translation(x: float, y: float, z: float) -> NDArray[np.float64]:
    """(4, 4) translation."""
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def rotation(axis: ArrayLike, degrees: float) -> NDArray[np.float64]:
    """(4, 4) rotation about `axis`, right-handed."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return matrix


def quads(corners: ArrayLike) -> Array:
    """(n, 4, 3) counter-clockwise corners to (2 n, 3, 3) triangles."""
    return np.asarray(corners, np.float32).reshape(-1, 4, 3)[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)


def quad(size: float = 1.0, y: float = 0.0) -> Array:
    """Square of side `size` in the plane of height `y`, facing +Y."""
    h = size / 2
    return quads([[[-h, y, h], [h, y, h], [h, y, -h], [-h, y, -h]]])


def box(size: ArrayLike = 1.0, centre: ArrayLike = 0.0, inward: bool = False) -> Array:
    """(12, 3, 3) triangles of an axis-aligned box, facing outward: faces in the order -x +x -y +y -z +z."""
    faces = []
    for axis in range(3):
        for sign in (-1, 1):
            a, b = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
            n = sign * np.eye(3)[axis]
            ring = [n - a - b, n + a - b, n + a + b, n - a + b]
            faces.append(ring if (sign > 0) != inward else ring[::-1])
    return quads(np.array(faces) * np.broadcast_to(np.asarray(size, float) / 2, 3) + np.asarray(centre))


def sphere(radius: float = 1.0, n: int = 32) -> tuple[Array, Array]:
    """Triangles of a latitude-longitude sphere and its exact normals, both (2 n (n - 1), 3, 3)."""
    theta = np.linspace(0, np.pi, n + 1)[:, None]
    phi = np.linspace(0, 2 * np.pi, n + 1)[None]
    grid = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, np.sin(theta) * np.cos(phi)], -1)
    grid[:, -1] = grid[:, 0]
    corners = np.stack([grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:], grid[:-1, :-1]], 2).reshape(-1, 4, 3)
    normals = quads(corners)
    area = np.linalg.norm(np.cross(normals[:, 1] - normals[:, 0], normals[:, 2] - normals[:, 0]), axis=1)
    normals = np.ascontiguousarray(normals[area > 1e-9])
    return np.float32(radius) * normals, normals


def look_at(
    eye: ArrayLike,
    target: ArrayLike = (0, 0, 0),
    up: ArrayLike = (0, 1, 0),
    *,
    fov: float = 40.0,
    width: int = 32,
    height: int = 32,
) -> Camera:
    """Pinhole camera; `fov` in degrees is the vertical angle."""
    eye = np.asarray(eye, float)
    z = eye - np.asarray(target, float)
    z /= np.linalg.norm(z)
    x = np.cross(np.asarray(up, float), z)
    x /= np.linalg.norm(x)
    top = np.tan(np.radians(fov) / 2)
    right = top * width / height
    matrix = np.column_stack([x, np.cross(z, x), z, eye])
    return Camera("/camera", matrix, (-right, right, -top, top), width, height)


def make_snapshot(
    meshes: Sequence[Mesh],
    *,
    lights: Sequence[Light] = (),
    camera: Camera | None = None,
) -> SceneSnapshot:
    """Snapshot of meshes (with their materials), analytic lights and a camera; nothing is recentred.

    `Materials` row 0 is the fallback (displayColor), then the meshes' materials
    in order of first use. A surface any of whose triangles has an emissive
    material is a mesh light, after the analytic ones.
    """
    fallback = Material(use_display_color=True, ior=1.0)
    materials: list[Material] = [fallback]
    images: list[Image] = []

    def row(items: list, item: object) -> int:
        for index, other in enumerate(items):
            if other is item:
                return index
        items.append(item)
        return len(items) - 1

    corner_table: dict[str, list[Array]] = {name: [] for name in Geometry._fields[:7]}
    begin = [0]
    double_sided, instance_mesh, to_world = [], [], []
    surfaces: list[Surface] = []
    for m, mesh in enumerate(meshes):
        points = np.asarray(mesh.points, np.float32).reshape(-1, 3, 3)
        n = len(points)
        begin.append(begin[-1] + n)
        normals = mesh.normals
        if normals is None:
            flat = np.cross((points[:, 1] - points[:, 0]).astype(float), (points[:, 2] - points[:, 0]).astype(float))
            normals = np.repeat((flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300))[:, None], 3, 1)
        each = mesh.material if isinstance(mesh.material, Sequence) else [mesh.material or fallback] * n
        face = np.arange(n) if mesh.face is None else np.asarray(mesh.face)
        face_uv = [[0, 0], [1, 0], [0, 1]] if mesh.face_uv is None else mesh.face_uv
        columns: dict[str, Any] = {
            "points": points,
            "normals": normals,
            "st": np.broadcast_to(np.asarray([[0, 0], [1, 0], [1, 1]] if mesh.st is None else mesh.st), (n, 3, 2)),
            "color": np.broadcast_to(np.asarray(mesh.color), (n, 3, 3)),
            "face": face,
            "face_uv": np.broadcast_to(np.asarray(face_uv), (n, 3, 2)),
            "material": np.array([row(materials, one) for one in each], np.int32).reshape(n),
        }
        for name, column in columns.items():
            corner_table[name].append(column)
        double_sided.append(mesh.double_sided)
        for i, transform in enumerate(mesh.transforms):
            path = mesh.path or f"/mesh_{m}"
            n_faces = int(face.max()) + 1 if n else 0
            surfaces.append(Surface(path, i if len(mesh.transforms) > 1 else -1, n_faces=n_faces))
            instance_mesh.append(m)
            to_world.append(np.asarray(transform, float)[:3])

    full = np.zeros((len(to_world), 4, 4))
    full[:, :3] = np.array(to_world).reshape(-1, 3, 4)
    full[:, 3, 3] = 1
    whole = np.ascontiguousarray
    widths = {"points": (0, 3, 3), "normals": (0, 3, 3), "st": (0, 3, 2), "color": (0, 3, 3), "face_uv": (0, 3, 2)}
    joined: dict[str, Any] = {}
    for name, parts in corner_table.items():
        kind = np.int32 if name in ("face", "material") else np.float32
        joined[name] = whole(np.concatenate([np.zeros(widths.get(name, (0,)), kind), *parts]), dtype=kind)
    geometry = Geometry(
        **joined,
        mesh_begin=np.array(begin, np.int64),
        mesh_double_sided=np.array(double_sided, np.uint8),
        instance_mesh=np.array(instance_mesh, np.int32),
        instance_surface=np.arange(len(instance_mesh), dtype=np.int32),
        instance_to_world=whole(full[:, :3], dtype=np.float32),
        instance_to_object=whole(np.linalg.inv(full)[:, :3], dtype=np.float32),
        instance_flip=(np.linalg.det(full[:, :3, :3]) < 0).astype(np.uint8),
    )

    n = len(materials)
    texture = np.full((n, 6), -1, np.int32)
    channel = np.full((n, 6), -1, np.int32)
    transform = np.zeros((n, 6, 2, 3), np.float32)
    transform[:] = (1, 0, 0), (0, 1, 0)
    scale, bias = np.ones((n, 6, 4), np.float32), np.zeros((n, 6, 4), np.float32)
    for m, material in enumerate(materials):
        for slot, use in material.textures.items():
            texture[m, slot] = row(images, use.image)
            channel[m, slot] = use.channel
            transform[m, slot] = use.transform
            scale[m, slot] = use.scale
            bias[m, slot] = use.bias
    light_texture = [-1 if light.image is None else row(images, light.image) for light in lights]

    def rgb(name: str) -> Array:
        return np.array([np.broadcast_to(getattr(one, name), 3) for one in materials], np.float32).reshape(n, 3)

    def scalar(name: str, kind: type = np.float32) -> NDArray:
        return np.array([getattr(one, name) for one in materials], kind)

    material_table = Materials(
        diffuse=rgb("diffuse"),
        emission=rgb("emission"),
        specular=rgb("specular"),
        use_specular=scalar("use_specular", np.uint8),
        metallic=scalar("metallic"),
        roughness=scalar("roughness"),
        opacity=scalar("opacity"),
        opacity_threshold=scalar("opacity_threshold"),
        ior=scalar("ior"),
        use_display_color=scalar("use_display_color", np.uint8),
        texture=texture,
        texture_channel=channel,
        texture_transform=transform,
        texture_scale=scale,
        texture_bias=bias,
    )

    texels, texel_begin = [np.zeros((0, 4), np.float32)], [0]
    for image in images:
        data = np.atleast_3d(np.asarray(image.texels, np.float32))
        rgba = np.ones((*data.shape[:2], 4), np.float32)
        rgba[..., : data.shape[2]] = data
        if data.shape[2] == 1:
            rgba[..., :3] = data
        texels.append(rgba.reshape(-1, 4))
        texel_begin.append(texel_begin[-1] + rgba.shape[0] * rgba.shape[1])
    textures = Textures(
        texels=np.concatenate(texels),
        begin=np.array(texel_begin[:-1], np.int64),
        width=np.array([np.shape(one.texels)[1] for one in images], np.int32),
        height=np.array([np.shape(one.texels)[0] for one in images], np.int32),
        wrap=np.array([one.wrap for one in images], np.int32).reshape(-1, 2),
    )

    emissive = (material_table.emission > 0).any(1) | (texture[:, Texture.EMISSION] >= 0)
    rows, owners, light_begin, light_surfaces = [], [], [0] * (len(lights) + 1), []
    for instance, m in enumerate(instance_mesh):
        span = np.arange(begin[m], begin[m + 1])
        span = span[emissive[geometry.material[span]]]
        if len(span):
            rows.append(span)
            owners.append(np.full(len(span), instance))
            light_begin.append(light_begin[-1] + len(span))
            light_surfaces.append(instance)
    n_mesh = len(light_surfaces)
    light_table = Lights(
        kind=np.array([one.kind for one in lights] + [LightKind.MESH] * n_mesh, np.int32),
        to_world=np.array(
            [np.asarray(one.to_world, float)[:3] for one in lights] + [IDENTITY] * n_mesh, np.float32
        ).reshape(-1, 3, 4),
        radiance=np.array(
            [np.broadcast_to(one.radiance, 3) for one in lights] + [np.ones(3)] * n_mesh, np.float32
        ).reshape(-1, 3),
        size=np.array([one.size for one in lights] + [(0, 0)] * n_mesh, np.float32).reshape(-1, 2),
        texture=np.array(light_texture + [-1] * n_mesh, np.int32),
        surface=np.array([-1] * len(lights) + light_surfaces, np.int32),
        triangle_begin=np.array(light_begin, np.int64),
        triangle=np.concatenate([np.zeros(0), *rows]).astype(np.int32),
        triangle_instance=np.concatenate([np.zeros(0), *owners]).astype(np.int32),
    )
    light_paths = [one.path or f"/light_{i}" for i, one in enumerate(lights)]

    radius = 0.0
    for instance, m in enumerate(instance_mesh):
        corners = geometry.points[begin[m] : begin[m + 1]].reshape(-1, 3)
        if len(corners):
            world = corners @ full[instance, :3, :3].T + full[instance, :3, 3]
            radius = max(radius, float(np.linalg.norm(world, axis=1).max()))
    return SceneSnapshot(
        geometry=geometry,
        surfaces=tuple(surfaces),
        materials=material_table,
        material_paths=tuple(f"/material_{i}" if i else "" for i in range(n)),
        textures=textures,
        lights=light_table,
        light_paths=(*light_paths, *(surfaces[i].path for i in light_surfaces)),
        camera=camera or look_at((0, max(radius, 1e-6), 3 * max(radius, 1e-6))),
        stage_path="",
        time_code=None,
        centre=np.zeros(3),
        radius=radius,
    )


def quad_scene(material: Material | None = None, *, size: float = 1.0, lights: Sequence[Light] = ()) -> SceneSnapshot:
    """One square in the plane y = 0 facing +Y, surface ``/quad``; its texture coordinates run over [0, 1]^2."""
    st = quads([[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]])[..., :2]
    mesh = Mesh(quad(size), material or Material(), st=st, face=[0, 0], face_uv=st, path="/quad")
    return make_snapshot([mesh], lights=lights, camera=look_at((0, 2 * size, 2 * size)))


def closed_box(albedo: ArrayLike = 0.5, emission: ArrayLike = 0.0, *, size: float = 2.0) -> SceneSnapshot:
    """The inside of a cube, camera at its centre: emission E and albedo a give radiance E / (1 - a) everywhere."""
    mesh = Mesh(box(size, inward=True), Material(diffuse=albedo, emission=emission), path="/box")
    return make_snapshot([mesh], camera=look_at((0, 0, 0), (0, 0, -1), fov=90))


def cornell_meshes() -> list[Mesh]:
    """Box of side 2 about the origin, open to +Z, red at -X and green at +X, and two blocks."""
    white = Material(diffuse=0.73)
    red, green = Material(diffuse=(0.65, 0.05, 0.05)), Material(diffuse=(0.12, 0.45, 0.15))
    walls = box(2, inward=True)
    tall = translation(-0.35, -0.4, -0.3) @ rotation((0, 1, 0), 17)
    low = translation(0.35, -0.7, 0.35) @ rotation((0, 1, 0), -17)
    return [
        Mesh(walls[0:2], red, path="/red"),
        Mesh(walls[2:4], green, path="/green"),
        Mesh(walls[4:6], white, path="/floor"),
        Mesh(walls[6:8], white, path="/ceiling"),
        Mesh(walls[8:10], white, path="/back"),
        Mesh(box((0.6, 1.2, 0.6)), white, transforms=[tall], path="/tall"),
        Mesh(box((0.6, 0.6, 0.6)), white, transforms=[low], path="/low"),
    ]


def cornell(width: int = 32, height: int = 32, *, emission: ArrayLike = (17, 12, 4)) -> SceneSnapshot:
    """`cornell_meshes` and a square lamp ``/lamp`` that shines to both sides."""
    lamp = Mesh(quad(0.5)[:, ::-1], Material(0.0, emission), transforms=[translation(0, 0.995, 0)], path="/lamp")
    camera = look_at((0, 0, 3.9), (0, 0, 0), fov=39.3, width=width, height=height)
    return make_snapshot([*cornell_meshes(), lamp], camera=camera)


def covered_cornell(
    lamp: str = "mesh",
    lights: Sequence[Light] = (),
    *,
    width: int = 20,
    height: int = 20,
    emission: ArrayLike = (17, 12, 4),
) -> SceneSnapshot:
    """`cornell` with a black cover ``/cover`` over its lamp: a ``"mesh"``, a ``"rect"`` light, or ``"none"`` of both.

    The cover keeps the back of the lamp from lighting the ceiling at a distance of millimetres, where sampling
    the lamp by its area does not converge in the time of a test. The rect light lies a hair before it, so that
    in a renderer where rect lights are shapes it blocks nothing more.
    """
    geometry = cornell_meshes()
    if lamp != "none":
        geometry.append(Mesh(quad(0.6)[:, ::-1], Material(0.0), transforms=[translation(0, 0.99, 0)], path="/cover"))
    if lamp == "mesh":
        shining = Material(0.0, emission)
        geometry.append(Mesh(quad(0.5)[:, ::-1], shining, transforms=[translation(0, 0.985, 0)], path="/lamp"))
    elif lamp == "rect":
        place = translation(0.02, 0.985, 0.03) @ rotation((1, 0, 0), -90)
        lights = (Light(LightKind.RECT, emission, place, (0.5, 0.4)), *lights)
    camera = look_at((0, 0, 3.9), (0, 0, 0), fov=39.3, width=width, height=height)
    return make_snapshot(geometry, lights=lights, camera=camera)


def soup(n: int = 300, seed: int = 0, *, material: Material | None = None, size: float = 0.3) -> Mesh:
    """Random triangles in the cube [-1, 1]^3."""
    rng = np.random.default_rng(seed)
    return Mesh(rng.uniform(-1, 1, (n, 1, 3)) + size * rng.normal(size=(n, 3, 3)), material)
