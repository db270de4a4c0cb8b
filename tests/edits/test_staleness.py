"""What a payload was made against is noticed when it changes, and only then."""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import numpy as np
import pytest

from icheat_usd.edits import operations, staleness
from icheat_usd.edits.facts import MAX_SURFACES, facts
from icheat_usd.edits.model import Edit, Payload, Region, Selection, Shape
from icheat_usd.edits.staleness import Aspect, changes, needs, stale_because
from icheat_usd.scene import PLAIN, LightControls, LightKind, SceneSnapshot
from tests.lighting.test_controls import EVEN
from tests.scenes import Light, Material, Mesh, box, cornell, look_at, make_snapshot, quad, rotation, translation

WHITE = Material(0.7)


def room(
    *,
    prefix: str = "/World",
    block: Any = None,
    lamp: float = 5.0,
    colour: tuple[float, float, float] = (1, 1, 1),
    lamp_at: Any = None,
    camera_at: tuple[float, float, float] = (0, 0, 3),
    width: int = 32,
    extra: int = 0,
    all_by: Any = None,
    shape: float = 0.5,
    paint: Material = WHITE,
) -> SceneSnapshot:
    by = np.eye(4) if all_by is None else all_by
    meshes = [
        Mesh(quad(4.0), WHITE, path=f"{prefix}/Floor", transforms=[by]),
        Mesh(quad(4.0, 2.0), WHITE, path=f"{prefix}/Ceiling", transforms=[by]),
        Mesh(box(shape), paint, path=f"{prefix}/Block", transforms=[by @ (np.eye(4) if block is None else block)]),
        *(
            Mesh(box(0.1), WHITE, path=f"{prefix}/Extra{i}", transforms=[by @ translation(i, 0, 0)])
            for i in range(extra)
        ),
    ]
    at = by @ (translation(0, 1.9, 0) if lamp_at is None else lamp_at)
    lights = [
        Light(LightKind.SPHERE, np.multiply(colour, lamp), at, (0.1, 0.0), path=f"{prefix}/Key"),
        Light(LightKind.DOME, 0.1, by, path=f"{prefix}/Sky"),
    ]
    eye = (by @ np.array([*camera_at, 1.0]))[:3]
    camera = look_at(tuple(eye), tuple(by[:3, 3]), width=width, height=24)
    return make_snapshot(meshes, lights=lights, camera=dataclasses.replace(camera, path=f"{prefix}/Camera"))


def texts(then: SceneSnapshot, now: SceneSnapshot, anchors: tuple[str, str] = ("/World", "/World")) -> list[str]:
    return [c.text for c in changes(facts(then, anchors[0]), facts(now, anchors[1], limit=False))]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, []),
        ({"block": translation(0.3, 0, 0)}, ["surface Block moved"]),
        ({"block": rotation((0, 1, 0), 5)}, ["surface Block moved"]),
        ({"shape": 0.6}, ["surface Block has another shape"]),
        ({"lamp": 7.5}, ["light Key got brighter (1.5 times)"]),
        ({"lamp": 2.5}, ["light Key got dimmer (0.5 times)"]),
        ({"lamp_at": translation(0.5, 1.9, 0)}, ["light Key moved"]),
        ({"camera_at": (0.5, 0, 3)}, ["camera Camera moved"]),
        ({"width": 48}, ["the resolution is 48x24, and was 32x24"]),
        ({"extra": 1}, ["surface Extra0 is new"]),
        ({"extra": 5}, ["5 surfaces are new (Extra0, Extra1, Extra2, ...)"]),
        ({"paint": Material((0.9, 0.1, 0.1))}, ["surface Block has another material"]),
    ],
)
def test_a_change_is_said_in_an_artists_words(change: dict[str, Any], expected: list[str]) -> None:
    assert texts(room(), room(**change)) == expected


