"""Two seconds in a room: a ball bounces into a basket that slides to meet it, and a person walks by the couch."""

from __future__ import annotations

from math import cos, pi, sin
from pathlib import Path

from . import images
from .build import StageBuilder
from .edits import New, Override
from .figure import Looks, Pose, add_figure
from .shapes import box, cushion, lathe, quad

NAME = "animated_room"
FRAMES = (1, 48)
DOC = """48 frames at 24 frames/s, camera fixed: a red ball bounces into a basket that slides to meet it while a person
walks past the couch. Lights and room stand still; the light that ball, basket and person take from and
send to the floor moves with them, so an edit on it has to be keyed.
Expect at 160 x 120 in frame 28: mean luminance 0.392, 53 % indirect; shot.usda changes the indirect light by +1.2 %."""

STEP = 3  # frames between samples; linear in between


SEQUENCE_DOC = "The sequence: the ball's red on the floor, keyed to swell at its second landing and fade by the end."
SEQUENCE = (
    New(
        "ballGlow",
        "Red light that the ball sends the floor: as it is, eight times as much at frame 28, as it is again.",
        receivers=("Geometry/Room/Floor",),
        casters=("Geometry/Ball",),
        keys={1.0: {"gain": 1.0}, 28.0: {"gain": 8.0}, 48.0: {"gain": 1.0}},
    ),
)
SHOT_DOC = "The shot: ballGlow at three quarters, and the yellow wall warmer on the person who walks away from it."
SHOT = (
    Override("ballGlow", amount=0.75),
    New(
        "wallOnPerson",
        "Light from the yellow wall and the floor on the person.",
        receivers=("Geometry/Person",),
        casters=("Geometry/Room/LeftWall", "Geometry/Room/Floor"),
        parameters={"color": (1.8, 1.5, 1.0)},
    ),
)


