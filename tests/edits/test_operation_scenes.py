"""Operations through the relighter in scenes whose answer one can write down.

In a closed box that shines everywhere all indirect light is the same radiance
from all directions, E a / (1 - a), whatever the geometry.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from icheat_usd.edits.model import Edit, Region, Selection, Shape, Value
from icheat_usd.scene import LightKind
from tests.pipeline import Pipeline, select
from tests.scenes import (
    Light,
    Material,
    Mesh,
    closed_box,
    covered_cornell,
    look_at,
    make_snapshot,
    quad,
    rotation,
    translation,
)

ALBEDO, EMISSION = 0.5, 1.0
B = EMISSION * ALBEDO / (1 - ALBEDO)  #: radiance that every wall reflects: all that edits act on
INDIRECT = ALBEDO * B  #: what receivers make of it: emission is direct light


@pytest.fixture(scope="module")
def furnace() -> Pipeline:
    scene = closed_box(ALBEDO, EMISSION)
    return Pipeline(scene, n_gather=512, rays=256, bounce_rays=256, light_samples=64, n_bounces=40)


def edit(operation: str, parameters: dict[str, Value], *paths: str, receivers: tuple[str, ...] = ()) -> Edit:
    return Edit("/edit", operation, parameters, select(*(receivers or paths)), select(*paths))


def indirect(pipeline: Pipeline, *edits: Edit) -> np.ndarray:
    """Mean indirect radiance over the view samples."""
    return pipeline.relight(*edits).indirect_edited.mean(axis=0)


GREEN: tuple[float, float, float] = (0.5, 1.0, 0.25)


@pytest.mark.parametrize(
    ("operation", "parameters", "expected"),
    [
        ("scale", {"color": GREEN, "gain": 2.0}, INDIRECT * 2 * np.array(GREEN)),
        ("hsv", {"value": 2.0, "hue": 90.0}, 2 * INDIRECT),
        ("gamma", {"exponent": 2.0, "pivot": 0.25}, INDIRECT**2 / 0.25),
        ("curve", {"inputs": (0.0, INDIRECT, 2.0), "outputs": (0.0, 0.75, 2.0)}, 0.75),
        ("curve", {"inputs": (0.0, INDIRECT, 2.0), "outputs": (0.0, 0.75, 2.0), "on": "luminance"}, 0.75),
        ("falloff", {}, INDIRECT),
        ("direction", {"direction": (0.3, 0.9, -0.2), "sharpness": 4.0, "strength": 2.0}, INDIRECT),
        ("emit", {"color": GREEN, "intensity": 2.0}, INDIRECT + ALBEDO * 2 * np.array(GREEN)),
        ("albedo", {"color": (0.25, 0.5, 1.0)}, INDIRECT * np.array([0.5, 1, 2])),
        ("albedo", {"color": GREEN, "replace": False}, INDIRECT * np.array(GREEN)),
        ("receive", {"scale": GREEN, "offset": (0.1, 0.2, 0.3)}, INDIRECT * np.array(GREEN) + [0.1, 0.2, 0.3]),
        # The area of the box is 24 m^2; outside, where half of its sides look, there is no light.
        ("paint", {"color": GREEN, "relative": False}, INDIRECT + 24 * B * np.array(GREEN)),
        ("paint", {"color": GREEN}, INDIRECT + B * np.array(GREEN)),
    ],
)
def test_in_a_furnace_every_operation_gives_what_its_formula_says(
    furnace: Pipeline, operation: str, parameters: dict[str, Value], expected: object
) -> None:
    plain = indirect(furnace)
    np.testing.assert_allclose(plain, INDIRECT, rtol=0.01)
    found = indirect(furnace, edit(operation, parameters, "/box"))
    np.testing.assert_allclose(found, np.broadcast_to(expected, 3), rtol=0.025)  # type: ignore[arg-type]


def test_the_physical_falloff_changes_no_more_than_the_order_of_sums(furnace: Pipeline) -> None:
    plain, edited = furnace.relight().indirect_edited, furnace.relight(edit("falloff", {}, "/box")).indirect_edited
    np.testing.assert_allclose(edited, plain, rtol=1e-6)


# --------------------------------------------------------------------------- a lit room


@pytest.fixture(scope="module")
def rooms() -> Iterator[dict[int, Pipeline]]:
    yield {
        n: Pipeline(covered_cornell("rect", width=16, height=16), n_gather=n, rays=512, bounce_rays=256, n_bounces=8)
        for n in (512, 4096)
    }


@pytest.mark.parametrize(
    ("operation", "parameters"),
    [
        ("gamma", {"exponent": 0.5}),
        ("gamma", {"exponent": 2.0}),
        ("hsv", {"hue": 60.0, "saturation": 1.5}),
        ("curve", {"inputs": (0.0, 0.1, 1.0), "outputs": (0.0, 0.3, 1.0)}),
        ("paint", {"color": (0.5, 0.0, 0.0)}),
    ],
)
def test_the_effect_does_not_depend_on_how_finely_the_scene_is_sampled(
    rooms: dict[int, Pipeline], operation: str, parameters: dict[str, Value]
) -> None:
    """As a share of what the casters send; with eight times as many samples, powers of each one's part of the light
    would add up to nearly three times as much."""
    everything = ("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low")
    casters = ("/red", "/floor")
    one = edit(operation, parameters, *casters, receivers=everything)
    without = edit("scale", {"gain": 0.0}, *casters, receivers=everything)
    share = []
    for room in rooms.values():
        plain = indirect(room)
        share.append((indirect(room, one) - plain) / (plain - indirect(room, without)))
    np.testing.assert_allclose(share[0], share[1], rtol=0.05, atol=0.02)


def test_redirected_light_reaches_what_lies_at_the_target_and_leaves_the_rest(rooms: dict[int, Pipeline]) -> None:
    room = rooms[4096]
    receivers = ("/floor", "/back")
    target = (0.2, -1.0, 0.7)  # on the floor
    one = edit("redirect", {"target": target, "spread": 20.0}, "/red", receivers=receivers)
    change = (room.relight(one).indirect_edited - room.relight().indirect_edited)[:, 0]
    place = room.view.points.position
    paths = np.array([room.snapshot.surfaces[i].path for i in range(len(room.snapshot.surfaces))])
    surface = paths[room.snapshot.geometry.instance_surface[room.view.points.instance]]
    near = (surface == "/floor") & (np.linalg.norm(place - np.float32(target), axis=1) < 0.4)
    assert near.sum() >= 3
    assert (change[near] > 0).all()
    far = (surface == "/back") & (place[:, 1] > 0.3)
    assert (change[far] < 0).all()
    assert (change[~np.isin(surface, receivers)] == 0).all()


def test_an_unlit_object_emits() -> None:
    """A black square beside a floor in the dark: the floor gets form factor x radiance."""
    panel = translation(0, 0.5, 0) @ rotation((1, 0, 0), 180)
    scene = make_snapshot(
        [
            Mesh(quad(0.2), Material(0.8), path="/floor"),
            Mesh(quad(1.0), Material(0.0), transforms=[panel], path="/panel"),
        ],
        lights=[Light(LightKind.DISTANT, 0.0, rotation((1, 0, 0), -90))],
        camera=look_at((0, 0.2, 0), (0, 0, 0.001), fov=20, width=8, height=8),
    )
    pipeline = Pipeline(scene, n_gather=512, rays=2048, light_samples=1, n_bounces=1)
    found = indirect(pipeline, edit("emit", {"intensity": 3.0}, "/panel", receivers=("/floor",)))
    # Point under the centre of a square of side 1 at height 1/2 (four corners of side x = y = 1/2 over h = 1/2).
    x = 1.0
    corner = (x / np.sqrt(1 + x * x)) * np.arctan(x / np.sqrt(1 + x * x)) / np.pi
    np.testing.assert_allclose(found, 0.8 * 3.0 * 4 * corner, rtol=0.02)


def test_falloff_moves_light_from_near_to_far_receivers_with_its_level_at_the_pivot(rooms: dict[int, Pipeline]) -> None:
    room = rooms[4096]
    one = edit("falloff", {"exponent": 0.0, "pivot": 1.0}, "/red", receivers=("/floor",))
    plain, changed = room.relight().indirect_edited, room.relight(one).indirect_edited
    red = room.relight(edit("scale", {"gain": 0.0}, "/red", receivers=("/floor",))).indirect_edited
    ratio = (changed - red)[:, 0] / np.maximum(plain - red, 1e-6)[:, 0]
    surface = room.snapshot.geometry.instance_surface[room.view.points.instance]
    floor = np.array([s.path == "/floor" for s in room.snapshot.surfaces])[surface]
    lit = floor & ((plain - red)[:, 0] > 1e-3)  # by the wall, not in the shadow of a block
    x = room.view.points.position[:, 0]
    beside, away = ratio[lit & (x < -0.6)], ratio[lit & (x > 0.7)]
    assert len(beside) >= 3 and len(away) >= 3
    assert beside.mean() < 0.9
    # Distances to the wall are from 1.7 on; its far corner is 3.4 away.
    assert away.min() > 1.7**2 and away.max() < 3.4**2


def test_a_region_of_casters_paints_by_its_own_area() -> None:
    """Relative paint from half of a uniformly shining box is as strong as from all of it."""
    pipeline = Pipeline(closed_box(ALBEDO, EMISSION), n_gather=2048, rays=128, bounce_rays=128, n_bounces=24)
    half = Region(Shape.BOX, (1, 0, 0, -1, 0, 1, 0, 0, 0, 0, 1, 0))  # x in [0, 2]
    whole = edit("paint", {"color": (1.0, 1.0, 1.0)}, "/box")
    part = Edit("/edit", "paint", whole.parameters, whole.receivers, Selection(frozenset(["/box"]), (half,)))
    plain = indirect(pipeline)
    np.testing.assert_allclose(indirect(pipeline, part) - plain, indirect(pipeline, whole) - plain, rtol=0.03)
