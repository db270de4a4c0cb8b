"""Materials of a stage as rows of `Materials`.

UsdPreviewSurface [1]_ is read in full but for the features reported as unsupported. MaterialX's
UsdPreviewSurface and standard surface nodes are read where their inputs are constant.

.. [1] https://openusd.org/release/spec_usdpreviewsurface.html
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from pxr import Sdf, Usd, UsdShade

from icheat_usd.scene import F32, F64, Finding, Materials, Texture
from icheat_usd.stage.reporting import Reporter
from icheat_usd.stage.shading import Source, resolve, resolve_input, time_code
from icheat_usd.stage.textures import TextureLibrary

#: What an unauthored diffuseColor, and a mesh without displayColor, reflects.
GREY = 0.18

Color = tuple[float, float, float]


@dataclass
class _Row:
    """One material while it is read; the fallbacks are UsdPreviewSurface's."""

    path: str = ""
    diffuse: Color = (GREY, GREY, GREY)
    emission: Color = (0.0, 0.0, 0.0)
    specular: Color = (0.0, 0.0, 0.0)
    use_specular: bool = False
    metallic: float = 0.0
    roughness: float = 0.5
    opacity: float = 1.0
    opacity_threshold: float = 0.0
    ior: float = 1.5
    use_display_color: bool = False
    st_name: str = ""
    textures: dict[Texture, _Image] = field(default_factory=dict)


@dataclass(frozen=True)
class _Image:
    """How one input looks up its texture."""

    row: int
    channel: int  #: -1 for rgb
    transform: F64  #: (2, 3)
    scale: tuple[float, float, float, float]
    bias: tuple[float, float, float, float]


def _display_color_row(path: str = "") -> _Row:
    """A matte surface of the mesh's displayColor: without an interface (ior 1), so that it has no highlight."""
    return _Row(path=path, use_display_color=True, ior=1.0, roughness=1.0)


#: Inputs of UsdPreviewSurface that are ignored, with the value at which ignoring them changes nothing.
_UNSUPPORTED: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("clearcoat", (0.0,)),
    ("normal", (0.0, 0.0, 1.0)),
    ("displacement", (0.0,)),
    ("occlusion", (1.0,)),
)

#: Inputs of MaterialX's standard_surface that are ignored unless at this value.
_UNSUPPORTED_STANDARD: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("coat", (0.0,)),
    ("sheen", (0.0,)),
    ("subsurface", (0.0,)),
    ("thin_film_thickness", (0.0,)),
    ("specular_anisotropy", (0.0,)),
    ("diffuse_roughness", (0.0,)),
)


