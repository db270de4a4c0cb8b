"""A person-like figure of closed Catmull-Clark tubes, jointed so that it can be posed and animated."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from .build import Animated, StageBuilder
from .shapes import cushion, tube

#: Rotations that make it stand at ease rather than at attention.
AT_EASE: Mapping[str, Animated] = {
    "ArmLeft": (6.0, 0.0, 9.0),
    "ArmRight": (-4.0, 0.0, -10.0),
    "ForearmLeft": (-22.0, 0.0, -6.0),
    "ForearmRight": (-14.0, 0.0, 5.0),
    "LegLeft": (-3.0, 0.0, 4.0),
    "LegRight": (3.0, 0.0, -3.0),
    "ShinLeft": (5.0, 0.0, 0.0),
    "ShinRight": (2.0, 0.0, 0.0),
    "Head": (4.0, 14.0, 0.0),
}


@dataclass(frozen=True)
class Looks:
    skin: str
    hair: str
    shirt: str
    trousers: str
    shoes: str

    @classmethod
    def one(cls, material: str) -> Looks:
        return cls(material, material, material, material, material)


@dataclass(frozen=True)
class Pose:
    joints: Mapping[str, Animated] = field(default_factory=lambda: AT_EASE)


def add_figure(
    builder: StageBuilder,
    path: str,
    looks: Looks,
    pose: Pose | None = None,
    robe: bool = False,
) -> None:
    """1.72 m tall, standing on y = 0 and facing +Z, below the prim at `path`; `robe` covers the legs with pleats."""
    joints = (pose or Pose()).joints

    def joint(name: str, parent: str, at: tuple[float, float, float]) -> str:
        return builder.group(f"{parent}/{name}", at, joints.get(name))

    def part(name: str, parent: str, rings: list, material: str, sides: int = 8) -> None:
        builder.mesh(f"{parent}/{name}", tube(rings, sides), material, smooth=True)

    torso = [
        ((0, 0.93, 0.0), 0.150, 0.105),
        ((0, 0.96, 0.0), 0.172, 0.122),
        ((0, 1.04, 0.005), 0.152, 0.110),
        ((0, 1.14, 0.01), 0.150, 0.108),
        ((0, 1.26, 0.01), 0.182, 0.124),
        ((0, 1.36, 0.0), 0.208, 0.124),
        ((0, 1.435, -0.01), 0.205, 0.102),
        ((0, 1.475, -0.01), 0.120, 0.076),
        ((0, 1.49, -0.01), 0.072, 0.062),
    ]
    part("Torso", path, torso, looks.shirt)
    part(
        "Neck",
        path,
        [((0, 1.44, -0.01), 0.06, 0.06), ((0, 1.50, -0.005), 0.058, 0.058), ((0, 1.57, 0.01), 0.056, 0.056)],
        looks.skin,
    )
    head = joint("Head", path, (0, 1.53, 0.0))
    face = [
        ((0, -0.012, 0.045), 0.030, 0.026),
        ((0, 0.010, 0.030), 0.062, 0.066),
        ((0, 0.060, 0.018), 0.082, 0.094),
        ((0, 0.115, 0.012), 0.090, 0.106),
        ((0, 0.165, 0.006), 0.084, 0.098),
        ((0, 0.200, 0.000), 0.056, 0.066),
        ((0, 0.208, 0.000), 0.024, 0.028),
    ]
    part("Face", head, face, looks.skin)
    builder.mesh(
        f"{head}/Nose", cushion((0.026, 0.048, 0.042), 0.011), looks.skin, (0, 0.062, 0.104), (-16, 0, 0), smooth=True
    )  # noqa: E501
    hair = [
        ((0, 0.055, -0.052), 0.056, 0.040),
        ((0, 0.090, -0.034), 0.088, 0.072),
        ((0, 0.140, -0.014), 0.098, 0.096),
        ((0, 0.185, -0.006), 0.086, 0.090),
        ((0, 0.216, -0.004), 0.056, 0.062),
        ((0, 0.224, -0.004), 0.022, 0.026),
    ]
    part("Hair", head, hair, looks.hair)

    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm = joint(f"Arm{side}", path, (sign * 0.188, 1.415, -0.008))
        upper = [
            ((0, -0.290, 0), 0.046, 0.046),
            ((0, -0.270, 0), 0.052, 0.054),
            ((0, -0.160, 0), 0.056, 0.060),
            ((-sign * 0.004, -0.050, 0), 0.066, 0.070),
            ((-sign * 0.012, 0.010, 0), 0.062, 0.066),
            ((-sign * 0.024, 0.036, 0), 0.034, 0.036),
        ]
        part("Sleeve", arm, upper, looks.shirt)
        forearm = joint(f"Forearm{side}", arm, (0, -0.275, 0))
        lower = [
            ((0, -0.262, 0.0), 0.026, 0.032),
            ((0, -0.230, 0.0), 0.030, 0.034),
            ((0, -0.100, 0.0), 0.042, 0.046),
            ((0, -0.020, 0.0), 0.046, 0.047),
            ((0, 0.020, 0.0), 0.036, 0.037),
        ]
        part("Forearm", forearm, lower, looks.skin)
        hand = [
            ((0, -0.425, 0.020), 0.012, 0.022),
            ((0, -0.405, 0.018), 0.018, 0.036),
            ((0, -0.345, 0.008), 0.024, 0.048),
            ((0, -0.290, 0.002), 0.026, 0.042),
            ((0, -0.255, 0.0), 0.023, 0.029),
            ((0, -0.235, 0.0), 0.020, 0.025),
        ]
        part("Hand", forearm, hand, looks.skin)

    if robe:
        skirt = [
            ((0, 0.000, 0.0), 0.270, 0.240),
            ((0, 0.020, 0.0), 0.275, 0.245),
            ((0, 0.250, 0.0), 0.235, 0.205),
            ((0, 0.550, 0.0), 0.205, 0.170),
            ((0, 0.820, 0.0), 0.190, 0.142),
            ((0, 0.960, 0.0), 0.180, 0.128),
            ((0, 1.020, 0.0), 0.165, 0.118),
            ((0, 1.060, 0.0), 0.150, 0.105),
        ]
        builder.mesh(f"{path}/Robe", tube(skirt, 48, pleats=(12, 0.09)), looks.trousers, smooth=True)
        return

    hips = [
        ((0, 0.800, 0.0), 0.110, 0.085),
        ((0, 0.820, 0.0), 0.150, 0.112),
        ((0, 0.880, -0.01), 0.180, 0.134),
        ((0, 0.955, -0.005), 0.176, 0.126),
        ((0, 1.010, 0.0), 0.162, 0.116),
        ((0, 1.020, 0.0), 0.150, 0.105),
    ]
    part("Hips", path, hips, looks.trousers)
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        leg = joint(f"Leg{side}", path, (sign * 0.088, 0.885, 0.0))
        thigh = [
            ((0, -0.440, 0.0), 0.056, 0.060),
            ((0, -0.410, 0.0), 0.066, 0.072),
            ((0, -0.260, 0.0), 0.078, 0.088),
            ((0, -0.100, 0.0), 0.092, 0.106),
            ((0, -0.010, 0.0), 0.090, 0.108),
            ((0, 0.030, 0.0), 0.064, 0.080),
        ]
        part("Thigh", leg, thigh, looks.trousers)
        shin = joint(f"Shin{side}", leg, (0, -0.420, 0.0))
        calf = [
            ((0, -0.425, -0.005), 0.052, 0.058),
            ((0, -0.405, -0.005), 0.054, 0.060),
            ((0, -0.250, -0.012), 0.058, 0.066),
            ((0, -0.110, -0.008), 0.064, 0.074),
            ((0, -0.010, 0.0), 0.064, 0.068),
            ((0, 0.030, 0.0), 0.050, 0.054),
        ]
        part("Shin", shin, calf, looks.trousers)
        shoe = [
            ((0, -0.4645, 0.055), 0.046, 0.130),
            ((0, -0.4635, 0.055), 0.052, 0.142),
            ((0, -0.430, 0.050), 0.052, 0.136),
            ((0, -0.395, 0.020), 0.046, 0.090),
            ((0, -0.365, -0.005), 0.042, 0.050),
        ]
        part("Shoe", shin, shoe, looks.shoes)
