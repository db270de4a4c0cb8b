"""Every operation in the relighter against the slow evaluator: levels, stack orders, blends, soft masks, lights."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from icheat_usd.edits import offsets, operations, reference
from icheat_usd.edits.encodings.bake import bake_field
from icheat_usd.edits.field import EditField
from icheat_usd.edits.model import Blend, Edit, KeyedPayload, MaskedSurface, Payload, SurfaceMask
from icheat_usd.relight import receivers as grouping
from icheat_usd.scene import LightKind
from icheat_usd.transport import SparseRows
from tests.pipeline import Pipeline, select
from tests.scenes import Light, Material, cornell_meshes, look_at, make_snapshot, rotation, translation

PARAMETERS: dict[str, Mapping[str, Any]] = {
    "scale": {"color": (2.0, 1.3, 0.5)},
    "hsv": {"hue": 120.0, "saturation": 0.8, "value": 1.5},
    "redirect": {"target": (0.1, -0.9, 0.2), "spread": 40.0},
    "gamma": {"exponent": 1.7, "pivot": 0.3},
    "curve": {"inputs": (0.0, 0.2, 1.0), "outputs": (0.1, 0.15, 1.5), "on": "luminance"},
    "falloff": {"exponent": 0.5},
    "direction": {"direction": (-1.0, 0.5, 0.0), "strength": 1.2},
    "unshadow": {"color": (1.0, 0.8, 0.5)},
    "paint": {"color": (0.3, -0.1, 0.2)},
    "emit": {"color": (0.5, 1.0, 0.2), "intensity": 0.4},
    "albedo": {"color": (0.2, 0.9, 0.4)},
    "receive": {"scale": (1.5, 1.0, 0.7), "offset": (0.0, 0.05, -0.001)},
}
EVERYTHING = select("/red", "/green", "/floor", "/ceiling", "/back", "/tall", "/low")
SOME = select("/floor", "/back", "/tall")


def room(size: int) -> Any:
    """The box with two lights of different colour, a glossy floor and a block of metal."""
    meshes = [
        replace(mesh, material=Material(diffuse=0.4, roughness=0.4, ior=1.5))
        if mesh.path == "/floor"
        else replace(mesh, material=Material(diffuse=0.8, roughness=0.5, metallic=1.0))
        if mesh.path == "/tall"
        else mesh
        for mesh in cornell_meshes()
    ]
    down = rotation((1, 0, 0), -90)
    lights = [
        Light(LightKind.RECT, (20, 12, 4), translation(-0.5, 0.99, 0) @ down, (0.5, 0.5), path="/warm"),
        Light(LightKind.RECT, (3, 6, 14), translation(0.5, 0.99, 0.3) @ down, (0.4, 0.4), path="/cold"),
    ]
    camera = look_at((0.1, 0.05, 3.9), (0, 0, 0), fov=41, width=size, height=size)
    return make_snapshot(meshes, lights=lights, camera=camera)


@functools.cache
def pipeline(kind: str) -> Pipeline:
    if kind == "coarse":
        return Pipeline(room(8), n_gather=48, rays=32, bounce_rays=32, light_samples=4, n_bounces=4, row_spacing=3)
    return Pipeline(room(6), n_gather=48, rays=32, bounce_rays=32, light_samples=4, n_bounces=4)


def soft_mask(path: str, seed: int) -> SurfaceMask:
    surface = next(s for s in pipeline("full").snapshot.surfaces if s.path == path)
    texels = np.random.default_rng(seed).uniform(0, 1, (surface.n_faces, 4, 4)).astype(np.float32)
    texels[texels < 0.3] = 0
    return SurfaceMask((MaskedSurface(path, surface.n_faces, surface.instance_id),), texels)


def edit(name: str, operation: str, receivers: Any = SOME, casters: Any = EVERYTHING, **values: Any) -> Edit:
    if operation == "unshadow":
        values = {"occluders": ("/low", "/tall"), **values}
    return Edit(f"/{name}", operation, PARAMETERS[operation], receivers, casters, **values)


def soft(name: str, operation: str, receiver: str, caster: str, seed: int, **values: Any) -> Edit:
    """From painted places to painted places, halfway between two keys."""
    masks = [(soft_mask(receiver, seed + k), soft_mask(caster, seed + 10 + k)) for k in range(2)]
    keys = tuple(
        KeyedPayload(Payload(operation, PARAMETERS[operation], *pair), weight)
        for pair, weight in zip(masks, (0.3, 0.7), strict=True)
    )
    return edit(name, operation, select(receiver), select(caster), keys=keys, **values)


def stacks(operation: str) -> dict[str, tuple[Edit, ...]]:
    warm = edit("warm_floor", "scale", select("/floor"), select("/red", "/back"))
    turn = edit("turn", "hsv", select("/floor", "/low"), select("/red", "/green", "/ceiling"), amount=0.6)
    return {
        "between hard edits": (warm, edit("op", operation), turn),
        "strongest, on soft places": (turn, soft("op", operation, "/floor", "/ceiling", 1)),
        "weakest, on soft places": (soft("op", operation, "/floor", "/ceiling", 1, amount=0.8), warm),
        "over": (turn, edit("op", operation, amount=0.5, blend=Blend.OVER), warm),
        "add": (warm, edit("op", operation, amount=0.5, blend=Blend.ADD)),
        "of one light": (edit("op", operation, lights=("/warm",)), replace(turn, lights=("/cold",)), warm),
    }


def dense(rows: SparseRows) -> np.ndarray:
    result = np.zeros(rows.shape)
    for i in range(rows.n_rows):
        entries = slice(rows.indptr[i], rows.indptr[i + 1])
        np.add.at(result[i], rows.indices[entries], rows.weights[entries])
    return result


def dense_lobes(of: Pipeline, lobes: Any) -> np.ndarray:
    spread = of.transport.interpolation
    weights = None if spread is None else dense(spread)
    matrix = np.zeros((of.view.n, of.gather.n, 3))
    for lobe in lobes:
        rows = dense(lobe.rows)
        matrix += (rows if weights is None else weights @ rows)[:, :, None] * lobe.tint[:, None, :]
    return matrix


def slow(of: Pipeline, field: EditField) -> np.ndarray:
    """The defining loop on the relighter's own matrices, written out densely."""
    radiance = np.zeros((field.n_groups, of.gather.n, 3), np.float32)
    np.add.at(radiance, field.light_group, of.cell_light.radiance)
    return reference.edited_radiance(
        field,
        dense_lobes(of, of.transport.lobes),
        radiance,
        of.gather.area,
        of.view.points.albedo,
        field.receivers(of.view.points),
        field.casters(of.gather.points),
        [dense_lobes(of, lobes) for lobes in of.relighter.receivers(field).held_back],
    )


