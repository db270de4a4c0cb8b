"""Lights that errors are measured under, in sets that a rule chooses for any scene.

The `first` set was looked at while the preview was made, so it is the one to look at again while something is tried.
The `second` was set down afterwards, by its seed alone, and is for reports: never try anything with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icheat_usd.materials import shade_hits, take_points
from icheat_usd.samples import ViewSamples
from icheat_usd.scene import F32, F64, PLAIN, LightKind, Lights, SceneSnapshot, SurfacePoints, Textures
from icheat_usd.tracing import Tracer, spawn_points

_PILOT = 4096  # places that the view receives light from
_DIRECTIONS = 512  # of the sun, to choose from
_SUN_HALF_ANGLE = np.radians(0.27)
_PATCH = 0.02  # share of the places that a sun patch should light
_LEAST_PATCH = 0.002

#: Seeds of the sets; the second is the day that it was set down.
SETS = {"first": 0, "second": 20_261_122}


#: Frames of a drag, and what a light moves, in the scene's unit, or turns in each; of other axes that goes with it.
DRAG_FRAMES, DRAG_STEP, DRAG_ANGLE = 10, 0.01, np.radians(0.3)


@dataclass(frozen=True)
class TestLight:
    """One light, and why it stands where it does."""

    __test__ = False  # of pytest, which takes the name for its own

    name: str
    kind: LightKind
    to_world: F64  #: (3, 4)
    radiance: tuple[float, float, float]
    size: tuple[float, float] = (0.0, 0.0)
    image: F32 | None = None  #: (height, width, 3) of a dome
    note: str = ""


def choose_lights(snapshot: SceneSnapshot, tracer: Tracer, view: ViewSamples, seed: int = 0) -> list[TestLight]:
    """A spot, a grazing rectangle, a sun patch and a dome for any scene.

    The sun and the dome are left out where no light from outside reaches what the view is lit by.
    """
    rng = np.random.default_rng([seed, 0x7E57])
    places = _lit_places(snapshot, tracer, view, rng)
    up = np.eye(3)[np.argmax(np.abs(snapshot.camera.to_world[:, 1]))] * np.sign(
        snapshot.camera.to_world[np.argmax(np.abs(snapshot.camera.to_world[:, 1])), 1]
    )
    found = [_spot(snapshot, tracer, places, rng), _grazing(snapshot, tracer, places, up, rng)]
    # The cloud of the first set stands where it always did.
    cloud = (0.6, 2.1) if seed == 0 else (float(rng.uniform(0.2, 1.2)), float(rng.uniform(0, 2 * np.pi)))
    return found + _from_outside(snapshot, tracer, places, up, rng, cloud)


def drag_to(light: TestLight, tracer: Tracer) -> list[F64]:
    """Where a light is from frame to frame, (3, 4) each, while it is dragged to its place as in the suite of frames.

    It passes through no surface, if there is such a way. What shines from afar is turned, about no axis of its own: a
    dome's pole moves.
    """
    places, way = [], _free_way(light, tracer)
    for left in range(DRAG_FRAMES, -1, -1):
        matrix = np.array(light.to_world, np.float64)
        if light.kind in (LightKind.DOME, LightKind.DISTANT):
            cos, sin = np.cos(DRAG_ANGLE * left), np.sin(DRAG_ANGLE * left)
            turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
            turn = turn @ np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
            matrix[:, :3] = turn @ matrix[:, :3]
        else:
            matrix[:, 3] -= DRAG_STEP * left * way
        places.append(matrix)
    return places


def _free_way(light: TestLight, tracer: Tracer) -> F64:
    """The first of some directions in which a light comes to its place past nothing; the first if there is none."""
    ways = np.array([np.roll(sign * np.array([1.0, 0.3, -0.5]), k) for k in range(3) for sign in (1.0, -1.0)])
    length = float(np.linalg.norm(ways[0]))
    back = np.ascontiguousarray(-ways / length, np.float32)
    start = np.repeat(np.asarray(light.to_world, np.float32)[None, :, 3], len(ways), axis=0)
    blocked = tracer.occluded(start, back, np.float32(1.2 * length * DRAG_STEP * DRAG_FRAMES))
    return np.asarray(ways[int(np.argmin(blocked))])


def with_lights(snapshot: SceneSnapshot, lights: list[TestLight]) -> SceneSnapshot:
    """The scene under these lights alone."""
    n = 0
    none = Lights(
        kind=np.zeros(n, np.int32),
        to_world=np.zeros((n, 3, 4), np.float32),
        radiance=np.zeros((n, 3), np.float32),
        size=np.zeros((n, 2), np.float32),
        texture=np.zeros(n, np.int32),
        surface=np.zeros(n, np.int32),
        triangle_begin=np.zeros(1, np.int64),
        triangle=np.zeros(0, np.int32),
        triangle_instance=np.zeros(0, np.int32),
    )
    return add_lights(replace(snapshot, lights=none, light_paths=(), light_controls=()), lights)


def add_lights(snapshot: SceneSnapshot, lights: list[TestLight]) -> SceneSnapshot:
    """The scene with more lights."""
    texels, begin, width, height, wrap = snapshot.textures
    rows = []
    for light in lights:
        if light.image is None:
            rows.append(-1)
            continue
        rows.append(len(begin))
        size = light.image.shape[:2]
        begin = np.append(begin, len(texels)).astype(np.int64)
        opaque = np.concatenate([light.image.reshape(-1, 3), np.ones((size[0] * size[1], 1), np.float32)], axis=1)
        texels = np.concatenate([texels, opaque.astype(np.float32)])
        width, height = np.append(width, size[1]).astype(np.int32), np.append(height, size[0]).astype(np.int32)
        wrap = np.concatenate([wrap.reshape(-1, 2), [[0, 1]]]).astype(np.int32)
    n, had = len(lights), snapshot.lights
    table = Lights(
        kind=np.append(had.kind, [int(light.kind) for light in lights]).astype(np.int32),
        to_world=np.concatenate([had.to_world, _rows([light.to_world for light in lights], 3, 4)]),
        radiance=np.concatenate([had.radiance, _rows([light.radiance for light in lights], 3)]),
        size=np.concatenate([had.size, _rows([light.size for light in lights], 2)]),
        texture=np.append(had.texture, rows).astype(np.int32),
        surface=np.append(had.surface, np.full(n, -1)).astype(np.int32),
        triangle_begin=np.append(had.triangle_begin, np.full(n, had.triangle_begin[-1])).astype(np.int64),
        triangle=had.triangle,
        triangle_instance=had.triangle_instance,
    )
    return replace(
        snapshot,
        lights=table,
        textures=Textures(texels, begin, width, height, wrap),
        light_paths=(*snapshot.light_paths, *(f"/TestLights/{light.name}" for light in lights)),
        light_controls=snapshot.light_controls and (*snapshot.light_controls, *(PLAIN for _ in lights)),
    )


def _rows(values: list, *shape: int) -> F32:
    return np.asarray(values, np.float32).reshape(len(values), *shape)


def _lit_places(snapshot: SceneSnapshot, tracer: Tracer, view: ViewSamples, rng: np.random.Generator) -> SurfacePoints:
    """Where rays from view samples end, one ray each."""
    start = np.sort(rng.choice(view.n, min(_PILOT, view.n), replace=False))
    points = take_points(view.points, start)
    sphere = rng.normal(size=(len(start), 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    directions = points.normal + 0.999 * sphere  # by the cosine
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    hits = tracer.intersect(spawn_points(snapshot, points, directions), directions)
    ends = shade_hits(snapshot, hits, directions)
    ends = take_points(ends, np.flatnonzero(ends.instance >= 0))
    return ends if len(ends.instance) else points


def _spot(snapshot: SceneSnapshot, tracer: Tracer, places: SurfacePoints, rng: np.random.Generator) -> TestLight:
    """A small ball close to a surface: a pool of light on it. (Snapshots have no shaping, so no cone.)"""
    height = 0.04 * snapshot.radius
    row = _place_with_room(
        snapshot, tracer, places, places.normal, 4 * height, np.ones(len(places.instance), bool), rng
    )
    centre = places.position[row] + height * places.normal[row]
    return TestLight(
        "spot", LightKind.SPHERE, _frame(np.eye(3), centre), (40.0, 34.0, 26.0), (0.15 * height, 0.0),
        note=f"ball of radius {0.15 * height:.3g} m, {height:.3g} m off a surface",
    )  # fmt: skip


def _grazing(
    snapshot: SceneSnapshot, tracer: Tracer, places: SurfacePoints, up: F64, rng: np.random.Generator
) -> TestLight:
    """A flat rectangle that shines along a wall from 3 % of the scene's radius off it."""
    walls = np.abs(places.normal @ up) < 0.3
    if not walls.any():
        walls[:] = True
    normal = places.normal.astype(np.float64)
    along = np.cross(normal, up)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-6)
    row = _place_with_room(snapshot, tracer, places, along.astype(np.float32), 0.4 * snapshot.radius, walls, rng)
    tilt = np.radians(10)
    shines = np.cos(tilt) * along[row] - np.sin(tilt) * normal[row]
    wide = np.cross(along[row], normal[row])
    z = -shines  # lights shine along -Z
    axes = np.stack([wide, np.cross(z, wide), z], axis=1)
    centre = places.position[row] + 0.03 * snapshot.radius * normal[row]
    size = (0.15 * snapshot.radius, 0.02 * snapshot.radius)
    return TestLight(
        "grazing", LightKind.RECT, _frame(axes, centre), (12.0, 14.0, 18.0), size,
        note=f"{size[0]:.3g} x {size[1]:.3g} m, {0.03 * snapshot.radius:.3g} m off a wall, 10 degrees to it",
    )  # fmt: skip


