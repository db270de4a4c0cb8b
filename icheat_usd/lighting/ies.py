"""Profiles of real luminaires: IESNA LM-63 files of photometric type C [1]_, in all versions since 1986.

.. [1] ANSI/IES LM-63-19, Standard File Format for the Electronic Transfer of Photometric Data.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icheat_usd.errors import IcheatError
from icheat_usd.scene import F64

#: A file with more values than this is damaged, or no profile: real ones have some thousands.
MOST_VALUES = 1 << 22

_CLOSE = 1e-3  # degrees


class ProfileError(IcheatError):
    """A photometric file is damaged, or of a kind that is not read."""


class Profile(NamedTuple):
    """Luminous intensity by direction, in candela; angles in radians."""

    vertical: F64  #: (n_v,) ascending, 0 straight down (nadir)
    horizontal: F64  #: (n_h,) ascending, the last one 2 pi above the first
    intensity: F64  #: (n_h, n_v)

    def mean(self) -> float:
        """Mean intensity over all directions; over half of them where the angles span a quarter turn at most.

        What UsdLux's `shaping:ies:normalize` divides by, integrated over the patches between angles as its
        reference renderer does [1]_.

        .. [1] OpenUSD, pxr/imaging/plugin/hdEmbree/pxrIES/pxrIES.cpp, `pxr_extra_process`.
        """
        span = self.vertical[-1] - self.vertical[0]
        value = self.intensity
        centre = 0.25 * (value[:-1, :-1] + value[:-1, 1:] + value[1:, :-1] + value[1:, 1:])
        down = np.diff(self.vertical) * np.sin(0.5 * (self.vertical[:-1] + self.vertical[1:]))
        total = float(np.diff(self.horizontal) @ centre @ down)
        return total / (4.0 * np.pi if span > 0.5 * np.pi + 0.1 else 2.0 * np.pi)


def read_profile(content: bytes, name: str) -> Profile:
    """Profile of a photometric file.

    Parameters
    ----------
    content
        The whole file.
    name
        For errors.

    Returns
    -------
    Profile
        Candela multiplier and ballast factors applied, what symmetry leaves out filled in. A tilt of the lamp
        is passed over.

    Raises
    ------
    ProfileError
        It is no such file, is cut short, has angles out of order or values that cannot be, or is of type A or B.
    """
    numbers = _Numbers(content, name)
    _lamps, _lumens, multiplier = numbers.take(3, "lamps, lumens and multiplier")
    counts = numbers.take(2, "numbers of angles")
    n_v, n_h = (int(count) for count in counts)
    if (counts != np.rint(counts)).any() or n_v < 2 or n_h < 1 or n_v * n_h > MOST_VALUES:
        raise ProfileError(f"{name} has {counts[0]:g} x {counts[1]:g} angles, expected at least 2 x 1; export it again")
    kind, *_ = numbers.take(5, "photometric type and size")
    if kind != 1:
        known = {2.0: "B", 3.0: "A"}.get(float(kind), f"{kind:g}")
        raise ProfileError(f"{name} is of photometric type {known}; only type C is read, convert it")
    ballast, factor, _watts = numbers.take(3, "ballast factors")
    vertical = _angles(numbers.take(n_v, "vertical angles"), 180.0, f"{name}: vertical angles")
    horizontal = _angles(numbers.take(n_h, "horizontal angles"), 360.0, f"{name}: horizontal angles")
    intensity = numbers.take(n_v * n_h, "intensities").reshape(n_h, n_v)
    with np.errstate(over="ignore", invalid="ignore"):
        intensity = intensity * (multiplier * ballast * factor)
    if not (np.isfinite(intensity) & (intensity >= 0.0)).all():
        raise ProfileError(f"{name} has a negative or infinite intensity; export it again")
    horizontal, intensity = _all_round(horizontal, intensity, name)
    return Profile(np.radians(vertical), np.radians(horizontal), np.ascontiguousarray(intensity))


class _Numbers:
    """Numbers behind the TILT line, one after another; commas are spaces, lines do not count."""

    def __init__(self, content: bytes, name: str) -> None:
        self._name, self._at = name, 0
        lines = content.decode("latin-1").replace("\r", "\n").split("\n")
        tilt = next((i for i, line in enumerate(lines) if line.strip().upper().startswith("TILT")), -1)
        if tilt < 0:
            raise ProfileError(f"{name} has no TILT line, so it is no IES profile; give a file of IESNA LM-63")
        words = " ".join(lines[tilt + 1 :]).replace(",", " ").split()
        if len(words) > 2 * MOST_VALUES:
            raise ProfileError(f"{name} has {len(words)} numbers, more than a profile can have; export it again")
        try:
            self._values = np.array([float(word) for word in words])
        except ValueError as error:
            raise ProfileError(f"{name} has text where numbers belong ({error}); export it again") from None
        if not np.isfinite(self._values).all():
            raise ProfileError(f"{name} has numbers that are not finite; export it again")
        if lines[tilt].partition("=")[2].strip().upper() == "INCLUDE":
            _geometry, n = self.take(2, "tilt")
            if n != int(n) or not 0 <= n <= MOST_VALUES:
                raise ProfileError(f"{name} has {n:g} tilt angles; export it again")
            self.take(2 * int(n), "tilt angles and factors")

    def take(self, n: int, what: str) -> F64:
        values = self._values[self._at : self._at + n]
        if len(values) < n:
            raise ProfileError(f"{self._name} ends within its {what}: it was cut short; copy it again")
        self._at += n
        return values


def _angles(angles: F64, highest: float, what: str) -> F64:
    if (np.diff(angles) <= 0.0).any() or angles[0] < -_CLOSE or angles[-1] > highest + _CLOSE:
        raise ProfileError(f"{what} do not ascend from 0 to {highest:g} degrees; export it again")
    return np.clip(angles, 0.0, highest)


def _all_round(angles: F64, intensity: F64, name: str) -> tuple[F64, F64]:
    """Horizontal angles over a whole turn: what a symmetric luminaire leaves out is mirrored."""
    first, last = float(angles[0]), float(angles[-1])
    if len(angles) == 1:
        return np.array([0.0, 360.0]), np.repeat(intensity, 2, axis=0)
    if abs(first) < _CLOSE and abs(last - 90.0) < _CLOSE:
        angles, intensity = _mirrored(angles, intensity)
        last = 180.0
    if abs(last - first - 180.0) < _CLOSE:
        angles, intensity = _mirrored(angles, intensity)
    elif last - first < 360.0 - _CLOSE and abs(first) < _CLOSE:
        # Some leave out 360, which is 0 again, and otherwise go on in equal steps.
        step = 360.0 - last
        if abs(step - (angles[1] - angles[0])) > _CLOSE and abs(step - (angles[-1] - angles[-2])) > _CLOSE:
            raise ProfileError(f"{name}: horizontal angles end at {last:g} degrees, expected 0, 90, 180 or 360")
        return np.append(angles, 360.0), np.concatenate([intensity, intensity[:1]])
    if abs(angles[-1] - angles[0] - 360.0) > _CLOSE:
        raise ProfileError(f"{name}: horizontal angles go from {first:g} to {last:g} degrees, which is no symmetry")
    return angles, intensity


def _mirrored(angles: F64, intensity: F64) -> tuple[F64, F64]:
    """Twice the range: mirrored in its end."""
    return np.concatenate([angles, 2.0 * angles[-1] - angles[-2::-1]]), np.concatenate([intensity, intensity[-2::-1]])
