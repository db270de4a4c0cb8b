"""Bins of the sky: where directions fall, what domes send through them, and which rays reach them."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.lighting import environment_radiance
from icheat_usd.scene import LightKind
from icheat_usd.transport.sky import SkyBins
from tests.scenes import Image, Light, Mesh, make_snapshot, quad, rotation, scaling


def random_directions(n: int, seed: int = 0) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(n, 3)).astype(np.float32)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_middles_of_bins_lie_in_their_bins_and_solid_angles_add_up() -> None:
    sky = SkyBins(24)
    assert np.array_equal(sky.of_directions(sky.direction), np.arange(sky.n))
    assert np.array_equal(sky.of_directions(7 * sky.direction), np.arange(sky.n))
    assert sky.solid_angle.sum() == pytest.approx(4 * np.pi, rel=1e-5)
    n = 400_000
    share = np.bincount(sky.of_directions(random_directions(n)), minlength=sky.n) / n
    expected = sky.solid_angle / (4 * np.pi)
    assert np.all(np.abs(share - expected) < 5 * np.sqrt(expected / n))


def test_a_bin_is_one_patch_of_the_sphere() -> None:
    sky = SkyBins(32)
    directions = random_directions(50_000)
    cosine = (directions * sky.direction[sky.of_directions(directions)]).sum(1)
    # In the middle of a face a step in the square is at most sqrt(3) long on the face, 1 / sqrt(3) from the centre.
    assert np.arccos(cosine.min()) < 3 * np.sqrt(2) / 32


@pytest.mark.parametrize("size", [(1, 1), (8, 16), (300, 700)])
def test_a_plain_dome_is_the_same_in_every_bin(size: tuple[int, int]) -> None:
    sky = SkyBins(16)
    texels = np.tile(np.float32([0.5, 1.0, 2.0]), (*size, 1))
    turned = rotation((1, 2, 3), 77)[:3, :3] @ scaling(1, 2, 0.5)[:3, :3]
    np.testing.assert_allclose(sky.average(sky.patches(texels), turned), np.tile([0.5, 1, 2], (sky.n, 1)), rtol=1e-5)


@pytest.mark.parametrize("shape", [(24, 48), (500, 900)])
def test_averages_of_a_turned_and_stretched_image_are_those_of_its_look_up(shape: tuple[int, int]) -> None:
    texels = np.random.default_rng(4).random((*shape, 3)).astype(np.float32) ** 4
    turned = rotation((3, -1, 2), 130) @ scaling(1, 1.5, 0.8)
    sky = SkyBins(8)
    scene = make_snapshot([Mesh(quad())], lights=[Light(LightKind.DOME, 1.0, turned, image=Image(texels, (0, 1)))])
    directions = random_directions(400_000)
    seen = environment_radiance(scene, directions)
    bins = sky.of_directions(directions)
    count = np.bincount(bins, minlength=sky.n)[:, None]
    expected = np.stack([np.bincount(bins, seen[:, c], sky.n) for c in range(3)], 1) / count
    average = sky.average(sky.patches(texels), np.asarray(turned))
    spread = seen.std() / np.sqrt(count)
    assert np.all(np.abs(average - expected) < 5 * spread + 0.01 * expected.mean())


def test_a_sun_of_one_texel_is_not_missed() -> None:
    texels = np.zeros((512, 1024, 3), np.float32)
    texels[100, 333] = 1e5
    sky = SkyBins(32)
    average = sky.average(sky.patches(texels), np.eye(3))
    band = np.cos(np.pi * 100 / 512) - np.cos(np.pi * 101 / 512)
    energy = 1e5 * band * 2 * np.pi / 1024
    # What one patch sends is spread over the bin it falls in, whose patches cover about its solid angle.
    assert (average[:, 0] * sky.solid_angle).sum() == pytest.approx(energy, rel=0.2)
    assert np.count_nonzero(average[:, 0]) == 1


def test_a_dome_without_an_inverse_is_black_and_no_bins_are_refused() -> None:
    sky = SkyBins(4)
    assert not sky.average(sky.patches(np.ones((1, 1, 3), np.float32)), np.zeros((3, 3))).any()
    with pytest.raises(ValueError, match="at least one bin"):
        SkyBins(0)
