"""Camera samples are distributed as the pixel filter, and stay stratified."""

from __future__ import annotations

import math

import numpy as np
import pytest

from icheat_usd.errors import SettingsError
from icheat_usd.samples import view_samples
from icheat_usd.samples.pixel_filter import FILTERS, PixelFilter
from icheat_usd.scene import F64
from icheat_usd.tracing import build_tracer
from tests.samples.test_view import looking_back, wall
from tests.scenes import Mesh, make_snapshot, quads


def share_left_of(name: str, x: F64) -> F64:
    """Integral of a filter on [-1, 1] up to `x`, of 1 in all, in closed form."""
    x = np.clip(x, -1, 1)
    if name == "box":
        return (x + 1) / 2
    if name == "triangle":
        return np.where(x < 0, (1 + x) ** 2 / 2, 1 - (1 - x) ** 2 / 2)
    if name == "gaussian":
        erf = np.vectorize(math.erf)
        return (erf(x * math.sqrt(2)) / math.erf(math.sqrt(2)) + 1) / 2
    # cos(k pi (x + 1)) = (-1)^k cos(k pi x): signs alternate against the window's own, so all add up at the centre.
    weights = (0.35875, 0.48829, 0.14128, 0.01168)
    waves = sum(w * np.sin(k * np.pi * x) / (k * np.pi) for k, w in enumerate(weights) if k)
    return (weights[0] * (x + 1) + waves) / (2 * weights[0])


@pytest.mark.parametrize(("name", "width"), [(name, 0.0) for name in FILTERS] + [("box", 2.5), ("gaussian", 3.0)])
def test_a_straight_edge_is_blurred_as_the_filter_says(name: str, width: float) -> None:
    # 16 x 4 pixels, the left half of the picture is a wall: the edge lies between two pixels.
    camera = looking_back(16, 4, window=(-2.0, 2.0, -0.5, 0.5))
    left = Mesh(quads([[(-9, -9, -1), (0.05, -9, -1), (0.05, 9, -1), (-9, 9, -1)]]), path="/left")
    scene = make_snapshot([left], camera=camera)
    chosen = PixelFilter(name, width)
    view = view_samples(scene, build_tracer(scene), samples_per_pixel=1024, pixel_filter=chosen)
    seen = np.bincount(view.pixel, view.throughput[:, 0], 64).reshape(4, 16)
    reach = 0.5 * {"box": width or 1.0, "triangle": 2.0, "gaussian": width or 2.0, "blackman-harris": 3.0}[name]
    edge = 8 + 0.05 * 4  # in pixels from the left
    expected = share_left_of(name, (edge - (np.arange(16) + 0.5)) / reach)
    np.testing.assert_allclose(seen, np.broadcast_to(expected, (4, 16)), atol=2e-3)


def test_samples_of_a_wide_filter_stay_stratified() -> None:
    scene = make_snapshot([wall(-1)], camera=looking_back(4, 4))
    tracer = build_tracer(scene)
    box = view_samples(scene, tracer, samples_per_pixel=64)
    wide = view_samples(scene, tracer, samples_per_pixel=64, pixel_filter=PixelFilter("triangle"))
    assert np.all(wide.throughput == 1 / 64)

    def place(view: object) -> F64:
        return (np.asarray(view.points.position[:64, :2], np.float64) * [1, -1] + 1) * 2 - 0.5  # type: ignore[attr-defined]

    # In x and y a sample lies where the triangle has as much weight on its left as the box had.
    np.testing.assert_allclose(share_left_of("triangle", place(wide)), place(box) + 0.5, atol=1e-3)


def test_a_box_of_one_pixel_is_the_default_bit_for_bit() -> None:
    scene = make_snapshot([wall(-1)], camera=looking_back(4, 4))
    one = view_samples(scene, build_tracer(scene), samples_per_pixel=4)
    other = view_samples(scene, build_tracer(scene), samples_per_pixel=4, pixel_filter=PixelFilter("box", 1.0))
    assert np.array_equal(one.points.position, other.points.position)


def test_unknown_filters_and_widths_are_refused() -> None:
    with pytest.raises(SettingsError, match="no pixel filter 'sinc'; use one of box, triangle, gaussian"):
        PixelFilter("sinc")
    for width in (-1.0, math.nan, math.inf):
        with pytest.raises(SettingsError, match="give it a positive width"):
            PixelFilter("box", width)
