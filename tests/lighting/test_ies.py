"""Photometric files are read as LM-63 says, and damaged ones are refused."""

from __future__ import annotations

import numpy as np
import pytest

from icheat_usd.lighting.ies import ProfileError, read_profile
from tests.ies import profile_text

DOWN = (0.0, 45.0, 90.0)


def test_one_horizontal_angle_stands_for_all() -> None:
    profile = read_profile(profile_text(DOWN, (0,), [100, 50, 0], multiplier=2, ballast=0.5).encode(), "a.ies")
    np.testing.assert_allclose(profile.vertical, np.radians(DOWN))
    np.testing.assert_allclose(profile.horizontal, [0, 2 * np.pi])
    np.testing.assert_allclose(profile.intensity, [[100, 50, 0]] * 2)


@pytest.mark.parametrize(
    ("horizontal", "levels", "angles", "expected"),
    [
        ((0, 45, 90), (1, 2, 3), (0, 45, 90, 135, 180, 225, 270, 315, 360), (1, 2, 3, 2, 1, 2, 3, 2, 1)),
        ((0, 90, 180), (1, 2, 3), (0, 90, 180, 270, 360), (1, 2, 3, 2, 1)),
        ((90, 180, 270), (1, 2, 3), (90, 180, 270, 360, 450), (1, 2, 3, 2, 1)),
        ((0, 90, 180, 270, 360), (1, 2, 3, 4, 1), (0, 90, 180, 270, 360), (1, 2, 3, 4, 1)),
        ((0, 90, 180, 270), (1, 2, 3, 4), (0, 90, 180, 270, 360), (1, 2, 3, 4, 1)),
    ],
)
def test_symmetry_fills_in_what_is_left_out(
    horizontal: tuple[float, ...], levels: tuple[float, ...], angles: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    text = profile_text(DOWN, horizontal, np.array(levels)[:, None] * np.ones(3))
    profile = read_profile(text.encode(), "a.ies")
    np.testing.assert_allclose(profile.horizontal, np.radians(angles))
    np.testing.assert_allclose(profile.intensity[:, 0], expected)


def test_the_mean_is_over_the_half_or_the_whole_of_all_directions() -> None:
    """A lamp of 7 candela everywhere has a mean of 7, up to the patches of the reference's rule."""
    half, whole = np.linspace(0, 90, 91), np.linspace(0, 180, 181)
    for angles in (half, whole):
        profile = read_profile(profile_text(angles.tolist(), (0,), 7.0).encode(), "a.ies")
        assert profile.mean() == pytest.approx(7.0, rel=1e-4)
    beam = read_profile(profile_text(whole.tolist(), (0,), np.where(whole <= 90, 7.0, 0.0)).encode(), "a.ies")
    assert beam.mean() == pytest.approx(3.5, rel=0.01)


def test_older_files_and_tilts_are_read() -> None:
    plain = profile_text(DOWN, (0,), [3, 2, 1])
    old = "\n".join(plain.splitlines()[3:])  # 1986: labels of any kind, or none, before TILT
    tilted = plain.replace("TILT=NONE", "TILT=INCLUDE\r\n1\r\n2\r\n0 90\r\n1 0.9")
    commas = plain.replace("0.0 45.0 90.0", "0.0,45.0,90.0")
    for text in (old, tilted, commas):
        np.testing.assert_array_equal(read_profile(text.encode(), "a.ies").intensity[0], [3, 2, 1])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "no TILT line"),
        ("\x00\xff\x00" * 50, "no TILT line"),
        ("TILT=NONE\n", "cut short"),
        (profile_text(DOWN, (0,), [3, 2, 1])[:-5], "cut short|text where numbers"),
        (profile_text(DOWN, (0,), [3, 2, 1]).replace("45.0", "many"), "text where numbers belong"),
        (profile_text(DOWN, (0,), [3, 2, 1]).replace("45.0", "nan"), "not finite"),
        (profile_text((0, 90, 45), (0,), [3, 2, 1]), "vertical angles do not ascend"),
        (profile_text((0, 90, 200), (0,), [3, 2, 1]), "vertical angles do not ascend"),
        (profile_text(DOWN, (0, 30, 70), 1.0), "horizontal angles end at 70"),
        (profile_text(DOWN, (20, 30, 70), 1.0), "no symmetry"),
        (profile_text(DOWN, (0,), [3, -2, 1]), "negative or infinite intensity"),
        (profile_text(DOWN, (0,), [3, 2, 1], multiplier=1e308, ballast=100), "negative or infinite intensity"),
        (profile_text(DOWN, (0,), [3, 2, 1], kind=2), "type B; only type C"),
        (profile_text(DOWN, (0,), [3, 2, 1], kind=3), "type A; only type C"),
        (profile_text(DOWN, (0,), [3, 2, 1]).replace(" 3 1 1 2", " 3000000 3000000 1 2"), "x 3e\\+06 angles"),
        (profile_text(DOWN, (0,), [3, 2, 1]).replace(" 3 1 1 2", " 1 1 1 2"), "expected at least 2 x 1"),
        (profile_text(DOWN, (0,), [3, 2, 1]).replace("TILT=NONE", "TILT=INCLUDE\n1 1e9"), "tilt angles"),
    ],
)
def test_damage_is_named(text: str, says: str) -> None:
    with pytest.raises(ProfileError, match=says) as error:
        read_profile(text.encode("latin-1"), "lamp.ies")
    assert "lamp.ies" in str(error.value)


def test_mutated_files_are_read_or_refused_in_one_sentence() -> None:
    whole = profile_text(
        (0, 30, 60, 90), (0, 45, 90), np.arange(12).reshape(3, 4), tilt="INCLUDE\n1 2 0 90 1 1"
    ).encode()
    rng = np.random.default_rng(5)
    n_read = 0
    for _ in range(2000):
        damaged = bytearray(whole)
        for place in rng.integers(100, len(whole), rng.integers(1, 4)):
            damaged[place] = rng.choice(np.frombuffer(b"0123456789.-e \n,x", np.uint8))
        cut = bytes(damaged[: rng.integers(150, len(damaged) + 60)])
        try:
            profile = read_profile(cut, "lamp.ies")
        except ProfileError as error:
            assert "lamp.ies" in str(error) and "\n" not in str(error)
            continue
        n_read += 1
        assert np.isfinite(profile.intensity).all() and (profile.intensity >= 0).all()
        assert (np.diff(profile.vertical) >= 0).all() and (np.diff(profile.horizontal) > 0).all()
        assert profile.horizontal[-1] - profile.horizontal[0] == pytest.approx(2 * np.pi)
    assert 50 < n_read < 1950
