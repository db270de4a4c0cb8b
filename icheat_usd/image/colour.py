"""From scene-linear Rec.709 to what a screen shows, through OpenColorIO."""

from __future__ import annotations

import os
from functools import lru_cache
from typing import Any

import numpy as np
import PyOpenColorIO as ocio
from numpy.typing import NDArray

from icheat_usd.errors import ImageError

#: The configuration used when ``$OCIO`` is not set. Pinned, so that an image does not change with the library; this
#: one because every OpenColorIO from 2.3 (VFX Reference Platform CY2024) carries it, and because its ACES 1.3 views
#: take a third of the time of the ACES 2 views of newer ones (measured at 640 x 480).
BUILTIN_CONFIG = "ocio://cg-config-v2.1.0_aces-v1.3_ocio-v2.3"
WORKING_SPACE = "Linear Rec.709 (sRGB)"

_OTHER_NAMES = ("lin_rec709_scene", "lin_rec709_srgb", "lin_rec709", "lin_srgb", "Utility - Linear - Rec.709")
# In Python the second does not derive from the first.
_OCIO_ERRORS = (ocio.Exception, ocio.ExceptionMissingFile)
# Far above any pixel worth showing; OpenColorIO turns infinity into NaN in some views.
_BRIGHTEST = 65504.0


def views() -> dict[str, tuple[str, ...]]:
    """Displays of the active configuration, each with its views; the default display and view come first.

    Raises
    ------
    ImageError
        ``$OCIO`` names a configuration that cannot be used.
    """
    config = _config(os.environ.get("OCIO", ""))
    first = config.getDefaultDisplay()
    displays = sorted(config.getDisplays(), key=lambda name: name != first)
    return {name: tuple(sorted(config.getViews(name), key=config.getDefaultView(name).__ne__)) for name in displays}


def default_display() -> str:
    """The display that is used when none is named."""
    return str(_config(os.environ.get("OCIO", "")).getDefaultDisplay())


def configuration_id() -> str:
    """A name for the content of the active configuration."""
    return str(_config(os.environ.get("OCIO", "")).getCacheID())


def to_display_float(
    rgb: NDArray[np.float32], *, display: str | None = None, view: str | None = None, exposure: float = 0.0
) -> NDArray[np.float32]:
    """Colours as the display wants them, not yet rounded or clamped.

    Parameters
    ----------
    rgb : (height, width, 3) or (height, width) float32, scene-linear Rec.709
        A scalar layer is shown as grey. NaN shows as black, values are limited to +-65504.
    display, view : str or None
        Names in the active configuration; None takes its defaults.
    exposure : float, stops
        Colours are multiplied by ``2**exposure`` first.

    Returns
    -------
    (height, width, 3) float32, display-encoded

    Raises
    ------
    ImageError
        The configuration, display or view does not exist; the message lists those there are.
    """
    pixels = np.asarray(rgb, dtype=np.float32)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=-1)
    if pixels.ndim != 3 or pixels.shape[-1] != 3:
        raise ImageError(f"an image of shape {pixels.shape} cannot be displayed; expected (height, width, 3)")
    pixels = pixels * np.float32(2.0**exposure)
    pixels = np.nan_to_num(pixels, nan=0.0, posinf=_BRIGHTEST, neginf=-_BRIGHTEST)
    # OpenColorIO works in place and takes C-contiguous float32 only.
    pixels = np.ascontiguousarray(np.clip(pixels, -_BRIGHTEST, _BRIGHTEST), dtype=np.float32)
    _processor(os.environ.get("OCIO", ""), display or "", view or "").applyRGB(pixels)
    return pixels


