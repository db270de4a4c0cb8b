"""Glossy and diffuse things beside a blue wall."""

from __future__ import annotations

from pathlib import Path

from . import images
from .build import StageBuilder
from .edits import New, Override
from .shapes import box, lathe, quad

NAME = "glossy_set"
FRAMES = None
DOC = """A table-top set: a glossy cone, a glossy sphere and a diffuse box between a blue wall and a pale one. The lamp
faces the blue wall, so what the things show on that side is light the wall sent on, diffuse on the box and as a
blurred reflection on cone and sphere: the two lobes an edit of the wall's light has to reach together.
Expect at 160 x 120: mean luminance 0.344, 30 % indirect; shot.usda changes the indirect light by +3.0 %."""


SEQUENCE_DOC = "The sequence: what the blue wall sends the things turns to orange, in both lobes."
SEQUENCE = (
    New(
        "wallOrange",
        "The blue wall's light on cone, sphere, box and ring turned to its complement.",
        receivers=("Geometry/Things",),
        casters=("Geometry/Set/BlueWall",),
        operation="hsv",
        parameters={"hue": 165.0, "value": 1.3},
    ),
)
SHOT_DOC = "The shot: wallOrange at half, and more of the wall on the floor beside it."
SHOT = (
    Override("wallOrange", amount=0.5),
    New(
        "floorBlue",
        "A pool of blue on the floor at the wall's foot.",
        receivers=("Geometry/Set/Floor",),
        casters=("Geometry/Set/BlueWall",),
        parameters={"gain": 3.0},
        receiver_sphere=(-1.6, 0.0, 0.2, 0.3, 1.4),
    ),
)


def build(folder: Path) -> None:
    images.write_png(folder / "textures/checker.png", images.checker())
    b = StageBuilder(DOC)
    b.material("Blue", (0.05, 0.13, 0.58))
    b.material("Pale", (0.70, 0.67, 0.61))
    b.material("Dusk", (0.30, 0.29, 0.30))
    b.material("Tiles", (0.4, 0.4, 0.4), texture="./textures/checker.png", texture_scale=(6.9, 8.7))
    b.material("Cone", (0.58, 0.36, 0.10), roughness=0.28, ior=1.6)
    b.material("Sphere", (0.92, 0.90, 0.88), roughness=0.22, metallic=1.0, ior=1.5)
    b.material("Box", (0.66, 0.30, 0.14))
    b.material("Ring", (0.55, 0.06, 0.08), roughness=0.35, ior=1.5)

    room = b.component("Set")
    left, right, back, front, top = -2.0, 2.6, -1.6, 4.2, 2.7
    b.mesh(f"{room}/Floor", quad([(left, 0, front), (right, 0, front), (right, 0, back), (left, 0, back)]), "Tiles")
    b.mesh(
        f"{room}/Ceiling",
        quad([(left, top, back), (right, top, back), (right, top, front), (left, top, front)]),
        "Pale",
    )
    b.mesh(f"{room}/BlueWall", quad([(left, 0, front), (left, 0, back), (left, top, back), (left, top, front)]), "Blue")
    b.mesh(f"{room}/PaleWall", quad([(left, 0, back), (right, 0, back), (right, top, back), (left, top, back)]), "Pale")
    b.mesh(
        f"{room}/RightWall",
        quad([(right, 0, back), (right, 0, front), (right, top, front), (right, top, back)]),
        "Pale",
    )
    b.mesh(
        f"{room}/FrontWall",
        quad([(right, 0, front), (left, 0, front), (left, top, front), (right, top, front)]),
        "Dusk",
    )

    things = b.component("Things")
    b.cone(f"{things}/Cone", 0.48, 1.25, "Cone", (-1.02, 0.625, -0.45))
    b.sphere(f"{things}/Sphere", 0.5, "Sphere", (0.22, 0.5, 0.18))
    b.mesh(f"{things}/Box", box((0.62, 0.78, 0.62)), "Box", (1.22, 0, -0.55), (0, 24, 0))
    ring = [(0.20, 0.0), (0.27, 0.0), (0.30, 0.05), (0.27, 0.10), (0.20, 0.10), (0.17, 0.05), (0.20, 0.0)]
    b.mesh(f"{things}/Ring", lathe(ring[:-1] + [ring[0]], 16, closed=False), "Ring", (-0.55, 0, 0.85), smooth=True)

    b.rect_light("/World/Lights/Key", (1.0, 1.0), (30.0, 28.5, 26.5), (0.7, 2.45, 0.7), (-38, 68, 0))
    main = b.camera("Main", (1.35, 1.32, 3.9), (-0.36, 0.52, -0.3), 46)
    b.render_settings(main)
    b.save(folder / "scene.usda")
