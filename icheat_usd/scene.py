"""What is rendered: frozen tables of arrays for one stage at one time code.

World space, metres, right-handed, about the scene's centre; colours are
scene-linear Rec.709. Tables are named tuples of C-contiguous arrays, so that
a kernel can take a whole table as one argument.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]
Bool = NDArray[np.bool_]


class Geometry(NamedTuple):
    """Triangles of every mesh in its own (object) space, and the instances that place them.

    Triangles of mesh `m` are rows ``mesh_begin[m]:mesh_begin[m + 1]``. Winding
    is counter-clockwise seen from the front in object space, left-handed
    orientation already resolved; `instance_flip` marks transforms that mirror.
    """

    points: F32  #: (n_triangles, 3, 3) corner positions, object space
    normals: F32  #: (n_triangles, 3, 3) unit shading normals per corner, object space
    st: F32  #: (n_triangles, 3, 2) texture coordinates, v up
    color: F32  #: (n_triangles, 3, 3) displayColor per corner
    face: I32  #: (n_triangles,) control face of the authored mesh
    face_uv: F32  #: (n_triangles, 3, 2) place of each corner in its control face, in [0, 1]^2
    material: I32  #: (n_triangles,) row of `Materials`
    mesh_begin: I64  #: (n_meshes + 1,)
    mesh_double_sided: U8  #: (n_meshes,)
    instance_mesh: I32  #: (n_instances,)
    instance_surface: I32  #: (n_instances,) row of `SceneSnapshot.surfaces`
    instance_to_world: F32  #: (n_instances, 3, 4) [R | t]: world = R @ object + t
    instance_to_object: F32  #: (n_instances, 3, 4) its inverse
    instance_flip: U8  #: (n_instances,) 1 where det(R) < 0


@dataclass(frozen=True)
class Surface:
    """A mesh as the stage names it: one per placement (an instance of a point instancer is one)."""

    path: str  #: scene path that collections match: of the gprim (an instance proxy's), or of the point instancer
    instance_id: int = -1  #: id within a point instancer, else -1
    part: str = ""  #: which of several meshes inside a point-instanced prototype; path relative to the prototype
    n_faces: int = 0  #: control faces
    topology_digest: str = ""  #: SHA-256 (hex) of face counts and indices of the control mesh


class Texture(IntEnum):
    """Inputs of a material that a texture can drive: columns of `Materials.texture`."""

    DIFFUSE = 0
    EMISSION = 1
    SPECULAR = 2
    METALLIC = 3
    ROUGHNESS = 4
    OPACITY = 5


class Materials(NamedTuple):
    """UsdPreviewSurface inputs per material; row 0 is the fallback (displayColor)."""

    diffuse: F32  #: (n, 3)
    emission: F32  #: (n, 3)
    specular: F32  #: (n, 3) specularColor
    use_specular: U8  #: (n,) 1 = useSpecularWorkflow
    metallic: F32  #: (n,)
    roughness: F32  #: (n,)
    opacity: F32  #: (n,)
    opacity_threshold: F32  #: (n,) > 0: a cut-out
    ior: F32  #: (n,)
    use_display_color: U8  #: (n,) 1: diffuse is the mesh's displayColor
    texture: I32  #: (n, 6) row of `Textures` or -1, by `Texture`
    texture_channel: I32  #: (n, 6) 0..3 for one channel, -1 for rgb
    texture_transform: F32  #: (n, 6, 2, 3) st' = M @ (s, t, 1)
    texture_scale: F32  #: (n, 6, 4)
    texture_bias: F32  #: (n, 6, 4)


class Textures(NamedTuple):
    """All texture images, texels one after another; row 0 of an image is its TOP row (v = 1)."""

    texels: F32  #: (n_texels, 4) linear RGBA
    begin: I64  #: (n,) first texel
    width: I32  #: (n,)
    height: I32  #: (n,)
    wrap: I32  #: (n, 2) per axis: 0 repeat, 1 clamp, 2 mirror, 3 black


class LightKind(IntEnum):
    SPHERE = 0
    DISK = 1
    RECT = 2
    CYLINDER = 3
    DISTANT = 4
    DOME = 5
    MESH = 6  #: triangles with an emissive material


class Lights(NamedTuple):
    """Light sources. Analytic lights neither block rays nor show themselves to a camera; domes and meshes do.

    A light's local frame is UsdLux's: disk and rect lie in XY and emit along
    -Z, a cylinder's axis is X, a distant light shines along -Z, a dome's pole
    is +Y in its own frame (other poles are already folded into `to_world`).
    Scale stays in `to_world`; sizes are local.
    """

    kind: I32  #: (n,)
    to_world: F32  #: (n, 3, 4)
    radiance: F32  #: (n, 3) with intensity, exposure, normalize and colour temperature applied;
    #: multiplies the image for textured lights; for MESH a multiplier (1) of the material's emission
    size: F32  #: (n, 2) sphere, disk: radius; rect: width, height; cylinder: radius, length; distant: half-angle, rad
    texture: I32  #: (n,) row of `Textures` or -1; domes (lat-long) and rects
    surface: I32  #: (n,) MESH: row of `SceneSnapshot.surfaces`, else -1
    triangle_begin: I64  #: (n + 1,) MESH: its rows in the two columns below
    triangle: I32  #: (n_emissive,) row of `Geometry` triangles
    triangle_instance: I32  #: (n_emissive,)


class Shaping(NamedTuple):
    """How a light's radiance depends on the direction in which it is emitted; angles in radians off local -Z."""

    cone: F64  #: (2,) all of it up to the first angle, smoothly less from there, none beyond the second
    focus: float  #: power of |cos| that the radiance fades with, towards `focus_tint`; 0 does nothing
    focus_tint: F64  #: (3,)
    profile_scale: float  #: of the profile's vertical angles, about 0 where positive and about pi where negative
    vertical: F64  #: (n_v,) ascending angles of a profile, 0 along -Z; beyond them it is dark
    horizontal: F64  #: (n_h,) ascending angles about +Z, the last one 2 pi above the first; empty: no profile
    intensity: F64  #: (n_h, n_v) factor of the radiance


