"""One layer per operation: a single edit over one of the sample scenes, in the manner of the paper's figures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from .build import write_over_layer
from .edits import New, author_edits

FOLDER = "operations"


@dataclass(frozen=True)
class Shown:
    """A layer that shows one operation; its name is the edit's."""

    scene: str
    expect: str  #: change of the indirect light at 160 x 120, in percent
    edit: New

    @property
    def doc(self) -> str:
        return f"{self.edit.doc}\nExpect at 160 x 120: the edit changes the indirect light by {self.expect} %."


SHOWN = (
    Shown(
        "cornell_box",
        "+21.3",
        New(
            "scale",
            "Scale: the red wall sends floor, back wall and blocks five times its light; the ceiling gets what it got.",
            receivers=("Geometry/Room/Floor", "Geometry/Room/BackWall", "Geometry/Blocks"),
            casters=("Geometry/Room/RedWall",),
            parameters={"gain": 5.0},
        ),
    ),
    Shown(
        "glossy_set",
        "+4.6",
        New(
            "hsv",
            "Hue, saturation, value: what the blue wall sends the things is turned to orange, on the diffuse box as "
            "in the reflections of cone and sphere.",
            receivers=("Geometry/Things",),
            casters=("Geometry/Set/BlueWall",),
            operation="hsv",
            parameters={"hue": 165.0, "value": 1.5},
        ),
    ),
    Shown(
        "furnished_room",
        "+6.6",
        New(
            "redirect",
            "Redirect: sunlit rug, table and floor send their light towards the person, at the room's expense.",
            receivers=("Geometry/Person", "Geometry/Sofa", "Geometry/Room/BackWall", "Geometry/Room/Ceiling"),
            casters=("Geometry/Rug", "Geometry/CoffeeTable", "Geometry/Room/Floor"),
            operation="redirect",
            parameters={"spread": 30.0},
            target="Geometry/Person",
        ),
    ),
    Shown(
        "staircase",
        "-3.9",
        New(
            "gamma",
            "Gamma: more contrast in what the ceiling sends stairs and statue.",
            receivers=("Geometry/Stairs", "Geometry/Statue"),
            casters=("Geometry/Hall/Ceiling",),
            operation="gamma",
            parameters={"exponent": 1.6, "pivot": 0.6},
        ),
    ),
    Shown(
        "furnished_room",
        "+7.0",
        New(
            "curve",
            "Curve: an S-curve on all the light that the room sends walls and ceiling; shadows sink, lights stay.",
            receivers=("Geometry/Room",),
            casters=("Geometry",),
            operation="curve",
            parameters={"inputs": (0.0, 0.05, 0.15, 0.4), "outputs": (0.0, 0.02, 0.18, 0.5), "on": "luminance"},
        ),
    ),
    Shown(
        "glossy_set",
        "+31.2",
        New(
            "falloff",
            "Falloff: the blue wall's light falls with the first power of distance from a pivot of 0.4 m, so that it "
            "carries further into the set.",
            receivers=("Geometry/Set", "Geometry/Things"),
            casters=("Geometry/Set/BlueWall",),
            operation="falloff",
            parameters={"exponent": 1.0, "pivot": 0.4},
        ),
    ),
    Shown(
        "furnished_room",
        "+0.7",
        New(
            "direction",
            "Direction: the person is lit from the window's side, and less from everywhere else.",
            receivers=("Geometry/Person",),
            casters=("Geometry",),
            operation="direction",
            parameters={"direction": (-1.0, 0.25, 0.3), "sharpness": 3.0, "strength": 2.5},
        ),
    ),
    Shown(
        "staircase",
        "+2.8",
        New(
            "unshadow",
            "Remove shadow: the ceiling's light reaches stairs and statue as if the cylinder were not there.",
            receivers=("Geometry/Stairs", "Geometry/Statue"),
            casters=("Geometry/Hall/Ceiling", "Geometry/Hall/RightWall"),
            operation="unshadow",
            occluders=("Geometry/Cylinder",),
        ),
    ),
    Shown(
        "glossy_set",
        "+10.6",
        New(
            "paint",
            "Paint: the box's colour bleeds onto the floor in a painted patch.",
            receivers=("Geometry/Set/Floor",),
            casters=("Geometry/Things/Box",),
            operation="paint",
            parameters={"color": (1.5, 1.5, 1.5)},
            receiver_sphere=(1.0, 0.0, 0.35, 0.1, 1.0),
        ),
    ),
    Shown(
        "staircase",
        "+3.9",
        New(
            "emit",
            "Emit: the cylinder sends red light to stairs and statue, and to nothing else.",
            receivers=("Geometry/Stairs", "Geometry/Statue"),
            casters=("Geometry/Cylinder",),
            operation="emit",
            parameters={"color": (1.0, 0.12, 0.08), "intensity": 14.0},
        ),
    ),
    Shown(
        "cornell_box",
        "+12.3",
        New(
            "albedo",
            "Albedo: the green wall is seen green, but all it sends on is as if it were golden.",
            receivers=("Geometry",),
            casters=("Geometry/Room/GreenWall",),
            operation="albedo",
            parameters={"color": (0.85, 0.55, 0.08)},
        ),
    ),
    Shown(
        "cornell_box",
        "+7.0",
        New(
            "receive",
            "Receive: all indirect light on the blocks, whoever sent it, warmer and lifted.",
            receivers=("Geometry/Blocks",),
            casters=("Geometry",),
            operation="receive",
            parameters={"scale": (1.5, 1.2, 0.9), "offset": (0.012, 0.008, 0.004)},
        ),
    ),
    Shown(
        "furnished_room",
        "+43.6",
        New(
            "one_light",
            "One light's share: what the sun's light does after it first met a surface, tinted and doubled; the sky's "
            "and the lamp's stay.",
            receivers=("Geometry",),
            casters=("Geometry",),
            parameters={"color": (2.4, 1.5, 1.0)},
            lights=("Lights/Sun",),
        ),
    ),
    Shown(
        "cornell_box",
        "+12.9",
        New(
            "region",
            "A region: within a soft sphere, whatever surfaces it meets, the green wall's light is six times as much.",
            receivers=("Geometry",),
            casters=("Geometry/Room/GreenWall",),
            parameters={"gain": 6.0},
            receiver_region=(0.45, 0.75, -0.7, 0.35, 0.85),
        ),
    ),
)


def build_operations(folder: Path) -> None:
    """Write every layer of the folder, with sidecars where masks are painted."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.icheat.h5"):
        old.unlink()
    for shown in SHOWN:
        path = folder / f"{shown.edit.name}.usda"
        write_over_layer(path, f"../{shown.scene}/scene.usda", shown.doc)
        painted = shown.edit.receiver_sphere is not None
        author_edits(path, (replace(shown.edit, needs_payload=painted),), make_stack=True)
