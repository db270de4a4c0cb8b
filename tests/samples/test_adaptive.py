"""Passes of camera samples go on from one another, whichever pixels are traced together; edges get more of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icheat_usd.samples import ViewSamples, view_samples
from icheat_usd.samples.adaptive import edge_pixels, join_looks, look_over, needs_more
from icheat_usd.samples.develop import develop
from icheat_usd.scene import I64, SceneSnapshot
from icheat_usd.tracing import build_tracer
from tests.samples.test_view import looking_back, wall
from tests.scenes import Light, LightKind, Material, Mesh, box, make_snapshot, quads


def glass_before_a_wall(size: int = 16) -> SceneSnapshot:
    glass = Material(opacity=0.0, ior=1.5, roughness=0.0)
    return make_snapshot(
        [Mesh(box(1, (0.1, 0, -2)), glass), wall(-5, size=6.0)],
        lights=[Light(LightKind.DOME, (1, 2, 3))],
        camera=looking_back(size, size, lens_radius=0.02, focus_distance=3.0),
    )


def assert_same_samples(one: ViewSamples, other: ViewSamples, rows: I64) -> None:
    """Samples `rows` of the first are those of the second."""
    assert np.array_equal(one.pixel[rows], other.pixel)
    assert np.array_equal(one.stream[rows], other.stream)
    assert np.array_equal(one.to_eye[rows], other.to_eye)
    assert np.array_equal(one.points.position[rows], other.points.position)
    assert np.array_equal(one.depth[rows], other.depth)


def test_a_pixels_samples_do_not_depend_on_what_is_traced_with_them() -> None:
    scene = glass_before_a_wall()
    tracer = build_tracer(scene)
    for splits in (0, 1):
        whole = view_samples(scene, tracer, samples_per_pixel=4, max_splits=splits, seed=5)
        some = np.array([3, 100, 101, 117, 118, 119, 200, 255])
        part = view_samples(scene, tracer, samples_per_pixel=4, max_splits=splits, seed=5, pixels=some)
        assert part.n > 10
        assert_same_samples(whole, part, np.flatnonzero(np.isin(whole.pixel, some)))
        assert np.array_equal(part.background[some], whole.background[some])
        assert not np.delete(part.background, some, axis=0).any()
        light = np.ones((part.n, 3), np.float32)
        listed = develop(part, light, some)
        assert np.array_equal(listed, develop(part, light)[some])


def test_a_second_pass_goes_on_where_the_first_one_ended() -> None:
    scene = glass_before_a_wall()
    tracer = build_tracer(scene)
    whole = view_samples(scene, tracer, samples_per_pixel=12, max_splits=0)
    first = view_samples(scene, tracer, samples_per_pixel=4, max_splits=0)
    second = view_samples(scene, tracer, samples_per_pixel=8, first_sample=4, max_splits=0)
    single = view_samples(scene, tracer, samples_per_pixel=1, first_sample=0, centred=False, max_splits=0)
    for part in (first, second, single):
        known = {number: k for k, number in enumerate(whole.stream.tolist())}
        assert part.n and len(known) == whole.n  # no two samples share a counter
        assert_same_samples(whole, part, np.array([known[number] for number in part.stream.tolist()]))
    assert first.n + second.n == whole.n
    image = (4 * first.background + 8 * second.background) / 12
    np.testing.assert_allclose(image, whole.background, atol=1e-6)


def test_edges_need_more_samples_and_even_walls_do_not() -> None:
    # 16 x 16 pixels over a square 2 m wide at 1 m: a pixel is an eighth of a metre there.
    scene = make_snapshot(
        [wall(-1), Mesh(box(0.5, (0.0, 0, -0.75)), path="/box")], camera=looking_back(16, 16, near=0.01)
    )
    tracer = build_tracer(scene)
    for samples in (1, 4):
        view = view_samples(scene, tracer, samples_per_pixel=samples)
        edge = np.zeros((16, 16), bool)
        edge.reshape(-1)[needs_more(view, scene.camera)] = True
        # The box's front, half a metre wide at half a metre, fills the middle half of the picture.
        expected = np.zeros((16, 16), bool)
        expected[3:13, 3:13] = True
        expected[5:11, 5:11] = False
        assert np.array_equal(edge, expected)


def two_halves(right: Material, tilt: float = 0.0, back: float = 0.0) -> SceneSnapshot:
    """One surface at z = -1 whose right half turns away by `tilt` degrees, or steps `back` metres."""
    rise = 4 * np.tan(np.radians(tilt))
    corners = quads(
        [
            [(-4, -4, -1), (0, -4, -1), (0, 4, -1), (-4, 4, -1)],
            [(0, -4, -1 - back), (4, -4, -1 - back - rise), (4, 4, -1 - back - rise), (0, 4, -1 - back)],
        ]
    )
    left = Material(0.5)
    return make_snapshot([Mesh(corners, [left, left, right, right])], camera=looking_back(16, 16))


@pytest.mark.parametrize(
    ("changes", "is_edge"),
    [
        ({"right": Material(0.51)}, False),
        ({"right": Material(0.6)}, True),
        ({"right": Material(0.5, emission=0.1)}, True),
        ({"right": Material(0.5), "tilt": 8.0}, False),
        ({"right": Material(0.5), "tilt": 12.0}, True),
        ({"right": Material(0.5), "back": 0.1}, False),
        ({"right": Material(0.5), "back": 0.2}, True),
    ],
)
def test_one_surface_needs_more_where_its_colour_direction_or_place_changes(
    changes: dict[str, Any], is_edge: bool
) -> None:
    scene = two_halves(**changes)
    for samples in (1, 4):
        view = view_samples(scene, build_tracer(scene), samples_per_pixel=samples)
        columns = np.unique(needs_more(view, scene.camera) % 16)
        assert np.array_equal(columns, [7, 8] if is_edge else [])


def test_bands_are_looked_over_one_by_one() -> None:
    scene = glass_before_a_wall()
    tracer = build_tracer(scene)
    whole = view_samples(scene, tracer, samples_per_pixel=4, max_splits=0)
    bands = []
    for first in range(0, 256, 48):
        pixels = (first, min(first + 48, 256))
        view = view_samples(scene, tracer, samples_per_pixel=4, max_splits=0, pixels=pixels)
        bands.append(look_over(view, scene.camera, pixels))
    found = edge_pixels(join_looks(*bands), 16)
    assert 40 < len(found) < 256
    assert np.array_equal(found, needs_more(whole, scene.camera))
