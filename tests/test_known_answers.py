"""Scenes whose radiance is known, rendered three ways: relighter, final gather and the plain renderer of `naive.py`."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.scene import LightKind
from tests import naive
from tests.pipeline import Pipeline
from tests.scenes import (
    Light,
    Material,
    Mesh,
    closed_box,
    look_at,
    make_snapshot,
    quad,
    quads,
    rotation,
    sphere,
    translation,
)


def total(pipeline: Pipeline) -> np.ndarray:
    light = pipeline.relight()
    return pipeline.view.points.emission + light.direct + light.indirect


@pytest.mark.parametrize(("albedo", "expected"), [(0.5, 2.0), (0.8, 5.0)])
def test_furnace_holds_emission_over_one_minus_albedo(albedo, expected):
    pipeline = Pipeline(closed_box(albedo, 1.0), n_gather=512, rays=256, light_samples=64, n_bounces=64)
    found = total(pipeline)
    assert found.mean() == pytest.approx(expected, rel=0.01)
    final = pipeline.final(samples=1, rays=64)
    assert (final.emission + final.direct + final.indirect).mean() == pytest.approx(expected, rel=0.02)


def test_furnace_of_the_plain_renderer():
    layers = naive.render(closed_box(0.5, 1.0), samples=16, n_bounces=12)
    found = layers["emission"] + layers["direct"] + layers["indirect"]
    assert found.mean() == pytest.approx(2.0, rel=0.02)


@pytest.mark.parametrize(("albedo", "expected"), [(0.5, 1.5), (0.8, 1.8)])
def test_furnace_with_one_reflection(albedo, expected):
    pipeline = Pipeline(closed_box(albedo, 1.0), n_gather=512, rays=64, n_bounces=1)
    light = pipeline.relight()
    assert (pipeline.view.points.emission + light.direct).mean() == pytest.approx(expected, rel=0.01)
    # The next order, which is the first indirect one: albedo^2.
    assert light.indirect.mean() == pytest.approx(albedo**2, rel=0.01)


def test_furnace_is_even_everywhere():
    pipeline = Pipeline(closed_box(0.5, 1.0), n_gather=1024, rays=512, bounce_rays=512, light_samples=256, n_bounces=40)
    indirect = pipeline.relight().indirect
    assert np.abs(indirect / indirect.mean() - 1).max() < 0.05


def test_a_closed_sphere_mixes_all_light():
    """L = Le(x) + rho / (1 - rho) mean(Le): half of the sphere emits, all of it receives the same."""
    points, normals = sphere(1.0, 24)
    points, normals = np.ascontiguousarray(points[:, ::-1]), np.ascontiguousarray(-normals[:, ::-1])
    upper = points.mean(axis=1)[:, 1] > 0
    cross = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    area = np.linalg.norm(cross, axis=1)
    lit, dark = Material(diffuse=0.6, emission=1.0), Material(diffuse=0.6)
    meshes = [
        Mesh(points[upper], lit, path="/upper"),
        Mesh(points[~upper], dark, path="/lower"),
    ]
    snapshot = make_snapshot(meshes, camera=look_at((0, 0, 0), (0, 0, -1), fov=100, width=24, height=24))
    pipeline = Pipeline(snapshot, n_gather=1024, rays=512, bounce_rays=256, light_samples=64, n_bounces=40)
    light = pipeline.relight()
    expected = 0.6 / (1 - 0.6) * area[upper].sum() / area.sum()
    assert (light.direct + light.indirect).mean() == pytest.approx(expected, rel=0.01)


def facing_plates(distance: float):
    """A unit receiver plate at y = 0 and an equal plate above it that reflects the light of a lamp."""
    return quad(1.0), quad(1.0, y=distance)[:, ::-1]


def test_form_factors_of_plates_are_the_row_sums():
    """Parallel unit squares one apart: 0.19982; perpendicular unit squares that share an edge: 0.20004."""
    for upper, expected in [
        (quad(1.0, y=1.0)[:, ::-1], 0.199825),
        (quads([[[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 1, -0.5], [-0.5, 1, -0.5]]]), 0.200044),
    ]:
        meshes = [Mesh(quad(1.0), Material(0.5), path="/low"), Mesh(upper, Material(0.5), path="/high")]
        camera = look_at((0, 0.4, 0), (0, 0, 0), up=(0, 0, -1), fov=102.6803, width=32, height=32)
        pipeline = Pipeline(make_snapshot(meshes, camera=camera), n_gather=512, rays=1024, bounce_rays=2048)
        on_low = pipeline.gather.points.instance == 0
        towards_high = pipeline.bounces.rows.matmul((~on_low).astype(np.float32)[:, None])[:, 0]
        facing = on_low & (pipeline.gather.points.normal[:, 1] > 0.5)
        area = pipeline.gather.area[facing]
        found = (towards_high[facing] * area).sum() / area.sum()
        assert found == pytest.approx(expected, rel=0.02)


def test_rows_of_a_closed_room_sum_to_one():
    pipeline = Pipeline(closed_box(0.5, 1.0), n_gather=512, rays=64)
    np.testing.assert_allclose(pipeline.transport.lobes[0].rows.row_sums(), 1, atol=1e-5)
    points = pipeline.gather.points
    inside = np.einsum("ij,ij->i", points.normal, points.position) < 0
    assert inside.sum() > 500
    np.testing.assert_allclose(pipeline.bounces.rows.row_sums()[inside], 1, atol=1e-5)


def lit_room(scale: float = 1.0):
    """A room with a block and a rect lamp, all sizes multiplied."""
    from tests.scenes import box, scaling

    grow = scaling(scale)
    meshes = [
        Mesh(box((4, 3, 5), inward=True), Material((0.7, 0.6, 0.5)), transforms=[grow], path="/room"),
        Mesh(box((1, 1, 1), centre=(0.6, -1, -0.7)), Material((0.3, 0.6, 0.8)), transforms=[grow], path="/block"),
    ]
    lamp = grow @ translation(0, 1.4, 0) @ rotation((1, 0, 0), -90)
    light = Light(LightKind.RECT, (12, 11, 9), lamp, (1.0, 0.7))
    eye, target = np.array([1.5, 0.5, 2.2]) * scale, np.array([0, -0.5, -1.0]) * scale
    return make_snapshot(meshes, lights=[light], camera=look_at(eye, target, fov=55, width=24, height=20))


@pytest.mark.parametrize("scale", [0.001, 1000.0])
def test_size_does_not_matter(scale):
    def images(snapshot):
        pipeline = Pipeline(snapshot, n_gather=512, rays=64, light_samples=16, n_bounces=6)
        light = pipeline.relight()
        final = pipeline.final(samples=1, rays=16, light_samples=4)
        return pipeline.image(light.direct + light.indirect), final.direct + final.indirect

    for ours, scaled in zip(images(lit_room()), images(lit_room(scale)), strict=True):
        assert ours.mean() > 0.1
        # The same random numbers: a pixel differs only where rounding moves a ray across an edge.
        assert np.quantile(np.abs(scaled / ours - 1), 0.95) < 0.01
        assert scaled.mean() == pytest.approx(ours.mean(), rel=2e-3)


def test_relighter_final_gather_and_plain_renderer_agree_in_a_lit_room():
    snapshot = lit_room()
    pipeline = Pipeline(snapshot, n_gather=4096, rays=1024, bounce_rays=512, light_samples=64, n_bounces=8)
    light = pipeline.relight()
    final = pipeline.final(samples=16, rays=64)
    halves = [naive.render(snapshot, samples=96, n_bounces=8, seed=seed) for seed in (1, 2)]
    for layer in ("direct", "indirect"):
        slow = (halves[0][layer] + halves[1][layer]) / 2
        noise = np.abs(halves[0][layer].mean() - halves[1][layer].mean()) / 2 / slow.mean()
        preview = pipeline.image(getattr(light, layer))
        assert preview.mean() == pytest.approx(slow.mean(), rel=0.01 + 3 * noise)
        assert getattr(final, layer).mean() == pytest.approx(slow.mean(), rel=0.015 + 3 * noise)