def _from_outside(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    places: SurfacePoints,
    up: F64,
    rng: np.random.Generator,
    cloud: tuple[float, float],
) -> list[TestLight]:
    """A sun whose patch covers about 2 % of what the view is lit by, and a dome, where any light gets in."""
    sphere = rng.normal(size=(_DIRECTIONS, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    share = np.array([_open_share(snapshot, tracer, places, towards) for towards in sphere.astype(np.float32)])
    enters = share >= _LEAST_PATCH
    if not enters.any():
        return []
    # Highest first among directions with a patch of about the wanted size: suns stand above.
    score = np.abs(np.log(np.maximum(share, 1e-6) / _PATCH)) - 0.5 * (sphere @ up)
    score[~enters] = np.inf
    best = int(np.argmin(score))
    z = sphere[best]
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    sun = TestLight(
        "sun", LightKind.DISTANT, _frame(np.stack([x, np.cross(z, x), z], axis=1), np.zeros(3)),
        (90000.0, 80000.0, 65000.0), (float(_SUN_HALF_ANGLE), 0.0),
        note=f"half-angle 0.27 degrees, lights {100 * share[best]:.1f} % of what the view is lit by",
    )  # fmt: skip
    axis = int(np.argmax(np.abs(up)))
    side = np.eye(3)[(axis + 1) % 3]
    axes = np.stack([side, up, np.cross(side, up)], axis=1)
    dome = TestLight(
        "dome", LightKind.DOME, _frame(axes, np.zeros(3)), (1.0, 1.0, 1.0), image=_sky(64, 128, *cloud),
        note="procedural sky of 128 x 64 texels with one bright cloud",
    )  # fmt: skip
    return [sun, dome]


def _open_share(snapshot: SceneSnapshot, tracer: Tracer, places: SurfacePoints, towards: F32) -> float:
    """Share of the places that see the sky in one direction, by cosine."""
    cosine = places.normal @ towards
    rows = np.flatnonzero(cosine > 0.05)
    if not len(rows):
        return 0.0
    directions = np.tile(towards, (len(rows), 1))
    blocked = tracer.occluded(spawn_points(snapshot, take_points(places, rows), directions), directions)
    return float((~blocked).sum() / len(places.instance))


def _place_with_room(
    snapshot: SceneSnapshot,
    tracer: Tracer,
    places: SurfacePoints,
    directions: F32,
    length: float,
    wanted: np.ndarray,
    rng: np.random.Generator,
) -> int:
    """A place of those `wanted` with free space above it and along its direction for `length`, if there is one."""
    lifted = places.position + np.float32(0.03 * snapshot.radius) * places.normal
    clear = ~tracer.occluded(spawn_points(snapshot, places, places.normal), places.normal, np.float32(length))
    clear &= ~tracer.occluded(lifted, np.ascontiguousarray(directions, np.float32), np.float32(length))
    rows = np.flatnonzero(clear & wanted)
    rows = rows if len(rows) else np.flatnonzero(wanted)
    return int(rng.choice(rows))


def _sky(height: int, width: int, high_up: float, around: float) -> F32:
    """Lat-long image: a blue gradient over brown ground, and one cloud ten times as bright at two angles (radians)."""
    elevation = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    azimuth = (np.arange(width) + 0.5) / width * 2 * np.pi
    high = np.clip(np.sin(elevation), 0, 1)[:, None, None]
    sky = (1 - high) * np.array([0.9, 1.0, 1.1]) + high * np.array([0.25, 0.45, 0.9])
    image = np.where(elevation[:, None, None] > 0, sky, np.array([0.18, 0.14, 0.1])) * np.ones((height, width, 1))
    towards = np.array([np.cos(high_up) * np.cos(around), np.sin(high_up), np.cos(high_up) * np.sin(around)])
    directions = np.stack(
        [
            np.cos(elevation)[:, None] * np.cos(azimuth),
            np.sin(elevation)[:, None] * np.ones(width),
            np.cos(elevation)[:, None] * np.sin(azimuth),
        ],
        axis=2,
    )
    cloud = np.exp(-(1 - directions @ towards) / 0.02)
    return (image + 10 * cloud[:, :, None] * np.array([1.0, 0.95, 0.9])).astype(np.float32)


def _frame(axes: F64, origin: F32 | F64) -> F64:
    """(3, 4) matrix with `axes` as columns."""
    return np.concatenate([np.asarray(axes, np.float64), np.asarray(origin, np.float64).reshape(3, 1)], axis=1)