def to_display(
    rgb: NDArray[np.float32],
    *,
    display: str | None = None,
    view: str | None = None,
    exposure: float = 0.0,
    dither: bool = False,
) -> NDArray[np.uint8]:
    """Colours as 8-bit values for a screen or a PNG; parameters and errors as `to_display_float`.

    Parameters
    ----------
    dither : bool
        Spread the rounding error over neighbours by a fixed pattern, below
        one step of 1/255, so that dark gradients do not band. The pattern
        depends on the pixel's place alone: the same image gives the same bytes.

    Returns
    -------
    (height, width, 3) uint8

    References
    ----------
    .. [1] Jimenez, Next Generation Post Processing in Call of Duty: Advanced Warfare, SIGGRAPH 2014:
       interleaved gradient noise.
    """
    encoded = np.nan_to_num(to_display_float(rgb, display=display, view=view, exposure=exposure), nan=0.0)
    threshold: NDArray[np.float32] = np.full((1, 1, 1), 0.5, dtype=np.float32)
    if dither:
        y, x = np.indices(encoded.shape[:2], dtype=np.float64)
        noise = (52.9829189 * ((0.06711056 * x + 0.00583715 * y) % 1.0)) % 1.0
        threshold = np.expand_dims(np.asarray(noise, dtype=np.float32), -1)
    return np.floor(np.clip(encoded, 0.0, 1.0) * np.float32(255.0) + threshold).clip(0, 255).astype(np.uint8)


@lru_cache(maxsize=4)
def _config(variable: str) -> Any:
    """The configuration that ``$OCIO`` names, or the pinned one."""
    # CreateFromEnv would quietly give an unmanaged configuration where the variable is unset.
    try:
        config = ocio.Config.CreateFromFile(variable or BUILTIN_CONFIG)
        config.validate()
    except _OCIO_ERRORS as problem:
        if variable:
            raise ImageError(
                f"$OCIO names '{variable}', which is not a usable OpenColorIO configuration "
                f"({_first_line(problem)}); correct the variable or unset it"
            ) from problem
        raise ImageError(
            f"this OpenColorIO {ocio.__version__} lacks the configuration {BUILTIN_CONFIG}; install 2.3 or newer"
        ) from problem
    return config


def _working_space(config: Any) -> str:
    for name in (WORKING_SPACE, *_OTHER_NAMES):
        space = config.getColorSpace(name)
        if space is not None:
            return str(space.getName())
    try:
        return str(ocio.Config.IdentifyBuiltinColorSpace(config, _config(""), WORKING_SPACE))
    except _OCIO_ERRORS as problem:
        raise ImageError(
            f"the OpenColorIO configuration '{config.getName() or os.environ.get('OCIO', '')}' has no scene-linear "
            f"Rec.709 colour space; add the alias '{_OTHER_NAMES[0]}' to it or unset $OCIO"
        ) from problem


def check_view(view: str | None) -> None:
    """Find out before anything is rendered. Raises `ImageError` if the default display has no such view."""
    _processor(os.environ.get("OCIO", ""), "", view or "")


@lru_cache(maxsize=32)
def _processor(variable: str, display: str, view: str) -> Any:
    config = _config(variable)
    displays = list(config.getDisplays())
    display = display or config.getDefaultDisplay()
    if display not in displays:
        raise ImageError(f"there is no display '{display}'; the configuration has {_listed(displays)}")
    view = view or config.getDefaultView(display)
    if view not in list(config.getViews(display)):
        raise ImageError(f"display '{display}' has no view '{view}'; it has {_listed(config.getViews(display))}")
    try:
        transform = ocio.DisplayViewTransform(src=_working_space(config), display=display, view=view)
        return config.getProcessor(transform).getDefaultCPUProcessor()
    except _OCIO_ERRORS as problem:
        raise ImageError(
            f"view '{view}' of display '{display}' cannot be computed ({_first_line(problem)}); choose another view"
        ) from problem


def _listed(names: Any) -> str:
    return ", ".join(f"'{name}'" for name in names) or "none"


def _first_line(problem: BaseException) -> str:
    return (str(problem).splitlines() or [""])[0].rstrip(". ")
