"""Edits in the final gather: against the relighter and a plain renderer, and what they must leave alone.

Compared are differences between edited and unedited images, which a good
unedited image cannot hide.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.edits.model import Edit, KeyedPayload, MaskedSurface, Payload, SurfaceMask, Value
from icheat_usd.final_gather import FinalGather
from icheat_usd.final_gather.settings import METHODS
from icheat_usd.samples import view_samples
from tests import naive
from tests.agreement import Agreement, compare
from tests.pipeline import Pipeline, select
from tests.scenes import covered_cornell, look_at

# Off the axis, so that no ray through a pixel centre runs along an edge of the room.
SCENE = replace(covered_cornell(), camera=look_at((0.11, 0.07, 3.9), (0.01, 0.02, 0), fov=40.7, width=16, height=16))
EVERYTHING = select(*(surface.path for surface in SCENE.surfaces))
WHITE = select("/floor", "/back", "/tall", "/low", "/ceiling")
SIDES = select("/red", "/green")
BOUNCES = 4

BLEED = Edit("/bleed", "scale", {"color": (3.0, 2.0, 0.5)}, WHITE, SIDES)
TURN = Edit("/turn", "hsv", {"hue": 120.0, "saturation": 0.8, "value": 1.8}, select("/floor", "/low"), EVERYTHING)
GREY = Edit("/grey", "hsv", {"saturation": 0.0}, WHITE, EVERYTHING, amount=0.7)
DIM = Edit("/dim", "scale", {"gain": 0.3}, EVERYTHING, select("/floor"))


def soft(path: str, seed: int) -> SurfaceMask:
    surface = next(s for s in SCENE.surfaces if s.path == path)
    texels = np.random.default_rng(seed).uniform(0, 1, (surface.n_faces, 4, 4)).astype(np.float32)
    texels[texels < 0.3] = 0
    return SurfaceMask((MaskedSurface(path, surface.n_faces, surface.instance_id),), texels)


def painted(operation: str, parameters: Mapping[str, Value]) -> Edit:
    """From painted places on a side wall to painted places on the back wall."""
    payload = Payload(operation, parameters, receiver_mask=soft("/back", 1), caster_mask=soft("/red", 2))
    return Edit("/soft", operation, parameters, select("/back"), select("/red"), keys=(KeyedPayload(payload, 1.0),))


STACKS: dict[str, tuple[Edit, ...]] = {
    "scale": (BLEED,),
    "hsv": (TURN,),
    "soft masks": (painted("scale", {"gain": 4.0}),),
    "scale, then hsv": (BLEED, GREY),
    "hsv, then scale": (GREY, BLEED),
    "overlapping scales": (BLEED, DIM),
}


@functools.cache
def previews() -> list[Pipeline]:
    return [
        Pipeline(SCENE, n_gather=4096, rays=64, light_samples=16, samples_per_pixel=16, n_bounces=BOUNCES, seed=seed)
        for seed in range(3)
    ]


def relit_differences(name: str) -> list[np.ndarray]:
    found = []
    for pipeline in previews():
        light = pipeline.relight(*STACKS[name])
        found.append(pipeline.image(light.indirect_edited - light.indirect))
    return found


@functools.cache
def final_differences(name: str, method: str) -> list[np.ndarray]:
    pipeline, counts = previews()[0], {"samples": 16, "rays": 16, "light_samples": 1}
    finals = [pipeline.final(*STACKS[name], method=method, seed=seed, **counts) for seed in range(4)]
    return [final.indirect_edited - final.indirect for final in finals]


def assert_agree(found: Agreement, slack: float) -> None:
    """Noise, and `slack` in the mean for what the size of the cells does."""
    assert (np.abs(found.ratio - 1) < 4 * found.error + slack).all(), found
    assert found.pixels < 1.4, found
    assert found.blocks < 2.4, found


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", STACKS)
def test_differences_that_edits_make_are_those_of_the_relighter(name, method):
    """Cells are 5 cm across in a box of 2 m: 3 % of tolerance for the light of a place, 2 % in the mean."""
    assert_agree(compare(relit_differences(name), final_differences(name, method), tolerance=0.03), 0.02)


@pytest.mark.parametrize("name", [name for name in STACKS if "hsv" not in name and "soft" not in name])
def test_differences_that_scales_make_are_those_of_a_plain_renderer(name):
    """The plain renderer multiplies the light of every gather ray by the factors of its two surfaces."""
    owner = naive.NaiveScene.of(SCENE).instance
    paths = np.array([SCENE.surfaces[SCENE.geometry.instance_surface[i]].path for i in owner])

    def edit(receiver, caster, light):
        hit = caster >= 0
        for one in STACKS[name]:
            factor = np.asarray(one.parameters.get("color", (1.0, 1.0, 1.0))) * one.parameters.get("gain", 1.0)
            pair = hit & np.isin(paths[receiver], list(one.receivers.paths))
            pair &= np.isin(paths[caster], list(one.casters.paths))
            light = np.where(pair[:, None], light * factor, light)
        return light

    # One sample per pixel is through its centre, as all are in the plain renderer.
    finals = [previews()[0].final(*STACKS[name], samples=1, rays=128, light_samples=1, seed=s) for s in range(6)]
    slow = [naive.render(SCENE, samples=24, n_bounces=BOUNCES, seed=seed, edit=edit) for seed in range(6)]
    found = compare(
        [final.indirect_edited - final.indirect for final in finals],
        [layers["indirect_edited"] - layers["indirect"] for layers in slow],
    )
    assert_agree(found, 0.002)


def render(*edits: Edit, threads: int = 2, method: str = "brute") -> FinalGather:
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    try:
        return previews()[0].final(*edits, method=method, samples=4, rays=16, light_samples=4)
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)


@functools.cache
def unedited(method: str) -> FinalGather:
    return render(method=method)


def touched_pixels(edit: Edit) -> np.ndarray:
    """(h, w) bool: a camera sample of the pixel, of those that `render` takes, has a receiver mask above 0."""
    pipeline = previews()[0]
    view = view_samples(SCENE, pipeline.tracer, samples_per_pixel=4, seed=0, max_splits=0)
    inside = (pipeline.field(edit).receiver_masks(view.points) > 0).any(axis=0)
    camera = SCENE.camera
    return np.bincount(view.pixel, inside, camera.width * camera.height).reshape(camera.height, camera.width) > 0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("edit", [BLEED, TURN, painted("scale", {"gain": 4.0})], ids=["scale", "hsv", "soft"])
def test_pixels_outside_the_receivers_keep_their_bits(edit, method):
    plain, edited = unedited(method), render(edit, method=method)
    for layer in ("direct", "indirect", "emission", "background", "albedo"):
        np.testing.assert_array_equal(getattr(edited, layer), getattr(plain, layer))
    inside = touched_pixels(edit)
    np.testing.assert_array_equal(edited.indirect_edited[~inside], plain.indirect_edited[~inside])
    changed = (edited.indirect_edited != plain.indirect_edited).any(axis=-1)
    assert changed[inside].mean() > 0.6
    assert 0.05 < inside.mean() < 0.95


@pytest.mark.parametrize("method", METHODS)
def test_an_edit_that_changes_a_fifth_of_the_picture_by_a_twentieth_stays_inside_its_receivers(method):
    strong = Edit("/strong", "scale", {"gain": 2.0}, WHITE, EVERYTHING)
    plain, edited = unedited(method), render(strong, method=method)
    before = plain.direct + plain.emission + plain.indirect
    after = edited.direct + edited.emission + edited.indirect_edited
    relative = np.abs(after - before).max(axis=-1) / np.maximum(before.max(axis=-1), 1e-6)
    assert (relative > 0.05).mean() > 0.2
    outside = ~touched_pixels(strong)
    assert outside.mean() > 0.2
    np.testing.assert_array_equal(after[outside], before[outside])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("threads", [1, 2])
def test_no_edit_muted_edit_and_amount_zero_are_the_unedited_image_bit_for_bit(threads, method):
    plain = unedited(method)
    np.testing.assert_array_equal(plain.indirect_edited, plain.indirect)
    for edit in (
        Edit("/e", "scale", {"gain": 3.0}, WHITE, EVERYTHING, enabled=False),
        Edit("/e", "hsv", {"hue": 90.0}, WHITE, EVERYTHING, amount=0.0),
        Edit("/e", "scale", {"gain": 3.0}, select("/nothing"), EVERYTHING),
    ):
        same = render(edit, threads=threads, method=method)
        np.testing.assert_array_equal(same.indirect_edited, plain.indirect)
        np.testing.assert_array_equal(same.indirect, plain.indirect)
        np.testing.assert_array_equal(same.direct, plain.direct)


@pytest.mark.parametrize("method", METHODS)
def test_the_same_bits_on_one_thread_and_on_two(method):
    one, two = render(BLEED, TURN, threads=1, method=method), render(BLEED, TURN, threads=2, method=method)
    for layer in ("background", "emission", "direct", "indirect", "indirect_edited", "albedo", "normal", "depth"):
        np.testing.assert_array_equal(getattr(one, layer), getattr(two, layer))


@pytest.mark.parametrize("method", METHODS)
def test_scaling_everything_scales_the_indirect_image(method):
    final = render(Edit("/e", "scale", {"gain": 2.5}, EVERYTHING, EVERYTHING), method=method)
    np.testing.assert_allclose(final.indirect_edited, 2.5 * final.indirect, rtol=1e-5)