def test_a_colour_is_told_from_brightness() -> None:
    found = texts(room(), room(colour=(1.0, 0.5, 0.2)))
    assert found == ["light Key got dimmer (0.585 times)", "light Key has another colour"]


def test_other_links_and_shaping_are_noticed_under_any_name() -> None:
    def linked(out: str, prefix: str = "/World", **controls: Any) -> SceneSnapshot:
        plain = room(prefix=prefix)
        receivers = np.array([surface.path != f"{prefix}/{out}" for surface in plain.surfaces], np.uint8)
        controls = {"receivers": None if receivers.all() else receivers} | controls
        return dataclasses.replace(plain, light_controls=(LightControls(**controls), PLAIN))

    said = ["light Key has another texture, other links or other shaping"]
    assert texts(room(), linked("Block")) == texts(linked("Block"), linked("Floor")) == said
    assert texts(room(), linked("", specular=0.5)) == said
    assert texts(room(), linked("", shaping=EVEN._replace(focus=2.0))) == said
    assert texts(linked("Block"), linked("Block", "/Show"), ("/World", "/Show")) == []


def test_what_goes_is_named() -> None:
    assert texts(room(extra=1), room()) == ["surface Extra0 is gone"]


def test_a_reference_under_another_name_and_place_changes_nothing() -> None:
    there = translation(100, -3, 20) @ rotation((0, 1, 0), 30)
    assert texts(room(), room(prefix="/Show/set_01"), ("/World", "/Show/set_01")) == []
    assert texts(room(), room(prefix="/Show/set_01", all_by=there), ("/World", "/Show/set_01")) == []


def test_the_centre_of_the_scene_does_not_count() -> None:
    """Another snapshot of the same things about another centre, with the rounding that this brings."""
    then = room()
    centre = np.array([1234.56, -7.0, 0.125])
    geometry = then.geometry
    placed = geometry.instance_to_world.astype(np.float64)
    placed[:, :, 3] -= centre
    lights = then.lights.to_world.astype(np.float64)
    lights[:, :, 3] -= centre
    camera = then.camera.to_world.copy()
    camera[:, 3] -= centre
    now = dataclasses.replace(
        then,
        geometry=geometry._replace(instance_to_world=placed.astype(np.float32)),
        lights=then.lights._replace(to_world=lights.astype(np.float32)),
        camera=dataclasses.replace(then.camera, to_world=camera),
        centre=centre,
    )
    assert texts(then, now) == [] and texts(now, then) == []


def test_beyond_the_bound_changes_are_still_found() -> None:
    many = MAX_SURFACES + 20
    stored = facts(room(extra=many), "/World")
    assert str(stored["surfaces"]).count("\n") == MAX_SURFACES - 1
    same = facts(room(extra=many), "/World", limit=False)
    assert changes(stored, same) == ()
    (change,) = changes(stored, facts(room(extra=many + 1), "/World", limit=False))
    assert change.text == "some of the other surfaces have other instances"
    scene = room(extra=many)
    placed = scene.geometry.instance_to_world.copy()
    placed[-1, 0, 3] += 5.0
    moved = dataclasses.replace(scene, geometry=scene.geometry._replace(instance_to_world=placed))
    (change,) = changes(stored, facts(moved, "/World", limit=False))
    assert change == (Aspect.GEOMETRY, "some of the other surfaces moved")