def build(folder: Path) -> None:
    images.write_png(folder / "textures/planks.png", images.wood_planks(128))
    b = StageBuilder(DOC, FRAMES)
    b.material("Wall", (0.70, 0.70, 0.66))
    b.material("Yellow", (0.72, 0.52, 0.16))
    b.material("Floor", (0.3, 0.18, 0.09), texture="./textures/planks.png")
    b.material("Couch", (0.16, 0.28, 0.20))
    b.material("Linen", (0.66, 0.62, 0.55))
    b.material("Ball", (0.68, 0.05, 0.04), roughness=0.35, ior=1.5)
    b.material("Basket", (0.50, 0.33, 0.16))
    b.material("Skin", (0.45, 0.27, 0.18))
    b.material("Hair", (0.04, 0.03, 0.025))
    b.material("Shirt", (0.16, 0.28, 0.52))
    b.material("Trousers", (0.42, 0.38, 0.32))
    b.material("Shoes", (0.5, 0.5, 0.48))

    left, right, back, front, top = -2.2, 2.2, -1.8, 3.6, 2.6
    room = b.component("Room")
    b.mesh(
        f"{room}/Floor",
        quad([(left, 0, front), (right, 0, front), (right, 0, back), (left, 0, back)], (4.4 / 1.2, 5.4 / 1.2)),
        "Floor",
    )
    b.mesh(
        f"{room}/Ceiling",
        quad([(left, top, back), (right, top, back), (right, top, front), (left, top, front)]),
        "Wall",
    )
    b.mesh(f"{room}/BackWall", quad([(left, 0, back), (right, 0, back), (right, top, back), (left, top, back)]), "Wall")
    b.mesh(
        f"{room}/LeftWall", quad([(left, 0, front), (left, 0, back), (left, top, back), (left, top, front)]), "Yellow"
    )
    b.mesh(
        f"{room}/RightWall",
        quad([(right, 0, back), (right, 0, front), (right, top, front), (right, top, back)]),
        "Wall",
    )
    b.mesh(
        f"{room}/FrontWall",
        quad([(right, 0, front), (left, 0, front), (left, top, front), (right, top, front)]),
        "Wall",
    )

    couch = b.component("Couch", (0.55, 0, -1.28))
    b.mesh(f"{couch}/Base", cushion((1.7, 0.26, 0.82), 0.05), "Couch", (0, 0.08, 0), smooth=True)
    b.mesh(f"{couch}/Seat", cushion((1.42, 0.18, 0.70), 0.06), "Couch", (0, 0.31, 0.06), smooth=True)
    b.mesh(f"{couch}/Back", cushion((1.42, 0.50, 0.20), 0.07), "Couch", (0, 0.42, -0.27), (-8, 0, 0), smooth=True)
    b.mesh(f"{couch}/ArmLeft", cushion((0.20, 0.48, 0.84), 0.07), "Couch", (-0.80, 0.08, 0), smooth=True)
    b.mesh(f"{couch}/ArmRight", cushion((0.20, 0.48, 0.84), 0.07), "Couch", (0.80, 0.08, 0), smooth=True)
    b.mesh(
        f"{couch}/Pillow", cushion((0.42, 0.40, 0.14), 0.07), "Linen", (0.45, 0.48, -0.04), (-22, -10, -5), smooth=True
    )  # noqa: E501
    b.mesh(f"{room}/Shelf", box((0.9, 0.04, 0.24)), "Linen", (-1.5, 1.35, -1.68))

    b.sphere(f"{b.component('Ball', _every(_ball))}/Surface", 0.14, "Ball")
    basket = b.component("Basket", _every(_basket))
    profile = [(0.19, 0.0), (0.20, 0.01), (0.24, 0.16), (0.27, 0.33), (0.255, 0.335), (0.225, 0.16), (0.18, 0.025)]
    b.mesh(f"{basket}/Weave", lathe(profile, 16), "Basket", smooth=True)

    person = b.component("Person", _every(_walk), (0, 78, 0))
    swing = {
        "ArmLeft": _every(lambda f: (24 * sin(_stride(f)), 0, 6)),
        "ArmRight": _every(lambda f: (-24 * sin(_stride(f)), 0, -6)),
        "ForearmLeft": _every(lambda f: (-24 + 10 * sin(_stride(f)), 0, 0)),
        "ForearmRight": _every(lambda f: (-24 - 10 * sin(_stride(f)), 0, 0)),
        "LegLeft": _every(lambda f: (-24 * sin(_stride(f)), 0, 0)),
        "LegRight": _every(lambda f: (24 * sin(_stride(f)), 0, 0)),
        "ShinLeft": _every(lambda f: (6 + 26 * max(0.0, cos(_stride(f))), 0, 0)),
        "ShinRight": _every(lambda f: (6 + 26 * max(0.0, -cos(_stride(f))), 0, 0)),
        "Head": (4.0, 0.0, 0.0),
    }
    add_figure(b, person, Looks("Skin", "Hair", "Shirt", "Trousers", "Shoes"), Pose(swing))

    # High on the right wall, tilted down: a window's worth of light that lands on floor and left wall.
    b.rect_light("/World/Lights/Window", (1.6, 1.0), (26.0, 24.0, 21.0), (1.95, 1.85, 0.9), (-25, 90, 0))
    main = b.camera("Main", (0.0, 1.45, 3.4), (0.0, 0.86, -0.9), 52)
    b.render_settings(main)
    b.save(folder / "scene.usda")


def _every(curve):  # type: ignore[no-untyped-def]
    """Samples of `curve`(frame) at the first frame, every `STEP` frames and the last one."""
    frames = sorted({*range(FRAMES[0], FRAMES[1] + 1, STEP), FRAMES[1]})
    return {float(frame): curve(frame) for frame in frames}


def _ball(frame: float) -> tuple[float, float, float]:
    """Three bounces along +x, each lower, the last one into the basket."""
    x = -1.3 + 1.9 * (frame - 1) / 42
    bounces = ((-9.0, 13.0, 1.15), (13.0, 28.0, 0.72), (28.0, 43.0, 0.66))
    for start, end, height in bounces:
        if frame <= end:
            t = (frame - start) / (end - start)
            rest = 0.14 if end < 40 or t < 0.5 else 0.19
            return x, rest + height * 4 * t * (1 - t), 0.55
    return _basket(frame)[0], 0.19, 0.55


def _basket(frame: float) -> tuple[float, float, float]:
    t = min(max((frame - 10) / 30, 0.0), 1.0)
    return 1.35 - 0.75 * t * t * (3 - 2 * t), 0.0, 0.55


def _walk(frame: float) -> tuple[float, float, float]:
    return -1.25 + 1.7 * (frame - 1) / 47, -0.02 * sin(_stride(frame)) ** 2, -0.35


def _stride(frame: float) -> float:
    return 2 * pi * (frame - 1) / 28