def assert_equals_the_slow_evaluator(kind: str, edits: tuple[Edit, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Compared are the differences that the edits make, group by group and pair by pair."""
    of = pipeline(kind)
    field = of.field(*edits)
    unedited = of.relight().indirect.astype(float)
    expected = slow(of, field) - unedited
    assert np.abs(expected).max() > 0.003
    for smallest in (1, 10_000):
        monkeypatch.setattr(grouping, "SMALLEST_GROUP", smallest)
        found = of.relighter.relight(field)
        np.testing.assert_array_equal(found.indirect, unedited.astype(np.float32))
        np.testing.assert_allclose(
            found.indirect_edited - unedited, expected, atol=5e-5 * np.abs(expected).max() + 1e-6
        )


def test_every_operation_is_here():
    own = {n for n in operations.names() if type(operations.find(n)).__module__.startswith("icheat_usd.")}
    assert own == set(PARAMETERS)


@pytest.mark.parametrize("stack", stacks("scale"))
@pytest.mark.parametrize("operation", PARAMETERS)
def test_operations_equal_the_slow_evaluator(operation, stack, monkeypatch):
    assert_equals_the_slow_evaluator("full", stacks(operation)[stack], monkeypatch)


@pytest.mark.parametrize("operation", ["falloff", "gamma", "unshadow", "paint"])
def test_operations_on_interpolated_rows_equal_the_slow_evaluator(operation, monkeypatch):
    assert_equals_the_slow_evaluator("coarse", stacks(operation)["between hard edits"], monkeypatch)


MIXED = {
    "two curves": ("gamma", "scale", "curve"),
    "a curve below": ("curve", "scale", "hsv"),
    "curve of what passes": ("unshadow", "gamma"),
    "curve of paint": ("paint", "gamma", "falloff"),
    "passing a curve": ("gamma", "unshadow", "receive"),
    "paint under falloff": ("paint", "falloff", "direction"),
    "emission turned": ("emit", "hsv", "curve"),
    "views and curves": ("receive", "gamma", "receive"),
}


@pytest.mark.parametrize("name", MIXED)
def test_levels_that_meet_equal_the_slow_evaluator(name, monkeypatch):
    edits = tuple(
        soft(f"e{k}", operation, "/floor", "/red", 3 * k) if k == 0 else edit(f"e{k}", operation, amount=0.8)
        for k, operation in enumerate(MIXED[name])
    )
    assert_equals_the_slow_evaluator("full", edits, monkeypatch)


def baked(operation: str, casters: Any) -> Payload:
    of = pipeline("full")
    field = of.field(edit("op", operation, select("/floor", "/back"), casters))
    return Payload("baked", {}, rows=bake_field(field, of.view, of.gather, of.snapshot, where="/op").rows)


@pytest.mark.parametrize("n_keys", [1, 2])
def test_baked_rows_equal_the_slow_evaluator(n_keys, monkeypatch):
    """Rows are looked up at both ends of each pair; of two keys, each has its own."""
    payloads = [baked("falloff", select("/red", "/ceiling")), baked("direction", select("/red", "/green"))]
    keys = tuple(KeyedPayload(payload, 1.0 / n_keys) for payload in payloads[:n_keys])
    rows = Edit("/op", "baked", {}, SOME, EVERYTHING, amount=0.8, keys=keys)
    warm = edit("warm", "scale", select("/floor"), select("/red", "/back"))
    curve = edit("curve", "gamma", select("/floor"))
    assert_equals_the_slow_evaluator("full", (warm, rows, curve), monkeypatch)


@pytest.mark.parametrize("operation", sorted(set(PARAMETERS) - {"receive"}))
def test_full_over_shows_the_edit_alone(operation):
    """Curves too: what they replace, they do not look at."""
    of = pipeline("full")
    weaker = edit("weaker", "scale"), edit("turn", "hsv")
    strong = edit("op", operation, blend=Blend.OVER)
    alone, both = (of.relighter.relight(of.field(*edits)).indirect_edited for edits in ((strong,), (*weaker, strong)))
    assert np.abs(alone - of.relight().indirect).max() > 0.003
    np.testing.assert_allclose(both, alone, atol=1e-5 * np.abs(alone).max())


def test_what_a_curve_lifts_out_of_the_dark_is_dimmed_by_stronger_edits():
    of = pipeline("full")
    lift = Edit("/lift", "curve", {"inputs": (0.0, 1.0), "outputs": (0.2, 1.0)}, SOME, EVERYTHING)
    out = Edit("/out", "scale", {"gain": 0.0}, SOME, EVERYTHING)
    lifted, dimmed, alone = (
        of.relighter.relight(of.field(*edits)).indirect_edited for edits in ((lift,), (lift, out), (out,))
    )
    assert np.abs(lifted - of.relight().indirect).max() > 0.1
    np.testing.assert_allclose(dimmed, alone, atol=1e-5)


def test_patches_of_casters_stand_for_all_of_them(monkeypatch):
    """Where each receiver has offsets of its own: exact where the edits are the same within a patch."""
    parts = Pipeline(room(8), n_gather=3000, rays=32, bounce_rays=32, light_samples=4, n_bounces=2)
    paint = edit("paint", "paint", select("/floor", "/back"), select("/red", "/ceiling"))
    for over, tolerance in (("gamma", 1e-4), ("falloff", 5e-3)):
        field = parts.field(paint, edit("over", over, select("/floor", "/back"), select("/red", "/green", "/ceiling")))
        found = []
        for most in (200, 10_000):
            monkeypatch.setattr(offsets, "MOST_CASTERS", most)
            light = parts.relighter.relight(field)
            found.append(light.indirect_edited - light.indirect)
        assert np.abs(found[1]).max() > 0.02
        np.testing.assert_allclose(found[0], found[1], atol=tolerance * np.abs(found[1]).max())
