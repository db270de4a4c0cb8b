"""Textures are read as stored, whatever file or memory they come from."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from icheat_usd.errors import ImageError
from icheat_usd.image.texture import read_texture
from tests.images import encode_png


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_a_png_of_8_bits_is_read_to_the_last_bit_with_its_top_row_first(tmp_path: Path, channels: int) -> None:
    samples = np.random.default_rng(channels).integers(0, 256, (5, 3, channels), np.uint8)
    (tmp_path / "a.png").write_bytes(encode_png(samples))
    image = read_texture(tmp_path / "a.png")
    assert image.is_8bit
    assert image.pixels.dtype == np.float32 and image.pixels.flags["C_CONTIGUOUS"]
    np.testing.assert_allclose(image.pixels, samples / 255.0, atol=1e-7)


def test_alpha_is_not_multiplied_into_colour(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(encode_png(np.array([[[200, 100, 50, 0], [200, 100, 50, 128]]], np.uint8)))
    pixels = read_texture(tmp_path / "a.png").pixels
    np.testing.assert_allclose(pixels[0, :, :3] * 255.0, [[200, 100, 50]] * 2, atol=1e-4)


def test_a_png_of_16_bits_keeps_its_precision_and_says_that_it_is_not_8_bit(tmp_path: Path) -> None:
    samples = np.array([[[1, 2, 65535]], [[257, 30000, 0]]], np.uint16)
    (tmp_path / "a.png").write_bytes(encode_png(samples))
    image = read_texture(tmp_path / "a.png")
    assert not image.is_8bit
    np.testing.assert_allclose(image.pixels * 65535.0, samples, atol=0.01)


def test_an_exr_written_by_another_library_is_read_as_stored(tmp_path: Path) -> None:
    import OpenEXR

    rgb = np.random.default_rng(0).uniform(-1.0, 5000.0, (4, 6, 3)).astype(np.float32)
    OpenEXR.File({}, {"RGB": rgb}).write(str(tmp_path / "a.exr"))
    image = read_texture(tmp_path / "a.exr")
    assert not image.is_8bit
    np.testing.assert_array_equal(image.pixels, rgb)


@pytest.mark.parametrize(
    ("extension", "tolerance", "is_8bit"), [("jpg", 0.01, True), ("tif", 1e-6, False), ("hdr", 0.02, False)]
)
def test_other_formats_keep_a_constant_colour(tmp_path: Path, extension: str, tolerance: float, is_8bit: bool) -> None:
    import OpenImageIO as oiio

    color = np.array([0.75, 0.25, 0.5], np.float32)
    path = tmp_path / f"a.{extension}"
    output = oiio.ImageOutput.create(str(path))
    assert output is not None
    assert output.open(str(path), oiio.ImageSpec(16, 8, 3, "uint8" if is_8bit else "float"))
    assert output.write_image(np.broadcast_to(color, (8, 16, 3)).copy())
    output.close()
    image = read_texture(path)
    assert image.pixels.shape == (8, 16, 3)
    assert image.is_8bit == is_8bit
    np.testing.assert_allclose(image.pixels, np.broadcast_to(color, (8, 16, 3)), atol=tolerance)


def test_bytes_read_as_their_file_does() -> None:
    samples = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    image = read_texture(encode_png(samples), "shot.usdz[0/wood.png]")
    np.testing.assert_allclose(image.pixels * 255.0, samples, atol=1e-4)


def test_wrap_modes_that_a_file_asks_for_are_handed_on(tmp_path: Path) -> None:
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(4, 4, 3, "uint8")
    spec.attribute("wrapmodes", "periodic,mirror")
    path = tmp_path / "a.tif"
    output = oiio.ImageOutput.create(str(path))
    assert output is not None
    assert output.open(str(path), spec)
    assert output.write_image(np.zeros((4, 4, 3), np.float32))
    output.close()
    assert read_texture(path).wrap == ("repeat", "mirror")


@pytest.mark.parametrize("content", [None, b"", b"not an image", encode_png(np.zeros((9, 9, 3), np.uint8))[:45]])
def test_a_missing_or_damaged_file_is_one_error_that_names_it(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "wood.png"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ImageError, match=r"wood\.png cannot be read as an image"):
        read_texture(path)


def test_damaged_bytes_are_called_by_the_name_the_caller_gives() -> None:
    with pytest.raises(ImageError, match=r"^a\.usdz\[wood\.png\] cannot be read"):
        read_texture(b"nothing", "a.usdz[wood.png]")


@pytest.mark.parametrize(
    "order",
    [
        ("pxr.Usd", "OpenEXR", "numba", "embreex", "OpenImageIO"),
        ("OpenImageIO", "embreex", "numba", "OpenEXR", "pxr.Usd"),
    ],
)
def test_the_image_library_shares_a_process_with_the_others(tmp_path: Path, order: tuple[str, ...]) -> None:
    """Two copies of OpenEXR are loaded; each must keep to its own."""
    code = f"""
import importlib
for name in {order!r}:
    importlib.import_module(name)
import numpy, OpenEXR
from icheat_usd.image.texture import read_texture
from tests.images import encode_png
rgb = numpy.arange(27, dtype=numpy.float32).reshape(3, 3, 3)
OpenEXR.File({{}}, {{"RGB": rgb}}).write({str(tmp_path / "a.exr")!r})
assert (read_texture({str(tmp_path / "a.exr")!r}).pixels == rgb).all()
assert (OpenEXR.File({str(tmp_path / "a.exr")!r}).channels()["RGB"].pixels == rgb).all()
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
