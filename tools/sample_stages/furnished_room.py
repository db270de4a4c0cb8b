"""A furnished room: sun through a window falls on the rug, and what it bounces lights the person who stands beside."""

from __future__ import annotations

from pathlib import Path

from . import images
from .build import StageBuilder
from .edits import New, Override
from .figure import Looks, add_figure
from .shapes import box, cushion, lathe, quad, wall_with_hole

NAME = "furnished_room"
FRAMES = None
DOC = """A furnished room, 5.2 x 5 m. Sunlight through a window left of the picture falls on the rug and the low table.
The person beside it stands in the shade, lit by what rug and floor send on: a lighter who wants the face warmer, or
less red from the rug, has no light to turn.
Variant set "sky" on /World: "rect" is a RectLight before the window, "dome" a textured sky that is seen through it.
Expect at 160 x 120: mean luminance 0.264, 45 % indirect; shot.usda changes the indirect light by +2.7 %."""


SEQUENCE_DOC = "The sequence: the rug's red kept off the person, the back wall opened up."
SEQUENCE = (
    New(
        "rugOffPerson",
        "What the rug sends the person loses most of its red.",
        receivers=("Geometry/Person",),
        casters=("Geometry/Rug",),
        operation="hsv",
        parameters={"saturation": 0.35},
    ),
    New(
        "openWall",
        "More light from the floor on the back wall, as if it were paler.",
        receivers=("Geometry/Room/BackWall",),
        casters=("Geometry/Room/Floor", "Geometry/Rug"),
        parameters={"color": (1.5, 1.45, 1.35)},
    ),
)
SHOT_DOC = "The shot: a warm fill on the face, which no light in the room could give alone; openWall held back."
SHOT = (
    Override("openWall", amount=0.6),
    New(
        "faceFill",
        "Indirect light on head and shoulders, soft at the edge.",
        receivers=("Geometry/Person",),
        casters=("Geometry/Room", "Geometry/Rug", "Geometry/CoffeeTable", "Geometry/Sofa"),
        parameters={"color": (2.1, 1.8, 1.5)},
        receiver_sphere=(0.95, 1.58, -0.62, 0.18, 0.62),
    ),
)


def build(folder: Path) -> None:
    images.write_png(folder / "textures/planks.png", images.wood_planks())
    images.write_png(folder / "textures/wood.png", images.wood())
    images.write_png(folder / "textures/rug.png", images.rug())
    images.write_png(folder / "textures/painting.png", images.painting())
    images.write_exr(folder / "textures/sky.exr", images.sky())

    b = StageBuilder(DOC)
    b.material("Wall", (0.72, 0.69, 0.63))
    b.material("Accent", (0.36, 0.47, 0.46))
    b.material("Ceiling", (0.80, 0.79, 0.76))
    b.material("Paint", (0.78, 0.77, 0.73), roughness=0.35, ior=1.5)
    b.material("Planks", (0.3, 0.18, 0.09), texture="./textures/planks.png")
    b.material("Wood", (0.27, 0.15, 0.08), texture="./textures/wood.png", roughness=0.4, ior=1.5)
    b.material("Rug", (0.5, 0.1, 0.06), texture="./textures/rug.png")
    b.material("Painting", (0.4, 0.35, 0.3), texture="./textures/painting.png")
    b.material("Sofa", (0.11, 0.30, 0.33))
    b.material("Mustard", (0.62, 0.38, 0.06))
    b.material("Rust", (0.50, 0.15, 0.06))
    b.material("Linen", (0.66, 0.62, 0.55))
    b.material("Curtain", (0.70, 0.67, 0.60))
    b.material("Brass", (0.80, 0.58, 0.27), metallic=1.0, roughness=0.3, ior=1.5)
    b.material("Ceramic", (0.55, 0.62, 0.66), roughness=0.2, ior=1.5)
    b.material("Shade", (0.82, 0.76, 0.64))
    b.material("Leaf", (0.08, 0.26, 0.07))
    for name, color in _BOOKS.items():
        b.material(name, color)
    b.material("Skin", (0.58, 0.36, 0.26))
    b.material("Hair", (0.05, 0.03, 0.02))
    b.material("Shirt", (0.70, 0.68, 0.64))
    b.material("Trousers", (0.10, 0.12, 0.18))
    b.material("Shoes", (0.07, 0.045, 0.03))

    _shell(b)
    _furniture(b)

    figure = b.component("Person", (0.95, 0, -0.62), (0, -38, 0), doc="Stands in the shade: indirect light only.")
    add_figure(b, figure, Looks("Skin", "Hair", "Shirt", "Trousers", "Shoes"))

    # The sun comes in at the window, 27 degrees high, and lands on the middle of the floor.
    b.sun("/World/Lights/Sun", (36.0, 30.6, 23.4), 0.8, (-26.4, -53.1, 0))
    # Beside the sun's way, so that also renderers whose area lights block light let the sun in.
    b.rect_light("/World/Lights/Sky", (3.0, 2.4), (13.0, 16.0, 20.0), (-4.3, 2.0, -0.5), (0, -132, 0))
    b.dome("/World/Lights/SkyDome", "./textures/sky.exr", 1.0, (0, 140, 0))
    b.sphere_light("/World/Lights/Lamp", 0.05, (70.0, 41.0, 18.0), (-2.15, 1.56, -1.72))

    variants = b.stage.GetPrimAtPath("/World").GetVariantSets().AddVariantSet("sky")
    for name, hidden in (("rect", "SkyDome"), ("dome", "Sky")):
        variants.AddVariant(name)
        variants.SetVariantSelection(name)
        with variants.GetVariantEditContext():
            b.stage.GetPrimAtPath(f"/World/Lights/{hidden}").SetActive(False)
    variants.SetVariantSelection("rect")

    main = b.camera("Main", (1.25, 1.42, 2.62), (-0.42, 0.98, -1.3), 60)
    b.camera("Window", (2.0, 1.5, -1.7), (-2.0, 1.1, 1.0), 62)
    b.render_settings(main)
    b.save(folder / "scene.usda")


