"""Pixels that get more camera samples since their cached light changes."""

from __future__ import annotations

import numpy as np

from icheat_usd.final_gather import CacheSettings
from icheat_usd.final_gather.contrast import TOLERANCE, light_edges
from tests.final_gather.test_irradiance_cache import Built, sized
from tests.scenes import closed_box

SIZE = 24


def stripe(points):
    """A box that glows in its upper half alone."""
    return np.where(points.position[:, 1:2] > 0.2, np.float32(1), np.float32(0.02)).repeat(3, axis=1)


def test_pixels_are_those_that_differ_from_a_neighbour_or_in_themselves():
    built = Built(sized(closed_box(), SIZE), stripe, CacheSettings(n_theta=8))
    found = light_edges(built.cache, built.places, built.view.pixel, SIZE, SIZE * SIZE)

    light = np.maximum(built.irradiance(), 0).sum(axis=1)
    floor = 0.01 * light.mean()
    of_pixel = [light[built.view.pixel == pixel] for pixel in range(SIZE * SIZE)]
    expected = set()
    for pixel in range(SIZE * SIZE):
        y, x = divmod(pixel, SIZE)
        for other in (pixel, pixel + 1 if x + 1 < SIZE else pixel, pixel + SIZE if y + 1 < SIZE else pixel):
            both = np.concatenate([of_pixel[pixel], of_pixel[other]])
            if both.max() - both.min() > TOLERANCE * (both.max() + floor):
                expected |= {pixel, other}
    assert found.tolist() == sorted(expected)
    assert 0 < len(found) < SIZE * SIZE / 2


def test_even_light_has_no_edges():
    built = Built(sized(closed_box(), SIZE), lambda points: np.float32(0.7), CacheSettings(n_theta=8))
    assert len(light_edges(built.cache, built.places, built.view.pixel, SIZE, SIZE * SIZE)) == 0
