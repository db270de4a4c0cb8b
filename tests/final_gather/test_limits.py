"""Edits narrowed to regions, materials and their combinations, through both renderers."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.edits import reference
from icheat_usd.edits.model import Combination, Edit, Region, Rule, Selection, Shape, SurfacesAt, SurfacesOf
from icheat_usd.samples import view_samples
from tests.agreement import compare
from tests.pipeline import Pipeline
from tests.scenes import covered_cornell, look_at, scaling, translation

# Off the axis, so that no ray through a pixel centre runs along an edge of the room.
BARE = replace(covered_cornell(), camera=look_at((0.11, 0.07, 3.9), (0.01, 0.02, 0), fov=40.7, width=16, height=16))
SCENE = replace(BARE, material_paths=tuple(f"/material_{row}" for row in range(len(BARE.material_paths))))
EVERYTHING = frozenset(surface.path for surface in SCENE.surfaces)


def region(shape: Shape, centre: tuple[float, float, float], reach: float, softness: float) -> Region:
    to_shape = np.linalg.inv(translation(*centre) @ scaling(reach))
    return Region(shape, tuple(to_shape[:3].ravel()), softness)


def material_of(path: str) -> SurfacesOf:
    geometry = SCENE.geometry
    surface = [s.path for s in SCENE.surfaces].index(path)
    mesh = geometry.instance_mesh[list(geometry.instance_surface).index(surface)]
    return SurfacesOf(frozenset([SCENE.material_paths[geometry.material[geometry.mesh_begin[mesh]]]]))


CORNER = region(Shape.SPHERE, (-0.5, -1.0, -0.5), 1.1, 0.8)
UPPER = region(Shape.BOX, (0.0, 1.0, 0.0), 1.5, 0.5)
LIMITED = {
    "soft sphere from soft box": Edit(
        "/e", "scale", {"gain": 4.0}, Selection(EVERYTHING, (CORNER,)), Selection(EVERYTHING, (UPPER,))
    ),
    "hard box without an object, from a material": Edit(
        "/e",
        "hsv",
        {"hue": 90.0, "value": 3.0},
        Selection(
            EVERYTHING,
            (
                Combination(
                    Rule.DIFFERENCE, (region(Shape.BOX, (0, -1, 0), 1.2, 0.0), SurfacesAt(frozenset(["/tall"])))
                ),
            ),
        ),
        Selection(EVERYTHING, (Combination(Rule.UNION, (material_of("/red"), material_of("/green"))),)),
    ),
}


@functools.cache
def previews() -> list[Pipeline]:
    return [
        Pipeline(SCENE, n_gather=4096, rays=64, light_samples=16, samples_per_pixel=16, n_bounces=3, seed=seed)
        for seed in range(3)
    ]


@pytest.mark.parametrize("name", LIMITED)
def test_both_renderers_make_the_same_difference(name: str) -> None:
    edit = LIMITED[name]
    relit = []
    for pipeline in previews():
        light = pipeline.relight(edit)
        relit.append(pipeline.image(light.indirect_edited - light.indirect))
    finals = [previews()[0].final(edit, samples=16, rays=16, light_samples=1, seed=seed) for seed in range(4)]
    found = compare(relit, [final.indirect_edited - final.indirect for final in finals], tolerance=0.03)
    assert (np.abs(found.ratio - 1) < 4 * found.error + 0.02).all(), found
    assert found.pixels < 1.4 and found.blocks < 2.4, found
    assert 0.05 < (np.abs(relit[0]).max(axis=-1) > 1e-4).mean() < 0.95


@pytest.mark.parametrize("name", LIMITED)
def test_pixels_outside_the_limits_keep_their_bits(name: str) -> None:
    pipeline, edit = previews()[0], LIMITED[name]
    plain, edited = (pipeline.final(*edits, samples=4, rays=16, light_samples=4) for edits in ((), (edit,)))
    view = view_samples(SCENE, pipeline.tracer, samples_per_pixel=4, seed=0, max_splits=0)
    inside = (pipeline.field(edit).receiver_masks(view.points) > 0).any(axis=0)
    touched = np.bincount(view.pixel, inside, 256).reshape(16, 16) > 0
    assert 0.05 < touched.mean() < 0.95
    np.testing.assert_array_equal(edited.indirect_edited[~touched], plain.indirect_edited[~touched])
    assert (edited.indirect_edited[touched] != plain.indirect_edited[touched]).any(axis=-1).mean() > 0.6


@pytest.mark.parametrize("name", LIMITED)
def test_the_relighter_equals_the_slow_evaluator(name: str) -> None:
    small = Pipeline(replace(SCENE, camera=look_at((0, 0, 3.9), width=6, height=6)), n_gather=80, rays=64)
    transport, points = small.transport, small.view.points
    matrix = np.zeros((small.view.n, len(small.gather.area), 3))
    for lobe in transport.lobes:
        for i in range(small.view.n):
            entries = slice(lobe.rows.indptr[i], lobe.rows.indptr[i + 1])
            for j, weight in zip(lobe.rows.indices[entries], lobe.rows.weights[entries], strict=True):
                matrix[i, j] += weight * lobe.tint[i]

    def slow(*edits: Edit) -> np.ndarray:
        field = small.field(*edits)
        radiance = small.relighter.radiance()[None]
        ends = field.receivers(points), field.casters(small.gather.points)
        return reference.edited_radiance(field, matrix, radiance, small.gather.area, points.albedo, *ends)

    fast = small.relight(LIMITED[name])
    expected = slow(LIMITED[name]) - slow()
    assert np.abs(expected).max() > 0.01
    difference = fast.indirect_edited.astype(float) - fast.indirect
    np.testing.assert_allclose(difference, expected, atol=2e-5 * np.abs(expected).max() + 1e-6)
