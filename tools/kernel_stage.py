"""Writes a small stage with what stages from outside have and sample stages have not: glass, leaves, a sky's image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from icheat_usd.image.exr import write_exr
from icheat_usd.image.film import Film

_STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)

def Xform "World"
{{
    def Mesh "Room"
    {{
        point3f[] points = [
            (-3, -3, -3), (3, -3, -3), (3, 3, -3), (-3, 3, -3), (-3, -3, 3), (3, -3, 3), (3, 3, 3), (-3, 3, 3)
        ]
        int[] faceVertexCounts = [4, 4, 4, 4, 4]
        int[] faceVertexIndices = [0, 4, 5, 1, 3, 2, 6, 7, 0, 3, 7, 4, 1, 5, 6, 2, 4, 7, 6, 5]
        uniform bool doubleSided = 1
        uniform token subdivisionScheme = "none"
        rel material:binding = </World/Plaster>
    }}

    def Mesh "Window"
    {{
        point3f[] points = [(-2, -2, -2.9), (2, -2, -2.9), (2, 2, -2.9), (-2, 2, -2.9)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        uniform bool doubleSided = 1
        uniform token subdivisionScheme = "none"
        rel material:binding = </World/Glass>
    }}

    def Sphere "Ball"
    {{
        double radius = 0.6
        double3 xformOp:translate = (1, -1, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        rel material:binding = </World/Glass>
    }}

    def Sphere "Mirror"
    {{
        double radius = 0.5
        double3 xformOp:translate = (0, -1, -1)
        uniform token[] xformOpOrder = ["xformOp:translate"]
        rel material:binding = </World/Metal>
    }}

    def Mesh "Leaf"
    {{
        point3f[] points = [(-2, -2, -1), (-0.5, -2, 0), (-0.5, 1, 0), (-2, 1, -1)]
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (1, 1), (0, 1)] (interpolation = "vertex")
        uniform bool doubleSided = 1
        uniform token subdivisionScheme = "none"
        rel material:binding = </World/Leaves>
    }}
{materials}
    def DomeLight "Sky"
    {{
        asset inputs:texture:file = @{image}@
        float inputs:intensity = 1
    }}

    def DistantLight "Sun"
    {{
        float inputs:angle = 0.53
        float inputs:intensity = 5
        float3 xformOp:rotateXYZ = (-30, 190, 0)
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ"]
    }}

    def SphereLight "Bulb"
    {{
        float inputs:radius = 0.05
        float inputs:intensity = 300
        double3 xformOp:translate = (0, 2, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}

    def Camera "Camera"
    {{
        float2 clippingRange = (0.01, 100)
        float focalLength = 20
        double3 xformOp:translate = (0, 0, 2.8)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }}
}}
"""

_MATERIAL = """
    def Material "{name}"
    {{
        token outputs:surface.connect = </World/{name}/Surface.outputs:surface>

        def Shader "Surface"
        {{
            uniform token info:id = "UsdPreviewSurface"
            {inputs}
            token outputs:surface
        }}

        def Shader "Image"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{image}@
            token inputs:sourceColorSpace = "raw"
            float2 inputs:st.connect = </World/{name}/St.outputs:result>
            float outputs:r
            float3 outputs:rgb
        }}

        def Shader "St"
        {{
            uniform token info:id = "UsdPrimvarReader_float2"
            string inputs:varname = "st"
            float2 outputs:result
        }}
    }}
"""

_INPUTS = {
    "Plaster": ("color3f inputs:diffuseColor = (0.7, 0.7, 0.7)",),
    "Glass": ("float inputs:opacity = 0", "float inputs:roughness = 0", "float inputs:ior = 1.5"),
    "Metal": ("float inputs:metallic = 1", "float inputs:roughness = 0"),
    "Leaves": (
        "color3f inputs:diffuseColor.connect = </World/Leaves/Image.outputs:rgb>",
        "float inputs:opacity.connect = </World/Leaves/Image.outputs:r>",
        "float inputs:opacityThreshold = 0.5",
    ),
}


def write_stage(folder: Path) -> Path:
    """The stage and its image, in a folder that is there."""
    image, stage = folder / "image.exr", folder / "stage.usda"
    u, v = np.meshgrid(np.linspace(0, 9, 64), np.linspace(0, 5, 32))
    colours = np.stack([0.5 + 0.5 * np.sin(u), 0.5 + 0.5 * np.cos(v), u * 0 + 0.4], axis=-1).astype(np.float32)
    write_exr(Film(64, 32, {"beauty": colours}), image)
    materials = "".join(
        _MATERIAL.format(name=name, inputs=("\n" + 12 * " ").join(inputs), image=image.name)
        for name, inputs in _INPUTS.items()
    )
    stage.write_text(_STAGE.format(materials=materials, image=image.name))
    return stage
