from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from icheat_usd.errors import ImageError
from icheat_usd.image.cryptomatte import Cryptomatte
from icheat_usd.image.exr import CHROMATICITIES_REC709, read_exr, write_exr
from icheat_usd.image.film import Film
from icheat_usd.image.replacing import replacing
from icheat_usd.image.whole import whole_metadata


@pytest.fixture
def film() -> Film:
    """Layers that are slices, flips and Fortran-ordered: the writer must not see their strides."""
    values = np.random.default_rng(3).normal(size=(7, 9, 5)).astype(np.float32)
    layers = {
        "beauty": values[::-1, :, 1:4],
        "direct": np.asfortranarray(values[..., :3]),
        "indirect": values[..., ::2],
        "normal": values[:, ::-1, :3],
        "albedo": np.ascontiguousarray(values[..., :3]),
        "depth": values[..., 4],
        "alpha": values[..., 3],
        "receiver_mask": values[..., 0].T.copy().T,
    }
    return Film(9, 7, layers, {"stage": "room.usda", "camera": "/World/Kamera_ä", "frame": "12.5"})


def test_every_layer_and_the_metadata_come_back_exactly(film: Film, tmp_path: Path) -> None:
    write_exr(film, tmp_path / "film.exr")
    again = read_exr(tmp_path / "film.exr")
    assert (again.width, again.height) == (9, 7)
    assert set(again.layers) == set(film.layers)
    for name, pixels in film.layers.items():
        np.testing.assert_array_equal(again.layer(name), pixels, err_msg=name)
    assert dict(again.metadata) == dict(film.metadata)


def test_other_programs_find_the_usual_channel_names_and_colour_space(film: Film, tmp_path: Path) -> None:
    write_exr(film, tmp_path / "film.exr")
    with OpenEXR.File(str(tmp_path / "film.exr"), separate_channels=True) as file:
        expected = {"R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z", "receiver_mask"}
        expected |= {f"{layer}.{c}" for layer in ("direct", "indirect", "albedo") for c in "RGB"}
        assert set(file.channels()) == expected
        np.testing.assert_array_equal(file.channels()["indirect.G"].pixels, film.layer("indirect")[..., 1])
        np.testing.assert_array_equal(file.channels()["Z"].pixels, film.layer("depth"))
        header = dict(file.header())
    np.testing.assert_allclose(header["chromaticities"], CHROMATICITIES_REC709, rtol=1e-6)
    assert header["colorInteropID"] == "lin_rec709_scene"
    assert header["icheat:camera"] == "/World/Kamera_ä"


def test_half_floats_clamp_instead_of_overflowing_and_leave_depth_alone(tmp_path: Path) -> None:
    beauty = np.full((2, 2, 3), 1.0, np.float32)
    beauty[0, 0] = (1e6, -1e6, np.inf)
    depth = np.full((2, 2), 123456.789, np.float32)
    write_exr(Film(2, 2, {"beauty": beauty, "depth": depth}), tmp_path / "half.exr", half=True)
    again = read_exr(tmp_path / "half.exr")
    np.testing.assert_array_equal(again.layer("beauty")[0, 0], (65504.0, -65504.0, 65504.0))
    np.testing.assert_array_equal(again.layer("depth"), depth)
    with OpenEXR.File(str(tmp_path / "half.exr"), separate_channels=True) as file:
        assert file.channels()["R"].pixels.dtype == np.float16


def test_the_same_film_is_written_as_the_same_bytes(film: Film, tmp_path: Path) -> None:
    write_exr(film, tmp_path / "a.exr")
    write_exr(film, tmp_path / "b.exr")
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_channels_of_other_programs_become_layers(tmp_path: Path) -> None:
    plane = np.arange(6, dtype=np.float32).reshape(2, 3)
    channels = {"R": plane, "G": plane + 1, "B": plane + 2, "A": plane, "ViewLayer.Mist.Z": plane + 3, "uv.U": plane}
    OpenEXR.File({}, channels).write(str(tmp_path / "other.exr"))
    film = read_exr(tmp_path / "other.exr")
    assert set(film.layers) == {"beauty", "ViewLayer.Mist.Z", "uv.U"}
    np.testing.assert_array_equal(film.layer("beauty")[..., 2], plane + 2)


@pytest.mark.parametrize("name", ["", "direct.R", "Z", "a b", "../x"])
def test_layer_names_that_would_be_other_channels_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="layer name"):
        write_exr(Film(2, 2, {name: np.zeros((2, 2), np.float32)}), tmp_path / "film.exr")


def test_a_missing_folder_and_a_folder_as_target_are_one_clear_error(film: Film, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match="there is no folder"):
        write_exr(film, tmp_path / "nowhere" / "film.exr")
    with pytest.raises(ImageError, match="is a folder"):
        write_exr(film, tmp_path)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a folder in which not even root may write")
def test_an_unwritable_folder_is_one_clear_error(film: Film) -> None:
    with pytest.raises(ImageError, match=r"/proc/film\.exr: cannot write in this folder"):
        write_exr(film, "/proc/film.exr")