class MaterialLibrary:
    """Materials bound on one stage at one time code; each is read once, however many instances show it.

    Parameters
    ----------
    stage
    time
        When inputs are read; None is the earliest time.

    Attributes
    ----------
    textures : TextureLibrary
        The images that materials look up; lights may add theirs.
    findings : list of Finding
        What was met and is not supported, or wrong; textures' findings included.

    Notes
    -----
    Row 0 is the fallback: the mesh's displayColor, matte. The constant of a textured input is the
    mean of the texture after scale and bias: an estimate for sampling, which a lookup replaces.
    All textures of a material read one primvar; a second one is reported.
    """

    def __init__(self, stage: Usd.Stage, time: Usd.TimeCode | float | None) -> None:
        self.stage = stage
        self.time = time_code(time)
        self.report = Reporter()
        self.textures = TextureLibrary(self.report)
        self._rows = [_display_color_row()]
        self._row_of: dict[Sdf.Path, int] = {}

    @property
    def findings(self) -> list[Finding]:
        return list(self.report.findings())

    def row(self, material: UsdShade.Material | None, *, prim_path: str) -> int:
        """Row of a bound material.

        Parameters
        ----------
        material
            What USD computed as bound; None or invalid where nothing is.
        prim_path
            The prim it is bound to; a binding of it or its ancestors that leads nowhere is reported.
        """
        if not material:
            self._report_dangling_binding(prim_path)
            return 0
        prim = material.GetPrim()
        shared = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
        key = shared.GetPath()
        if key not in self._row_of:
            self._row_of[key] = len(self._rows)
            self._rows.append(self._read(material, _scene_path(prim)))
        return self._row_of[key]

    def st_name(self, row: int) -> str:
        """Name of the primvar that the row's textures read; '' where it has none."""
        return self._rows[row].st_name

    def tables(self) -> tuple[Materials, tuple[str, ...]]:
        """All rows, and the path of the material of each ('' for row 0)."""
        rows = self._rows
        n = len(rows)
        texture = np.full((n, len(Texture)), -1, np.int32)
        channel = np.full((n, len(Texture)), -1, np.int32)
        transform = np.zeros((n, len(Texture), 2, 3), np.float32)
        transform[:, :, 0, 0] = transform[:, :, 1, 1] = 1.0
        scale = np.ones((n, len(Texture), 4), np.float32)
        bias = np.zeros((n, len(Texture), 4), np.float32)
        for i, row in enumerate(rows):
            for column, image in row.textures.items():
                texture[i, column] = image.row
                channel[i, column] = image.channel
                transform[i, column] = image.transform
                scale[i, column] = image.scale
                bias[i, column] = image.bias

        def numbers(values: list[Any]) -> F32:
            return np.array(values, np.float32)

        table = Materials(
            diffuse=numbers([row.diffuse for row in rows]),
            emission=numbers([row.emission for row in rows]),
            specular=numbers([row.specular for row in rows]),
            use_specular=np.array([row.use_specular for row in rows], np.uint8),
            metallic=numbers([row.metallic for row in rows]),
            roughness=numbers([row.roughness for row in rows]),
            opacity=numbers([row.opacity for row in rows]),
            opacity_threshold=numbers([row.opacity_threshold for row in rows]),
            ior=numbers([row.ior for row in rows]),
            use_display_color=np.array([row.use_display_color for row in rows], np.uint8),
            texture=texture,
            texture_channel=channel,
            texture_transform=transform,
            texture_scale=scale,
            texture_bias=bias,
        )
        return table, tuple(row.path for row in rows)

    # Surface shaders ----------------------------------------------------------------------------

    def _read(self, material: UsdShade.Material, path: str) -> _Row:
        found: list[UsdShade.Shader] = []
        for output in _surface_outputs(material):
            node = resolve(output, self.time).node
            if node:
                found.append(node)
        for shader in found:
            read = self._SHADERS.get(shader.GetShaderId() or "")
            if read is not None:
                row = _Row(path=path)
                read(self, shader, row)
                return row
        if found:
            self.report(
                path,
                "surface shader",
                f"it has no surface that can be read, only {_describe(found[0])}; displayColor is used. "
                "Give it a UsdPreviewSurface beside it.",
            )
        else:
            self.report(path, "surface", "it has no surface shader; displayColor is used.")
        return _display_color_row(path)

    def _read_preview_surface(self, shader: UsdShade.Shader, row: _Row) -> None:
        row.use_specular = bool(self._number(shader, "useSpecularWorkflow", 0.0, None, row))
        row.diffuse = self._color(shader, "diffuseColor", (GREY, GREY, GREY), Texture.DIFFUSE, row)
        row.emission = self._color(shader, "emissiveColor", (0.0, 0.0, 0.0), Texture.EMISSION, row)
        row.specular = self._color(shader, "specularColor", (0.0, 0.0, 0.0), Texture.SPECULAR, row)
        row.metallic = self._number(shader, "metallic", 0.0, Texture.METALLIC, row)
        row.roughness = self._number(shader, "roughness", 0.5, Texture.ROUGHNESS, row)
        row.opacity = self._number(shader, "opacity", 1.0, Texture.OPACITY, row)
        row.opacity_threshold = self._number(shader, "opacityThreshold", 0.0, None, row)
        row.ior = self._number(shader, "ior", 1.5, None, row)
        self._report_unsupported(shader, _UNSUPPORTED, row)
        see_through = row.opacity < 1.0 or Texture.OPACITY in row.textures
        if see_through and row.opacity_threshold <= 0.0:
            mode = resolve_input(shader, "opacityMode", self.time).value
            if mode == "presence":
                self._unsupported(row, "opacityMode", "'presence' is treated as 'transparent'")

    def _read_standard_surface(self, shader: UsdShade.Shader, row: _Row) -> None:
        """MaterialX standard_surface: base, metal, one specular lobe, transmission, opacity and emission."""
        base = self._number(shader, "base", 1.0, None, row)
        base_color = self._color(shader, "base_color", (0.8, 0.8, 0.8), None, row)
        emission = self._number(shader, "emission", 0.0, None, row)
        emission_color = self._color(shader, "emission_color", (1.0, 1.0, 1.0), None, row)
        specular = self._number(shader, "specular", 1.0, None, row)
        opacity = self._color(shader, "opacity", (1.0, 1.0, 1.0), None, row)
        transmission = self._number(shader, "transmission", 0.0, None, row)
        row.diffuse = (base * base_color[0], base * base_color[1], base * base_color[2])
        row.emission = (emission * emission_color[0], emission * emission_color[1], emission * emission_color[2])
        row.metallic = self._number(shader, "metalness", 0.0, None, row)
        row.roughness = self._number(shader, "specular_roughness", 0.2, None, row)
        row.ior = self._number(shader, "specular_IOR", 1.5, None, row) if specular > 0.0 else 1.0
        row.opacity = sum(opacity) / 3.0 * (1.0 - transmission)
        self._report_unsupported(shader, _UNSUPPORTED_STANDARD, row)

    # Functions, not methods of `self`: those would hold the library, and by it the stage, until garbage is collected.
    _SHADERS: ClassVar[dict[str, Callable[[MaterialLibrary, UsdShade.Shader, _Row], None]]] = {
        "UsdPreviewSurface": _read_preview_surface,
        "ND_UsdPreviewSurface_surfaceshader": _read_preview_surface,
        "ND_standard_surface_surfaceshader": _read_standard_surface,
    }

    def _report_unsupported(
        self, shader: UsdShade.Shader, inputs: tuple[tuple[str, tuple[float, ...]], ...], row: _Row
    ) -> None:
        for name, neutral in inputs:
            source = resolve_input(shader, name, self.time)
            if source.node or (source.value is not None and not np.allclose(_components(source.value), neutral)):
                self._unsupported(row, name, "it is ignored")

    def _unsupported(self, row: _Row, feature: str, consequence: str) -> None:
        self.report(row.path, feature, f"{feature} is not supported; {consequence}.")

    # Inputs -------------------------------------------------------------------------------------

    def _number(self, shader: UsdShade.Shader, name: str, default: float, column: Texture | None, row: _Row) -> float:
        return self._input(shader, name, (default,), column, row)[0]

    def _color(self, shader: UsdShade.Shader, name: str, default: Color, column: Texture | None, row: _Row) -> Color:
        values = self._input(shader, name, default, column, row)
        return (values[0], values[1], values[2])

    def _input(
        self, shader: UsdShade.Shader, name: str, default: tuple[float, ...], column: Texture | None, row: _Row
    ) -> tuple[float, ...]:
        """Value of an input with as many components as its default; a texture it reads is noted in `row`."""
        source = resolve_input(shader, name, self.time)
        if source.broken:
            self.report(row.path, f"{name} connection", f"{name} is connected to nothing; its own value is used.")
        if source.node is None:
            return _fit(source.value, default, default)
        identifier = str(source.node.GetShaderId() or "")
        if identifier == "UsdUVTexture" and column is not None:
            return self._texture(source, default, column, row)
        if identifier.startswith("UsdPrimvarReader_"):
            return self._primvar(source.node, name, default, row)
        self._unsupported(row, name, f"{_describe(source.node)} is connected to it, and the default is used")
        return default

    def _primvar(self, reader: UsdShade.Shader, name: str, default: tuple[float, ...], row: _Row) -> tuple[float, ...]:
        primvar = str(resolve_input(reader, "varname", self.time).value or "")
        fallback = _fit(resolve_input(reader, "fallback", self.time).value, default, default)
        if name == "diffuseColor" and primvar == "displayColor":
            row.use_display_color = True
        else:
            self._unsupported(
                row, name, f"it reads the primvar '{primvar}', of which only displayColor as diffuseColor is supported"
            )
        return fallback

    def _texture(self, source: Source, default: tuple[float, ...], column: Texture, row: _Row) -> tuple[float, ...]:
        node = source.node
        assert node is not None

        def value(name: str) -> Any:
            return resolve_input(node, name, self.time).value

        is_color = len(default) == 3
        channel = {"r": 0, "g": 1, "b": 2, "a": 3}.get(source.output, -1 if is_color else 0)
        scale = _rgba(value("scale"), (1.0, 1.0, 1.0, 1.0))
        bias = _rgba(value("bias"), (0.0, 0.0, 0.0, 0.0))
        asset = value("file")
        color_space = str(value("sourceColorSpace") or "auto")
        if color_space not in ("auto", "raw", "sRGB"):
            self._unsupported(row, f"sourceColorSpace '{color_space}'", "'auto' is used")
        texture = self.textures.add(
            asset if isinstance(asset, (Sdf.AssetPath, str)) else "",
            color_space,
            str(value("wrapS") or "useMetadata"),
            str(value("wrapT") or "useMetadata"),
            prim_path=_scene_path(node.GetPrim()),
        )
        if texture < 0:
            # The fallback is the node's output as it stands: scale and bias belong to a texture that was read.
            rgba = np.array(_rgba(value("fallback"), (0.0, 0.0, 0.0, 1.0)))
        else:
            transform, st_name = self._texture_coordinates(node, row)
            if row.st_name and st_name != row.st_name:
                self.report(
                    row.path,
                    "texture coordinates",
                    f"it reads texture coordinates '{row.st_name}' and '{st_name}'; "
                    f"'{row.st_name}' is used for all its textures.",
                )
            row.st_name = row.st_name or st_name
            row.textures[column] = _Image(texture, channel, transform, scale, bias)
            rgba = self.textures.mean(texture) * np.array(scale) + np.array(bias)
        if channel >= 0:
            return (float(rgba[channel]),) * len(default)
        return tuple(float(x) for x in rgba[:3])

    def _texture_coordinates(self, texture: UsdShade.Shader, row: _Row) -> tuple[F64, str]:
        """The 2x3 matrix from primvar to image coordinates, and the primvar's name."""
        total = np.eye(3)
        source = resolve_input(texture, "st", self.time)
        while source.node and source.node.GetShaderId() == "UsdTransform2d":
            total = total @ self._transform_2d(source.node)
            source = resolve_input(source.node, "in", self.time)
        if source.node and source.node.GetShaderId() == "UsdPrimvarReader_float2":
            name = str(resolve_input(source.node, "varname", self.time).value or "")
            if name:
                return total[:2], name
        reads = _describe(source.node) if source.node else "no primvar reader"
        self.report(
            row.path,
            "texture coordinates",
            f"the texture coordinates of {texture.GetPath()} come from {reads}; the primvar 'st' is used.",
        )
        return total[:2], "st"

    def _transform_2d(self, node: UsdShade.Shader) -> F64:
        """UsdTransform2d as a 3x3 matrix: scale, then rotate counter-clockwise (degrees), then translate."""

        def pair(name: str, default: tuple[float, ...]) -> tuple[float, ...]:
            return _fit(resolve_input(node, name, self.time).value, default, default)

        angle = math.radians(pair("rotation", (0.0,))[0])
        scale = pair("scale", (1.0, 1.0))
        translation = pair("translation", (0.0, 0.0))
        cosine, sine = math.cos(angle), math.sin(angle)
        return np.array(
            [
                [cosine * scale[0], -sine * scale[1], translation[0]],
                [sine * scale[0], cosine * scale[1], translation[1]],
                [0.0, 0.0, 1.0],
            ]
        )

    def _report_dangling_binding(self, prim_path: str) -> None:
        """Note a material binding that names no prim, as a missing reference leaves it."""
        path = Sdf.Path(prim_path) if prim_path and Sdf.Path.IsValidPathString(prim_path) else Sdf.Path()
        prim = self.stage.GetPrimAtPath(path) if path.IsAbsolutePath() else None
        while prim and not prim.IsPseudoRoot():
            for relationship in prim.GetRelationships():
                if not relationship.GetName().startswith("material:binding") or ":collection" in relationship.GetName():
                    continue
                for target in relationship.GetTargets():
                    if not self.stage.GetPrimAtPath(target):
                        self.report(
                            target,
                            "missing material",
                            f"it is bound on {prim.GetPath()} and does not exist; displayColor is used.",
                        )
                        return
            prim = prim.GetParent()