_BOOKS: dict[str, tuple[float, float, float]] = {
    "BookRed": (0.42, 0.06, 0.05),
    "BookBlue": (0.06, 0.13, 0.32),
    "BookGreen": (0.10, 0.24, 0.12),
    "BookCream": (0.64, 0.57, 0.42),
}


def _shell(b: StageBuilder) -> None:
    left, right, back, front, top = -2.6, 2.6, -2.2, 2.8, 2.7
    room = b.component("Room")
    b.mesh(
        f"{room}/Floor",
        quad([(left, 0, front), (right, 0, front), (right, 0, back), (left, 0, back)], (5.2 / 1.2, 5.0 / 1.2)),
        "Planks",
    )
    b.mesh(
        f"{room}/Ceiling",
        quad([(left, top, back), (right, top, back), (right, top, front), (left, top, front)]),
        "Ceiling",
    )
    b.mesh(
        f"{room}/BackWall", quad([(left, 0, back), (right, 0, back), (right, top, back), (left, top, back)]), "Accent"
    )
    b.mesh(
        f"{room}/FrontWall",
        quad([(right, 0, front), (left, 0, front), (left, top, front), (right, top, front)]),
        "Wall",
    )
    b.mesh(
        f"{room}/RightWall",
        quad([(right, 0, back), (right, 0, front), (right, top, front), (right, top, back)]),
        "Wall",
    )
    b.mesh(f"{room}/WindowWall", wall_with_hole(5.0, top, (0.7, 2.8, 0.6, 2.30)), "Wall", (left, 0, front), (0, 90, 0))
    b.mesh(f"{room}/SkirtingBack", box((5.2, 0.09, 0.02)), "Paint", (0, 0, back + 0.01))
    b.mesh(f"{room}/SkirtingRight", box((0.02, 0.09, 5.0)), "Paint", (right - 0.01, 0, 0.3))
    b.mesh(f"{room}/SkirtingLeft", box((0.02, 0.09, 5.0)), "Paint", (left + 0.01, 0, 0.3))

    window = b.component("Window")
    b.mesh(f"{window}/Sill", box((0.34, 0.04, 2.26)), "Paint", (left - 0.02, 0.56, 1.05))
    b.mesh(f"{window}/Head", box((0.20, 0.06, 2.22)), "Paint", (left - 0.08, 2.28, 1.05))
    b.mesh(f"{window}/JambFar", box((0.20, 1.74, 0.06)), "Paint", (left - 0.08, 0.58, -0.01))
    b.mesh(f"{window}/JambNear", box((0.20, 1.74, 0.06)), "Paint", (left - 0.08, 0.58, 2.11))
    for index, z in enumerate((0.35, 1.05, 1.75)):
        b.mesh(f"{window}/Upright{index + 1}", box((0.05, 1.7, 0.045)), "Paint", (left - 0.10, 0.6, z))
    b.mesh(f"{window}/Crossbar", box((0.05, 0.045, 2.10)), "Paint", (left - 0.10, 1.55, 1.05))


