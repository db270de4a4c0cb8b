"""A staircase, a statue at its foot and a cylinder that hangs above, all lit by way of the ceiling."""

from __future__ import annotations

from pathlib import Path

from .build import StageBuilder
from .edits import New, Override
from .figure import Looks, Pose, add_figure
from .shapes import box, lathe, quad, staircase

NAME = "staircase"
FRAMES = None
DOC = """A stair hall lit from one panel that faces the ceiling, so all light in the picture but the ceiling's is
indirect. A large cylinder hangs between ceiling and stairs and lays a soft indirect shadow on the treads and
the statue: a shadow that no light's settings can lighten, and that an edit can.
Expect at 160 x 120: mean luminance 0.352, 97 % indirect; shot.usda changes the indirect light by +6.3 %."""


SEQUENCE_DOC = "The sequence: the cylinder's indirect shadow lightened on the statue."
SEQUENCE = (
    New(
        "statueLift",
        "More of the ceiling's light on the statue.",
        receivers=("Geometry/Statue",),
        casters=("Geometry/Hall/Ceiling",),
        parameters={"color": (1.9, 1.85, 1.75)},
    ),
)
SHOT_DOC = (
    "The shot: statueLift held back, the treads under the cylinder lit from the ceiling, less terracotta on them."
)
SHOT = (
    Override("statueLift", amount=0.7),
    New(
        "treadsClear",
        "The soft shadow on the stairs under the cylinder, lightened where it is deepest.",
        receivers=("Geometry/Stairs",),
        casters=("Geometry/Hall/Ceiling",),
        parameters={"gain": 1.8},
        receiver_sphere=(-0.3, 0.4, -0.3, 0.5, 1.6),
    ),
    New(
        "terracotta",
        "Less colour from the left wall on the stairs.",
        receivers=("Geometry/Stairs",),
        casters=("Geometry/Hall/LeftWall",),
        operation="hsv",
        parameters={"saturation": 0.4},
    ),
)


def build(folder: Path) -> None:
    b = StageBuilder(DOC)
    b.material("Plaster", (0.74, 0.71, 0.66))
    b.material("Ceiling", (0.84, 0.82, 0.78))
    b.material("Stone", (0.52, 0.49, 0.45))
    b.material("Marble", (0.76, 0.75, 0.72), roughness=0.4, ior=1.5)
    b.material("Terracotta", (0.58, 0.33, 0.22))
    b.material("Blue", (0.16, 0.30, 0.42), roughness=0.5, ior=1.5)
    b.material("Copper", (0.72, 0.36, 0.20), roughness=0.5, ior=1.5)
    b.material("Runner", (0.34, 0.05, 0.06))

    left, right, back, front, top = -1.9, 2.1, -2.9, 4.9, 3.6
    hall = b.component("Hall")
    b.mesh(f"{hall}/Floor", quad([(left, 0, front), (right, 0, front), (right, 0, back), (left, 0, back)]), "Stone")
    b.mesh(
        f"{hall}/Ceiling",
        quad([(left, top, back), (right, top, back), (right, top, front), (left, top, front)]),
        "Ceiling",
    )
    b.mesh(
        f"{hall}/BackWall", quad([(left, 0, back), (right, 0, back), (right, top, back), (left, top, back)]), "Plaster"
    )
    b.mesh(
        f"{hall}/LeftWall",
        quad([(left, 0, front), (left, 0, back), (left, top, back), (left, top, front)]),
        "Terracotta",
    )
    b.mesh(
        f"{hall}/RightWall",
        quad([(right, 0, back), (right, 0, front), (right, top, front), (right, top, back)]),
        "Plaster",
    )
    b.mesh(
        f"{hall}/FrontWall",
        quad([(right, 0, front), (left, 0, front), (left, top, front), (right, top, front)]),
        "Plaster",
    )

    stairs = b.component("Stairs", (-0.75, 0, 0.1))
    b.mesh(f"{stairs}/Steps", staircase(8, 2.2, 0.17, 0.29), "Stone")
    b.mesh(f"{stairs}/Landing", box((2.2, 1.36, 0.68)), "Stone", (0, 0, -2.66))
    b.mesh(f"{stairs}/Parapet", box((0.14, 0.92, 0.68)), "Plaster", (1.03, 1.36, -2.66))
    for step in range(8):
        tread = box((1.0, 0.012, 0.29))
        b.mesh(
            f"{stairs}/Runner{step + 1}",
            tread,
            "Runner",
            (0, round(0.17 * (step + 1), 4), round(-0.29 * (step + 0.5), 4)),
        )  # noqa: E501
    for step in range(0, 8, 2):
        b.cylinder(
            f"{stairs}/Post{step // 2 + 1}",
            0.028,
            0.86,
            "Copper",
            (1.03, round(0.17 * (step + 1) + 0.43, 4), round(-0.29 * (step + 0.5), 4)),
        )  # noqa: E501
    rail = box((0.06, 0.05, 2.18))
    b.mesh(f"{stairs}/Rail", rail, "Copper", (1.03, 1.525, -1.015), (30.4, 0, 0))

    statue = b.component("Statue", (1.12, 0, 0.42), (0, -22, 0), doc="A statue on a plinth, in the cylinder's shade.")
    b.mesh(
        f"{statue}/Plinth",
        lathe([(0.36, 0), (0.36, 0.08), (0.30, 0.10), (0.28, 0.36), (0.33, 0.40), (0.33, 0.46)], 24),
        "Stone",
    )  # noqa: E501
    figure = b.group(f"{statue}/Figure", (0, 0.46, 0))
    pose = {
        "ArmLeft": (-8.0, 0.0, 112.0),
        "ForearmLeft": (0.0, 0.0, 52.0),
        "ArmRight": (8.0, 0.0, -16.0),
        "ForearmRight": (-34.0, 0.0, 12.0),
        "Head": (-8.0, 24.0, 0.0),
    }
    add_figure(b, figure, Looks.one("Marble"), Pose(pose), robe=True)
    b.sphere(f"{figure}/ArmLeft/ForearmLeft/Orb", 0.085, "Copper", (0.0, -0.47, 0.03))

    above = b.component("Cylinder", (0.30, 2.78, 0.10), doc="Casts the indirect shadow.")
    b.cylinder(f"{above}/Body", 0.34, 2.0, "Blue", axis="X", rotate=(0, 12, 0))

    # The panel lies on a ledge of the right wall and looks up.
    b.rect_light("/World/Lights/Cove", (0.5, 2.2), (64.0, 60.0, 54.0), (1.78, 2.75, 0.9), (90, 0, 0))
    ledge = b.component("Ledge", (1.8, 2.68, 0.9))
    b.mesh(f"{ledge}/Board", box((0.6, 0.05, 2.4)), "Plaster")

    main = b.camera("Main", (0.62, 1.66, 4.6), (0.10, 1.46, -0.6), 53)
    b.render_settings(main)
    b.save(folder / "scene.usda")
