"""Lights of a stage as rows of `Lights`.

A light's radiance is ``color * intensity * 2^exposure``, times the colour of a black body where
`enableColorTemperature` is on, over a size factor where `normalize` is on [1]_. In units: intensity 1
is 1 nit, a radiance of 1 here.

Size factors are areas in **stage units**, world space, the transform's scale included: what is
authored as 2 x 3 counts as 6 whether a unit is a metre or a centimetre. So calling the same stage
centimetres instead of metres leaves its picture as it was, as for lights that are not normalized.

.. [1] https://openusd.org/release/user_guides/schemas/usdLux/LightAPI.html
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from icheat_usd.errors import EditError
from icheat_usd.scene import F64, Finding, Geometry, LightKind, Lights, Materials, Surface, Texture, Textures
from icheat_usd.stage.light_inputs import LightInputs
from icheat_usd.stage.shading import time_code
from icheat_usd.stage.textures import TextureLibrary
from icheat_usd.stage.transforms import Placement, from_gf

#: Radius, in metres, of the sphere that stands in for a point light whose radius is zero.
POINT_RADIUS = 1e-3

#: MeshLightAPI's way with materials: the light is the material's emission, tinted by the light's inputs.
GLOW = "materialGlowTintsLight"

#: Where a dome's pole is Z: a quarter turn about X takes it there from +Y, and longitude 0 from +Z to -Y.
POLE_TURN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class _Light:
    """One row of `Lights` before it becomes one."""

    path: str
    kind: LightKind
    to_world: F64
    radiance: F64
    size: tuple[float, float] = (0.0, 0.0)
    texture: int = -1
    surface: int = -1


def read_lights(
    prims: Iterable[Usd.Prim],
    time: Usd.TimeCode | float | None,
    placement: Placement,
    textures: TextureLibrary,
) -> tuple[Lights, tuple[str, ...], list[Finding]]:
    """Lights that are prims of their own; `with_mesh_lights` adds emissive meshes.

    Parameters
    ----------
    prims
        Prims that may be lights, instance proxies included; others are passed over.
    time
        When transforms and inputs are read; None is the earliest time.
    placement
        Takes local-to-world matrices to metres about the scene's centre.
    textures
        Receives the images of textured lights.

    Returns
    -------
    Lights
        In the order of `prims`. A distant light of angle 0 has half-angle 0 and, as `radiance`, the
        irradiance on a plane that faces it: its size factor is 1 [1]_.
    tuple of str
        Scene path of each.
    list of Finding
        What is not supported, once per light and feature. Files that cannot be read are among the
        findings of `textures`.

    Notes
    -----
    Invisible lights are left out. Colour temperature is `UsdLux.BlackbodyTemperatureAsRgb`, of
    luminance 1 and within 4 % of white at 6500 K. A light whose image cannot be used keeps its
    plain colour.

    References
    ----------
    .. [1] https://openusd.org/release/user_guides/schemas/usdLux/LightAPI.html, "normalize"
    """
    reader = _Reader(time_code(time), placement, textures)
    rows = [row for prim in prims for row in reader.read(prim)]
    return _table(rows), tuple(row.path for row in rows), list(reader.inputs.report.findings())


def read_mesh_factors(prims: Iterable[Usd.Prim], time: Usd.TimeCode | float | None) -> dict[str, F64]:
    """What MeshLightAPI multiplies the emission of meshes with when they light the scene.

    Parameters
    ----------
    prims
        Prims that may be mesh lights, instance proxies included; others are passed over.
    time
        When inputs are read; None is the earliest time.

    Returns
    -------
    dict of str to (3,) float64
        Colour, intensity, exposure and colour temperature as one factor, by scene path. A camera
        sees the material's own emission: UsdLux lets these inputs act on the light it gives only.
        Modes other than "materialGlowTintsLight" have no factor; `read_lights` reports them.
    """
    code = time_code(time)
    reader = _Reader(code, Placement(1.0, np.zeros(3)), TextureLibrary())
    return {
        str(prim.GetPath()): reader.radiance(prim, None, 1.0)
        for prim in prims
        if prim.IsA(UsdGeom.Mesh) and prim.HasAPI(UsdLux.LightAPI) and _material_mode(prim) == GLOW
    }


def read_light_radiance(prim: Usd.Prim, time: Usd.TimeCode | float | None) -> F64:
    """Radiance (3,) of a prim that is a light of a kind that is read; see `read_lights`.

    Raises
    ------
    EditError
        The light gives none, such as one without an area.
    """
    reader = _Reader(time_code(time), Placement(1.0, np.zeros(3)), TextureLibrary())
    light = reader.light(prim)
    if light is None:
        raise EditError(f"{prim.GetPath()} has no area and gives no light; give it a size")
    return light.radiance


def with_mesh_lights(
    lights: Lights,
    paths: tuple[str, ...],
    geometry: Geometry,
    surfaces: Sequence[Surface],
    materials: Materials,
    textures: Textures,
    factors: Mapping[str, F64] | None = None,
) -> tuple[Lights, tuple[str, ...]]:
    """Append one light per placed mesh that has triangles of an emissive material.

    Parameters
    ----------
    lights, paths
        Rows so far; their own mesh rows, if any, are kept.
    geometry, surfaces, materials, textures
        Of the snapshot. A material emits where its emissive colour is above zero in any channel, or
        where the image of its emissive colour has a texel that is after scale and bias.
    factors
        What `read_mesh_factors` found; surfaces that are not among them have factor 1.

    Returns
    -------
    Lights, tuple of str
        The new rows' paths are their surfaces'; instances of a point instancer share one.
    """
    factors = factors or {}
    emissive = np.array((materials.emission > 0.0).any(axis=1))
    for row in np.flatnonzero(materials.texture[:, Texture.EMISSION] >= 0):
        emissive[row] = _texture_emits(materials, textures, int(row))
    shines = emissive[geometry.material] if len(geometry.material) else np.zeros(0, np.bool_)
    per_mesh = [
        first + np.flatnonzero(shines[first:last])
        for first, last in zip(geometry.mesh_begin[:-1], geometry.mesh_begin[1:], strict=True)
    ]
    instances = [i for i, mesh in enumerate(geometry.instance_mesh) if len(per_mesh[mesh])]
    rows = [
        _Light(
            path=surfaces[geometry.instance_surface[i]].path,
            kind=LightKind.MESH,
            to_world=geometry.instance_to_world[i].astype(np.float64),
            radiance=factors.get(surfaces[geometry.instance_surface[i]].path, np.ones(3)),
            surface=int(geometry.instance_surface[i]),
        )
        for i in instances
    ]
    triangles = [per_mesh[geometry.instance_mesh[i]] for i in instances]
    counts = np.array([len(t) for t in triangles], np.int64)
    added = _table(rows)._replace(
        triangle_begin=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        triangle=np.concatenate([np.zeros(0, np.int32), *triangles]).astype(np.int32),
        triangle_instance=np.repeat(np.array(instances, np.int32), counts),
    )
    begin = np.concatenate([lights.triangle_begin, lights.triangle_begin[-1] + added.triangle_begin[1:]])
    joined = {name: np.concatenate([getattr(lights, name), getattr(added, name)]) for name in Lights._fields}
    return Lights(**(joined | {"triangle_begin": begin})), paths + tuple(row.path for row in rows)


def _texture_emits(materials: Materials, textures: Textures, row: int) -> bool:
    image = materials.texture[row, Texture.EMISSION]
    first = textures.begin[image]
    count = int(textures.width[image]) * int(textures.height[image])
    texels = textures.texels[first : first + count]
    brightest = np.stack([texels.min(axis=0), texels.max(axis=0)])  # a negative scale makes the darkest brightest
    values = brightest * materials.texture_scale[row, Texture.EMISSION] + materials.texture_bias[row, Texture.EMISSION]
    channel = materials.texture_channel[row, Texture.EMISSION]
    return bool((values[:, :3] > 0.0).any() if channel < 0 else (values[:, channel] > 0.0).any())


def _table(rows: Sequence[_Light]) -> Lights:
    n = len(rows)
    return Lights(
        kind=np.array([row.kind for row in rows], np.int32),
        to_world=np.array([row.to_world for row in rows], np.float32).reshape(n, 3, 4),
        radiance=np.array([row.radiance for row in rows], np.float32).reshape(n, 3),
        size=np.array([row.size for row in rows], np.float32).reshape(n, 2),
        texture=np.array([row.texture for row in rows], np.int32),
        surface=np.array([row.surface for row in rows], np.int32),
        triangle_begin=np.zeros(n + 1, np.int64),
        triangle=np.zeros(0, np.int32),
        triangle_instance=np.zeros(0, np.int32),
    )


# Size factors -----------------------------------------------------------------------------------


def rect_area(linear: F64, width: float, height: float) -> float:
    """World area of a rectangle in XY under a linear map ``(3, 3)``."""
    return float(np.linalg.norm(np.cross(linear[:, 0], linear[:, 1]))) * width * height


def disk_area(linear: F64, radius: float) -> float:
    """World area of a disk in XY under a linear map ``(3, 3)``."""
    return rect_area(linear, math.pi * radius, radius)


def sphere_area(linear: F64, radius: float) -> float:
    """World area of a sphere under a linear map ``(3, 3)``: of an ellipsoid, where it scales unevenly.

    The area element of a unit sphere grows by |cofactor(linear) n|, and n |-> |C n| has the same mean
    for C as for its singular values, integrated here over one octant.
    """
    s = np.linalg.svd(linear, compute_uv=False)
    cofactors = np.array([s[1] * s[2], s[2] * s[0], s[0] * s[1]])
    node, weight = np.polynomial.legendre.leggauss(48)
    z = (node[:, None] + 1.0) / 2.0
    angle = (node[None, :] + 1.0) * (math.pi / 4.0)
    across = np.sqrt(1.0 - z * z)
    # The smallest cofactor along the pole keeps the integrand smooth where the others vary most.
    growth = np.sqrt(
        (across * np.cos(angle) * cofactors[2]) ** 2
        + (across * np.sin(angle) * cofactors[1]) ** 2
        + (z * cofactors[0]) ** 2
    )
    octant = float(weight @ growth @ weight) * (math.pi / 8.0)
    return 8.0 * octant * radius * radius


def cylinder_area(linear: F64, radius: float, length: float) -> float:
    """World area of the side of a cylinder along X under a linear map ``(3, 3)``, caps left out."""
    angle = np.arange(512) * (2.0 * math.pi / 512)
    tangents = np.outer(linear[:, 2], np.cos(angle)) - np.outer(linear[:, 1], np.sin(angle))
    growth = np.linalg.norm(np.cross(linear[:, 0], tangents.T), axis=1)
    return float(growth.mean()) * 2.0 * math.pi * radius * length


def distant_size_factor(half_angle: float) -> float:
    """What a distant light's radiance is divided by: the irradiance that radiance 1 makes on a plane facing it."""
    theta = min(max(half_angle, 0.0), math.pi)
    if theta == 0.0:
        return 1.0
    sine = math.sin(theta) ** 2
    return math.pi * (sine if theta <= math.pi / 2.0 else 2.0 - sine)