def test_a_failed_write_leaves_the_old_image_and_nothing_else(
    film: Film, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "film.exr"
    write_exr(film, target)
    before = target.read_bytes()

    def interrupted(source: str, destination: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_exr(Film(1, 1, {"depth": np.zeros((1, 1), np.float32)}), target)
    assert target.read_bytes() == before
    assert list(tmp_path.iterdir()) == [target]


def test_what_is_no_exr_or_a_damaged_one_is_an_error_that_names_the_file(film: Film, tmp_path: Path) -> None:
    with pytest.raises(ImageError, match=r"gone\.exr: there is no such image"):
        read_exr(tmp_path / "gone.exr")
    (tmp_path / "text.exr").write_text("no image")
    with pytest.raises(ImageError, match=r"text\.exr: not an OpenEXR file"):
        read_exr(tmp_path / "text.exr")
    for name in ("gone.exr", "text.exr", "gone.png"):
        with pytest.raises(ImageError, match=name):
            whole_metadata(tmp_path / name)
    write_exr(film, tmp_path / "film.exr")
    whole = (tmp_path / "film.exr").read_bytes()
    for length in (40, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.exr").write_bytes(whole[:length])
        with pytest.raises(ImageError, match=r"cut\.exr"):
            read_exr(tmp_path / "cut.exr")
        with pytest.raises(ImageError, match=r"cut\.exr"):
            whole_metadata(tmp_path / "cut.exr")


@pytest.fixture
def rich(film: Film) -> Film:
    """The film with ID mattes: ids are bits, which no conversion may touch."""
    mattes = []
    for name, seed in (("CryptoObject", 1), ("CryptoEdit", 2)):
        ranks = np.zeros((7, 9, 6, 2), np.float32)
        ids = np.random.default_rng(seed).integers(1 << 23, 0x7F7FFFFF, (7, 9, 6), np.uint32)
        ranks[..., 0], ranks[..., 1] = ids.view(np.float32), 1 / 6
        mattes.append(Cryptomatte(name, ranks, {"/World/Ä": "13851a76"}))
    return Film(9, 7, film.layers, film.metadata, tuple(mattes), 2.0)


@pytest.mark.parametrize("multipart", [False, True])
def test_parts_and_mattes_come_back_exactly(rich: Film, multipart: bool, tmp_path: Path) -> None:
    write_exr(rich, tmp_path / "film.exr", multipart=multipart)
    again = read_exr(tmp_path / "film.exr")
    assert set(again.layers) == set(rich.layers) and again.pixel_aspect == 2.0
    for name, pixels in rich.layers.items():
        np.testing.assert_array_equal(again.layer(name), pixels, err_msg=name)
    assert dict(again.metadata) == dict(rich.metadata) == whole_metadata(tmp_path / "film.exr")
    assert [matte.name for matte in again.mattes] == ["CryptoObject", "CryptoEdit"]
    for before, after in zip(rich.mattes, again.mattes, strict=True):
        np.testing.assert_array_equal(after.ranks.view(np.uint32), before.ranks.view(np.uint32))
        assert dict(after.manifest) == dict(before.manifest)


def test_another_reader_finds_a_part_for_each_layer(rich: Film, tmp_path: Path) -> None:
    """OpenImageIO, whose reader is not the library that wrote the file."""
    write_exr(rich, tmp_path / "film.exr", multipart=True, half={"direct"})
    image = OpenImageIO.ImageInput.open(str(tmp_path / "film.exr"))
    found = {}
    while image.seek_subimage(len(found), 0):
        spec = image.spec()
        found[spec.get_string_attribute("oiio:subimagename")] = spec
    assert list(found) == [*(name for name in rich.layers if name != "alpha"), "CryptoObject", "CryptoEdit"]
    assert found["beauty"].channelnames == ("R", "G", "B", "A") and found["depth"].channelnames == ("Z",)
    assert found["direct"].channelnames == ("direct.R", "direct.G", "direct.B")
    assert found["CryptoEdit"].channelnames[:5] == (*(f"CryptoEdit00.{c}" for c in "RGBA"), "CryptoEdit01.R")
    assert str(found["direct"].format) == "half" and str(found["indirect"].format) == "float"
    for name, spec in found.items():
        assert spec.get_string_attribute("icheat:frame") == "12.5", name
        assert spec.get_string_attribute("compression") == "zip"
        np.testing.assert_allclose(spec["chromaticities"], CHROMATICITIES_REC709, rtol=1e-6)
        assert spec.get_float_attribute("PixelAspectRatio") == 2.0
    # Programs that look at the first part alone find what mattes there are.
    for name in ("beauty", "CryptoEdit"):
        assert found[name].get_string_attribute("cryptomatte/e8d945c/name") == "CryptoEdit"


def test_parts_of_other_programs_keep_their_names(tmp_path: Path) -> None:
    plane = np.arange(6, dtype=np.float32).reshape(2, 3)
    parts = [OpenEXR.Part({}, dict.fromkeys("RGB", plane + index), part) for index, part in enumerate(("rgb", "glow"))]
    OpenEXR.File(parts).write(str(tmp_path / "other.exr"))
    film = read_exr(tmp_path / "other.exr")
    assert set(film.layers) == {"beauty", "glow"}
    np.testing.assert_array_equal(film.layer("glow")[..., 0], plane + 1)


def test_what_killed_writers_left_is_removed_and_what_is_being_written_is_not(film: Film, tmp_path: Path) -> None:
    target = tmp_path / "film.exr"
    left, other = tmp_path / ".film.exr.00000000.tmp", tmp_path / ".film2.exr.00000000.tmp"
    for path in (left, other):
        path.write_bytes(b"half")
        os.utime(path, (1e9, 1e9))
    with replacing(target) as being_written:
        os.utime(being_written, (1e9, 1e9))
        write_exr(film, target)
        assert being_written.exists()
        being_written.write_bytes(b"later")
    assert set(tmp_path.iterdir()) == {target, other} and target.read_bytes() == b"later"
