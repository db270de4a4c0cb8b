"""A Cornell-like box: red wall, green wall, two white blocks, one light under the ceiling."""

from __future__ import annotations

from pathlib import Path

from .build import StageBuilder
from .edits import New, Override
from .shapes import box, quad

NAME = "cornell_box"
FRAMES = None
DOC = """A Cornell-like box, 2 m a side, open to the camera: red wall left, green wall right, two white blocks.
Variant set "light" on /World: "rect" is a RectLight under the ceiling, "mesh" a quad with an emissive material of the
same size and radiance, so both give the same picture but for the lamp itself, which only the mesh shows.
Expect at 160 x 160: mean luminance 0.125, 48 % indirect; shot.usda changes the indirect light by +0.8 %."""

RADIANCE = (24.0, 19.5, 14.0)


SEQUENCE_DOC = "The sequence: less red from the wall on the blocks, and the short one tinted by hue."
SEQUENCE = (
    New(
        "lessRed",
        "The red wall sends the blocks a third of its light.",
        receivers=("Geometry/Blocks",),
        casters=("Geometry/Room/RedWall",),
        parameters={"gain": 0.33},
    ),
    New(
        "greenToBlue",
        "What the green wall sends the short block turns towards blue.",
        receivers=("Geometry/Blocks/Short",),
        casters=("Geometry/Room/GreenWall",),
        operation="hsv",
        parameters={"hue": 100.0, "value": 1.5},
    ),
)
SHOT_DOC = "The shot: keeps half of lessRed, and lifts the ceiling from the floor in a soft round patch."
SHOT = (
    Override("lessRed", amount=0.5),
    New(
        "ceilingPatch",
        "Light from the floor on the middle of the ceiling, more and warmer towards the centre.",
        receivers=("Geometry/Room/Ceiling",),
        casters=("Geometry/Room/Floor",),
        parameters={"color": (2.4, 2.0, 1.5)},
        receiver_sphere=(0.0, 2.0, 0.0, 0.2, 0.9),
    ),
)


def build(folder: Path) -> None:
    b = StageBuilder(DOC)
    b.material("White", (0.73, 0.72, 0.69))
    b.material("Red", (0.63, 0.06, 0.05))
    b.material("Green", (0.12, 0.45, 0.11))
    b.material("Emitter", (0.0, 0.0, 0.0), emissive=RADIANCE)

    room = b.component("Room")
    b.mesh(f"{room}/Floor", quad([(-1, 0, 1), (1, 0, 1), (1, 0, -1), (-1, 0, -1)]), "White")
    b.mesh(f"{room}/Ceiling", quad([(-1, 2, -1), (1, 2, -1), (1, 2, 1), (-1, 2, 1)]), "White")
    b.mesh(f"{room}/BackWall", quad([(-1, 0, -1), (1, 0, -1), (1, 2, -1), (-1, 2, -1)]), "White")
    b.mesh(f"{room}/RedWall", quad([(-1, 0, 1), (-1, 0, -1), (-1, 2, -1), (-1, 2, 1)]), "Red")
    b.mesh(f"{room}/GreenWall", quad([(1, 0, -1), (1, 0, 1), (1, 2, 1), (1, 2, -1)]), "Green")

    blocks = b.component("Blocks")
    b.mesh(f"{blocks}/Tall", box((0.6, 1.2, 0.6)), "White", (-0.34, 0, -0.30), (0, 17, 0))
    b.mesh(f"{blocks}/Short", box((0.6, 0.6, 0.6)), "White", (0.35, 0, 0.36), (0, -17, 0))

    b.rect_light("/World/Lights/Ceiling", (0.5, 0.4), RADIANCE, (0, 1.99, 0), (-90, 0, 0))
    lamp = b.component("Lamp", (0, 1.99, 0))
    b.mesh(
        f"{lamp}/Panel",
        quad([(-0.25, 0, -0.2), (0.25, 0, -0.2), (0.25, 0, 0.2), (-0.25, 0, 0.2)]),
        "Emitter",
    )
    # Black behind the panel: the emission of a surface leaves both its sides, a RectLight's only one.
    b.material("Black", (0.0, 0.0, 0.0))
    b.mesh(
        f"{lamp}/Cover",
        quad([(-0.25, 0.005, -0.2), (0.25, 0.005, -0.2), (0.25, 0.005, 0.2), (-0.25, 0.005, 0.2)]),
        "Black",
    )

    world = b.stage.GetPrimAtPath("/World")
    variants = world.GetVariantSets().AddVariantSet("light")
    for name, hidden in (("rect", "/World/Geometry/Lamp"), ("mesh", "/World/Lights/Ceiling")):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            b.stage.GetPrimAtPath(hidden).SetActive(False)
    variants.SetVariantSelection("rect")

    camera = b.camera("Main", (0, 1, 3.95), (0, 1, 0), 37.2, aspect=1.0)
    b.render_settings(camera, 480, 480)
    b.save(folder / "scene.usda")