@dataclass(frozen=True, eq=False)
class LightControls:
    """What an artist may ask of one light beside its radiance, as UsdLux names it; as it stands, nothing."""

    receivers: U8 | None = None  #: (n_instances,) 1: `lightLink` has it, the light shines on it; None: on everything
    blockers: U8 | None = None  #: (n_instances,) 1: `shadowLink` has it, it blocks the light; None: everything does
    diffuse: float = 1.0  #: factor of what diffuse responses, and all gather samples, make of the light
    specular: float = 1.0  #: factor of what specular responses make of it
    shaping: Shaping | None = None  #: of lights that are no dome and no mesh; None: even


#: Controls of a light that asks for nothing.
PLAIN = LightControls()


@dataclass(frozen=True)
class Camera:
    """A pinhole or thin-lens perspective camera, or an orthographic one.

    `window` is the film's rectangle (left, right, bottom, top) on the plane one
    metre in front of the eye (perspective) or in metres (orthographic), with
    aperture offsets and the aspect policy applied for `width` x `height`.
    """

    path: str
    to_world: F64  #: (3, 4) camera looks along its -Z, +Y up; no scale
    window: tuple[float, float, float, float]
    width: int
    height: int
    orthographic: bool = False
    lens_radius: float = 0.0  #: metres; 0 is a pinhole
    focus_distance: float = 0.0  #: metres
    near: float = 0.0  #: metres
    far: float = float("inf")
    shutter: tuple[float, float] = (0.0, 0.0)  #: frames, relative
    exposure_scale: float = 1.0  #: recorded, not applied to radiance


@dataclass(frozen=True)
class Finding:
    """One thing that a stage has and the snapshot does not support, or a mistake in it, reported once."""

    prim: str
    feature: str
    message: str


@dataclass(frozen=True)
class SceneSnapshot:
    """A stage at one time code. After this, nothing asks the stage a question."""

    geometry: Geometry
    surfaces: tuple[Surface, ...]
    materials: Materials
    material_paths: tuple[str, ...]
    textures: Textures
    lights: Lights
    light_paths: tuple[str, ...]
    camera: Camera
    stage_path: str
    time_code: float | None
    centre: F64  #: (3,) metres, stage axes: subtracted from every position
    radius: float  #: of the sphere about the origin that holds all geometry; metres
    findings: tuple[Finding, ...] = field(default=())
    light_controls: tuple[LightControls, ...] = ()  #: of each light; none where all are plain
    light_tags: tuple[str, ...] = ()  #: of each light: the group that layers show it in, "" for its own; or none at all

    def __post_init__(self) -> None:
        if len(self.light_controls) not in (0, len(self.light_paths)):
            raise ValueError(f"{len(self.light_controls)} controls for {len(self.light_paths)} lights")

    @property
    def n_instances(self) -> int:
        return len(self.geometry.instance_mesh)

    def controls(self, light: int) -> LightControls:
        """Controls of light `light`."""
        return self.light_controls[light] if self.light_controls else PLAIN


class Hits(NamedTuple):
    """Nearest intersections of n rays."""

    distance: F32  #: (n,) along the ray direction as given; inf where nothing was hit
    instance: I32  #: (n,) -1 where nothing was hit
    triangle: I32  #: (n,) row of `Geometry`; -1 where nothing was hit
    u: F32  #: (n,) barycentric weight of corner 1
    v: F32  #: (n,) barycentric weight of corner 2


class DeltaKind(IntEnum):
    """How a surface point continues a path without scattering it."""

    NONE = 0
    MIRROR = 1
    GLASS = 2
    PASS = 3  #: cut out, or the see-through share of a translucent surface


class SurfacePoints(NamedTuple):
    """Scene surface and its material at n points, seen from one side.

    Normals are turned to the side that was seen. Points that were no hit have
    ``instance == -1`` and zeros elsewhere.
    """

    position: F32  #: (n, 3)
    normal: F32  #: (n, 3) geometric, unit
    shading_normal: F32  #: (n, 3) unit, in the hemisphere of `normal`
    instance: I32  #: (n,)
    triangle: I32  #: (n,)
    barycentric: F32  #: (n, 2) weights of corners 1 and 2
    side: U8  #: (n,) 0 front, 1 back
    face: I32  #: (n,) control face
    face_uv: F32  #: (n, 2)
    albedo: F32  #: (n, 3) diffuse reflectance
    specular: F32  #: (n, 3) Fresnel reflectance at normal incidence; Schlick, towards `specular_edge` at grazing
    specular_edge: F32  #: (n, 3) reflectance at grazing: white for a dielectric, a metal's own colour, 0 where ior is 1
    roughness: F32  #: (n,) UsdPreviewSurface roughness; GGX alpha = roughness^2
    emission: F32  #: (n, 3) radiance
    delta: U8  #: (n,) `DeltaKind`
    opacity: F32  #: (n,)
    ior: F32  #: (n,)
