"""Every operation in the final gather: against the relighter, and against numbers that are known."""

from __future__ import annotations

import functools
from dataclasses import replace

import numba
import numpy as np
import pytest

from icheat_usd.edits.encodings.bake import bake_field
from icheat_usd.edits.model import Edit, KeyedPayload, Payload
from icheat_usd.final_gather.settings import METHODS
from icheat_usd.relight import Relighter
from icheat_usd.scene import LightKind, SceneSnapshot
from icheat_usd.tracing import build_tracer
from icheat_usd.transport import build_transport
from tests.agreement import compare
from tests.final_gather.test_edits import EVERYTHING, WHITE, assert_agree, previews
from tests.pipeline import Pipeline, select
from tests.relight.test_operations import PARAMETERS, room
from tests.scenes import Light, Material, Mesh, look_at, make_snapshot, quad, quads

CURVES = ("gamma", "curve")


@functools.cache
def finer_previews() -> list[Pipeline]:
    return [replace(pipeline, n_gather=16_384) for pipeline in previews()]


@functools.cache
def shiny_previews() -> list[Pipeline]:
    """The box with a glossy floor, a block of metal, and two lights."""
    return [
        Pipeline(room(12), n_gather=4096, rays=128, light_samples=16, samples_per_pixel=16, n_bounces=3, seed=seed)
        for seed in range(2)
    ]


def edit(operation: str, receivers=WHITE, casters=EVERYTHING, **values) -> Edit:
    if operation == "unshadow":
        values = {"occluders": ("/tall", "/low"), **values}
    return Edit(f"/{operation}", operation, PARAMETERS[operation], receivers, casters, **values)


def assert_both_renderers_agree(pipelines: list[Pipeline], edits: tuple[Edit, ...], method: str = "brute") -> None:
    """Differences that the edits make are compared; the cells of the relighter are 5 cm across in a box of 2 m."""
    relit = []
    for pipeline in pipelines:
        light = pipeline.relight(*edits)
        relit.append(pipeline.image(light.indirect_edited - light.indirect))
    # What a curve makes of a receiver's light is found from all its rays, and so many are needed.
    counts = (4, 64) if any(one.operation in CURVES for one in edits) else (12, 16)
    finals = []
    for seed in range(3):
        final = pipelines[0].final(*edits, method=method, samples=counts[0], rays=counts[1], light_samples=1, seed=seed)
        finals.append(final.indirect_edited - final.indirect)
    assert np.abs(np.mean(relit, axis=0)).max() > 0.01
    # Differences of both signs cancel in the mean, which then says nothing: signs are compared one by one.
    sign = np.sign(np.mean(relit, axis=0).mean(axis=(0, 1)))
    assert_agree(compare(np.array(relit) * sign, np.array(finals) * sign, tolerance=0.03), 0.02)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("operation", PARAMETERS)
def test_differences_that_operations_make_are_those_of_the_relighter(operation, method):
    if (operation, method) == ("direction", "cached"):
        pytest.skip("its slope is steep: over records as wide as these are in a picture of 16 pixels it is no line")
    # Light of cells is that of their places in sight: of those half under the blocks it is too bright for rays that go
    # through the blocks, the less the smaller cells are (measured: 11 % with 4,096 of them, 5.5 % with 16,384).
    pipelines = finer_previews() if operation == "unshadow" else previews()
    assert_both_renderers_agree(pipelines, (edit(operation),), method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("operation", ["hsv", "falloff", "gamma", "unshadow"])
def test_differences_on_glossy_receivers_are_those_of_the_relighter(operation, method):
    everything = select("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low")
    values = {"occluders": ("/low",)} if operation == "unshadow" else {}
    floor = select("/floor", "/tall", "/back")
    assert_both_renderers_agree(shiny_previews(), (edit(operation, floor, everything, **values),), method)


def test_differences_in_the_light_of_one_lamp_are_those_of_the_relighter():
    everything = select("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low")
    warm = edit("scale", everything, everything, lights=("/warm",))
    turn = edit("hsv", select("/floor", "/back"), everything, lights=("/cold",))
    assert_both_renderers_agree(shiny_previews(), (warm, turn))


def test_differences_that_baked_rows_make_are_those_of_the_relighter():
    parts = previews()[0]
    field = parts.field(edit("falloff", select("/floor", "/back"), select("/red", "/green", "/ceiling")))
    rows = bake_field(field, parts.view, parts.gather, parts.snapshot, where="/falloff").rows
    keys = (KeyedPayload(Payload("baked", {}, rows=rows), 1.0),)
    assert_both_renderers_agree(previews(), (Edit("/baked", "baked", {}, EVERYTHING, EVERYTHING, keys=keys),))


# Identity -------------------------------------------------------------------------------------------------------------


def shiny_render(*edits: Edit, threads: int = 2):
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    try:
        return shiny_previews()[0].final(*edits, samples=2, rays=8, light_samples=1)
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)


