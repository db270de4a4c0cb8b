"""A small animated stage with render settings, as text; and its command lines."""

from __future__ import annotations

from pathlib import Path

from icheat_usd.cli import main

STAGE = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
    startTimeCode = 1
    endTimeCode = 4
    renderSettingsPrimPath = "/Render/Settings"
)
def Xform "World"
{
    def Cube "Room"
    {
        double size = 4
        token orientation = "leftHanded"
        color3f[] primvars:displayColor = [(0.7, 0.7, 0.7)]
        token visibility.timeSamples = { 1: "inherited", 9: "invisible" }
    }
    def Cube "Block"
    {
        double size = 1
        double3 xformOp:translate.timeSamples = { 1: (0.5, -1.5, -0.5), 4: (-0.5, -1.5, -0.5) }
        uniform token[] xformOpOrder = ["xformOp:translate"]
        color3f[] primvars:displayColor = [(0.8, 0.2, 0.1)]
        token visibility.timeSamples = { 1: "inherited", 9: "invisible" }
    }
    def RectLight "Lamp"
    {
        float inputs:intensity = 20
        double3 xformOp:translate = (0, 1.95, 0)
        float xformOp:rotateX = -90
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    }
    def Camera "Camera"
    {
        float focalLength = 15
        float horizontalAperture = 20
        float verticalAperture = 15
        double3 xformOp:translate = (0, 0, 1.9)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
def Scope "Render"
{
    def RenderSettings "Settings"
    {
        rel camera = </World/Camera>
        uniform int2 resolution = (16, 12)
    }
}
"""

#: A frame in a fraction of a second.
QUICK = ("--method", "brute", "--samples", "1", "--rays", "8", "--bounces", "2")


def make_stage(folder: Path, text: str = STAGE) -> Path:
    """The stage with an edit: the block's light on the room is three times as much."""
    path = folder / "shot.usda"
    path.write_text(text)
    edit = ["edit", "add", str(path), "bleed", "--receivers", "Room", "--casters", "Block", "--set", "gain=3"]
    assert main(edit) == 0
    return path