def _furniture(b: StageBuilder) -> None:
    sofa = b.component("Sofa", (-0.75, 0, -1.66))
    b.mesh(f"{sofa}/Base", cushion((2.05, 0.26, 0.86), 0.05), "Sofa", (0, 0.10, 0), smooth=True)
    b.mesh(f"{sofa}/SeatLeft", cushion((0.86, 0.18, 0.72), 0.06), "Sofa", (-0.44, 0.34, 0.06), smooth=True)
    b.mesh(f"{sofa}/SeatRight", cushion((0.86, 0.18, 0.72), 0.06), "Sofa", (0.44, 0.34, 0.06), smooth=True)
    b.mesh(f"{sofa}/BackLeft", cushion((0.86, 0.50, 0.20), 0.07), "Sofa", (-0.44, 0.46, -0.29), (-9, 0, 0), smooth=True)
    b.mesh(f"{sofa}/BackRight", cushion((0.86, 0.50, 0.20), 0.07), "Sofa", (0.44, 0.46, -0.29), (-9, 0, 0), smooth=True)
    b.mesh(f"{sofa}/ArmLeft", cushion((0.22, 0.50, 0.88), 0.07), "Sofa", (-0.97, 0.10, 0), smooth=True)
    b.mesh(f"{sofa}/ArmRight", cushion((0.22, 0.50, 0.88), 0.07), "Sofa", (0.97, 0.10, 0), smooth=True)
    b.mesh(
        f"{sofa}/PillowMustard",
        cushion((0.46, 0.44, 0.15), 0.07),
        "Mustard",
        (-0.62, 0.52, -0.06),
        (-22, 14, 6),
        smooth=True,
    )  # noqa: E501
    b.mesh(
        f"{sofa}/PillowLinen",
        cushion((0.44, 0.42, 0.14), 0.07),
        "Linen",
        (0.60, 0.52, -0.06),
        (-24, -12, -5),
        smooth=True,
    )  # noqa: E501
    b.mesh(
        f"{sofa}/PillowRust", cushion((0.36, 0.34, 0.13), 0.06), "Rust", (0.30, 0.52, 0.03), (-26, -4, 4), smooth=True
    )  # noqa: E501
    for index, (x, z) in enumerate(((-0.92, 0.34), (0.92, 0.34), (-0.92, -0.34), (0.92, -0.34))):
        b.cylinder(f"{sofa}/Foot{index + 1}", 0.025, 0.11, "Wood", (x, 0.055, z))

    rug = b.component("Rug", (-0.45, 0, -0.15))
    b.mesh(
        f"{rug}/Weave",
        quad([(-1.25, 0.008, 0.85), (1.25, 0.008, 0.85), (1.25, 0.008, -0.85), (-1.25, 0.008, -0.85)]),
        "Rug",
    )

    table = b.component("CoffeeTable", (-0.62, 0, -0.30), (0, 4, 0))
    b.mesh(f"{table}/Top", box((1.0, 0.035, 0.5), 1.4), "Wood", (0, 0.385, 0))
    b.mesh(f"{table}/Shelf", box((0.9, 0.02, 0.42), 1.4), "Wood", (0, 0.16, 0))
    for index, (x, z) in enumerate(((-0.46, 0.21), (0.46, 0.21), (-0.46, -0.21), (0.46, -0.21))):
        b.mesh(f"{table}/Leg{index + 1}", box((0.04, 0.385, 0.04), 1.4), "Wood", (x, 0, z))
    b.mesh(f"{table}/BookLow", box((0.27, 0.035, 0.20)), "BookBlue", (-0.22, 0.42, 0.02), (0, 12, 0))
    b.mesh(f"{table}/BookHigh", box((0.24, 0.03, 0.17)), "BookCream", (-0.21, 0.455, 0.03), (0, -8, 0))
    bowl = [(0.05, 0.0), (0.06, 0.005), (0.12, 0.05), (0.15, 0.085), (0.145, 0.088), (0.112, 0.055), (0.05, 0.018)]
    b.mesh(f"{table}/Bowl", lathe(bowl, 12), "Ceramic", (0.24, 0.42, -0.02), smooth=True)

    chair = b.component("Chair", (-1.95, 0, -0.55), (0, 72, 0))
    _chair(b, chair)
    second = b.component("ChairByShelf", (2.12, 0, -0.85), (0, -74, 0))
    _chair(b, second)

    lamp = b.component("FloorLamp", (-2.15, 0, -1.72))
    b.mesh(
        f"{lamp}/Stand",
        lathe([(0.15, 0), (0.15, 0.015), (0.10, 0.03), (0.014, 0.04), (0.012, 1.0), (0.012, 1.48)], 12),
        "Brass",
    )  # noqa: E501
    shade = [(0.21, 1.42), (0.205, 1.47), (0.165, 1.68), (0.16, 1.72)]
    b.mesh(f"{lamp}/Shade", lathe(shade, 16, closed=False), "Shade", smooth=True)

    picture = b.component("Picture", (-0.75, 1.58, -2.175))
    b.mesh(f"{picture}/Frame", box((1.02, 0.70, 0.04)), "Wood", (0, -0.35, 0))
    b.mesh(
        f"{picture}/Canvas",
        quad([(-0.47, -0.31, 0.022), (0.47, -0.31, 0.022), (0.47, 0.31, 0.022), (-0.47, 0.31, 0.022)]),
        "Painting",
    )

    shelf = b.component("Shelves", (1.55, 0, -2.03))
    for index, y in enumerate((0.06, 0.46, 0.86, 1.26, 1.66)):
        b.mesh(f"{shelf}/Board{index + 1}", box((1.1, 0.025, 0.30), 1.4), "Wood", (0, y, 0))
    for index, x in enumerate((-0.55, 0.55)):
        b.mesh(f"{shelf}/Side{index + 1}", box((0.025, 1.74, 0.30), 1.4), "Wood", (x, 0, 0))
    _books(b, shelf)
    vase = [
        (0.045, 0),
        (0.05, 0.004),
        (0.085, 0.07),
        (0.075, 0.15),
        (0.03, 0.21),
        (0.034, 0.245),
        (0.026, 0.24),
        (0.022, 0.20),
    ]  # noqa: E501
    b.mesh(f"{shelf}/Vase", lathe(vase, 12), "Ceramic", (0.30, 1.285, 0.02), smooth=True)
    b.mesh(
        f"{shelf}/Jar",
        lathe([(0.06, 0), (0.065, 0.005), (0.065, 0.11), (0.05, 0.13)], 12),
        "Mustard",
        (-0.35, 1.685, 0),
        smooth=True,
    )  # noqa: E501

    plant = b.component("Plant", (0.62, 0, -1.86))
    b.mesh(
        f"{plant}/Pot",
        lathe([(0.10, 0), (0.105, 0.005), (0.14, 0.24), (0.145, 0.27), (0.125, 0.27), (0.12, 0.22)], 12),
        "Rust",
        smooth=True,
    )  # noqa: E501
    for index in range(11):
        turn = 137.5 * index
        lean = 14 + 4.2 * index
        leaf = cushion((0.12, 0.62 - 0.02 * index, 0.012), 0.05)
        b.mesh(f"{plant}/Leaf{index + 1}", leaf, "Leaf", (0, 0.20, 0), (lean, turn, 0), smooth=True)


