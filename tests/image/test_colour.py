from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import PyOpenColorIO as ocio
import pytest
from numpy.typing import NDArray

from icheat_usd.errors import ImageError
from icheat_usd.image import colour
from icheat_usd.image.film import Film
from icheat_usd.image.png import write_png

SRGB = "sRGB - Display"


@pytest.fixture(autouse=True)
def no_config_of_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OCIO", raising=False)


def _stored(path: Path) -> NDArray[np.uint8]:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.UINT8), dtype=np.uint8)


def _ramp() -> NDArray[np.float32]:
    values = np.geomspace(1e-4, 50.0, 64, dtype=np.float32)
    return np.repeat(values[None, :, None], 3, axis=2)


def test_the_untonemapped_srgb_view_is_the_srgb_curve() -> None:
    linear = np.linspace(0.0, 1.0, 301, dtype=np.float32)
    encoded = colour.to_display_float(linear[None, :], display=SRGB, view="Un-tone-mapped")
    # IEC 61966-2-1, the sRGB transfer function.
    expected = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(encoded[0], np.repeat(expected[:, None], 3, axis=1), atol=2e-4)


def test_the_raw_view_of_a_png_is_what_opencolorio_alone_computes(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).random((5, 6, 3)).astype(np.float32)
    path = write_png(Film(6, 5, {"beauty": rgb}), tmp_path / "raw.png", view="Raw")
    config = ocio.Config.CreateFromFile(colour.BUILTIN_CONFIG)
    processor = config.getProcessor("Linear Rec.709 (sRGB)", SRGB, "Raw", ocio.TRANSFORM_DIR_FORWARD)
    expected = [processor.getDefaultCPUProcessor().applyRGB([float(c) for c in pixel]) for pixel in rgb.reshape(-1, 3)]
    stored = _stored(path).reshape(-1, 3)
    np.testing.assert_array_equal(stored, np.floor(np.array(expected) * 255 + 0.5).clip(0, 255).astype(np.uint8))


def test_brighter_is_never_darker_in_any_view() -> None:
    for display, names in colour.views().items():
        for view in names:
            shown = colour.to_display_float(_ramp(), display=display, view=view)[0].mean(axis=1)
            assert (np.diff(shown) >= -1e-4).all(), (display, view)


def test_one_stop_of_exposure_doubles_the_light() -> None:
    np.testing.assert_array_equal(
        colour.to_display(_ramp(), exposure=1.0), colour.to_display(np.float32(2.0) * _ramp())
    )


def test_the_input_is_left_as_it_was() -> None:
    ramp = _ramp()
    colour.to_display(ramp)
    np.testing.assert_array_equal(ramp, _ramp())


def test_nan_shows_black_and_infinity_white() -> None:
    pixels = np.array([[[np.nan] * 3, [np.inf] * 3, [-np.inf] * 3]], np.float32)
    shown = colour.to_display(pixels, display=SRGB, view="Un-tone-mapped")
    np.testing.assert_array_equal(shown[0, :, 0], (0, 255, 0))


def test_dither_repeats_itself_and_keeps_the_mean() -> None:
    flat = np.full((64, 64, 3), 0.1003, np.float32)
    plain = colour.to_display(flat, view="Raw")
    dithered = colour.to_display(flat, view="Raw", dither=True)
    np.testing.assert_array_equal(dithered, colour.to_display(flat, view="Raw", dither=True))
    assert set(np.unique(plain)) == {26}
    assert dithered.mean() == pytest.approx(0.1003 * 255, abs=0.02)


def test_unknown_displays_and_views_are_errors_that_list_the_known_ones() -> None:
    with pytest.raises(ImageError, match=r"no view 'Filmic'; it has 'ACES 1.0 - SDR Video'"):
        colour.to_display(_ramp(), view="Filmic")
    with pytest.raises(ImageError, match="no display 'CRT'; the configuration has 'sRGB - Display'"):
        colour.to_display(_ramp(), display="CRT")


def test_a_broken_ocio_variable_is_an_error_and_not_a_silent_fallback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OCIO", str(tmp_path / "missing.ocio"))
    with pytest.raises(ImageError, match=r"\$OCIO names"):
        colour.to_display(_ramp())
    (tmp_path / "bad.ocio").write_text("ocio_profile_version: 2\nroles: 7\n")
    monkeypatch.setenv("OCIO", str(tmp_path / "bad.ocio"))
    with pytest.raises(ImageError, match=r"\$OCIO names"):
        colour.views()


def test_the_ocio_variable_chooses_the_configuration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCIO", "ocio://studio-config-v2.1.0_aces-v1.3_ocio-v2.3")
    np.testing.assert_array_equal(colour.to_display(_ramp()).shape, (1, 64, 3))
    assert colour.views() != {}


def test_a_configuration_without_our_working_space_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw = ocio.Config.CreateRaw().serialize()
    (tmp_path / "raw.ocio").write_text(raw)
    monkeypatch.setenv("OCIO", str(tmp_path / "raw.ocio"))
    with pytest.raises(ImageError, match="no scene-linear Rec.709"):
        colour.to_display(_ramp())


def test_a_png_says_srgb_and_carries_the_metadata(tmp_path: Path) -> None:
    film = Film(64, 1, {"beauty": _ramp(), "depth": _ramp()[..., 0]}, {"camera": "/World/Kamera_ä"})
    spec = oiio.ImageBuf(str(write_png(film, tmp_path / "film.png"))).spec()
    assert (spec.width, spec.height, spec.nchannels, str(spec.format)) == (64, 1, 3, "uint8")
    assert spec.getattribute("icheat:camera") == "/World/Kamera_ä"
    assert b"sRGB\0" in (tmp_path / "film.png").read_bytes()
    assert b"sRGB\0" not in write_png(film, tmp_path / "p3.png", display="Display P3 - Display").read_bytes()
    assert oiio.ImageBuf(str(write_png(film, tmp_path / "depth.png", layer="depth"))).spec().nchannels == 3


def test_a_png_holds_the_pixels_of_the_screen(tmp_path: Path) -> None:
    rgb = np.random.default_rng(1).random((17, 13, 3)).astype(np.float32)
    path = write_png(Film(13, 17, {"beauty": rgb}), tmp_path / "film.png", exposure=0.5)
    stored = _stored(path)
    np.testing.assert_array_equal(stored, colour.to_display(rgb, exposure=0.5))


def test_a_png_in_a_missing_folder_or_of_a_missing_layer_is_one_clear_error(tmp_path: Path) -> None:
    film = Film(64, 1, {"beauty": _ramp()})
    with pytest.raises(ImageError, match="there is no folder"):
        write_png(film, tmp_path / "nowhere" / "film.png")
    with pytest.raises(ImageError, match="no layer 'albedo'"):
        write_png(film, tmp_path / "film.png", layer="albedo")
    assert list(tmp_path.iterdir()) == []