def pole_axis(prim: Usd.Prim) -> str:
    """The axis, "Y" or "Z", that a DomeLight_1 has its pole along."""
    axis = str(prim.GetAttribute("poleAxis").Get() or "scene")
    return str(UsdGeom.GetStageUpAxis(prim.GetStage())) if axis == "scene" else axis


def _material_mode(prim: Usd.Prim) -> str:
    return str(prim.GetAttribute("light:materialSyncMode").Get() or "noMaterialResponse")


# Reading ----------------------------------------------------------------------------------------


class _Reader:
    def __init__(self, time: Usd.TimeCode, placement: Placement, textures: TextureLibrary) -> None:
        self.time = time
        self.placement = placement
        self.textures = textures
        self.inputs = LightInputs(time)
        self.transforms = UsdGeom.XformCache(time)

    def read(self, prim: Usd.Prim) -> list[_Light]:
        kind = str(prim.GetTypeName())
        if not self._is_light(prim) or self._is_invisible(prim):
            return []
        if kind not in self._KINDS:
            self._report_kind(prim, kind)
            return []
        light = self.light(prim)
        return [] if light is None else [light]

    def light(self, prim: Usd.Prim) -> _Light | None:
        """A light of a kind that is read; None where it gives no light."""
        # Stage units; the placement turns it to metres once the sizes that need stage units are known.
        linear = from_gf(self.transforms.GetLocalToWorldTransform(prim))[:, :3]
        return self._KINDS[str(prim.GetTypeName())](self, prim, linear)

    def _is_light(self, prim: Usd.Prim) -> bool:
        return bool(prim) and (
            prim.HasAPI(UsdLux.LightAPI) or prim.IsA(UsdLux.PortalLight) or prim.IsA(UsdLux.PluginLight)
        )

    def _is_invisible(self, prim: Usd.Prim) -> bool:
        imageable = UsdGeom.Imageable(prim)
        return bool(imageable) and imageable.ComputeVisibility(self.time) == UsdGeom.Tokens.invisible

    # Kinds --------------------------------------------------------------------------------------

    def _sphere(self, prim: Usd.Prim, linear: F64) -> _Light | None:
        radius = self.inputs.number(prim, "radius", 0.5)
        as_point = bool(prim.GetAttribute("treatAsPoint").Get(self.time))
        if radius <= 0.0 and as_point:
            scale = float(np.linalg.norm(linear, 2)) * self.placement.meters_per_unit
            radius = POINT_RADIUS / scale if scale > 0.0 else POINT_RADIUS
        elif as_point:
            self.inputs.unsupported(prim, "treatAsPoint", "the light is a sphere of its radius")
        return self._area_light(prim, LightKind.SPHERE, (radius, 0.0), sphere_area(linear, radius))

    def _disk(self, prim: Usd.Prim, linear: F64) -> _Light | None:
        radius = self.inputs.number(prim, "radius", 0.5)
        return self._area_light(prim, LightKind.DISK, (radius, 0.0), disk_area(linear, radius))

    def _rect(self, prim: Usd.Prim, linear: F64) -> _Light | None:
        width, height = self.inputs.number(prim, "width", 1.0), self.inputs.number(prim, "height", 1.0)
        texture = self._texture(prim, "clamp", "clamp")
        return self._area_light(prim, LightKind.RECT, (width, height), rect_area(linear, width, height), texture)

    def _cylinder(self, prim: Usd.Prim, linear: F64) -> _Light | None:
        radius, length = self.inputs.number(prim, "radius", 0.5), self.inputs.number(prim, "length", 1.0)
        if prim.GetAttribute("treatAsLine").Get(self.time):
            self.inputs.unsupported(prim, "treatAsLine", "the light is a cylinder of its radius")
        return self._area_light(prim, LightKind.CYLINDER, (radius, length), cylinder_area(linear, radius, length))

    def _distant(self, prim: Usd.Prim, linear: F64) -> _Light | None:
        half_angle = math.radians(min(max(self.inputs.number(prim, "angle", 0.53), 0.0), 360.0)) / 2.0
        factor = distant_size_factor(half_angle)
        return self._light(prim, LightKind.DISTANT, (half_angle, 0.0), self.radiance(prim, factor, 50000.0))

    def _dome(self, prim: Usd.Prim, linear: F64) -> _Light | None:
        # Ignores `normalize`: it has no size.
        texture = self._texture(prim, "repeat", "clamp")
        light = self._light(prim, LightKind.DOME, (0.0, 0.0), self.radiance(prim, None, 1.0), texture)
        if str(prim.GetTypeName()) == "DomeLight_1" and pole_axis(prim) == "Z":
            light.to_world[:, :3] = light.to_world[:, :3] @ POLE_TURN
        return light

    # Functions, not methods of `self`: those would hold the reader, and by it the stage, until garbage is collected.
    _KINDS: ClassVar[dict[str, Callable[[_Reader, Usd.Prim, F64], _Light | None]]] = {
        "SphereLight": _sphere,
        "DiskLight": _disk,
        "RectLight": _rect,
        "CylinderLight": _cylinder,
        "DistantLight": _distant,
        "DomeLight": _dome,
        "DomeLight_1": _dome,
    }

    def _area_light(
        self, prim: Usd.Prim, kind: LightKind, size: tuple[float, float], area: float, texture: int = -1
    ) -> _Light | None:
        if not area > 0.0:
            self.inputs.report(
                prim.GetPath(),
                "size",
                "it has no area and gives no light; give it a size, or a transform that does not flatten it.",
            )
            return None
        return self._light(prim, kind, size, self.radiance(prim, area, 1.0), texture)

    def _light(
        self, prim: Usd.Prim, kind: LightKind, size: tuple[float, float], radiance: F64, texture: int = -1
    ) -> _Light:
        to_world = self.placement.matrix(self.transforms.GetLocalToWorldTransform(prim))
        return _Light(str(prim.GetPath()), kind, to_world, radiance, size, texture)

    # Inputs -------------------------------------------------------------------------------------

    def radiance(self, prim: Usd.Prim, size_factor: float | None, default_intensity: float) -> F64:
        """Radiance of a light; a size factor of None stands for a light that ignores `normalize`."""
        color = self.inputs.value(prim, "color", Gf.Vec3f(1.0))
        radiance = np.array([float(c) for c in color], np.float64)
        radiance *= self.inputs.number(prim, "intensity", default_intensity) * 2.0 ** self.inputs.number(
            prim, "exposure", 0.0
        )
        if self.inputs.value(prim, "enableColorTemperature", False):
            kelvin = self.inputs.number(prim, "colorTemperature", 6500.0)
            radiance *= np.array(list(UsdLux.BlackbodyTemperatureAsRgb(kelvin)), np.float64)
        if size_factor is not None and self.inputs.value(prim, "normalize", False):
            radiance /= size_factor
        if not (np.isfinite(radiance).all() and (radiance >= 0.0).all()):
            self.inputs.report(
                prim.GetPath(),
                "radiance",
                "it has a negative or infinite radiance, which counts as 0; check its color, intensity and exposure.",
            )
            radiance = np.where(np.isfinite(radiance), np.maximum(radiance, 0.0), 0.0)
        return radiance

    def _texture(self, prim: Usd.Prim, wrap_s: str, wrap_t: str) -> int:
        asset = self.inputs.value(prim, "texture:file", None)
        if not isinstance(asset, Sdf.AssetPath) or not asset.path:
            return -1
        layout = self.inputs.value(prim, "texture:format", "automatic")
        if layout not in ("automatic", "latlong"):
            self.inputs.unsupported(
                prim, "texture:format", f"'{layout}' images are not read, and its plain colour is used"
            )
            return -1
        return self.textures.add(asset, "auto", wrap_s, wrap_t, prim_path=str(prim.GetPath()))

    # Findings -----------------------------------------------------------------------------------

    def _report_kind(self, prim: Usd.Prim, kind: str) -> None:
        if prim.IsA(UsdGeom.Mesh):
            mode = _material_mode(prim)
            if mode != GLOW:
                self.inputs.unsupported(
                    prim, "light:materialSyncMode", f"'{mode}' is ignored, and the mesh shines by its material alone"
                )
            elif self.inputs.value(prim, "normalize", False):
                self.inputs.unsupported(prim, "normalize", "a mesh shines by its radiance, whatever its area")
            return
        if prim.IsA(UsdGeom.Gprim):
            self.inputs.unsupported(prim, "LightAPI", f"a {kind} shines by the emission of its material alone")
            return
        self.inputs.unsupported(prim, kind or "LightAPI", "it gives no light")