def _chair(b: StageBuilder, path: str) -> None:
    b.mesh(f"{path}/Seat", cushion((0.44, 0.05, 0.42), 0.02), "Linen", (0, 0.43, 0), smooth=True)
    for index, (x, z) in enumerate(((-0.19, 0.18), (0.19, 0.18))):
        b.mesh(f"{path}/LegFront{index + 1}", box((0.035, 0.44, 0.035), 1.4), "Wood", (x, 0, z))
    for index, x in enumerate((-0.19, 0.19)):
        b.mesh(f"{path}/LegBack{index + 1}", box((0.035, 0.90, 0.035), 1.4), "Wood", (x, 0, -0.19), (-4, 0, 0))
    for index, y in enumerate((0.60, 0.71, 0.82)):
        b.mesh(f"{path}/Slat{index + 1}", box((0.38, 0.055, 0.018), 1.4), "Wood", (0, y, -0.19 - 0.07 * y))


def _books(b: StageBuilder, shelf: str) -> None:
    names = list(_BOOKS)
    spines = ((0.035, 0.25), (0.028, 0.22), (0.045, 0.27), (0.03, 0.24), (0.04, 0.21), (0.025, 0.26))
    for row, (level, start, count) in enumerate(((0.485, -0.50, 15), (0.885, -0.18, 17), (1.285, -0.50, 11))):
        x = start
        for index in range(count):
            width, height = spines[(index * 5 + row) % len(spines)]
            book = box((width - 0.003, height, 0.19))
            material = names[(index * 3 + row * 2 + index // 4) % len(names)]
            b.mesh(f"{shelf}/Book{row + 1}_{index + 1}", book, material, (round(x + width / 2, 4), level, 0.02))
            x += width