def _surface_outputs(material: UsdShade.Material) -> list[UsdShade.Output]:
    """The universal surface output, then MaterialX's, then other render contexts' in the order they are authored."""
    rank = {"outputs:surface": 0, "outputs:mtlx:surface": 1}
    outputs = [output for output in material.GetSurfaceOutputs() if output]
    return sorted(outputs, key=lambda output: rank.get(str(output.GetFullName()), 2))


def _describe(shader: UsdShade.Shader) -> str:
    """A shader as findings name it."""
    identifier = shader.GetShaderId()
    if identifier:
        return f"the shader '{identifier}'"
    for attribute in shader.GetPrim().GetAttributes():
        if attribute.GetName().endswith("sourceAsset") and isinstance(attribute.Get(), Sdf.AssetPath):
            return f"a shader of {attribute.Get().path}"
    return f"the shader {shader.GetPath()}, which has no identifier"


def _scene_path(prim: Usd.Prim) -> str:
    """Path by which a scene names a prim: never through a prototype, whose name changes from run to run."""
    path = prim.GetPath()
    while prim and prim.IsInPrototype():
        root = prim
        while not root.IsPrototype():
            root = root.GetParent()
        prim = root.GetInstances()[0]
        path = path.ReplacePrefix(root.GetPath(), prim.GetPath())
    return str(path)


def _components(value: Any) -> tuple[float, ...]:
    """Components of a USD number, vector or bool; empty for anything else."""
    try:
        return (float(value),)
    except (TypeError, ValueError):
        pass
    try:
        return tuple(float(x) for x in value)
    except (TypeError, ValueError):
        return ()


def _fit(value: Any, default: tuple[float, ...], otherwise: tuple[float, ...]) -> tuple[float, ...]:
    """A value with as many components as `default`: a single number fills all, too many are cut."""
    components = _components(value)
    if len(components) == 1:
        return components * len(default)
    return components[: len(default)] if len(components) >= len(default) else otherwise


def _rgba(value: Any, default: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    values = _fit(value, default, default)
    return (values[0], values[1], values[2], values[3])