@functools.cache
def shiny_unedited():
    return shiny_render()


@pytest.mark.parametrize("operation", PARAMETERS)
def test_the_unedited_image_does_not_depend_on_operations(operation):
    plain = shiny_unedited()
    found = shiny_render(edit(operation, select("/floor"), lights=("/warm",)))
    for layer in ("direct", "indirect", "emission", "background"):
        np.testing.assert_array_equal(getattr(found, layer), getattr(plain, layer))
    changed = (found.indirect_edited != plain.indirect_edited).any(axis=-1)
    assert 0.05 < changed.mean() < 0.6
    upper = slice(0, found.indirect.shape[0] // 2)
    np.testing.assert_array_equal(found.indirect_edited[upper], plain.indirect_edited[upper])


def test_every_level_has_the_same_bits_on_one_thread_and_on_two():
    edits = [edit(name, amount=0.7) for name in ("unshadow", "gamma", "paint", "falloff", "receive")]
    one, two = (shiny_render(*edits, threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.indirect_edited, two.indirect_edited)


@pytest.mark.parametrize("how", ["receive", "albedo"])
def test_scaling_what_is_sent_or_what_is_received_is_scaling_everything(how):
    everything = select("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low")
    factor = (2.5, 0.5, 1.5)
    scaled = shiny_render(Edit("/s", "scale", {"color": factor}, everything, everything))
    parameters = {"scale": factor} if how == "receive" else {"color": factor, "replace": False}
    other = shiny_render(Edit("/o", how, parameters, everything, everything))
    np.testing.assert_allclose(other.indirect_edited, scaled.indirect_edited, rtol=1e-5)
    np.testing.assert_allclose(scaled.indirect_edited, scaled.indirect * factor, rtol=1e-5)


# Known answers --------------------------------------------------------------------------------------------------------

FLOOR, WALL = select("/floor"), select("/wall")


def screened(floor: Material, screen: bool = True) -> SceneSnapshot:
    """A floor, a wall that the sun lights, and a black screen between them that shades neither.

    The sun has no angle, so that the light on the wall is known without noise.
    """
    wall = quads([[[-2, 0, 1], [-2, 0, -1], [-2, 2, -1], [-2, 2, 1]]])
    between = quads([[[-1.2, 0, 1.5], [-1.2, 0, -1.5], [-1.2, 1, -1.5], [-1.2, 1, 1.5]]])
    meshes = [Mesh(quad(2), floor, path="/floor"), Mesh(wall, Material(0.6), path="/wall")]
    if screen:
        meshes.append(Mesh(between, Material(0.0), path="/screen"))
    sun = Light(LightKind.DISTANT, (3, 2, 1), look_at((1, 2, 0)).to_world, path="/sun")
    camera = look_at((0.2, 3, 0), (0.2, 0, 0.01), fov=20, width=8, height=8)
    return make_snapshot(meshes, lights=[sun], camera=camera)


MATTE, GLOSSY = Material(0.8), Material(0.4, roughness=0.5, ior=1.5)


@pytest.mark.parametrize("floor", [MATTE, GLOSSY], ids=["matte", "glossy"])
def test_removing_a_shadow_is_rendering_without_the_occluder(floor):
    remove = Edit("/remove", "unshadow", {}, FLOOR, WALL, occluders=("/screen",))
    with_screen = Pipeline(screened(floor), n_gather=400, n_bounces=1)
    without = Pipeline(screened(floor, screen=False), n_gather=400, n_bounces=1)
    found = with_screen.final(remove, samples=2, rays=64)
    expected = without.final(samples=2, rays=64)
    assert expected.indirect.mean() > 1.3 * found.indirect.mean() > 0
    np.testing.assert_allclose(found.indirect_edited, expected.indirect, rtol=1e-4)


@pytest.mark.parametrize("floor", [MATTE, GLOSSY], ids=["matte", "glossy"])
@pytest.mark.parametrize("spacing", [1, 2])
def test_removing_a_shadow_in_the_preview_is_rendering_without_the_occluder(floor, spacing):
    remove = Edit("/remove", "unshadow", {}, FLOOR, WALL, occluders=("/screen",))
    parts = Pipeline(screened(floor), n_gather=400, n_bounces=1, rays=256, row_spacing=spacing)
    snapshot = parts.snapshot
    clear = build_tracer(snapshot, hidden=np.array([s.path == "/screen" for s in snapshot.surfaces]))
    transport = build_transport(snapshot, clear, parts.view, parts.gather, rays_per_row=256, row_spacing=spacing)
    plain = parts.relighter
    without = Relighter(plain.view, plain.gather, transport, plain.view_direct, plain.cell_light)
    expected = without.relight(parts.field()).indirect
    found = parts.relight(remove)
    assert expected.mean() > 1.3 * found.indirect.mean() > 0
    np.testing.assert_allclose(found.indirect_edited, expected, rtol=1e-4)


def test_half_of_a_color_removes_half_of_a_shadow():
    whole, half = (
        Edit("/remove", "unshadow", {"color": (c, c, c)}, FLOOR, WALL, occluders=("/screen",)) for c in (1.0, 0.5)
    )
    parts = Pipeline(screened(MATTE), n_gather=400, n_bounces=1, rays=64)
    full, part = (parts.relight(one).indirect_edited for one in (whole, half))
    np.testing.assert_allclose(part, 0.5 * (full + parts.relight().indirect), rtol=1e-4)


def test_offsets_come_whole_from_casters_half_of_which_are_hidden():
    """0.70 in all; gather rays, which see only the upper half of the wall, would find 0.35."""
    parts = Pipeline(screened(MATTE), n_gather=400, n_bounces=1, rays=64)
    sent = np.array([3, 2, 1]) * 0.6 / np.pi / np.sqrt(5)  # radiance of the wall: 63 degrees from the sun
    density = 0.70 / (sent * 4.0)
    paint = Edit("/paint", "paint", {"color": tuple(density), "relative": False}, FLOOR, WALL)
    light = parts.relight(paint)
    np.testing.assert_allclose(light.indirect_edited - light.indirect, 0.70, rtol=2e-4)
    final = parts.final(paint, samples=1, rays=16)
    np.testing.assert_allclose(final.indirect_edited - final.indirect, 0.70, rtol=2e-4)


@pytest.mark.parametrize("n_gather", [64, 1024])
def test_a_curve_does_not_depend_on_how_finely_casters_are_sampled(n_gather):
    """Of all the light there is, gamma makes the same power whatever it is summed from."""
    everything = select("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low")
    parts = Pipeline(room(8), n_gather=n_gather, rays=64, bounce_rays=32, light_samples=4, n_bounces=4)
    light = parts.relight(Edit("/g", "gamma", {"exponent": 0.5, "pivot": 0.2}, everything, everything))
    np.testing.assert_allclose(light.indirect_edited, 0.2 * (light.indirect / 0.2) ** 0.5, rtol=2e-4)
