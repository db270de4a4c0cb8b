"""Light of groups of lights apart: parts add up to the whole, and are what edits make of each light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits.model import Edit
from icheat_usd.final_gather import Extras, FinalGather
from icheat_usd.final_gather.settings import METHODS
from icheat_usd.scene import F32, LightKind, SceneSnapshot
from tests.pipeline import Pipeline, select
from tests.scenes import Light, Material, Mesh, cornell_meshes, look_at, make_snapshot, quad

SIZE = 12
CAMERA = look_at((0.11, 0.07, 3.9), (0.01, 0.02, 0), fov=40.7, width=SIZE, height=SIZE)
KEY = Light(
    LightKind.SPHERE, radiance=(20, 18, 15), size=(0.1, 0.0), to_world=((1, 0, 0, 0.3), (0, 1, 0, 0.6), (0, 0, 1, 0))
)
FILL = Light(
    LightKind.SPHERE, radiance=(3, 5, 20), size=(0.1, 0.0), to_world=((1, 0, 0, -0.4), (0, 1, 0, 0), (0, 0, 1, 0.6))
)
SHINY = Mesh(
    quad(0.5)[:, :, [0, 2, 1]],
    path="/shiny",
    material=Material(diffuse=0.2, specular=0.5, use_specular=True, roughness=0.4),
    transforms=[((1, 0, 0, 0.2), (0, 1, 0, 0.2), (0, 0, 1, 0.5))],
)
ROOM = make_snapshot([*cornell_meshes(), SHINY], lights=[KEY, FILL], camera=CAMERA)
GROUPS = {"key": (ROOM.light_paths[0],), "fill": (ROOM.light_paths[1],)}
EVERYTHING = select(*(surface.path for surface in ROOM.surfaces))
WALLS = select("/red", "/green")

STACKS = {
    "none": (),
    "scale": (Edit("/a", "scale", {"color": (3.0, 2.0, 0.5)}, select("/floor", "/back"), WALLS),),
    "of one light": (Edit("/a", "scale", {"gain": 3.0}, EVERYTHING, EVERYTHING, lights=GROUPS["key"]),),
    "falloff of one light": (
        Edit("/a", "falloff", {"exponent": 1.0}, select("/floor", "/back"), WALLS, lights=GROUPS["key"]),
    ),
    "hsv and falloff": (
        Edit("/a", "hsv", {"saturation": 0.2}, select("/back", "/tall"), EVERYTHING),
        Edit("/b", "falloff", {"exponent": 1.0}, select("/floor"), WALLS),
    ),
    "gamma": (Edit("/a", "gamma", {"exponent": 1.4}, select("/back"), EVERYTHING),),
    "paint": (Edit("/a", "paint", {"color": (0.2, 0.1, 0.3)}, select("/back", "/floor"), WALLS),),
    "through": (Edit("/a", "unshadow", {}, select("/floor", "/back"), EVERYTHING, occluders=("/tall",)),),
    "cut off": (Edit("/a", "receive", {"offset": (-0.1, -0.1, -0.1)}, select("/back"), EVERYTHING),),
}


def pipeline(room: SceneSnapshot = ROOM) -> Pipeline:
    return Pipeline(room, n_gather=256, bounce_rays=32, light_samples=4, n_bounces=2)


def render(room: SceneSnapshot, *edits: Edit, method: str = "cached") -> FinalGather:
    extras = Extras(light_groups=GROUPS, indirect=True, edits=True)
    return pipeline(room).final(*edits, method=method, samples=2, rays=8, light_samples=1, extras=extras)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("stack", STACKS)
def test_parts_add_up_to_the_whole(stack: str, method: str) -> None:
    found = render(ROOM, *STACKS[stack], method=method)
    for kind in ("direct", "indirect", "indirect_edited"):
        whole = getattr(found, kind)
        parts = [found.light_groups[kind, name] for name in GROUPS]
        assert min(part.mean() for part in parts) > 0.01 * whole.mean()
        if kind != "indirect_edited" or stack != "cut off":
            np.testing.assert_allclose(sum(parts), whole, rtol=2e-5, atol=2e-6, err_msg=kind)
    if stack == "cut off":
        none = found.indirect_edited == 0
        assert none.any() and not any(found.light_groups["indirect_edited", name][none].any() for name in GROUPS)
    untouched = np.ones(SIZE * SIZE, np.bool_)
    untouched[found.coverage["edit"].pixel] = False
    for name in GROUPS:
        base, edited = (found.light_groups[kind, name].reshape(-1, 3) for kind in ("indirect", "indirect_edited"))
        np.testing.assert_array_equal(edited[untouched], base[untouched])
        is_same = stack == "none" or (stack.endswith("of one light") and name == "fill")
        assert np.allclose(base, edited, rtol=1e-5) == is_same


@pytest.mark.parametrize("method", METHODS)
def test_what_no_light_sent_is_in_no_part(method: str) -> None:
    glow = Edit("/glow", "emit", {"color": (0.5, 0.2, 0.1)}, select("/floor", "/back"), WALLS)
    lift = Edit("/lift", "receive", {"scale": (0.5, 0.5, 0.5), "offset": (0.1, 0.1, 0.1)}, select("/floor"), EVERYTHING)
    found = render(ROOM, glow, lift, method=method)
    for name in GROUPS:
        assert (found.light_groups["indirect_edited", name] <= found.light_groups["indirect", name] * (1 + 1e-5)).all()
    parts = sum(found.light_groups["indirect_edited", name] for name in GROUPS)
    dark = replace(ROOM, lights=ROOM.lights._replace(radiance=0 * ROOM.lights.radiance))
    added, unlit = found.indirect_edited - parts, render(dark, glow, lift, method="brute").indirect_edited
    assert unlit.max() > 0.1
    if method == "brute":
        np.testing.assert_allclose(added, unlit, rtol=1e-4, atol=1e-5)
    assert added.mean() == pytest.approx(unlit.mean(), rel=0.02)


def lit_by(light: int) -> SceneSnapshot:
    radiance: F32 = ROOM.lights.radiance.copy()
    radiance[1 - light] = 0
    return replace(ROOM, lights=ROOM.lights._replace(radiance=radiance))


@pytest.mark.parametrize("stack", ["none", "scale", "of one light", "paint", "through"])
def test_a_part_is_the_image_without_the_other_light(stack: str) -> None:
    whole = render(ROOM, *STACKS[stack], method="brute")
    for light, name in enumerate(GROUPS):
        alone = render(lit_by(light), *STACKS[stack], method="brute")
        for kind in ("direct", "indirect", "indirect_edited"):
            part = whole.light_groups[kind, name]
            np.testing.assert_allclose(part, getattr(alone, kind), rtol=1e-4, atol=1e-6, err_msg=kind)


def test_an_edit_of_one_light_leaves_the_other_as_it_is() -> None:
    found = render(ROOM, *STACKS["of one light"])
    for name, factor in {"key": 3.0, "fill": 1.0}.items():
        parts = [found.light_groups[kind, name] for kind in ("indirect_edited", "indirect")]
        np.testing.assert_allclose(parts[0], factor * parts[1], rtol=1e-4, atol=1e-6)


def test_the_usual_layers_are_those_without_parts() -> None:
    stack = STACKS["hsv and falloff"]
    for method in METHODS:
        rich = render(ROOM, *stack, method=method)
        plain = pipeline().final(*stack, method=method, samples=2, rays=8, light_samples=1)
        for layer in ("direct", "indirect", "indirect_edited"):
            np.testing.assert_array_equal(getattr(rich, layer), getattr(plain, layer))
        assert not plain.light_groups


def test_what_is_seen_of_lights_is_theirs() -> None:
    lamp = Mesh(quad(1.0)[:, :, [0, 2, 1]], path="/lamp", material=Material(emission=(3, 2, 1)))
    skies = [Light(LightKind.DOME, radiance=(0.1, 0.2, 0.4)), Light(LightKind.DOME, radiance=(0.5, 0.1, 0.1))]
    scene = make_snapshot([lamp], lights=skies, camera=CAMERA)
    assert len(scene.light_paths) == 3
    groups = {path: (path,) for path in scene.light_paths}
    found = Pipeline(scene, n_bounces=1).final(samples=2, rays=1, extras=Extras(light_groups=groups))
    parts = [found.light_groups["seen", name] for name in groups]
    np.testing.assert_allclose(sum(parts), found.background + found.emission, rtol=1e-6)
    centre, corner = (SIZE // 2, SIZE // 2), (0, 0)
    for part, light in zip(parts, scene.light_paths, strict=True):
        glows = light == "/lamp"
        assert (part[centre].any(), part[corner].any()) == (glows, not glows)
    np.testing.assert_allclose(parts[1][corner] / parts[0][corner], (5, 0.5, 0.25), rtol=1e-5)