def test_only_what_a_payload_depends_on_makes_it_stale() -> None:
    then, scale, gamma = facts(room(), "/World"), operations.find("scale"), operations.find("hsv")
    assert scale is not None and gamma is not None
    assert needs(scale, has_rows=False) == (False, False)
    assert needs(scale, has_rows=True) == (True, False)
    assert needs(gamma, has_rows=True) == (True, True)
    assert needs(None, has_rows=True) == (True, True)
    rows: Any = object()
    brighter = facts(room(lamp=9.0), "/World", limit=False)
    moved = facts(room(block=translation(0, 0, 0.4)), "/World", limit=False)
    camera = facts(room(camera_at=(1, 0, 3)), "/World", limit=False)
    for name, light in (("scale", False), ("hsv", True)):
        payload = Payload(name, {}, rows=rows, made_against=then)
        assert bool(stale_because(payload, "baked", brighter)) is light
        assert stale_because(payload, "baked", moved) == ("surface Block moved",)
        assert stale_because(payload, name, camera) == ()
    recipe = Payload("hsv", {}, made_against=then)
    assert stale_because(recipe, "hsv", brighter) == () == stale_because(recipe, "hsv", moved)


def test_a_changed_selection_is_noticed() -> None:
    scene = room()

    def edit(prefix: str, *limits: Region, occluders: tuple[str, ...] = ()) -> Edit:
        sides = Selection(frozenset([f"{prefix}/Floor"])), Selection(frozenset([f"{prefix}/Block"]), limits)
        return Edit(f"{prefix}/warm", "scale", {}, *sides, occluders=occluders)

    def found(now: Edit, anchor: str = "/World") -> list[str]:
        then = facts(scene, "/World", edit=edit("/World"))
        return [
            c.text for c in changes(then, facts(scene, "/World", limit=False) | staleness.selection_facts(now, anchor))
        ]

    assert found(edit("/World")) == [] == found(edit("/Other"), "/Other")
    sphere = Region(Shape.SPHERE, tuple(float(x) for x in np.eye(3, 4).ravel()))
    assert found(edit("/World", sphere)) == ["the edit has other casters"]
    assert found(edit("/World", occluders=("/World/Block",))) == ["the edit has another target, lights or occluders"]


def test_parameters_that_moved_on_since_the_bake_are_named() -> None:
    baked = Payload("scale", {"gain": 0.5}, scale_delta=(-0.5, -0.5, -0.5))
    assert staleness.baked_parameters(baked, {"gain": 0.5, "color": (1.0, 1.0, 1.0)}) == ()
    assert staleness.baked_parameters(baked, {"gain": float(np.float32(0.8)), "color": (1.0, 1.0, 1.0)}) == (
        "gain is 0.8, and was 0.5 when it was baked",
    )
    assert staleness.baked_parameters(Payload("scale", {"gain": 0.5}), {"gain": 0.8}) == ()


@pytest.mark.parametrize("name", ["surfaces", "lights", "camera-view", "centre", "radius"])
def test_facts_that_something_else_wrote_are_passed_over(name: str) -> None:
    then = facts(room(), "/World") | {name: "by hand"}
    assert changes(then, facts(room(), "/World", limit=False)) == ()


def test_facts_hold_only_numbers_and_text_and_are_quick() -> None:
    n = 150_000
    points = np.random.default_rng(0).random((n, 3, 3), np.float32)
    scene = make_snapshot(
        [Mesh(points[i::100], WHITE, path=f"/World/M{i}") for i in range(100)], camera=cornell().camera
    )
    began = time.perf_counter()
    found = facts(scene, "/World")
    assert time.perf_counter() - began < 0.5  # 0.02 s on an idle machine
    assert all(isinstance(value, (str, int, float)) for value in found.values())
    assert sum(len(str(value)) for value in found.values()) < 20_000


def test_mutated_facts_never_stop_anything() -> None:
    random = np.random.default_rng(5)
    then, now = facts(room(extra=3), "/World"), facts(room(lamp=7.0), "/World", limit=False)
    letters = "0123456789abcdefe+-. \t\n*nai"
    for _ in range(400):
        broken = dict(then)
        name = str(random.choice(sorted(broken)))
        text = list(str(broken[name]))
        for place in random.integers(0, len(text), 1 + int(random.integers(3))):
            text[place] = str(random.choice(list(letters)))
        broken[name] = "".join(text)
        assert all(isinstance(change.text, str) for change in changes(broken, now))
