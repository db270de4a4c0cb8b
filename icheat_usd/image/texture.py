"""Read texture files: PNG, JPEG, EXR, HDR, TIFF and whatever else OpenImageIO reads."""

from __future__ import annotations

import os
import tempfile
from pathlib import PurePath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from icheat_usd.errors import ImageError

F32 = NDArray[np.float32]


class StoredImage(NamedTuple):
    """A texture as its file holds it: no colour decoding, alpha not multiplied in or out."""

    pixels: F32  #: (height, width, channels), row 0 on top; integers scaled to [0, 1]
    is_8bit: bool  #: whether channels are stored in 8 bits
    color_space: str  #: "linear" where the file says so, "srgb" where it says or its format implies it, else ""
    wrap: tuple[str, str]  #: wrap modes the file asks for, as UsdUVTexture tokens; "" where it asks for none


#: OpenImageIO's words for wrap modes as UsdUVTexture's.
_WRAP = {"black": "black", "clamp": "clamp", "periodic": "repeat", "repeat": "repeat", "mirror": "mirror"}


def read_texture(source: str | os.PathLike[str] | bytes, name: str = "") -> StoredImage:
    """Read the first image of a texture file at full resolution.

    Parameters
    ----------
    source
        A path, or the content of a file.
    name
        What to call it in errors; for `bytes` its extension also names the format.

    Returns
    -------
    StoredImage

    Raises
    ------
    ImageError
        The file is missing, damaged, of an unknown format, or holds no ordinary image.

    Notes
    -----
    Layers, parts and mip levels after the first are ignored, and so is orientation metadata, which
    texture coordinates do not know about.
    """
    if not isinstance(source, bytes):
        path = os.fspath(source)
        return _read_file(path, name or path)
    # OpenImageIO's Python module reads files only; its memory reader is not bound.
    with tempfile.TemporaryDirectory(prefix="icheat-texture-") as folder:
        path = os.path.join(folder, "texture" + PurePath(name).suffix.lower())
        with open(path, "wb") as file:
            file.write(source)
        return _read_file(path, name or "texture in memory")


def _read_file(path: str, name: str) -> StoredImage:
    import OpenImageIO as oiio  # 20 MB of libraries; a stage without textures does not need them

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    image = oiio.ImageInput.open(path, config)
    if image is None:
        raise ImageError(f"{name} cannot be read as an image ({_reason(oiio.geterror(), path, name)}); check the file.")
    try:
        spec = image.spec()
        pixels = None if spec.deep else image.read_image("float")
        reason = "it is a deep image" if spec.deep else image.geterror()
        if pixels is None or pixels.size == 0:
            raise ImageError(f"{name} cannot be read as an image ({_reason(reason, path, name)}); check the file.")
        return StoredImage(
            pixels=np.ascontiguousarray(pixels, dtype=np.float32).reshape(spec.height, spec.width, spec.nchannels),
            is_8bit=str(spec.format) in ("uint8", "int8"),
            color_space=_color_space(spec.get_string_attribute("oiio:ColorSpace")),
            wrap=_wrap(spec.get_string_attribute("wrapmodes")),
        )
    finally:
        image.close()


def _reason(text: str, path: str, name: str) -> str:
    """OpenImageIO's message on one line, speaking of the file by the name the user knows."""
    return " ".join(text.replace(path, name).split()).rstrip(".") or "unknown reason"


def _color_space(token: str) -> str:
    lowered = token.lower()
    if lowered.startswith(("lin", "scene_linear", "raw", "data", "aces")):
        return "linear"
    return "srgb" if lowered.startswith("srgb") else ""


def _wrap(modes: str) -> tuple[str, str]:
    words = [_WRAP.get(word.strip().lower(), "") for word in modes.split(",")] if modes else [""]
    return words[0], words[-1]
