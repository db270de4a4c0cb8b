"""Author prims of a sample stage: meshes, implicit shapes, materials, lights, cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdLux, UsdRender, UsdShade, Vt

from .shapes import Shape

Color = tuple[float, float, float]
Triple = tuple[float, float, float]
#: A constant transform component, or its samples by frame.
Animated = Triple | Mapping[float, Triple]


class StageBuilder:
    """One `scene.usda` under construction: Y up, metres, default prim /World.

    Layout: /World/Geometry/<component>, /World/Materials, /World/Lights,
    /World/Cameras, and /Render/Settings.
    """

    def __init__(self, doc: str, frames: tuple[int, int] | None = None) -> None:
        self.layer = Sdf.Layer.CreateAnonymous(".usda")
        self.stage = Usd.Stage.Open(self.layer)
        UsdGeom.SetStageUpAxis(self.stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(self.stage, 1.0)
        self.layer.documentation = doc
        world = UsdGeom.Xform.Define(self.stage, "/World").GetPrim()
        self.stage.SetDefaultPrim(world)
        Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
        if frames is not None:
            self.stage.SetStartTimeCode(frames[0])
            self.stage.SetEndTimeCode(frames[1])
            self.stage.SetTimeCodesPerSecond(24)
            self.stage.SetFramesPerSecond(24)
        Usd.ModelAPI(UsdGeom.Xform.Define(self.stage, "/World/Geometry").GetPrim()).SetKind(Kind.Tokens.group)
        UsdGeom.Scope.Define(self.stage, "/World/Materials")
        UsdGeom.Scope.Define(self.stage, "/World/Lights")
        UsdGeom.Scope.Define(self.stage, "/World/Cameras")

    def save(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.layer.Export(str(path))

    # Transforms ------------------------------------------------------------------------------------------------

    def place(
        self,
        prim: Usd.Prim,
        translate: Animated | None = None,
        rotate: Animated | None = None,
        scale: Triple | None = None,
    ) -> None:
        xformable = UsdGeom.Xformable(prim)
        if translate is not None:
            _set(xformable.AddTranslateOp(), translate, Gf.Vec3d)
        if rotate is not None:
            _set(xformable.AddRotateXYZOp(), rotate, Gf.Vec3f)
        if scale is not None:
            _set(xformable.AddScaleOp(), scale, Gf.Vec3f)

    def component(
        self, name: str, translate: Animated | None = None, rotate: Animated | None = None, doc: str = ""
    ) -> str:
        """A model below /World/Geometry; returns its path."""
        return self.group(f"/World/Geometry/{name}", translate, rotate, kind=Kind.Tokens.component, doc=doc)

    def group(
        self,
        path: str,
        translate: Animated | None = None,
        rotate: Animated | None = None,
        kind: str = "",
        doc: str = "",
    ) -> str:
        prim = UsdGeom.Xform.Define(self.stage, path).GetPrim()
        if kind:
            Usd.ModelAPI(prim).SetKind(kind)
        if doc:
            prim.SetDocumentation(doc)
        self.place(prim, translate, rotate)
        return path

    # Shapes ----------------------------------------------------------------------------------------------------

    def mesh(
        self,
        path: str,
        shape: Shape,
        material: str,
        translate: Animated | None = None,
        rotate: Animated | None = None,
        scale: Triple | None = None,
        smooth: bool = False,
    ) -> str:
        """A polygon mesh, or with `smooth` a Catmull-Clark cage."""
        mesh = UsdGeom.Mesh.Define(self.stage, path)
        points = np.ascontiguousarray(np.round(shape.points, 5) + 0.0, dtype=np.float32)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray([len(face) for face in shape.faces]))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray([i for face in shape.faces for i in face]))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.catmullClark if smooth else UsdGeom.Tokens.none)
        mesh.CreateExtentAttr([Gf.Vec3f(*map(float, points.min(0))), Gf.Vec3f(*map(float, points.max(0)))])
        if shape.st is not None:
            st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
                "st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying
            )
            st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(np.round(shape.st, 5) + 0.0, dtype=np.float32)))
        self._finish(mesh, material, translate, rotate, scale)
        return path

    def sphere(self, path: str, radius: float, material: str, translate: Animated | None = None) -> str:
        sphere = UsdGeom.Sphere.Define(self.stage, path)
        sphere.CreateRadiusAttr(radius)
        sphere.CreateExtentAttr([Gf.Vec3f(-radius), Gf.Vec3f(radius)])
        self._finish(sphere, material, translate, None, None)
        return path

    def cylinder(
        self,
        path: str,
        radius: float,
        height: float,
        material: str,
        translate: Animated | None = None,
        rotate: Animated | None = None,
        axis: str = "Y",
    ) -> str:
        cylinder = UsdGeom.Cylinder.Define(self.stage, path)
        self._axial(cylinder, radius, height, axis)
        self._finish(cylinder, material, translate, rotate, None)
        return path

    def cone(self, path: str, radius: float, height: float, material: str, translate: Triple | None = None) -> str:
        cone = UsdGeom.Cone.Define(self.stage, path)
        self._axial(cone, radius, height, "Y")
        self._finish(cone, material, translate, None, None)
        return path

    @staticmethod
    def _axial(gprim: UsdGeom.Gprim, radius: float, height: float, axis: str) -> None:
        gprim.CreateRadiusAttr(radius)
        gprim.CreateHeightAttr(height)
        gprim.CreateAxisAttr(axis)
        half = [height / 2 if name == axis else radius for name in "XYZ"]
        gprim.CreateExtentAttr([-Gf.Vec3f(*half), Gf.Vec3f(*half)])

    def _finish(
        self,
        gprim: UsdGeom.Gprim,
        material: str,
        translate: Animated | None,
        rotate: Animated | None,
        scale: Triple | None,
    ) -> None:
        self.place(gprim.GetPrim(), translate, rotate, scale)
        bound = UsdShade.Material(self.stage.GetPrimAtPath(f"/World/Materials/{material}"))
        if not bound:
            raise KeyError(f"{gprim.GetPath()}: no material {material}")
        UsdShade.MaterialBindingAPI.Apply(gprim.GetPrim()).Bind(bound)

    # Looks -----------------------------------------------------------------------------------------------------

    def material(
        self,
        name: str,
        diffuse: Color = (0.5, 0.5, 0.5),
        roughness: float = 1.0,
        metallic: float = 0.0,
        ior: float = 1.0,
        emissive: Color | None = None,
        texture: str | None = None,
        texture_scale: tuple[float, float] = (1.0, 1.0),
    ) -> str:
        """A UsdPreviewSurface; without an `ior` it is purely diffuse. `texture` drives the diffuse colour."""
        path = f"/World/Materials/{name}"
        material = UsdShade.Material.Define(self.stage, path)
        surface = UsdShade.Shader.Define(self.stage, f"{path}/Surface")
        surface.CreateIdAttr("UsdPreviewSurface")
        diffuse_input = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        diffuse_input.Set(Gf.Vec3f(*diffuse))
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
        surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(metallic)
        surface.CreateInput("ior", Sdf.ValueTypeNames.Float).Set(ior)
        if emissive is not None:
            surface.CreateInput("emissiveColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*emissive))
        surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
        material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
        if texture is not None:
            diffuse_input.ConnectToSource(self._texture(path, texture, texture_scale, diffuse), "rgb")
        return name

    def _texture(self, path: str, file: str, scale: tuple[float, float], fallback: Color) -> UsdShade.ConnectableAPI:
        reader = UsdShade.Shader.Define(self.stage, f"{path}/St")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
        reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        source = reader
        if scale != (1.0, 1.0):
            source = UsdShade.Shader.Define(self.stage, f"{path}/StScale")
            source.CreateIdAttr("UsdTransform2d")
            source.CreateInput("scale", Sdf.ValueTypeNames.Float2).Set(Gf.Vec2f(*scale))
            source.CreateInput("in", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
            source.CreateOutput("result", Sdf.ValueTypeNames.Float2)
        image = UsdShade.Shader.Define(self.stage, f"{path}/Image")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(Sdf.AssetPath(file))
        image.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
        image.CreateInput("wrapS", Sdf.ValueTypeNames.Token).Set("repeat")
        image.CreateInput("wrapT", Sdf.ValueTypeNames.Token).Set("repeat")
        image.CreateInput("fallback", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*fallback, 1.0))
        image.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(source.ConnectableAPI(), "result")
        image.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
        return image.ConnectableAPI()

    # Lights and cameras ----------------------------------------------------------------------------------------

    def rect_light(
        self,
        path: str,
        size: tuple[float, float],
        radiance: Color,
        translate: Triple,
        rotate: Triple,
    ) -> str:
        light = UsdLux.RectLight.Define(self.stage, path)
        light.CreateWidthAttr(size[0])
        light.CreateHeightAttr(size[1])
        half = Gf.Vec3f(size[0] / 2, size[1] / 2, 0)
        light.CreateExtentAttr([-half, half])
        self._radiance(light, radiance)
        self.place(light.GetPrim(), translate, rotate)
        return path

    def sphere_light(self, path: str, radius: float, radiance: Color, translate: Triple) -> str:
        light = UsdLux.SphereLight.Define(self.stage, path)
        light.CreateRadiusAttr(radius)
        light.CreateExtentAttr([Gf.Vec3f(-radius), Gf.Vec3f(radius)])
        self._radiance(light, radiance)
        self.place(light.GetPrim(), translate)
        return path

    def sun(self, path: str, irradiance: Color, angle: float, rotate: Triple) -> str:
        """A distant light given by the irradiance on a plane that faces it (`normalize`)."""
        light = UsdLux.DistantLight.Define(self.stage, path)
        light.CreateAngleAttr(angle)
        light.CreateNormalizeAttr(True)
        self._radiance(light, irradiance)
        self.place(light.GetPrim(), None, rotate)
        return path

    def dome(self, path: str, file: str, intensity: float, rotate: Triple | None = None) -> str:
        light = UsdLux.DomeLight.Define(self.stage, path)
        light.CreateTextureFileAttr(Sdf.AssetPath(file))
        light.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
        light.CreateIntensityAttr(intensity)
        self.place(light.GetPrim(), None, rotate)
        return path

    @staticmethod
    def _radiance(light: UsdLux.BoundableLightBase, radiance: Color) -> None:
        peak = max(radiance)
        light.CreateIntensityAttr(round(peak, 6))
        light.CreateColorAttr(Gf.Vec3f(*(value / peak for value in radiance)))

    def camera(self, name: str, eye: Triple, target: Triple, fov: float, aspect: float = 4 / 3) -> str:
        """A camera at `eye` that looks at `target`; `fov` is horizontal, in degrees."""
        path = f"/World/Cameras/{name}"
        camera = UsdGeom.Camera.Define(self.stage, path)
        aperture = 24.0  # tenths of a scene unit, as UsdGeom has it
        camera.CreateHorizontalApertureAttr(aperture)
        camera.CreateVerticalApertureAttr(round(aperture / aspect, 6))
        camera.CreateFocalLengthAttr(round(aperture / 2 / float(np.tan(np.radians(fov) / 2)), 6))
        camera.CreateClippingRangeAttr(Gf.Vec2f(0.05, 100))
        forward = Gf.Vec3d(*target) - Gf.Vec3d(*eye)
        # Euler angles rather than a matrix: a person can read and change them.
        yaw = float(np.degrees(np.arctan2(-forward[0], -forward[2])))
        pitch = float(np.degrees(np.arctan2(forward[1], np.hypot(forward[0], forward[2]))))
        self.place(camera.GetPrim(), eye, (round(pitch, 4), round(yaw, 4), 0.0))
        return path

    def render_settings(self, camera: str, width: int = 640, height: int = 480) -> None:
        UsdGeom.Scope.Define(self.stage, "/Render")
        settings = UsdRender.Settings.Define(self.stage, "/Render/Settings")
        settings.CreateCameraRel().SetTargets([camera])
        settings.CreateResolutionAttr(Gf.Vec2i(width, height))
        self.stage.SetMetadata("renderSettingsPrimPath", "/Render/Settings")


def _set(op: UsdGeom.XformOp, value: Animated, kind: type) -> None:
    if isinstance(value, Mapping):
        for frame, sample in value.items():
            op.Set(kind(*(round(float(x), 5) + 0.0 for x in sample)), frame)
    else:
        op.Set(kind(*value))


def write_over_layer(path: Path, weaker: str, doc: str, frames: tuple[int, int] | None = None) -> Sdf.Layer:
    """A layer that sublayers `weaker` and says nothing yet, with the stage metadata a root layer needs."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.subLayerPaths = [weaker if weaker.startswith("../") else f"./{weaker}"]
    layer.documentation = doc
    layer.defaultPrim = "World"
    root = layer.pseudoRoot
    root.SetInfo("upAxis", "Y")
    root.SetInfo("metersPerUnit", 1.0)
    root.SetInfo("renderSettingsPrimPath", "/Render/Settings")
    if frames is not None:
        layer.startTimeCode, layer.endTimeCode = frames
        layer.timeCodesPerSecond = layer.framesPerSecond = 24
    path.parent.mkdir(parents=True, exist_ok=True)
    layer.Export(str(path))
    return layer
