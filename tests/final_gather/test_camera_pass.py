"""Camera samples of a final gather: their filter, and images that are parts of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icheat_usd.errors import SettingsError
from icheat_usd.final_gather import GatherSettings
from icheat_usd.final_gather.camera_pass import CameraPass
from icheat_usd.samples import ViewSamples
from icheat_usd.samples.develop import develop
from icheat_usd.scene import F64
from icheat_usd.tracing import build_tracer
from tests.scenes import cornell

SCENE = cornell(24, 24)
TRACER = build_tracer(SCENE)


def views(settings: GatherSettings) -> list[ViewSamples]:
    camera = CameraPass(SCENE, TRACER, settings, settings.edge_samples, band=1000)
    for _ in camera.first():
        pass
    return [band.view for band in camera.all()]


def places(settings: GatherSettings) -> set[tuple[float, ...]]:
    return {tuple(place) for view in views(settings) for place in view.points.position.tolist()}


def normals(settings: GatherSettings) -> F64:
    """Mean normal of each pixel: an image with edges."""
    image = np.zeros((24 * 24, 3))
    for view in views(settings):
        image += develop(view, view.points.shading_normal)
    return image


def test_every_sample_has_its_own_counter_and_weight() -> None:
    settings = GatherSettings(samples_per_pixel=2, edge_samples=3)
    for view in views(settings):
        assert len(view.stream) == view.n == len(set(view.stream.tolist()))
        pixel = np.concatenate([view.pixel, view.sky.pixel])
        counts = np.bincount(pixel)
        assert set(counts[counts > 0].tolist()) == {2, 5}
        weights = np.bincount(pixel, np.concatenate([view.throughput, view.sky.throughput])[:, 0])
        np.testing.assert_allclose(weights[counts > 0], 1, rtol=1e-6)


def test_images_that_are_parts_of_one_have_its_samples() -> None:
    whole = GatherSettings(samples_per_pixel=12, edge_samples=0)
    parts = [replace(whole, samples_per_pixel=n, first_sample=first) for first, n in ((0, 1), (1, 3), (4, 8))]
    assert set.union(*(places(part) for part in parts)) == places(whole)
    image = sum(normals(part) * part.samples_per_pixel for part in parts) / 12
    np.testing.assert_allclose(image, normals(whole), atol=1e-6)


def test_a_wide_filter_blurs_edges() -> None:
    sharp = GatherSettings(samples_per_pixel=64, edge_samples=0)
    assert np.array_equal(normals(sharp), normals(replace(sharp, pixel_filter="box", filter_width=1.0)))
    soft = normals(replace(sharp, pixel_filter="gaussian", filter_width=4.0)).reshape(24, 24, 3)
    steps = np.abs(np.diff(normals(sharp).reshape(24, 24, 3), axis=1)).max()
    assert steps > 0.9 and np.abs(np.diff(soft, axis=1)).max() < 0.6 * steps


def test_an_unknown_filter_is_refused_before_the_render() -> None:
    with pytest.raises(SettingsError, match="no pixel filter"):
        GatherSettings(pixel_filter="lanczos")
