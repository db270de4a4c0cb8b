"""Noise goes, edges of masks stay: to the pixel, and to the bit outside."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.typing import NDArray

from icheat_usd.errors import ImageError
from icheat_usd.image.denoise import EditImage, denoise, denoise_edited

HEIGHT, WIDTH = 96, 128
Y, X = np.mgrid[:HEIGHT, :WIDTH]
SMOOTH = np.array([1.0, 0.8, 0.5], np.float32) * (0.5 + 0.3 * np.sin(X / 17) + 0.15 * np.cos(Y / 11))[..., None].astype(
    np.float32
)

BLUE = np.array([0.3, 0.6, 0.9], np.float32)

needs_oidn = pytest.mark.skipif(find_spec("pyoidn") is None, reason="needs the extra 'denoise'")


def noisy(seed: int = 0) -> NDArray[np.float32]:
    return (SMOOTH * np.random.default_rng(seed).gamma(4, 0.25, (HEIGHT, WIDTH, 1))).astype(np.float32)


def off(image: NDArray[np.float32], exact: NDArray[np.float32]) -> float:
    return float(np.sqrt(np.mean((image - exact) ** 2)) / exact.mean())


@needs_oidn
def test_noise_goes_the_same_way_every_time() -> None:
    image = noisy()
    found = denoise(image)
    assert found.dtype == np.float32
    assert off(found, SMOOTH) < 0.2 * off(image, SMOOTH)
    np.testing.assert_array_equal(denoise(image), found)
    assert abs(found.mean() / SMOOTH.mean() - 1) < 0.03


@needs_oidn
def test_features_keep_their_edges() -> None:
    albedo = np.where((X // 8 + Y // 8) % 2 == 0, 0.8, 0.3)[..., None].repeat(3, 2).astype(np.float32)
    normal = np.broadcast_to(np.array([0, 0, 1], np.float32), albedo.shape)
    exact = SMOOTH * albedo
    image = noisy() * albedo
    assert off(denoise(image, albedo, normal), exact) < 0.7 * off(denoise(image), exact)


def hard(x: int, share: float = 0.4) -> NDArray[np.float32]:
    """1 from column `x` on, and a column of pixels before it that the edge crosses."""
    return np.where(X >= x, 1.0, np.where(X == x - 1, share, 0.0)).astype(np.float32)


@needs_oidn
@pytest.mark.parametrize("gain", [0.2, 3.0])
def test_a_hard_mask_stays_sharp_to_the_pixel(gain: float) -> None:
    image, mask = noisy(), hard(61)
    found = denoise_edited(image, [EditImage(mask, image * mask[..., None] * np.float32(gain - 1))])
    np.testing.assert_array_equal(found.unedited, denoise(image))
    outside = mask == 0
    np.testing.assert_array_equal(found.edited[outside], found.unedited[outside])
    np.testing.assert_array_equal(found.changes[0][outside], 0)
    # The edit multiplies, so it must multiply what is left without noise: in every column about the edge as well.
    wanted = 1 + (gain - 1) * mask
    ratio = (found.edited / found.unedited).mean(axis=(0, 2))
    np.testing.assert_allclose(ratio[56:68], wanted[0, 56:68], rtol=0.015)
    ratio = found.edited / found.unedited
    assert np.abs(ratio / wanted[..., None] - 1).max() < 0.1
    # What is gained: a denoised product of the edit is not this sharp.
    edited = image * wanted[..., None].astype(np.float32)
    plain = np.abs(denoise(edited)[:, 61] / found.unedited[:, 61] / gain - 1).mean()
    assert np.abs(ratio[:, 61] / gain - 1).mean() < 0.5 * plain
    assert off(found.edited, SMOOTH * wanted[..., None]) < 0.25 * off(edited, SMOOTH * wanted[..., None])


@needs_oidn
def test_edges_of_a_weaker_edit_stay_sharp_within_a_stronger_one() -> None:
    image = noisy()
    first, second = hard(40), (np.abs(Y - 48) < 20).astype(np.float32)
    once = image * (1 + 2 * first[..., None])
    changes = [once - image, once * second[..., None] * np.float32(-0.7)]
    found = denoise_edited(image, [EditImage(first, changes[0]), EditImage(second, changes[1])])
    wanted = (1 + 2 * first) * (1 - 0.7 * second)
    ratio = (found.edited / found.unedited).mean(axis=2)
    off_by = np.abs(ratio / wanted - 1)
    assert off_by.mean() < 0.01
    for where in (off_by[:, 37:43], off_by[26:31], off_by[66:70]):
        assert where.mean() < 0.02
        assert where.max() < 0.15
    np.testing.assert_allclose(found.changes[0] + found.changes[1], found.edited - found.unedited, atol=1e-5)


@needs_oidn
def test_a_soft_mask_and_light_where_there_was_none() -> None:
    mask = np.clip((X - 30) / 60, 0, 1).astype(np.float32)
    light = BLUE * np.random.default_rng(5).gamma(4, 0.25, (HEIGHT, WIDTH, 1)).astype(np.float32)
    dark = np.zeros_like(light)
    found = denoise_edited(dark, [EditImage(mask, light * mask[..., None])])
    exact = BLUE * mask[..., None]
    assert not found.unedited.any()
    assert off(found.edited, exact) < 0.2 * off(light * mask[..., None], exact)
    assert not found.edited[mask == 0].any()


@needs_oidn
def test_an_edit_without_effect_leaves_every_bit() -> None:
    image = noisy()
    found = denoise_edited(image, [EditImage(hard(61), np.zeros_like(image))])
    np.testing.assert_array_equal(found.edited, found.unedited)
    found = denoise_edited(image, [EditImage(np.zeros((HEIGHT, WIDTH), np.float32), np.zeros_like(image))])
    np.testing.assert_array_equal(found.edited, denoise(image))


@needs_oidn
def test_images_must_belong_together() -> None:
    image = noisy()
    with pytest.raises(ImageError, match="albedo"):
        denoise(image, normal=image)
    with pytest.raises(ImageError, match=r"albedo of shape \(96, 64, 3\)"):
        denoise(image, image[:, ::2], image)
    with pytest.raises(ImageError, match="mask"):
        denoise_edited(image, [EditImage(image[..., 0].T, image)])


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(ImageError, match=r"pip install 'icheat-usd\[denoise\]'"):
        denoise(noisy())
